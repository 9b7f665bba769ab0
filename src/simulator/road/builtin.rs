//! The tracks that come with the program; they are part of the binary.

/// Name and text of each file in `data/tracks/`, by name.
const TRACKS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/tracks.rs"));

/// Names of the built-in tracks: those for training first, then those held out.
pub fn names() -> impl Iterator<Item = &'static str> {
    #[derive(serde::Deserialize)]
    struct Track {
        held_out: bool,
    }
    let side = |held_out: bool| {
        let is_there = move |text| toml::from_str::<Track>(text).is_ok_and(|track| track.held_out == held_out);
        TRACKS.iter().filter(move |(_, text)| is_there(text)).map(|(name, _)| *name)
    };
    side(false).chain(side(true))
}

/// Text of the track file `name`.
pub fn text(name: &str) -> Option<&'static str> {
    TRACKS.iter().find(|(n, _)| *n == name).map(|(_, text)| *text)
}

#[cfg(test)]
mod tests {
    #[test]
    fn training_tracks_come_first_and_none_is_left_out() {
        assert_eq!(super::names().collect::<Vec<_>>(), ["lake", "mountain", "coast", "forest"]);
    }
}
