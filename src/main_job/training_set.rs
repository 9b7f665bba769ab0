//! What the main job trains on: drives of the expert on training tracks, recorded once and used again.

use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Serialize;
use sha2::{Digest, Sha256};

use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::geometry::CarGeometry;
use crate::observer::{Observer, Progress};
use crate::recipe::Recipe;
use crate::simulator::{RecordOptions, RecordRequest, Track, record_all};

/// Random tracks in the set. Variety of looks teaches more than laps: each is driven for a fraction of a lap.
pub const RANDOM_TRACKS: u64 = 48;
/// Hash of the simulator's pictures and drives. It is part of a set's name, so a set is recorded again when the simulator has
/// changed. Computing it builds several worlds, which takes long, so a test computes it, and prints the new hash when the
/// simulator has changed.
const SIMULATOR: &str = "7f7e81b7c041362f";
/// Rows per second: one every 1.8 m at 20 mph. Twice the road teaches more than twice the frames of the same road.
const HZ: u64 = 5;
/// Seed of the first recording; far from the seeds of drives, so that starts and light differ.
const FIRST_SEED: u64 = 101;

/// One recording of the set.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Take {
    /// Track as on the command line.
    pub track: String,
    /// See [`RecordOptions::laps`].
    pub laps: f64,
    /// Driven the other way round.
    pub reverse: bool,
    /// Only ways back to the line.
    pub recovery: bool,
    /// Draws start, light and texture.
    pub seed: u64,
    /// See [`RecordOptions::label_ahead_m`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label_ahead_m: Option<f64>,
}

impl Take {
    /// Name of the recording's folder.
    pub(super) fn folder(&self) -> String {
        let direction = if self.reverse { "-reverse" } else { "" };
        let kind = if self.recovery { "-recovery" } else { "" };
        format!("{}{direction}{kind}", self.track.replace(':', "-"))
    }

    pub(super) fn options(&self, car: Option<&CarGeometry>) -> RecordOptions {
        RecordOptions {
            laps: self.laps,
            reverse: self.reverse,
            recovery: self.recovery,
            seed: self.seed,
            hz: HZ,
            label_ahead_m: self.label_ahead_m,
            car: car.cloned(),
            ..Default::default()
        }
    }
}

/// The takes of the set, grouped by track: the training tracks in both directions, plain and recovery; then random tracks
/// in one direction plain and in the other with recovery, or the other way about.
pub fn takes() -> Vec<Take> {
    let mut takes = Vec::new();
    let mut take = |track: &str, laps, reverse, recovery| {
        let seed = FIRST_SEED + takes.len() as u64;
        takes.push(Take { track: track.into(), laps, reverse, recovery, seed, ..Take::default() });
    };
    for track in ["lake", "mountain"] {
        for (laps, recovery) in [(0.8, false), (0.4, true)] {
            take(track, laps, false, recovery);
            take(track, laps, true, recovery);
        }
    }
    for number in 1..=RANDOM_TRACKS {
        let track = format!("random:{number}");
        let odd = number % 2 == 1;
        take(&track, 0.2, odd, false);
        take(&track, 0.15, !odd, true);
    }
    takes
}

/// `takes` with labels as `recipe` wants them of the expert.
pub fn labelled(takes: &[Take], recipe: &Recipe) -> Vec<Take> {
    let label_ahead_m = recipe.labels.expert_ahead_m;
    takes.iter().map(|take| Take { label_ahead_m, ..take.clone() }).collect()
}

/// Everything that determines a set recorded as `car`, as text: the same text gives the same pictures.
fn settings(takes: &[Take], car: Option<&CarGeometry>) -> Result<String> {
    #[derive(Serialize)]
    struct Settings<'a> {
        version: &'a str,
        simulator: &'static str,
        hz: u64,
        tracks_hash: String,
        #[serde(skip_serializing_if = "Option::is_none")]
        car: Option<&'a CarGeometry>,
        take: &'a [Take],
    }
    let failed = |e: toml::ser::Error| Error::Fault(format!("the training set cannot be described: {e}"));
    let mut tracks = Sha256::new();
    for of_track in takes.chunk_by(|a, b| a.track == b.track) {
        tracks.update(toml::to_string(&Track::load(&of_track[0].track)?.spec).map_err(failed)?);
    }
    let (version, tracks_hash) = (env!("CARGO_PKG_VERSION"), digits(tracks));
    let settings = Settings { version, simulator: SIMULATOR, hz: HZ, tracks_hash, car, take: takes };
    toml::to_string(&settings).map_err(failed)
}

