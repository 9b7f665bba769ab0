//! A closed-loop drive, shown in real time.

use std::time::{Duration, Instant};

use super::clock::Clock;
use super::messages::State;
use super::server::Live;
use crate::error::Result;
use crate::observer::{Observer, StopSignal};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::explain::saliency::Saliency;
use crate::simulator::camera::jpeg;
use crate::simulator::{DriveEvent, DriveFrame, HEIGHT, RunOptions, WIDTH};

/// How soon a wait notices that it is to end.
const TICK: Duration = Duration::from_millis(50);

/// Shows the runs of a drive on a page, and holds them to the clock.
pub struct Watch<'a> {
    live: &'a Live,
    stop: &'a StopSignal,
    driver: &'a str,
    /// Who steers once more, to see what excites the network. Never the driver itself, whose drive must not change.
    saliency: Option<(Pilot, Saliency)>,
    runs: usize,
    clock: Option<Clock>,
    title: String,
    way: u64,
    /// Seeds begun; a seed may be driven twice.
    begun: usize,
    seed: Option<u64>,
    image: RgbImage,
    camera: Vec<u8>,
}

impl<'a> Watch<'a> {
    /// Shows `runs` seeds of `driver` on `live` until `stop` is requested. `pilot` is the model at the wheel, if one is.
    pub fn new(live: &'a Live, driver: &'a str, pilot: Option<&Pilot>, runs: usize, stop: &'a StopSignal) -> Watch<'a> {
        // A network without a convolution has no saliency to show.
        let saliency = pilot.and_then(|pilot| Some((pilot.clone(), Saliency::new(pilot.network()).ok()?)));
        Watch {
            live,
            stop,
            driver,
            saliency,
            runs,
            clock: None,
            title: String::new(),
            way: 0,
            begun: 0,
            seed: None,
            image: RgbImage { height: HEIGHT, width: WIDTH, pixels: vec![0; HEIGHT * WIDTH * 3] },
            camera: Vec::new(),
        }
    }

    /// Waits until the clock has come as far as the drive.
    fn wait(&mut self, time_s: f64) -> Result<()> {
        let clock = self.clock.get_or_insert_with(|| Clock::start(Instant::now()));
        loop {
            self.stop.check()?;
            let left = clock.until(time_s, Instant::now());
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
    fn begin(&mut self, seed: u64, options: &RunOptions) {
        self.begun += usize::from(self.seed != Some(seed));
        (self.seed, self.clock, self.way) = (Some(seed), None, self.way + 1);
        let help = if options.assisted { "again, put back when 1 m off the middle" } else { "without help" };
        self.title = format!("{}, run {} of {} (seed {seed}), {help}", self.driver, self.begun, self.runs);
    }

    fn frame(&mut self, frame: &DriveFrame) -> Result<()> {
        self.wait(frame.simulation.time_s())?;
        let mut state = State {
            way: self.way,
            steering: frame.steering,
            throttle: frame.throttle,
            put_back: frame.interventions,
            ..State::of(frame.simulation)
        };
        self.live.trace(&state);
        if self.live.viewers() == 0 {
            return Ok(());
        }
        state.title.clone_from(&self.title);
        self.camera.clear();
        jpeg::encode(frame.picture, &mut self.camera)?;
        let mut excited = Vec::new();
        if let Some((pilot, saliency)) = &mut self.saliency {
            saliency.steer(pilot, HEIGHT, WIDTH, &frame.picture.pixels)?;
            self.image.pixels.copy_from_slice(&frame.picture.pixels);
            saliency.overlay(&pilot.recipe().preprocessing, &mut self.image);
            excited = self.image.to_jpeg();
        }
        self.live.publish(&state, &self.camera, &excited);
        Ok(())
    }
}
