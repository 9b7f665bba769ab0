//! The rows of a recording: the expert drives, or another driver whose rows the expert labels.

use crate::Result;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::car::dynamics::{Controls, MPS_PER_MPH, STEP_S, STEPS_PER_S};
use crate::simulator::car::expert::{Keyboard, Style, pursuit};
use crate::simulator::car::noise::SteeringNoise;
use crate::simulator::car::pose::BodyPose;
use crate::simulator::car::simulation::{Simulation, Start};
use crate::simulator::car::speed::SpeedController;
use crate::simulator::math::Rng;
use crate::simulator::recorder::options::RecordOptions;
use crate::simulator::recorder::sample::Sample;
use crate::simulator::track::Track;
use crate::simulator::trial::driver::{DriveState, Driver};
use crate::simulator::trial::outcome::DRIVE_HZ;

/// The expert driving for a recording.
struct ExpertDrive<'a> {
    simulation: Simulation<'a>,
    speed: SpeedController,
    keyboard: Option<Keyboard>,
    noise: SteeringNoise,
    options: &'a RecordOptions,
    steps_per_row: u64,
}

impl ExpertDrive<'_> {
    /// Drives one step; returns the label and the throttle of its beginning.
    fn step(&mut self) -> (f64, f64) {
        let steering = match &mut self.keyboard {
            Some(keyboard) => keyboard.steer(&self.simulation),
            None => pursuit(&self.simulation),
        };
        let target_mph = self.options.target_mph(&self.simulation);
        let throttle = self.speed.throttle(target_mph, self.simulation.car.speed_mps / MPS_PER_MPH, STEP_S);
        let label = self.options.label(&self.simulation).unwrap_or(steering);
        let disturbed = steering + self.noise.next(STEP_S);
        self.simulation.step(Controls { steering: disturbed, throttle });
        (label, throttle)
    }

    fn sample(&self, time_s: f64, (steering, throttle): (f64, f64), body: BodyPose, speed_mps: f64) -> Sample {
        let speed_mph = speed_mps / MPS_PER_MPH;
        Sample { time_s, body, steering, throttle: throttle.max(0.0), brake: (-throttle).max(0.0), speed_mph }
    }

    /// Drives `steps` steps or until `done`, taking a sample whenever a row is due.
    fn drive(&mut self, steps: u64, samples: &mut Vec<Sample>, done: impl Fn(&Simulation) -> bool) {
        for step in 0..steps {
            if done(&self.simulation) {
                return;
            }
            let due = step % self.steps_per_row == 0;
            let before =
                due.then(|| (self.simulation.time_s(), self.simulation.body_pose(), self.simulation.car.speed_mps));
            let driven = self.step();
            if let Some((time_s, body, speed_mps)) = before {
                samples.push(self.sample(time_s, driven, body, speed_mps));
            }
        }
    }
}

/// A car at `start`, as fast as `options` say there.
fn begin<'a>(track: &'a Track, start: Start, options: &RecordOptions) -> Simulation<'a> {
    let mut simulation = Simulation::new(track, start, options.speed_mph * MPS_PER_MPH);
    if options.bends_mps2.is_some() {
        put(&mut simulation, start, options);
    }
    simulation
}

/// Puts the car to `start`, as fast as `options` say there.
fn put(simulation: &mut Simulation, start: Start, options: &RecordOptions) {
    simulation.put(start, options.speed_mph * MPS_PER_MPH);
    if options.bends_mps2.is_some() {
        let there_mph = options.target_mph(simulation);
        simulation.put(start, there_mph * MPS_PER_MPH);
    }
}

/// Lets the expert drive as `options` say, and returns the rows, without pictures.
pub fn drive_expert(track: &Track, options: &RecordOptions) -> Vec<Sample> {
    let mut rng = Rng::new(options.seed, "recording");
    let start = Start { reverse: options.reverse, ..Start::draw(track, options.seed) };
    let speed_mps = options.speed_mph * MPS_PER_MPH;
    let mut expert = ExpertDrive {
        simulation: begin(track, start, options),
        speed: SpeedController::default(),
        keyboard: (options.style == Style::Keyboard).then(Keyboard::default),
        noise: SteeringNoise::new(options.seed, options.noise),
        options,
        steps_per_row: STEPS_PER_S / options.hz,
    };
    let way_m = options.laps * track.length_m;
    let max_steps = (way_m / speed_mps.max(1.0) * 3.0) as u64 * STEPS_PER_S + 500;
    let mut samples = Vec::new();
    if !options.recovery {
        expert.drive(max_steps, &mut samples, |s| s.progress_m >= way_m);
        return samples;
    }
    // Every 22 m or so the car is put off its line, on alternating sides, and the way back is recorded.
    let mut s_m = start.s_m;
    let mut driven_m = 0.0;
    let mut side = if rng.unit() < 0.5 { 1.0 } else { -1.0 };
    while driven_m < way_m {
        let room = track.at(s_m).width_m / 2.0 - 1.2;
        let offset_m = side * rng.between(0.7, 2.2).min(room);
        let heading_deg = rng.between(-4.0, 12.0) * side;
        put(&mut expert.simulation, Start { s_m, reverse: options.reverse, offset_m, heading_deg }, options);
        expert.keyboard = expert.keyboard.map(|_| Keyboard::default());
        expert.drive(3 * STEPS_PER_S, &mut samples, |s| s.cte_m().abs() < 0.1 && s.heading_error().abs() < 0.03);
        // A pause in the names of the pictures, so that a reader sees where one stretch ends and the next begins.
        expert.simulation.steps += 2 * STEPS_PER_S;
        let step_m = rng.between(16.0, 28.0);
        driven_m += step_m;
        s_m += if options.reverse { -step_m } else { step_m };
        side = -side;
    }
    samples
}

