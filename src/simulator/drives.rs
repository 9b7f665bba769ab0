//! Drives of one driver on several tracks, or with several options, whose seeds are shared out among the ranks.

use std::sync::{Arc, Mutex, PoisonError};

use serde::{Deserialize, Serialize};

use crate::cluster::message::{Message, join, split_first, written};
use crate::cluster::tasks::{Ran, Work, run};
use crate::observer::{Observer, Progress, Tally};
use crate::pilot::Pilot;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::recorder::expert_drive::drive_expert;
use crate::simulator::recorder::options::RecordOptions;
use crate::simulator::road::spec::TrackSpec;
use crate::simulator::track::Track;
use crate::simulator::trial::drive::{Measured, measure, put_together};
use crate::simulator::trial::summary::{DriveOptions, DriveResult};
use crate::simulator::trial::wheel::Wheel;
use crate::{Error, Result};

/// Frames of the expert's drive that the offline error is taken over.
const OFFLINE_FRAMES: usize = 300;

/// One drive of several.
#[derive(Clone)]
pub struct Leg {
    /// The track. Legs that share it share its visible world.
    pub track: Arc<Track>,
    /// How it is driven.
    pub options: DriveOptions,
}

/// What came of a [`Leg`].
#[derive(Clone, Debug)]
pub struct LegResult {
    /// The seeds that were driven; `None` if there are none.
    pub drive: Option<DriveResult>,
    /// Mean absolute error on frames of the expert's drive, if it was asked for; see [`offline_mae_deg`].
    pub offline_mae_deg: Option<f64>,
    /// Whether all of it was done.
    pub complete: bool,
}

