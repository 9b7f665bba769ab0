//! The class `Simulation`: a trial that is driven from outside, one frame after the other. The simulator has a thread of its own, in
//! which its track lives; orders go to it and frames come back.

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Mutex, PoisonError};

use ndarray::Array3;
use numpy::IntoPyArray;
use pyo3::prelude::*;
use pyo3::types::PyDict;

use super::arrays::plain;
use crate::error::{Error, Result};
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::car::expert;
use crate::simulator::car::speed::telemetry_mph;
use crate::simulator::trial::outcome::Failure;
use crate::simulator::{ClosedLoop, DriveOptions, HEIGHT, Pace, Speed, SpeedController, Track, TrialOptions, WIDTH};

/// What the simulator is told.
enum Order {
    /// A new trial.
    Reset { seed: u64, options: TrialOptions },
    /// Answer to the last frame; without a throttle the speed is held.
    Step { steering: f32, throttle: Option<f32> },
}

/// A frame, and what is known beside it.
struct Frame {
    pixels: Vec<u8>,
    time_s: f64,
    place_m: [f64; 2],
    heading_deg: f64,
    s_m: f64,
    cte_m: f64,
    speed_mph: f64,
    progress_m: f64,
    expert_steering: f64,
    interventions: usize,
    goes_on: bool,
    too_slow: bool,
    failure: Option<Failure>,
}

/// A trial under way.
#[pyclass(module = "steersman._native", frozen)]
pub(super) struct Simulation {
    #[pyo3(get)]
    track: String,
    #[pyo3(get)]
    length_m: f64,
    #[pyo3(get)]
    held_out: bool,
    ends: Mutex<(Sender<Order>, Receiver<Result<Frame>>)>,
}

#[pymethods]
impl Simulation {
    #[new]
    fn new(py: Python, track: &str) -> PyResult<Simulation> {
        let track = py.detach(|| Track::load(track))?;
        let (name, length_m, held_out) = (track.name().to_string(), track.length_m, track.held_out());
        let (to_simulator, orders) = channel();
        let (frames, from_simulator) = channel();
        let thread = std::thread::Builder::new().name("simulator".into());
        let started = thread.spawn(move || simulate(&track, &orders, &frames));
        started.map_err(|e| Error::System(format!("cannot start a thread: {e}")))?;
        Ok(Simulation { track: name, length_m, held_out, ends: Mutex::new((to_simulator, from_simulator)) })
    }

    /// Begins a trial whose start, direction, light and noise `seed` draws.
    #[pyo3(signature = (seed, *, laps, speed_mph, driver_throttle, latency_ms, noise, assisted))]
    #[allow(clippy::too_many_arguments, reason = "they have names in Python")]
    fn reset<'py>(
        &self,
        py: Python<'py>,
        seed: u64,
        laps: usize,
        speed_mph: f64,
        driver_throttle: bool,
        latency_ms: f64,
        noise: f64,
        assisted: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        let speed = if driver_throttle { Speed::Driver(speed_mph) } else { Speed::Fixed(speed_mph) };
        let options = DriveOptions { laps, runs: 1, seed, speed, latency_ms, noise };
        options.check()?;
        self.tell(py, Order::Reset { seed, options: options.trial_options(assisted) })
    }

    /// Answers the last frame and drives on to the next.
    #[pyo3(signature = (steering, throttle = None))]
    fn step<'py>(&self, py: Python<'py>, steering: f32, throttle: Option<f32>) -> PyResult<Bound<'py, PyDict>> {
        self.tell(py, Order::Step { steering, throttle })
    }
}

