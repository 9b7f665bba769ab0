//! The car: a bicycle model with limited grip and the engine, brakes and steering of Udacity's car.

use crate::simulator::math::{sin_cos, tan};

/// One step of the simulation, s (50 Hz).
pub const STEP_S: f64 = 0.02;
/// Steps for each second.
pub const STEPS_PER_S: u64 = 50;
/// Distance between the axles, m.
pub const WHEELBASE_M: f64 = 2.87;
/// Front axle ahead of the middle of the car, m.
pub const FRONT_AXLE_M: f64 = 1.27;
/// Rear axle behind the middle of the car, m.
pub const REAR_AXLE_M: f64 = 1.60;
/// Wheels to either side of the middle, m.
pub const HALF_TRACK_M: f64 = 1.0;
/// Angle of the front wheels at steering 1, deg.
pub const MAX_STEER_DEG: f64 = 25.0;
/// Metres a second in a mile an hour, as Udacity's simulator rounds it.
pub const MPS_PER_MPH: f64 = 1.0 / 2.236_936_29;
/// Top speed, m/s (30 mph).
pub const TOP_SPEED_MPS: f64 = 30.0 * MPS_PER_MPH;
/// Largest sideways acceleration, and largest braking, m/s² (0.9 g).
pub const GRIP_MPS2: f64 = 0.9 * GRAVITY_MPS2;
const GRAVITY_MPS2: f64 = 9.81;
/// Acceleration at full throttle: 2,000 Nm at wheels of 0.3525 m under 1,000 kg.
pub const FULL_THROTTLE_MPS2: f64 = 2000.0 / 0.3525 / 1000.0;
/// Braking at full brake before grip limits it: 20,000 Nm at each of four wheels.
const FULL_BRAKE_MPS2: f64 = 4.0 * 20_000.0 / 0.3525 / 1000.0;
/// Below 5 mph the brake pedal is reverse gear; this car does not go backwards, its 150 Nm only slow it.
const SLOW_BRAKE_MPS2: f64 = 150.0 / 0.3525 / 1000.0;
/// Air and rolling drag, 1/s.
const DRAG_PER_S: f64 = 0.1;
/// Drag of soft ground with all wheels off the road: constant, m/s², and with speed, 1/s.
const SOFT_MPS2: f64 = 1.2;
const SOFT_PER_S: f64 = 0.25;

/// What the driver does.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Controls {
    /// Steering, [-1, 1], + = right; taken up at once.
    pub steering: f64,
    /// [0, 1] accelerates, [-1, 0) brakes.
    pub throttle: f64,
}

/// Position and motion of the car. The position is the middle of the body, between the axles.
#[derive(Clone, Debug, PartialEq)]
pub struct Car {
    /// East, m.
    pub x: f64,
    /// North, m.
    pub y: f64,
    /// Where the car points: unit vector, east part.
    pub hx: f64,
    /// Where the car points, north part.
    pub hy: f64,
    /// Speed, m/s, never negative.
    pub speed_mps: f64,
    /// Steering in force, [-1, 1].
    pub steering: f64,
}

impl Car {
    /// A car at a point, pointing along the unit vector `(hx, hy)`.
    pub fn new(x: f64, y: f64, hx: f64, hy: f64, speed_mps: f64) -> Car {
        Car { x, y, hx, hy, speed_mps, steering: 0.0 }
    }

    /// Moves the car by one step of [`STEP_S`].
    ///
    /// `slope` is the rise of the ground for each metre forward; `off_road` the share of wheels off the road.
    pub fn step(&mut self, controls: Controls, slope: f64, off_road: f64) {
        self.steering = controls.steering.clamp(-1.0, 1.0);
        let throttle = controls.throttle.clamp(-1.0, 1.0);
        let mut acceleration = throttle.max(0.0) * FULL_THROTTLE_MPS2;
        acceleration -= GRAVITY_MPS2 * slope / (1.0 + slope * slope).sqrt();
        let mut drag = DRAG_PER_S * self.speed_mps;
        if throttle < 0.0 {
            let fast = self.speed_mps > 5.0 * MPS_PER_MPH;
            drag += if fast { (-throttle * FULL_BRAKE_MPS2).min(GRIP_MPS2) } else { -throttle * SLOW_BRAKE_MPS2 };
        }
        drag += off_road * (SOFT_MPS2 + SOFT_PER_S * self.speed_mps);
        self.speed_mps = (self.speed_mps + (acceleration - drag) * STEP_S).clamp(0.0, TOP_SPEED_MPS);

        // The rear axle moves where the car points; the front wheels turn the car about it, as far as the tyres hold.
        let wanted = self.speed_mps / WHEELBASE_M * tan((self.steering * MAX_STEER_DEG).to_radians());
        let limit = GRIP_MPS2 / self.speed_mps.max(0.1);
        let turn = -wanted.clamp(-limit, limit) * STEP_S;
        let (rear_x, rear_y) = (self.x - REAR_AXLE_M * self.hx, self.y - REAR_AXLE_M * self.hy);
        let rotate = |angle: f64| {
            let (sin, cos) = sin_cos(angle);
            let (x, y) = (self.hx * cos - self.hy * sin, self.hx * sin + self.hy * cos);
            let norm = 1.0 / (x * x + y * y).sqrt();
            (x * norm, y * norm)
        };
        let (mid_x, mid_y) = rotate(turn / 2.0);
        (self.hx, self.hy) = rotate(turn);
        let path = self.speed_mps * STEP_S;
        self.x = rear_x + path * mid_x + REAR_AXLE_M * self.hx;
        self.y = rear_y + path * mid_y + REAR_AXLE_M * self.hy;
    }

