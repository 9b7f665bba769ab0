//! The video of a run as it is driven.

use std::path::Path;

use super::film::Video;
use super::onlooker::Onlooker;
use super::painter::{Captions, FilmFrame, FilmScales, Painter};
use super::summary::VideoSummary;
use crate::calm::Calm;
use crate::error::{Error, Result};
use crate::observer::{Observer, Progress};
use crate::picture::RgbImage;
use crate::simulator::car::dynamics::MAX_STEER_DEG;
use crate::simulator::car::expert::pursuit;
use crate::simulator::trial::outcome::{DRIVE_HZ, Failure};
use crate::simulator::{
    DriveEvent, DriveFrame, Driver, HEIGHT, Simulation, Track, Trial, TrialOptions, WIDTH, run_trial_observed,
};

/// A video of a run that is yet to be driven.
pub struct DriveVideo {
    video: Video,
    frame: FilmFrame,
    /// Colours the picture, if that was asked for; steers nothing.
    onlooker: Option<Onlooker>,
}

/// Films while the run goes on.
struct FilmObserver<'a> {
    film: &'a mut DriveVideo,
    /// Whether the driver looks at pictures, so that its time to answer means something.
    looks: bool,
    observer: &'a mut dyn Observer<Progress>,
}

impl DriveVideo {
    /// A video in the new file `path` of a run on `track`, with `fps` pictures a second, as many as the driver sees if none is
    /// given. `names.model` drives.
    ///
    /// # Errors
    ///
    /// As [`Video::create`].
    pub fn create(
        path: &Path,
        track: &Track,
        names: Captions,
        fps: Option<f64>,
        onlooker: Option<Onlooker>,
    ) -> Result<DriveVideo> {
        let saliency = onlooker.as_ref().is_some_and(Onlooker::colours);
        let video = Video::create(
            path,
            Painter::new(names, scales(track), Some(track), saliency),
            fps.unwrap_or(DRIVE_HZ as f64),
        )?;
        let frame = FilmFrame { picture: RgbImage::filled(HEIGHT, WIDTH, [0; 3]), ..FilmFrame::default() };
        Ok(DriveVideo { video, frame, onlooker })
    }

    /// Drives the run `seed`, as [`run`](crate::simulator::trial::run::run_trial) does and to the same bits, and writes the video. `observer`
    /// is told the share of the way that is made. If it returns [`Error::Interrupted`], what there is by then is written, and the
    /// second value is `true`.
    ///
    /// # Errors
    ///
    /// If a picture cannot be encoded or the file cannot be written.
    pub fn film(
        mut self,
        track: &Track,
        driver: &mut dyn Driver,
        options: &TrialOptions,
        seed: u64,
        observer: &mut dyn Observer<Progress>,
    ) -> Result<(VideoSummary, bool)> {
        let looks = driver.needs_frame();
        match run_trial_observed(track, driver, options, seed, &mut FilmObserver { film: &mut self, looks, observer }) {
            Ok(run) => Ok((self.video.finish(&outcome(&run, options))?, false)),
            Err(Error::Interrupted) => Ok((self.video.finish("stopped")?, true)),
            Err(error) => Err(error),
        }
    }
}

impl<'e> Observer<DriveEvent<'e>> for FilmObserver<'_> {
    fn observe(&mut self, event: DriveEvent<'e>) -> Result<()> {
        match event {
            DriveEvent::Begin { .. } | DriveEvent::End(_) => Ok(()),
            DriveEvent::Frame(frame) => self.frame(frame),
        }
    }
}

impl FilmObserver<'_> {
    fn frame(&mut self, driven: &DriveFrame) -> Result<()> {
        let DriveVideo { video, frame, onlooker } = &mut *self.film;
        let simulation = driven.simulation;
        frame.picture.pixels.clone_from(&driven.picture.pixels);
        if let Some(onlooker) = onlooker {
            onlooker.look(&mut frame.picture)?;
        }
        frame.time_s = simulation.time_s();
        frame.model_deg = Some(driven.steering * MAX_STEER_DEG);
        frame.reference_deg = Some(driven.expert_steering * MAX_STEER_DEG);
        frame.speed_mph = Some(driven.speed_mph);
        frame.cte_m = Some(simulation.cte_m());
        frame.answered_in = self.looks.then_some(driven.answered_in);
        frame.lap = Some((driven.lap(), Some(driven.options.laps)));
        frame.place = Some([simulation.car.x, simulation.car.y]);
        frame.put_back = driven.put_back;
        video.show(frame)?;
        let way_m = driven.options.laps as f64 * simulation.track.length_m;
        self.observer.observe(Progress((simulation.progress_m / way_m).clamp(0.0, 1.0)))
    }
}

/// Scales for a drive on `track` that is yet to come: those that the expert needs. Its car is a metre from the line at most.
fn scales(track: &Track) -> FilmScales {
    let angles = track.stations.iter().step_by(5).map(|station| {
        let heading_deg = station.ty.atan2(station.tx).to_degrees();
        pursuit(&Simulation::posed(track, [station.x, station.y], heading_deg, 10.0)) * MAX_STEER_DEG
    });
    FilmScales { darkest_m: 1.0, ..FilmScales::covering(angles, [].into_iter()) }
}

/// What a run came to, in a few words.
fn outcome(run: &Trial, options: &TrialOptions) -> String {
    let time_s = run.time_s;
    match run.failure {
        Some(Failure::Crash) => format!("hit a wall after {time_s:.1} s"),
        Some(Failure::LeftRoad) => format!("left the road after {time_s:.1} s"),
        Some(Failure::StoodStill) => format!("stood still after {time_s:.1} s"),
        Some(Failure::Disqualified) => format!("disqualified after {time_s:.1} s"),
        None if run.laps_completed < options.laps => format!("too slow: stopped after {time_s:.1} s"),
        None if run.interventions > 0 => format!("{time_s:.1} s, put back {} times", run.interventions),
        None => {
            let laps = if options.laps == 1 { "lap".into() } else { format!("{} laps", options.laps) };
            let calm = Calm::of([run.calm_frames()]);
            format!("{laps} completed in {time_s:.1} s, {:.0} wheel reversals/min", calm.reversals_per_min)
        }
    }
}
