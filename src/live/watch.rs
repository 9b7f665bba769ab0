//! Shows a closed-loop drive in real time.

use std::time::{Duration, Instant};

use super::messages::State;
use super::real_time::RealTime;
use super::server::Live;
use crate::error::Result;
use crate::observer::{Observer, StopSignal};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::explain::saliency::Saliency;
use crate::simulator::camera::jpeg;
use crate::simulator::{DriveEvent, DriveFrame, HEIGHT, TrialOptions, WIDTH};

/// Longest time until a wait notices that it has to end.
const TICK: Duration = Duration::from_millis(50);

/// Shows the runs of a drive on a page, in real time.
pub struct Watch<'a> {
    live: &'a Live,
    stop: &'a StopSignal,
    driver: &'a str,
    /// A copy of the pilot, and its saliency. The driver itself is left alone, so that its drive stays the same.
    saliency: Option<(Pilot, Saliency)>,
    runs: usize,
    real_time: Option<RealTime>,
    title: String,
    trail_id: u64,
    /// Number of seeds begun. A seed may be driven twice.
    begun: usize,
    seed: Option<u64>,
    image: RgbImage,
    camera_jpeg: Vec<u8>,
}

impl<'a> Watch<'a> {
    /// Shows `runs` seeds of `driver` on `live` until `stop` is requested. `pilot` is the model that drives, if any.
    pub fn new(live: &'a Live, driver: &'a str, pilot: Option<&Pilot>, runs: usize, stop: &'a StopSignal) -> Watch<'a> {
        // A network without a convolution has no saliency.
        let saliency = pilot.and_then(|pilot| Some((pilot.clone(), Saliency::new(pilot.network()).ok()?)));
        Watch {
            live,
            stop,
            driver,
            saliency,
            runs,
            real_time: None,
            title: String::new(),
            trail_id: 0,
            begun: 0,
            seed: None,
            image: RgbImage { height: HEIGHT, width: WIDTH, pixels: vec![0; HEIGHT * WIDTH * 3] },
            camera_jpeg: Vec::new(),
        }
    }

    /// Waits until the clock has reached the simulated time `time_s`.
    fn wait(&mut self, time_s: f64) -> Result<()> {
        let real_time = self.real_time.get_or_insert_with(|| RealTime::start(Instant::now()));
        loop {
            self.stop.check()?;
            let left = real_time.until(time_s, Instant::now());
            if left.is_zero() {
                return Ok(());
            }
            std::thread::sleep(left.min(TICK));
        }
    }
}

impl<'e> Observer<DriveEvent<'e>> for Watch<'_> {
    fn observe(&mut self, event: DriveEvent<'e>) -> Result<()> {
        match event {
            DriveEvent::Begin { seed, options } => self.begin(seed, options),
            DriveEvent::Frame(frame) => return self.frame(frame),
        }
        Ok(())
    }
}

impl Watch<'_> {
    fn begin(&mut self, seed: u64, options: &TrialOptions) {
        self.begun += usize::from(self.seed != Some(seed));
        (self.seed, self.real_time, self.trail_id) = (Some(seed), None, self.trail_id + 1);
        let help = if options.assisted { "again, put back when 1 m off the middle" } else { "without help" };
        self.title = format!("{}, run {} of {} (seed {seed}), {help}", self.driver, self.begun, self.runs);
    }

    fn frame(&mut self, frame: &DriveFrame) -> Result<()> {
        self.wait(frame.simulation.time_s())?;
        let mut state = State {
            trail_id: self.trail_id,
            steering: frame.steering,
            throttle: frame.throttle,
            put_back: frame.interventions,
            ..State::of(frame.simulation)
        };
        self.live.extend_trail(&state);
        if self.live.viewers() == 0 {
            return Ok(());
        }
        state.title.clone_from(&self.title);
        self.camera_jpeg.clear();
        jpeg::encode(frame.picture, &mut self.camera_jpeg)?;
        let mut saliency_jpeg = Vec::new();
        if let Some((pilot, saliency)) = &mut self.saliency {
            saliency.steer(pilot, frame.picture.view())?;
            self.image.pixels.copy_from_slice(&frame.picture.pixels);
            saliency.overlay(&pilot.recipe().preprocessing, &mut self.image);
            saliency_jpeg = self.image.to_jpeg();
        }
        self.live.publish(&state, &self.camera_jpeg, &saliency_jpeg);
        Ok(())
    }
}
