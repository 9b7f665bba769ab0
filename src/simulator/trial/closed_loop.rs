//! A trial, step by step: the same for a driver in this process and for one behind a connection.

use std::collections::VecDeque;

use crate::simulator::car::dynamics::{Controls, MAX_STEER_DEG, STEP_S, STEPS_PER_S};
use crate::simulator::car::noise::SteeringNoise;
use crate::simulator::car::simulation::{Simulation, Start};
use crate::simulator::car::speed::telemetry_mph;
use crate::simulator::track::Track;
use crate::simulator::trial::outcome::{DRIVE_HZ, Failure, INTERVENTION_M, Moment, Trial, TrialOptions};

/// Longest time with more than two wheels off the road, s.
const OFF_ROAD_LIMIT_S: f64 = 1.0;
/// Longest time standing still, s.
const STANDING_LIMIT_S: f64 = 10.0;

/// A trial under way: frames are due at 20 Hz, the driver's answers set the controls, steps move the car, and a failure ends
/// the trial.
pub struct ClosedLoop<'a> {
    simulation: Simulation<'a>,
    options: TrialOptions,
    noise: SteeringNoise,
    /// Delayed steering: the step at which it takes effect, and its value.
    pending: VecDeque<(u64, f64)>,
    latency_steps: u64,
    distance_m: f64,
    max_steps: u64,
    controls: Controls,
    /// Step of the last frame, and frames so far.
    shown: u64,
    frames: u64,
    /// The last answer.
    steering: f64,
    off_steps: u64,
    standing_steps: u64,
    put_back: bool,
    trial: Trial,
}

impl<'a> ClosedLoop<'a> {
    /// A trial whose start and noise `seed` draws.
    pub fn new(track: &'a Track, options: &TrialOptions, seed: u64) -> ClosedLoop<'a> {
        let simulation = Simulation::new(track, Start::draw(track, seed), options.speed.at_start_mps());
        let distance_m = options.laps as f64 * track.length_m;
        let slowest_mps = 0.25 * options.speed.at_start_mps().max(2.0);
        ClosedLoop {
            options: *options,
            noise: SteeringNoise::new(seed, options.noise),
            pending: VecDeque::new(),
            latency_steps: (options.latency_ms / 1000.0 * STEPS_PER_S as f64).round() as u64,
            distance_m,
            max_steps: ((distance_m / slowest_mps + 60.0) * STEPS_PER_S as f64) as u64,
            controls: Controls::default(),
            shown: 0,
            frames: 0,
            steering: 0.0,
            off_steps: 0,
            standing_steps: 0,
            put_back: false,
            trial: Trial { worst_cte_m: simulation.cte_m().abs(), ..Trial::default() },
            simulation,
        }
    }

    /// The car on its track.
    pub fn simulation(&self) -> &Simulation<'a> {
        &self.simulation
    }

    /// What the wheels and the pedals do now.
    pub fn controls(&self) -> Controls {
        self.controls
    }

    /// The moment of the last answer.
    pub fn last_moment(&self) -> Option<&Moment> {
        self.trial.moments.last()
    }

    /// Times the car was put back so far.
    pub fn interventions(&self) -> usize {
        self.trial.interventions
    }

    /// Why the trial ended early, if it did.
    pub fn failure(&self) -> Option<Failure> {
        self.trial.failure
    }

    /// Share of the distance that is driven, 0 to 1.
    pub fn share(&self) -> f64 {
        (self.simulation.progress_m / self.distance_m).clamp(0.0, 1.0)
    }

    /// Whether there is more to drive: not all laps, no failure, and not far too slow.
    pub fn goes_on(&self) -> bool {
        self.simulation.progress_m < self.distance_m
            && self.simulation.steps < self.max_steps
            && self.trial.failure.is_none()
    }

    /// Whether the trial ended because it took far longer than a slow car needs.
    pub fn is_too_slow(&self) -> bool {
        self.simulation.progress_m < self.distance_m
            && self.simulation.steps >= self.max_steps
            && self.trial.failure.is_none()
    }