/// Lets `wheel` drive all `legs`, on all ranks; with `offline` a model's [error](offline_mae_deg) is measured as well. The results are in the
/// order of the legs; the flag is `true` if the observer ended it with [`Error::Interrupted`], and then they hold what was driven until then.
///
/// # Errors
///
/// Impossible options, a picture that cannot be encoded, and the observer's own; [`Error::Interrupted`] if nothing was driven until then.
pub fn drive_legs(
    wheel: &Wheel,
    legs: Vec<Leg>,
    offline: bool,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<(Vec<LegResult>, bool)> {
    legs.iter().try_for_each(|leg| leg.options.check())?;
    let mut tasks = Vec::new();
    for (leg, Leg { options, .. }) in legs.iter().enumerate() {
        tasks.extend((offline && wheel.pilot().is_some()).then_some(Task::Offline(leg)));
        tasks.extend((0..options.runs).map(|k| Task::Seed(leg, k)));
    }
    let work = Drives { wheel: wheel.clone(), legs };
    let tally = Tally::new(tasks.len(), observer);
    let done: Vec<Mutex<Option<Done>>> = tasks.iter().map(|_| Mutex::default()).collect();
    let Ran { threads, ended } = run(
        &work,
        tasks.len(),
        |number| Ok(tasks[number]),
        |number, result| {
            *done[number].lock().unwrap_or_else(PoisonError::into_inner) = Some(result);
            tally.add(1)
        },
    );
    let stopped = match ended {
        Ok(()) => false,
        Err(Error::Interrupted) => true,
        Err(error) => return Err(error),
    };
    let mut done = done.into_iter().map(|done| done.into_inner().unwrap_or_else(PoisonError::into_inner));
    let mut results = Vec::with_capacity(work.legs.len());
    let of_legs = tasks.chunk_by(|a, b| a.leg() == b.leg());
    for (Leg { track, options }, of_leg) in work.legs.iter().zip(of_legs) {
        let (mut measured, mut offline_mae_deg, mut complete) = (Vec::new(), None, true);
        for done in done.by_ref().take(of_leg.len()) {
            match done {
                Some(Done::Seed(seed)) => measured.push(Ok(*seed)),
                Some(Done::Offline(bits)) => offline_mae_deg = Some(f64::from_bits(bits)),
                None => complete = false,
            }
        }
        let drive = match measured.is_empty() {
            true => None,
            false => Some(put_together(track, options, measured, threads)?),
        };
        let drive = drive.map(|mut drive| {
            drive.summary.trained_on_held_out = wheel.trained_on_held_out().to_vec();
            drive
        });
        results.push(LegResult { drive, offline_mae_deg, complete });
    }
    match stopped && results.iter().all(|result| result.drive.is_none()) {
        true => Err(Error::Interrupted),
        false => Ok((results, stopped)),
    }
}

/// Mean absolute error of `pilot` on frames that the expert sees on `track` in a drive drawn by `seed`, in degrees of the
/// front wheels: what evaluation of recordings calls MAE. The labels look as far ahead as those that the pilot learned from
/// ([`LabelSpec::expert_ahead_m`](crate::dataset::LabelSpec::expert_ahead_m)).
///
/// # Errors
///
/// [`Error::Codec`] if a picture cannot be encoded.
pub fn offline_mae_deg(pilot: &Pilot, track: &Track, seed: u64) -> Result<f64> {
    let label_ahead_m = pilot.recipe().labels.expert_ahead_m;
    let samples = drive_expert(track, &RecordOptions { seed, label_ahead_m, ..Default::default() });
    let (mut pilot, mut eye) = (pilot.clone(), FrontCamera::new(track, seed));
    if samples.is_empty() {
        return Err(Error::Data {
            place: track.name().into(),
            message: "the expert makes no way on this track".into(),
        });
    }
    let mut sum = 0.0;
    let count = samples.len().min(OFFLINE_FRAMES);
    for sample in spread(samples.len(), count).map(|k| &samples[k]) {
        let frame = eye.look_from(&sample.body)?;
        let steering = pilot.steer(frame.view())?;
        sum += (f64::from(steering) - sample.steering).abs();
    }
    Ok(sum / count as f64 * pilot.recipe().full_lock_deg)
}

/// `count` of the indices 0 to `len`, evenly spread.
fn spread(len: usize, count: usize) -> impl Iterator<Item = usize> {
    (0..count).map(move |k| k * len / count)
}

/// The work of [`drive_legs`].
pub(crate) struct Drives {
    wheel: Wheel,
    legs: Vec<Leg>,
}

#[derive(Clone, Copy, Serialize, Deserialize)]
pub(crate) enum Task {
    /// The model's error on the expert's frames of the first seed of a leg.
    Offline(usize),
    /// A seed of a leg.
    Seed(usize, usize),
}

impl Task {
    fn leg(self) -> usize {
        match self {
            Task::Offline(leg) | Task::Seed(leg, _) => leg,
        }
    }
}

#[derive(Serialize, Deserialize)]
pub(crate) enum Done {
    /// The bits of the error, which may be no number.
    Offline(u64),
    Seed(Box<Measured>),
}

impl Work for Drives {
    const NAME: &'static str = "drive";
    type Task = Task;
    type Done = Done;

    fn perform(&self, task: Task) -> Result<Done> {
        let Leg { track, options } = &self.legs[task.leg()];
        match (task, self.wheel.pilot()) {
            (Task::Seed(_, k), _) => {
                let new_driver = || Ok(self.wheel.driver());
                Ok(Done::Seed(Box::new(measure(track, &new_driver, options, k as u64, None)?)))
            }
            (Task::Offline(_), Some(pilot)) => {
                Ok(Done::Offline(offline_mae_deg(pilot, track, options.seed)?.to_bits()))
            }
            (Task::Offline(_), None) => Err(Error::Fault("a driver that is no model has no offline error".into())),
        }
    }
}

impl Message for Drives {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let mut tracks: Vec<&Arc<Track>> = Vec::new();
        let mut legs = Vec::new();
        for Leg { track, options } in &self.legs {
            let known = tracks.iter().position(|known| Arc::ptr_eq(known, track));
            legs.push((known.unwrap_or(tracks.len()), options));
            if known.is_none() {
                tracks.push(track);
            }
        }
        let specs: Vec<&TrackSpec> = tracks.iter().map(|track| &track.spec).collect();
        Ok(join([self.wheel.to_bytes()?, written(&(specs, legs))?]))
    }

    fn of_bytes(bytes: &[u8]) -> Result<Drives> {
        let ([wheel, legs], _) = split_first::<2>(bytes)?;
        let (specs, legs): (Vec<TrackSpec>, Vec<(usize, DriveOptions)>) = Message::of_bytes(legs)?;
        let tracks: Vec<Arc<Track>> = specs.into_iter().map(|spec| Arc::new(Track::again(spec))).collect();
        let leg = |(track, options): (usize, DriveOptions)| match tracks.get(track) {
            Some(track) => Ok(Leg { track: track.clone(), options }),
            None => Err(Error::Fault("a drive of another rank lacks its track".into())),
        };
        Ok(Drives { wheel: Wheel::of_bytes(wheel)?, legs: legs.into_iter().map(leg).collect::<Result<_>>()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model_file::Model;
    use crate::observer::Unobserved;
    use crate::recipe::Recipe;
    use crate::simulator::car::speed::Speed;
    use crate::simulator::trial::drive::drive;
    use steersman_kernels::Isa;

    #[test]
    fn the_frames_of_the_offline_error_are_spread_over_the_whole_drive() {
        for len in [300, 301, 599, 899, 1500] {
            let places: Vec<usize> = spread(len, OFFLINE_FRAMES).collect();
            assert!(places.len() == OFFLINE_FRAMES && places[0] == 0, "{len}");
            assert!(places.is_sorted_by(|a, b| a < b) && *places.last().unwrap() >= len - len.div_ceil(OFFLINE_FRAMES));
        }
    }

    #[test]
    fn the_offline_error_is_that_from_labels_as_far_ahead_as_those_that_were_learned() {
        let track = Track::load("lake").unwrap();
        let [own, farther] = [&[][..], &["labels.expert_ahead_m=12.0".into()]].map(|set| {
            let recipe = Recipe::find("lenet", set).unwrap();
            let parameters = recipe.network(Isa::PORTABLE).unwrap().initialize(1);
            let model = Model { recipe, parameters, record: Default::default(), training_rows: Vec::new() };
            offline_mae_deg(&Pilot::new(model, Isa::PORTABLE).unwrap(), &track, 1).unwrap()
        });
        assert!(own > 0.0 && farther > 0.0 && own != farther, "{own} {farther}");
    }

    fn legs() -> Vec<Leg> {
        let tracks = ["lake", "random:3"].map(|name| Arc::new(Track::load(name).unwrap()));
        let options = |runs, seed| DriveOptions { runs, seed, noise: 0.02, speed: Speed::Auto, ..Default::default() };
        [(0, options(2, 1)), (1, options(3, 5)), (0, options(1, 9))]
            .map(|(track, options)| Leg { track: tracks[track].clone(), options })
            .to_vec()
    }

    /// On another rank tracks and options are made again from what was sent.
    #[test]
    fn legs_have_the_results_of_drives_of_their_own_also_where_they_are_sent() {
        let (results, stopped) = drive_legs(&Wheel::Expert, legs(), true, &mut Unobserved).unwrap();
        assert!(!stopped && results.len() == 3);
        let sent = Drives { wheel: Wheel::Expert, legs: legs() }.to_bytes().unwrap();
        let sent = Drives::of_bytes(&sent).unwrap();
        assert!(Arc::ptr_eq(&sent.legs[0].track, &sent.legs[2].track));
        for ((result, leg), sent) in results.into_iter().zip(legs()).zip(sent.legs) {
            let new_driver = || Ok(Wheel::Expert.driver());
            let alone = drive(&leg.track, new_driver, &leg.options, &mut Unobserved).unwrap();
            let again = drive(&sent.track, new_driver, &sent.options, &mut Unobserved).unwrap();
            assert!(result.complete && result.offline_mae_deg.is_none());
            assert_eq!(result.drive.unwrap().trials, alone.trials);
            assert_eq!(again.trials, alone.trials);
        }
    }

    #[test]
    fn an_error_that_is_no_number_is_sent_as_it_is() {
        let sent = Done::Offline(f64::NAN.to_bits()).to_bytes().unwrap();
        let Done::Offline(bits) = Done::of_bytes(&sent).unwrap() else { panic!("no seed was sent") };
        assert!(f64::from_bits(bits).is_nan());
    }

    #[test]
    fn what_was_driven_before_a_stop_is_there() {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let mut seeds = 0;
        let mut observer = |_| {
            seeds += 1;
            if seeds == 3 { Err(Error::Interrupted) } else { Ok(()) }
        };
        let (results, stopped) = pool.install(|| drive_legs(&Wheel::Zero, legs(), false, &mut observer)).unwrap();
        let driven = results.iter().map(|result| result.drive.as_ref().map_or(0, |drive| drive.trials.len()));
        assert!(stopped && driven.eq([2, 1, 0]));
        assert!(results.iter().map(|result| result.complete).eq([true, false, false]));
        let nothing =
            pool.install(|| drive_legs(&Wheel::Zero, legs(), false, &mut |_| Err(Error::System("no".into()))));
        assert!(matches!(nothing, Err(Error::System(_))));
    }
}