/// The first 16 digits of a hash.
fn digits(hash: Sha256) -> String {
    hash.finalize().iter().take(8).map(|byte| format!("{byte:02x}")).collect()
}

/// The recordings of `takes` under `folder`, in order, recorded as `car`, or as the simulator's own; records them first if they do
/// not exist. The flag is `true` if they
/// existed.
///
/// A set lies in a folder named after a hash of its settings. It is written under another name and renamed when it is
/// complete, so a set that exists is complete. `observer` is told the share that is recorded.
///
/// # Errors
///
/// [`Error::Io`] if something cannot be written, [`Error::Data`] if recordings were taken out of a set, and the observer's
/// own; nothing is left behind then.
pub fn recordings(
    folder: &Path,
    takes: &[Take],
    car: Option<&CarGeometry>,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<(Vec<PathBuf>, bool)> {
    let settings = settings(takes, car)?;
    let set = folder.join(format!("set-{}", digits(Sha256::new_with_prefix(&settings))));
    let paths: Vec<PathBuf> = takes.iter().map(|take| set.join(take.folder())).collect();
    if set.exists() {
        if let Some(gone) = paths.iter().find(|path| !path.join("recording.toml").is_file()) {
            let message = "this recording of the training set is gone or not whole; remove the folder of the set, it will \
                           be recorded again";
            return Err(Error::data(gone, message));
        }
        return Ok((paths, true));
    }
    let new = NewFolder::create(&set)?;
    let recorded = with_requests(takes, car, new.unfinished(), |requests| record_all(requests, observer));
    recorded.map_err(|error| new.explain(error))?;
    let side = new.unfinished().join("set.toml");
    std::fs::write(&side, settings).map_err(|source| new.explain(Error::Io { path: side, source }))?;
    new.finish()?;
    Ok((paths, false))
}

/// Lets `record` make the recordings of `takes`, as `car` sees them or the simulator's own, in folders of their own under `folder`.
///
/// # Errors
///
/// [`Error::Usage`] for held-out tracks; as `record`.
pub(super) fn with_requests<T>(
    takes: &[Take],
    car: Option<&CarGeometry>,
    folder: &Path,
    record: impl FnOnce(&[RecordRequest]) -> Result<T>,
) -> Result<T> {
    let load = |of_track: &[Take]| {
        let track = Track::load(&of_track[0].track)?;
        if track.held_out() {
            return Err(Error::Usage(format!("{} is held out; the training set must not have it", track.name())));
        }
        Ok((track, of_track.len()))
    };
    let of_tracks: Vec<&[Take]> = takes.chunk_by(|a, b| a.track == b.track).collect();
    let tracks: Vec<(Track, usize)> = of_tracks.into_par_iter().map(load).collect::<Result<_>>()?;
    let of_takes = tracks.iter().flat_map(|(track, takes)| std::iter::repeat_n(track, *takes));
    let request = |(track, take): (_, &Take)| RecordRequest {
        track,
        options: take.options(car),
        out: folder.join(take.folder()),
    };
    record(&of_takes.zip(takes).map(request).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::Unobserved;
    use crate::simulator::recorder::expert_drive::drive_expert;
    use crate::simulator::{Camera, Mount, Renderer, RgbFrame, Variant};

    #[test]
    fn a_recipe_that_looks_farther_ahead_has_a_set_of_its_own() {
        let takes = takes();
        let [own, eight, ten] =
            ["lenet", "default", "calm"].map(|name| labelled(&takes, &Recipe::find(name, &[]).unwrap()));
        assert_eq!(own, takes);
        for (ahead, metres) in [(&eight, 8.0), (&ten, 10.0)] {
            assert!(ahead.iter().all(|take| take.options(None).label_ahead_m == Some(metres)));
        }
        let [own, eight, ten] = [&own, &eight, &ten].map(|takes| settings(takes, None).unwrap());
        assert!(own != eight && own != ten && eight != ten && !own.contains("label_ahead_m"));
    }

    #[test]
    fn the_hash_of_the_simulator_is_that_of_what_it_draws_and_drives() {
        let mut hash = Sha256::new();
        let (mut renderer, mut frame) = (Renderer::default(), RgbFrame::default());
        for (name, recovery) in [("lake", false), ("mountain", true), ("random:1", false), ("random:2", true)] {
            let track = Track::load(name).unwrap();
            let take = Take {
                track: name.into(),
                laps: 1.0,
                reverse: recovery,
                recovery,
                seed: FIRST_SEED,
                ..Default::default()
            };
            let (variant, samples) =
                (Variant::new(track.world(), take.seed), drive_expert(&track, &take.options(None)));
            for (k, sample) in samples.iter().enumerate() {
                hash.update(sample.time_s.to_le_bytes());
                hash.update(sample.steering.to_le_bytes());
                hash.update(sample.speed_mph.to_le_bytes());
                let mount = Mount::ALL[k % 3];
                renderer.render(track.world(), &variant, &Camera::new(&sample.body, mount), mount, &mut frame);
                hash.update(&frame.pixels);
            }
        }
        let now = digits(hash);
        assert_eq!(
            now, SIMULATOR,
            "the simulator draws or drives otherwise than before; if that is wanted, SIMULATOR becomes {now:?}, and training \
             sets are recorded anew"
        );
    }

    #[test]
    fn held_out_tracks_look_like_no_training_track() {
        use crate::simulator::road::spec::{Centre, Edge, Plant, Surface, Wall};
        let reserved = |track: &Track| {
            let looks = &track.spec.look;
            let surface = looks.iter().any(|l| matches!(l.surface, Surface::Concrete | Surface::Gravel));
            let edge =
                looks.iter().any(|l| [l.left, l.right].iter().any(|e| matches!(e, Edge::Dashes | Edge::Overgrown)));
            let centre = looks.iter().any(|l| l.centre == Centre::Yellow);
            let plants = &track.spec.land.plants;
            let plant = plants.iter().any(|p| matches!(p, Plant::Cypress | Plant::Fir | Plant::Birch));
            let walls = track.spec.stretch.iter().flat_map(|s| [s.left_wall, s.right_wall]);
            let wall = walls.flatten().any(|w| matches!(w, Wall::Stone | Wall::Fence));
            [surface, edge, plant, wall, centre]
        };
        for name in ["coast", "forest"] {
            assert_eq!(reserved(&Track::load(name).unwrap())[..4], [true; 4], "{name}");
        }
        assert!(reserved(&Track::load("coast").unwrap())[4]);
        for take in takes() {
            assert_eq!(reserved(&Track::load(&take.track).unwrap()), [false; 5], "{}", take.track);
        }
    }

    fn few() -> Vec<Take> {
        let take = |track: &str, recovery, seed| Take {
            track: track.into(),
            laps: 0.01,
            reverse: true,
            recovery,
            seed,
            ..Default::default()
        };
        vec![take("lake", false, 1), take("lake", true, 2), take("random:4", false, 3)]
    }

    #[test]
    fn the_set_has_both_training_tracks_in_both_directions_with_recovery_and_no_held_out_track() {
        let takes = takes();
        for track in ["lake", "mountain"] {
            for (reverse, recovery) in [(false, false), (false, true), (true, false), (true, true)] {
                let wanted = |t: &&Take| t.track == track && t.reverse == reverse && t.recovery == recovery;
                assert_eq!(takes.iter().filter(wanted).count(), 1, "{track} {reverse} {recovery}");
            }
        }
        assert!(takes.iter().all(|take| !Track::load(&take.track).unwrap().held_out()));
        let mut folders: Vec<String> = takes.iter().map(Take::folder).collect();
        folders.sort();
        folders.dedup();
        assert_eq!(folders.len(), takes.len());
    }

    #[test]
    fn a_set_is_recorded_once_and_one_that_lacks_something_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let (paths, reused) = recordings(folder.path(), &few(), None, &mut Unobserved).unwrap();
        assert!(!reused && paths.len() == 3 && paths.iter().all(|path| path.join("driving_log.csv").is_file()));
        let again = recordings(folder.path(), &few(), None, &mut |_| panic!("nothing is to be recorded")).unwrap();
        assert_eq!(again, (paths.clone(), true));
        let other: Vec<Take> = few().into_iter().map(|take| Take { seed: take.seed + 10, ..take }).collect();
        assert!(recordings(folder.path(), &other, None, &mut Unobserved).unwrap().0[0] != paths[0]);
        std::fs::remove_file(paths[1].join("recording.toml")).unwrap();
        let error = recordings(folder.path(), &few(), None, &mut Unobserved).unwrap_err().to_string();
        assert!(error.contains("recorded again"), "{error}");
    }

    #[test]
    fn what_is_stopped_or_refused_leaves_nothing_behind() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(
            recordings(folder.path(), &few(), None, &mut |_| Err(Error::Interrupted)),
            Err(Error::Interrupted)
        ));
        let held_out = vec![Take { track: "coast".into(), ..few()[0].clone() }];
        assert!(
            recordings(folder.path(), &held_out, None, &mut Unobserved).unwrap_err().to_string().contains("held out")
        );
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