impl Simulation {
    fn tell<'py>(&self, py: Python<'py>, order: Order) -> PyResult<Bound<'py, PyDict>> {
        let gone = || Error::Fault("the simulator's thread has ended".into());
        let frame = py.detach(|| {
            let ends = self.ends.lock().unwrap_or_else(PoisonError::into_inner);
            ends.0.send(order).map_err(|_| gone())?;
            ends.1.recv().map_err(|_| gone())?
        })?;
        let dict = PyDict::new(py);
        let image = Array3::from_shape_vec((HEIGHT, WIDTH, 3), frame.pixels).expect("a frame has its size");
        dict.set_item("image", image.into_pyarray(py))?;
        dict.set_item("time_s", frame.time_s)?;
        dict.set_item("x_m", frame.place_m[0])?;
        dict.set_item("y_m", frame.place_m[1])?;
        dict.set_item("heading_deg", frame.heading_deg)?;
        dict.set_item("s_m", frame.s_m)?;
        dict.set_item("cte_m", frame.cte_m)?;
        dict.set_item("speed_mph", frame.speed_mph)?;
        dict.set_item("progress_m", frame.progress_m)?;
        dict.set_item("expert_steering", frame.expert_steering)?;
        dict.set_item("interventions", frame.interventions)?;
        dict.set_item("goes_on", frame.goes_on)?;
        dict.set_item("too_slow", frame.too_slow)?;
        dict.set_item("failure", plain(py, &frame.failure)?)?;
        Ok(dict)
    }
}

/// Follows `orders` until nobody gives any.
fn simulate(track: &Track, orders: &Receiver<Order>, frames: &Sender<Result<Frame>>) {
    let Ok(mut order) = orders.recv() else { return };
    loop {
        let Order::Reset { seed, options } = order else {
            let _ = frames.send(Err(Error::Usage("call reset() before step()".into())));
            let Ok(next) = orders.recv() else { return };
            order = next;
            continue;
        };
        let mut trial = Driven {
            closed_loop: ClosedLoop::new(track, &options, seed),
            eye: FrontCamera::new(track, seed),
            controller: SpeedController::default(),
            speed: options.speed,
        };
        let mut frame = trial.frame();
        order = loop {
            // Nobody waits any more if this fails, and then there are no more orders.
            let _ = frames.send(frame);
            match orders.recv() {
                Ok(Order::Step { steering, throttle }) => frame = trial.step(steering, throttle),
                Ok(reset) => break reset,
                Err(_) => return,
            }
        };
    }
}

/// A trial and what sees and holds its car.
struct Driven<'a> {
    closed_loop: ClosedLoop<'a>,
    eye: FrontCamera<'a>,
    controller: SpeedController,
    speed: Speed,
}

impl Driven<'_> {
    /// As a trial of `drive` with a driver that answers this.
    fn step(&mut self, steering: f32, throttle: Option<f32>) -> Result<Frame> {
        if !self.closed_loop.goes_on() {
            return Err(Error::Usage("the drive is over; call reset() before step()".into()));
        }
        let simulation = self.closed_loop.simulation();
        let (time_s, speed_mph) = (simulation.time_s(), telemetry_mph(simulation.car.speed_mps));
        let target_mph = self.speed.target_mph(simulation);
        let throttle = match throttle {
            Some(throttle) => self.controller.throttle_for(Pace::Throttle(throttle), time_s, target_mph, speed_mph),
            None => self.controller.throttle_at(time_s, target_mph, speed_mph),
        };
        self.closed_loop.answer(steering, throttle);
        loop {
            self.closed_loop.step();
            if !self.closed_loop.goes_on() || self.closed_loop.frame_is_due() {
                return self.frame();
            }
        }
    }

    fn frame(&mut self) -> Result<Frame> {
        let closed_loop = &self.closed_loop;
        let simulation = closed_loop.simulation();
        Ok(Frame {
            pixels: self.eye.look(simulation)?.pixels.clone(),
            time_s: simulation.time_s(),
            place_m: [simulation.car.x, simulation.car.y],
            heading_deg: simulation.car.hy.atan2(simulation.car.hx).to_degrees(),
            s_m: simulation.location.s_m,
            cte_m: simulation.cte_m(),
            speed_mph: telemetry_mph(simulation.car.speed_mps),
            progress_m: simulation.progress_m,
            expert_steering: expert::pursuit(simulation),
            interventions: closed_loop.interventions(),
            goes_on: closed_loop.goes_on(),
            too_slow: closed_loop.is_too_slow(),
            failure: closed_loop.failure(),
        })
    }
}