    /// Whether a frame is to be answered before the next step.
    pub fn frame_is_due(&self) -> bool {
        self.simulation.steps * DRIVE_HZ >= self.frames * STEPS_PER_S
    }

    /// Takes the answer to the frame that is due. The throttle acts at once, the steering after the latency.
    pub fn answer(&mut self, steering: f32, throttle: f32) {
        let step = self.simulation.steps;
        let dt_s = if self.frames == 0 { 1.0 / DRIVE_HZ as f64 } else { (step - self.shown) as f64 * STEP_S };
        let steering = sane(steering);
        if self.frames > 0 {
            let change = (steering - self.steering) * MAX_STEER_DEG;
            self.trial.whiteness_sum += change * change / dt_s;
        }
        self.steering = steering;
        self.pending.push_back((step + self.latency_steps, steering + self.noise.next(dt_s)));
        self.controls.throttle = sane(throttle);
        self.trial.moments.push(Moment {
            time_s: self.simulation.time_s(),
            x: self.simulation.car.x,
            y: self.simulation.car.y,
            heading_deg: self.simulation.car.hy.atan2(self.simulation.car.hx).to_degrees(),
            s_m: self.simulation.location.s_m,
            cte_m: self.simulation.cte_m(),
            steering,
            throttle: self.controls.throttle,
            speed_mph: telemetry_mph(self.simulation.car.speed_mps),
            intervention: std::mem::take(&mut self.put_back),
        });
        (self.shown, self.frames) = (step, self.frames + 1);
    }

    /// Applies commands between frames: both act at once, and delayed steering is discarded.
    pub fn take_up(&mut self, steering: f32, throttle: f32) {
        self.pending.clear();
        self.controls = Controls { steering: sane(steering), throttle: sane(throttle) };
    }

    /// Moves the car by one step and checks for failures and interventions.
    pub fn step(&mut self) {
        let step = self.simulation.steps;
        while self.pending.front().is_some_and(|(at, _)| *at <= step) {
            self.controls.steering = self.pending.pop_front().map_or(0.0, |(_, value)| value);
        }
        self.simulation.step(self.controls);

        let cte_m = self.simulation.cte_m().abs();
        let off = self.simulation.wheels_off > 2;
        self.off_steps = if off { self.off_steps + 1 } else { 0 };
        self.standing_steps = if self.simulation.car.speed_mps < 0.1 { self.standing_steps + 1 } else { 0 };
        self.trial.off_road_s += if off { STEP_S } else { 0.0 };
        self.trial.worst_cte_m = self.trial.worst_cte_m.max(cte_m);
        if self.options.assisted {
            if cte_m > INTERVENTION_M {
                self.trial.interventions += 1;
                self.simulation.put_back();
                self.pending.clear();
                self.controls.steering = 0.0;
                self.put_back = true;
            }
        } else if self.simulation.at_wall {
            self.trial.failure = Some(Failure::Crash);
        } else if self.off_steps as f64 * STEP_S > OFF_ROAD_LIMIT_S {
            self.trial.failure = Some(Failure::LeftRoad);
        } else if self.standing_steps as f64 * STEP_S > STANDING_LIMIT_S {
            self.trial.failure = Some(Failure::StoodStill);
        }
    }

    /// Ends the trial.
    pub fn finish(mut self) -> Trial {
        self.trial.time_s = self.simulation.time_s();
        self.trial.distance_m = self.simulation.progress_m.max(0.0);
        let laps = (self.trial.distance_m / self.simulation.track.length_m + 1e-9) as usize;
        self.trial.laps_completed = laps.min(self.options.laps);
        self.trial
    }
}

/// The command clamped to [-1, 1]; 0, straight ahead and rolling, for NaN and infinity.
fn sane(command: f32) -> f64 {
    if command.is_finite() { f64::from(command).clamp(-1.0, 1.0) } else { 0.0 }
}
