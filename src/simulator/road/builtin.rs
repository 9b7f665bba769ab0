//! The tracks that come with the program; they are part of the binary.

/// Name and text of every built-in track: the training tracks first, then those held out.
const TRACKS: [(&str, &str); 4] = [
    ("lake", include_str!("../../../data/tracks/lake.toml")),
    ("mountain", include_str!("../../../data/tracks/mountain.toml")),
    ("coast", include_str!("../../../data/tracks/coast.toml")),
    ("forest", include_str!("../../../data/tracks/forest.toml")),
];

/// Names of the built-in tracks.
pub fn names() -> impl Iterator<Item = &'static str> {
    TRACKS.iter().map(|(name, _)| *name)
}

/// Text of the track file `name`.
pub fn text(name: &str) -> Option<&'static str> {
    TRACKS.iter().find(|(n, _)| *n == name).map(|(_, text)| *text)
}
