//! `train RECORDING --with-simulator`: the simulator's set, as the camera of a recording sees it; and what is told of recordings that are
//! trained on.

use std::path::{Path, PathBuf};

use super::job::{JobEvent, RECORDINGS, training_set};
use super::training_set::{self, Take};
use crate::dataset::held_out::{self, trained_on_held_out};
use crate::dataset::{self, Description, ImageCheck};
use crate::error::{Error, Result};
use crate::geometry::CarGeometry;
use crate::observer::{Observer, StopSignal};
use crate::recipe::Recipe;
use crate::simulator::camera::foreign_car;

/// What a training on a user's recordings may do beside.
#[derive(Clone, Copy, Debug)]
pub struct Allowed {
    /// Train on the simulator's set as well, with this share of an epoch if it is not the recipe's.
    pub with_simulator: Option<Option<f64>>,
    /// Train on recordings of held-out tracks all the same.
    pub held_out: bool,
}

/// Before a training of `recipe` on the recordings `training`, with `validation` as its other side, of all of which the user says `said`:
/// refuses held-out tracks, sets the simulator's share in the recipe, and returns the recordings of the simulator's set, recorded now
/// if they are not there; none without it. `notice` is told what the user should know.
///
/// # Errors
///
/// [`Error::Usage`] for held-out tracks, for a share that cannot be, and with the simulator's set for recordings of different cameras or
/// of one that the simulator cannot have; as [`training_set`](fn@training_set) and [`dataset::load_with`].
pub fn beside_recordings(
    recipe: &mut Recipe,
    [training, validation]: [&[PathBuf]; 2],
    said: &Description,
    allowed: Allowed,
    notice: &mut dyn FnMut(&str),
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<PathBuf>> {
    if let Some(Some(share)) = allowed.with_simulator {
        recipe.samples.simulator_share = share;
        recipe.samples.validate()?;
    }
    let held_out = held_out::check(training, allowed.held_out)?;
    if !held_out.is_empty() {
        notice(&trained_on_held_out(&held_out));
    }
    recipe.labels.notice_of_recordings().into_iter().for_each(notice);
    if allowed.with_simulator.is_none() {
        return Ok(Vec::new());
    }
    let takes = training_set::labelled(&training_set::takes(), recipe);
    simulator_set(RECORDINGS.as_ref(), &takes, &[training, validation].concat(), said, observer, stop)
}

/// The recordings of `takes` under `folder` with camera and car of `recordings`, of which the user says `said`; recorded now if they
/// are not there.
///
/// # Errors
///
/// [`Error::Usage`] if the recordings have different cameras, or one that the simulator cannot have; as [`training_set`] and
/// [`dataset::load_with`].
fn simulator_set(
    folder: &Path,
    takes: &[Take],
    recordings: &[PathBuf],
    said: &Description,
    observer: &mut (dyn Observer<JobEvent> + Send),
    stop: &StopSignal,
) -> Result<Vec<PathBuf>> {
    let car = car_of(recordings, said)?;
    let own = car.as_ref().is_none_or(|car| *car == CarGeometry::simulator());
    training_set(folder, takes, car.as_ref().filter(|_| !own), observer, stop)
}

/// Camera and car of `recordings`; `None` if there are none.
fn car_of(recordings: &[PathBuf], said: &Description) -> Result<Option<CarGeometry>> {
    let mut first: Option<(&PathBuf, CarGeometry)> = None;
    for path in recordings {
        let car = dataset::load_with(path, said, ImageCheck::Skip)?.geometry;
        if let Some(trouble) = foreign_car::trouble(&car) {
            let message =
                format!("{}: --with-simulator cannot show its set as this camera sees: {trouble}", path.display());
            return Err(Error::Usage(message));
        }
        match &first {
            Some((other, known)) if *known != car => {
                let [other, path] = [other, path].map(|path| path.display());
                let message = "have different cameras or cars (steersman.toml), and --with-simulator can have only one";
                return Err(Error::Usage(format!("{other} and {path} {message}")));
            }
            Some(_) => {}
            None => first = Some((path, car)),
        }
    }
    Ok(first.map(|(_, car)| car))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::jpeg;
    use crate::observer::Unobserved;

    fn recording(folder: &Path, name: &str, camera: &str) -> PathBuf {
        let path = folder.join(name);
        std::fs::create_dir_all(path.join("IMG")).unwrap();
        std::fs::write(path.join("IMG/a.jpg"), jpeg(32, 16, [9, 9, 9])).unwrap();
        std::fs::write(path.join("driving_log.csv"), "IMG/a.jpg,,,0.1,1,0,20\n".repeat(3)).unwrap();
        std::fs::write(path.join("steersman.toml"), format!("[camera]\n{camera}\n")).unwrap();
        path
    }

    #[test]
    fn the_set_is_recorded_with_the_recordings_camera_and_by_itself_for_the_simulators() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path();
        let takes =
            [Take { track: "lake".into(), laps: 0.01, reverse: false, recovery: false, seed: 3, ..Take::default() }];
        let set = |recordings: &[PathBuf]| {
            let sets = folder.join("sets");
            simulator_set(&sets, &takes, recordings, &Description::default(), &mut Unobserved, &StopSignal::default())
        };
        let own = set(&[recording(folder, "own", "preset = \"steersman\"")]).unwrap();
        assert_eq!(
            own,
            training_set(&folder.join("sets"), &takes, None, &mut Unobserved, &StopSignal::default()).unwrap()
        );
        let udacity = recording(folder, "udacity", "preset = \"udacity\"\nfull_lock_deg = 20.0");
        let other = set(std::slice::from_ref(&udacity)).unwrap();
        assert_ne!(own, other);
        let [own, other] = [&own, &other].map(|set| dataset::load(&set[0]).unwrap());
        assert_eq!(other.geometry, dataset::load(&udacity).unwrap().geometry);
        assert!(other.camera_named && own.rows.len() == other.rows.len());
        // The same bends, in shares of a smaller lock, and another view of the same place.
        let turns = own.rows.iter().zip(&other.rows).filter(|(row, _)| row.steering.abs() > 0.02);
        assert!(turns.clone().count() > 0);
        turns.for_each(|(row, as_other)| assert!((as_other.steering / row.steering - 1.25).abs() < 1e-3));
        let [picture, as_other] =
            [&own, &other].map(|of| std::fs::read(of.image_path(0, dataset::View::Centre).unwrap()).unwrap());
        assert!(picture != as_other);
    }

    #[test]
    fn different_cameras_and_those_that_cannot_be_simulated_are_refused() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path();
        let cameras = ["udacity\"", "steersman\"", "donkeycar\"", "donkeycar\"\nfocal_px = 40.0"];
        let [a, b, small, fish_eye] =
            cameras.map(|camera| recording(folder, &camera.replace(['"', '\n'], ""), &format!("preset = \"{camera}")));
        let refused = |recordings: &[PathBuf]| car_of(recordings, &Description::default()).unwrap_err().to_string();
        assert!(refused(&[a.clone(), b]).contains("different cameras"));
        assert!(refused(&[fish_eye]).contains("its lens shows 127 degrees across"));
        assert_eq!(car_of(&[a.clone(), a], &Description::default()).unwrap(), CarGeometry::preset("udacity"));
        assert_eq!(car_of(&[small], &Description::default()).unwrap(), CarGeometry::preset("donkeycar"));
    }
}
