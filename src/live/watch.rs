//! Shows a closed-loop drive in real time.

use std::time::{Duration, Instant};

use super::messages::{RunResult, State};
use super::playback::PlaybackClock;
use super::server::Live;
use crate::error::Result;
use crate::observer::{Observer, StopSignal};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::explain::saliency::Saliency;
use crate::simulator::camera::jpeg;
use crate::simulator::trial::outcome::{Trial, line_errors_m};
use crate::simulator::{DriveEvent, DriveFrame, HEIGHT, TrialOptions, WIDTH};

/// Longest time until a wait notices that it has to end.
const TICK: Duration = Duration::from_millis(50);
/// A drive that was paused goes on when nobody has looked for so long.
const LONGEST_PAUSE_ALONE: Duration = Duration::from_secs(10);
/// Largest number of results on the page.
const MAX_RESULTS: usize = 12;

/// Shows the runs of a drive on a page, in real time.
pub struct Watch<'a> {
    live: &'a Live,
    stop: &'a StopSignal,
    driver: &'a str,
    /// A copy of the pilot, and its saliency. The driver itself is left alone, so that its drive stays the same.
    saliency: Option<(Pilot, Saliency)>,
    runs: usize,
    clock: PlaybackClock,
    shown: Shown,
    results: Vec<RunResult>,
    /// The run, without its driver.
    run: String,
    title: String,
    trail_id: u64,
    /// Number of seeds begun. A seed may be driven twice.
    begun: usize,
    seed: Option<u64>,
    image: RgbImage,
}

/// The last frame on the page.
#[derive(Default)]
pub(super) struct Shown {
    state: State,
    camera_jpeg: Vec<u8>,
    saliency_jpeg: Vec<u8>,
}

impl Shown {
    /// Shows a frame, whose JPEGs `draw` makes if anybody looks.
    ///
    /// # Errors
    ///
    /// Those of `draw`.
    pub fn show(
        &mut self,
        live: &Live,
        state: State,
        draw: impl FnOnce(&mut Vec<u8>, &mut Vec<u8>) -> Result<()>,
    ) -> Result<()> {
        live.extend_trail(&state);
        if live.viewers() == 0 {
            return Ok(());
        }
        self.camera_jpeg.clear();
        self.saliency_jpeg.clear();
        draw(&mut self.camera_jpeg, &mut self.saliency_jpeg)?;
        self.state = State { playback: Some(live.playback()), ..state };
        live.publish(&self.state, &self.camera_jpeg, &self.saliency_jpeg);
        Ok(())
    }

    /// Waits on `clock` until the run with trail `trail_id` has reached the simulated time `time_s`. What the pages ask for
    /// meanwhile is shown at once.
    ///
    /// # Errors
    ///
    /// [`Error::Interrupted`](crate::Error::Interrupted) if the stop is requested.
    pub fn wait(
        &mut self,
        clock: &mut PlaybackClock,
        live: &Live,
        (trail_id, time_s): (u64, f64),
        stop: &StopSignal,
    ) -> Result<()> {
        let mut alone_since = None;
        loop {
            stop.check()?;
            let playback = live.playback();
            if playback.paused && live.viewers() == 0 {
                let since = *alone_since.get_or_insert_with(Instant::now);
                if since.elapsed() > LONGEST_PAUSE_ALONE {
                    live.play();
                }
            } else {
                alone_since = None;
            }
            if self.state.playback.is_some_and(|shown| shown != playback) {
                self.state.playback = Some(playback);
                live.publish(&self.state, &self.camera_jpeg, &self.saliency_jpeg);
            }
            let left = clock.until(time_s, trail_id, &playback, Instant::now());
            if left.is_some_and(|left| left.is_zero()) {
                return Ok(());
            }
            std::thread::sleep(left.unwrap_or(TICK).min(TICK));
        }
    }
}

impl<'a> Watch<'a> {
    /// Shows `runs` seeds of `driver` on `live` until `stop` is requested. `pilot` is the model that drives, if any.
    pub fn new(live: &'a Live, driver: &'a str, pilot: Option<&Pilot>, runs: usize, stop: &'a StopSignal) -> Watch<'a> {
        // Trails are counted anew.
        live.play();
        // A network without a convolution has no saliency.
        let saliency = pilot.and_then(|pilot| Some((pilot.clone(), Saliency::new(pilot.network()).ok()?)));
        Watch {
            live,
            stop,
            driver,
            saliency,
            runs,
            clock: PlaybackClock::start(Instant::now()),
            shown: Shown::default(),
            results: Vec::new(),
            run: String::new(),
            title: String::new(),
            trail_id: 0,
            begun: 0,
            seed: None,
            image: RgbImage { height: HEIGHT, width: WIDTH, pixels: vec![0; HEIGHT * WIDTH * 3] },
        }
    }
}

impl<'e> Observer<DriveEvent<'e>> for Watch<'_> {
    fn observe(&mut self, event: DriveEvent<'e>) -> Result<()> {
        match event {
            DriveEvent::Begin { seed, options } => self.begin(seed, options),
            DriveEvent::Frame(frame) => return self.frame(frame),
            DriveEvent::End(trial) => self.end(trial),
        }
        Ok(())
    }
}

impl Watch<'_> {
    fn begin(&mut self, seed: u64, options: &TrialOptions) {
        self.begun += usize::from(self.seed != Some(seed));
        (self.seed, self.trail_id) = (Some(seed), self.trail_id + 1);
        self.clock = PlaybackClock::start(Instant::now());
        let help = if options.assisted { "again, put back when 1 m off the middle" } else { "without help" };
        self.run = format!("run {} of {} (seed {seed}), {help}", self.begun, self.runs);
        self.title = format!("{}, {}", self.driver, self.run);
    }

    fn end(&mut self, trial: &Trial) {
        self.results.push(RunResult {
            run: self.run.clone(),
            laps: trial.laps_completed,
            failure: trial.failure,
            put_back: trial.interventions,
            time_s: trial.time_s,
            cte_mean_m: line_errors_m(trial.moments.iter())[0],
        });
        let too_many = self.results.len().saturating_sub(MAX_RESULTS);
        self.results.drain(..too_many);
    }

    fn frame(&mut self, frame: &DriveFrame) -> Result<()> {
        let moment = (self.trail_id, frame.simulation.time_s());
        self.shown.wait(&mut self.clock, self.live, moment, self.stop)?;
        let state = State {
            title: self.title.clone(),
            trail_id: self.trail_id,
            steering: frame.steering,
            throttle: frame.throttle,
            put_back: frame.interventions,
            results: self.results.clone(),
            ..State::of(frame.simulation)
        };
        let Watch { saliency, image, .. } = self;
        self.shown.show(self.live, state, |camera_jpeg, saliency_jpeg| {
            jpeg::encode(frame.picture, camera_jpeg)?;
            if let Some((pilot, saliency)) = saliency {
                saliency.steer(pilot, frame.picture.view())?;
                image.pixels.copy_from_slice(&frame.picture.pixels);
                saliency.overlay(&pilot.recipe().preprocessing, image);
                *saliency_jpeg = image.to_jpeg();
            }
            Ok(())
        })
    }
}