/// Distance from the line at which the driver is put back, m; rows farther out teach nothing about staying on the road.
const LOST_M: f64 = 2.2;

/// Lets `driver` drive as `options` say, and returns the rows, labelled with the expert's steering at every moment; throttle and speed are
/// those of the car, whose speed is held as `options` say whoever steers.
/// In a random share `expert_share` of the seconds the expert drives.
///
/// # Errors
/// If a picture cannot be encoded.
pub fn drive_and_label(
    track: &Track,
    options: &RecordOptions,
    driver: &mut dyn Driver,
    expert_share: f64,
) -> Result<Vec<Sample>> {
    let mut rng = Rng::new(options.seed, "who drives");
    let start = Start { reverse: options.reverse, ..Start::draw(track, options.seed) };
    let speed_mps = options.speed_mph * MPS_PER_MPH;
    let mut simulation = begin(track, start, options);
    let mut eye = FrontCamera::new(track, options.seed);
    let mut controller = SpeedController::default();
    let way_m = options.laps * track.length_m;
    let max_steps = (way_m / speed_mps.max(1.0) * 3.0) as u64 * STEPS_PER_S + 500;
    let (mut samples, mut answer, mut frames, mut by_expert) = (Vec::new(), 0.0, 0, true);
    for step in 0..max_steps {
        if simulation.progress_m >= way_m {
            break;
        }
        if step % STEPS_PER_S == 0 {
            by_expert = rng.unit() < expert_share;
        }
        let expert = pursuit(&simulation);
        let speed_mph = simulation.car.speed_mps / MPS_PER_MPH;
        let throttle = controller.throttle(options.target_mph(&simulation), speed_mph, STEP_S);
        if step * DRIVE_HZ >= frames * STEPS_PER_S {
            frames += 1;
            let state = DriveState { simulation: &simulation, speed_mph };
            answer = f64::from(driver.steer(eye.look(&simulation)?, &state));
            answer = if answer.is_finite() { answer.clamp(-1.0, 1.0) } else { 0.0 };
        }
        if step % (STEPS_PER_S / options.hz) == 0 {
            samples.push(Sample {
                time_s: simulation.time_s(),
                body: simulation.body_pose(),
                steering: options.label(&simulation).unwrap_or(expert),
                throttle: throttle.max(0.0),
                brake: (-throttle).max(0.0),
                speed_mph,
            });
        }
        simulation.step(Controls { steering: if by_expert { expert } else { answer }, throttle });
        if simulation.cte_m().abs() > LOST_M || simulation.at_wall {
            simulation.put_back();
        }
    }
    Ok(samples)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::car::dynamics::{MAX_STEER_DEG, WHEELBASE_M};

    #[test]
    fn a_lap_is_sampled_at_ten_hertz_and_holds_the_speed() {
        let track = Track::load("forest").unwrap();
        let samples = drive_expert(&track, &RecordOptions::default());
        let expected = track.length_m / (20.0 * MPS_PER_MPH) * 10.0;
        assert!((samples.len() as f64 - expected).abs() < 0.08 * expected, "{} of {expected}", samples.len());
        assert!(samples.windows(2).all(|w| (w[1].time_s - w[0].time_s - 0.1).abs() < 1e-6));
        let settled = &samples[100..];
        assert!(settled.iter().all(|s| (s.speed_mph - 20.0).abs() < 2.5));
    }

    #[test]
    fn before_bends_it_slows_down_if_it_is_to() {
        let track = Track::load("mountain").unwrap();
        let options = RecordOptions { speed_mph: 30.0, ..Default::default() };
        let fast = drive_expert(&track, &options);
        let slower = drive_expert(&track, &RecordOptions { bends_mps2: Some(2.5), ..options });
        let sideways = |samples: &[Sample]| {
            let of = |s: &Sample| {
                let curvature = (s.steering * MAX_STEER_DEG).to_radians().tan().abs() / WHEELBASE_M;
                (s.speed_mph * MPS_PER_MPH).powi(2) * curvature
            };
            samples.iter().map(of).fold(0.0, f64::max)
        };
        assert!(sideways(&fast) > 7.0 && sideways(&slower) < 4.0, "{} {}", sideways(&fast), sideways(&slower));
        let range = |samples: &[Sample]| {
            samples.iter().fold((f64::MAX, 0.0_f64), |(low, high), s| (low.min(s.speed_mph), high.max(s.speed_mph)))
        };
        let (low, high) = range(&slower);
        assert!(low < 18.0 && high > 25.0, "{low} to {high} mph");
    }

    #[test]
    fn whoever_drives_the_labels_are_the_experts() {
        use crate::simulator::trial::driver::{Expert, Zero};
        let track = Track::load("lake").unwrap();
        let options = RecordOptions { laps: 0.3, ..Default::default() };
        let recorded = drive_and_label(&track, &options, &mut Expert, 0.0).unwrap();
        let plain = drive_expert(&track, &options);
        assert!(
            recorded.len() > 100 && recorded.len().abs_diff(plain.len()) < 10,
            "{} {}",
            recorded.len(),
            plain.len()
        );
        assert!(recorded.iter().zip(&plain).all(|(a, b)| (a.steering - b.steering).abs() < 0.1));
        // Who never steers drifts off the line, and the labels say how to get back.
        let strength =
            |samples: &[Sample]| samples.iter().map(|s| s.steering.abs()).sum::<f64>() / samples.len() as f64;
        let zero = drive_and_label(&track, &options, &mut Zero, 0.0).unwrap();
        let helped = drive_and_label(&track, &options, &mut Zero, 0.5).unwrap();
        assert!(strength(&zero) > 2.0 * strength(&plain), "{} {}", strength(&zero), strength(&plain));
        assert!(strength(&helped) < strength(&zero));
    }

    #[test]
    fn labels_from_farther_ahead_ask_less_for_the_same_place_and_leave_the_drive_as_it_is() {
        use crate::simulator::trial::driver::Zero;
        let track = Track::load("lake").unwrap();
        let own = RecordOptions { recovery: true, laps: 0.2, ..Default::default() };
        let ahead = RecordOptions { label_ahead_m: Some(12.26), ..own.clone() };
        let (own_rows, rows) = (drive_expert(&track, &own), drive_expert(&track, &ahead));
        assert!(own_rows.len() > 50 && own_rows.len() == rows.len());
        assert!(own_rows.iter().zip(&rows).all(|(a, b)| a.body == b.body && a.throttle == b.throttle));
        // At 20 mph the expert looks 6.13 m ahead. Right after the car is put beside the line, twice as far asks for a quarter of the way back.
        let strength = |rows: &[Sample]| rows.iter().map(|s| s.steering.abs()).sum::<f64>();
        let share = strength(&rows) / strength(&own_rows);
        assert!((0.25..0.6).contains(&share), "{share}");
        let same = RecordOptions { recovery: false, label_ahead_m: Some(12.26), ..own };
        let labelled = drive_and_label(&track, &same, &mut Zero, 0.0).unwrap();
        let plain = drive_and_label(&track, &RecordOptions { label_ahead_m: None, ..same }, &mut Zero, 0.0).unwrap();
        assert!(labelled.len() == plain.len() && strength(&labelled) < 0.8 * strength(&plain));
        let wrong = RecordOptions { label_ahead_m: Some(2.0), ..Default::default() };
        assert!(wrong.check().unwrap_err().to_string().contains("3 to 30 m"));
    }

    #[test]
    fn recovery_steers_back_and_keyboard_labels_are_often_zero() {
        let track = Track::load("lake").unwrap();
        let recovery = drive_expert(&track, &RecordOptions { recovery: true, ..Default::default() });
        let spread = |samples: &[Sample]| samples.iter().map(|s| s.steering.abs()).sum::<f64>() / samples.len() as f64;
        let smooth = drive_expert(&track, &RecordOptions::default());
        assert!(recovery.len() > 300 && spread(&recovery) > 1.5 * spread(&smooth));
        let keys = drive_expert(&track, &RecordOptions { style: Style::Keyboard, ..Default::default() });
        let zero =
            |samples: &[Sample]| samples.iter().filter(|s| s.steering == 0.0).count() as f64 / samples.len() as f64;
        assert!(zero(&keys) > 0.4 && zero(&smooth) < 0.05, "{} {}", zero(&keys), zero(&smooth));
    }
}
