//! Keeping held-out tracks out of training.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use crate::error::{Error, Result};

/// What is of interest in `recording.toml`.
#[derive(Deserialize)]
struct Side {
    track: String,
    held_out: bool,
}

/// The held-out tracks that `recordings` (folders, or their logs) were made on, by the `recording.toml` beside the log.
/// Recordings without one were not made by this simulator and count as free.
///
/// # Errors
///
/// [`Error::Io`] or [`Error::Data`] for a `recording.toml` that cannot be read.
pub fn held_out_tracks<P: AsRef<Path>>(recordings: &[P]) -> Result<Vec<String>> {
    let mut tracks = Vec::new();
    for recording in recordings {
        let recording = recording.as_ref();
        let folder = if recording.is_file() { recording.parent().unwrap_or(Path::new("")) } else { recording };
        let side = folder.join("recording.toml");
        if side.is_file() {
            let text = std::fs::read_to_string(&side).map_err(Error::io(&side))?;
            let side: Side = toml::from_str(&text).map_err(|e| Error::data(&side, e.message()))?;
            if side.held_out && !tracks.contains(&side.track) {
                tracks.push(side.track);
            }
        }
    }
    Ok(tracks)
}

/// Refuses to train on held-out tracks unless `forced`; returns those that are trained on all the same.
///
/// # Errors
///
/// [`Error::Usage`] naming the tracks; as [`held_out_tracks`].
pub fn check(recordings: &[PathBuf], forced: bool) -> Result<Vec<String>> {
    let tracks = held_out_tracks(recordings)?;
    if tracks.is_empty() || forced {
        return Ok(tracks);
    }
    Err(Error::Usage(format!(
        "these recordings show {}, held out to test what was learned elsewhere; leave them out, or train on them with \
         --force-held-out",
        tracks.join(", ")
    )))
}

/// What every report on a model says that was trained on the held-out `tracks`.
pub fn trained_on_held_out(tracks: &[String]) -> String {
    format!("trained on {}, held-out tracks: driving there shows nothing about new roads", tracks.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn held_out_recordings_are_refused_unless_forced() {
        let folder = tempfile::tempdir().unwrap();
        let make = |name: &str, side: &str| {
            let path = folder.path().join(name);
            std::fs::create_dir(&path).unwrap();
            std::fs::write(path.join("driving_log.csv"), "").unwrap();
            std::fs::write(path.join("recording.toml"), side).unwrap();
            path
        };
        let free = make("free", "track = 'lake'\nheld_out = false\nseed = 1");
        let kept = make("kept", "track = 'coast'\nheld_out = true");
        assert!(check(&[free.clone(), folder.path().to_path_buf()], false).unwrap().is_empty());
        for path in [kept.clone(), kept.join("driving_log.csv")] {
            let error = check(&[free.clone(), path.clone()], false).unwrap_err().to_string();
            assert!(error.contains("show coast,") && error.contains("--force-held-out"), "{error}");
            assert_eq!(check(&[free.clone(), path], true).unwrap(), ["coast"]);
        }
        let broken = make("broken", "track = 3");
        assert!(matches!(check(&[broken], true), Err(Error::Data { .. })));
    }
}