    /// Places of the four wheels: front left, front right, rear left, rear right.
    pub fn wheels(&self) -> [(f64, f64); 4] {
        let at = |ahead: f64, right: f64| {
            (self.x + self.hx * ahead + self.hy * right, self.y + self.hy * ahead - self.hx * right)
        };
        [
            at(FRONT_AXLE_M, -HALF_TRACK_M),
            at(FRONT_AXLE_M, HALF_TRACK_M),
            at(-REAR_AXLE_M, -HALF_TRACK_M),
            at(-REAR_AXLE_M, HALF_TRACK_M),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drive(car: &mut Car, controls: Controls, seconds: f64) {
        for _ in 0..(seconds / STEP_S).round() as usize {
            car.step(controls, 0.0, 0.0);
        }
    }

    #[test]
    fn full_lock_at_walking_pace_turns_on_the_geometric_radius_to_the_right() {
        let mut car = Car::new(0.0, 0.0, 1.0, 0.0, 1.0);
        let (mut low, mut high) = (f64::MAX, f64::MIN);
        for _ in 0..4000 {
            car.speed_mps = 1.0;
            car.step(Controls { steering: 1.0, throttle: 0.0 }, 0.0, 0.0);
            let rear_y = car.y - REAR_AXLE_M * car.hy;
            (low, high) = (low.min(rear_y), high.max(rear_y));
        }
        // The centre lies to the right (south), 2.87 m / tan 25 deg = 6.155 m away.
        assert!((low + 2.0 * 6.155).abs() < 0.03, "{low}");
        assert!(high < 0.03, "{high}");
    }

    #[test]
    fn the_rear_axle_moves_along_the_chord_of_its_circle() {
        let mut car = Car::new(0.0, 0.0, 1.0, 0.0, 6.0);
        car.step(Controls { steering: 1.0, throttle: 0.0 }, 0.0, 0.0);
        let (dx, dy) = (car.x - REAR_AXLE_M * car.hx + REAR_AXLE_M, car.y - REAR_AXLE_M * car.hy);
        let turn = car.hy.atan2(car.hx);
        assert!(turn < -0.01, "to the right: {turn}");
        assert!((dy.atan2(dx) - turn / 2.0).abs() < 1e-9, "{} {turn}", dy.atan2(dx));
    }

    #[test]
    fn grip_limits_the_turn() {
        let mut car = Car::new(0.0, 0.0, 1.0, 0.0, 12.0);
        let before = car.clone();
        car.step(Controls { steering: -1.0, throttle: 0.0 }, 0.0, 0.0);
        let turn = before.hx * car.hy - before.hy * car.hx;
        let sideways = car.speed_mps * turn / STEP_S;
        assert!((sideways - GRIP_MPS2).abs() < 0.01, "{sideways}");
    }

    #[test]
    fn top_speed_and_braking() {
        let mut car = Car::new(0.0, 0.0, 1.0, 0.0, 0.0);
        drive(&mut car, Controls { steering: 0.0, throttle: 1.0 }, 10.0);
        assert_eq!(car.speed_mps, TOP_SPEED_MPS);
        let from = car.x;
        drive(&mut car, Controls { steering: 0.0, throttle: -1.0 }, 1.2);
        assert!(car.speed_mps < 5.0 * MPS_PER_MPH);
        // v^2 / (2 * 0.9 g) is 10.2 m from 30 mph to rest; drag takes some of it, slow braking below 5 mph adds some.
        assert!((8.0..10.5).contains(&(car.x - from)), "{}", car.x - from);
        drive(&mut car, Controls { steering: 0.0, throttle: -1.0 }, 20.0);
        assert_eq!(car.speed_mps, 0.0);
    }

    #[test]
    fn soft_ground_and_climbs_slow_the_car() {
        let [road, soft, climb] = [(0.0, 0.0), (0.0, 1.0), (0.15, 0.0)].map(|(slope, off_road)| {
            let mut car = Car::new(0.0, 0.0, 1.0, 0.0, 9.0);
            (0..50).for_each(|_| car.step(Controls { steering: 0.0, throttle: 0.2 }, slope, off_road));
            car.speed_mps
        });
        assert!(soft < road - 1.5 && climb < road - 1.0, "{road} {soft} {climb}");
    }
}
