//! A car on a track: what happens in one step, and where the car is relative to the road.

use crate::simulator::car::dynamics::{Car, Controls, STEP_S};
use crate::simulator::car::pose::BodyPose;
use crate::simulator::math::{Rng, sin_cos, vec3};
use crate::simulator::road::line::{Location, WALL_GAP_M};
use crate::simulator::track::Track;

/// Where and how a drive starts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Start {
    /// Place along the reference line, m.
    pub s_m: f64,
    /// Driven against the direction of the track's points.
    pub reverse: bool,
    /// Offset from the line, m, + = right as driven.
    pub offset_m: f64,
    /// Direction relative to the line, deg, + = to the right as driven.
    pub heading_deg: f64,
}

impl Start {
    /// Drawn by the seed of a trial: place, direction, offset within ±0.5 m, heading within ±5 degrees.
    pub fn draw(track: &Track, seed: u64) -> Start {
        let mut rng = Rng::new(seed, "start");
        Start {
            s_m: rng.between(0.0, track.length_m),
            reverse: rng.unit() < 0.5,
            offset_m: rng.between(-0.5, 0.5),
            heading_deg: rng.between(-5.0, 5.0),
        }
    }
}

/// A car on a track.
#[derive(Clone)]
pub struct Simulation<'a> {
    /// The track.
    pub track: &'a Track,
    /// The car.
    pub car: Car,
    /// Where the middle of the car is.
    pub location: Location,
    /// Driven against the direction of the track's points.
    pub reverse: bool,
    /// Steps since the start.
    pub steps: u64,
    /// Progress along the line since the start, m; decreases while the car drives backwards.
    pub progress_m: f64,
    /// Wheels off the road, 0 to 4.
    pub wheels_off: usize,
    /// Whether the car touches a wall.
    pub at_wall: bool,
}

impl<'a> Simulation<'a> {
    /// A car at `start`, already moving at `speed_mps`.
    pub fn new(track: &'a Track, start: Start, speed_mps: f64) -> Simulation<'a> {
        let car = placed(track, start, speed_mps);
        Simulation::with_car(track, car, start.reverse)
    }

    /// The moment before the first step.
    fn with_car(track: &'a Track, car: Car, reverse: bool) -> Simulation<'a> {
        let location = track.locate(car.x, car.y);
        let mut simulation =
            Simulation { track, car, location, reverse, steps: 0, progress_m: 0.0, wheels_off: 0, at_wall: false };
        simulation.update_wheels();
        simulation
    }

    /// Simulated time since the start, s.
    pub fn time_s(&self) -> f64 {
        self.steps as f64 * STEP_S
    }

    /// +1 along the track's points, -1 against them.
    fn sign(&self) -> f64 {
        if self.reverse { -1.0 } else { 1.0 }
    }

    /// Cross-track error: distance of the middle of the car from the reference line, m, + = right as driven.
    pub fn cte_m(&self) -> f64 {
        self.location.offset_m * self.sign()
    }

    /// Sine of the angle between the car and the line, + = the car points to the right of it.
    pub fn heading_error(&self) -> f64 {
        (self.car.hx * self.location.ty - self.car.hy * self.location.tx) * self.sign()
    }

    /// A car at the place (`x`, `y`), m, pointing to `heading_deg`, anticlockwise from east. Which way round it drives follows
    /// from that.
    pub fn posed(track: &'a Track, [x, y]: [f64; 2], heading_deg: f64, speed_mps: f64) -> Simulation<'a> {
        let (hy, hx) = sin_cos(heading_deg.to_radians());
        let location = track.locate(x, y);
        let reverse = hx * location.tx + hy * location.ty < 0.0;
        Simulation::with_car(track, Car::new(x, y, hx, hy, speed_mps), reverse)
    }

    /// Moves the car to the next point of a trajectory and counts its progress and one step of time; otherwise as
    /// [`posed`](Simulation::posed).
    pub fn pose(&mut self, [x, y]: [f64; 2], heading_deg: f64, speed_mps: f64) {
        let (hy, hx) = sin_cos(heading_deg.to_radians());
        let steering = self.car.steering;
        self.car = Car { steering, ..Car::new(x, y, hx, hy, speed_mps) };
        self.update_location();
    }

    /// Moves the car to another place on the track; progress and time are kept.
    pub fn put(&mut self, start: Start, speed_mps: f64) {
        let steering = self.car.steering;
        self.car = Car { steering, ..placed(self.track, start, speed_mps) };
        self.location = self.track.locate(self.car.x, self.car.y);
        self.update_wheels();
    }

    /// Puts the car back on the line where it is, pointing along it, at its present speed.
    pub fn put_back(&mut self) {
        let start = Start { s_m: self.location.s_m, reverse: self.reverse, offset_m: 0.0, heading_deg: 0.0 };
        self.put(start, self.car.speed_mps);
    }

    /// Slope of the ground in the direction of the car: rise per metre.
    fn slope(&self) -> f64 {
        let s = &self.track.stations[self.location.station];
        let along = self.car.hx * s.tx + self.car.hy * s.ty;
        let right = self.car.hx * s.ty - self.car.hy * s.tx;
        s.slope * along - s.crossfall * right
    }

    /// Moves by one step of 20 ms.
    pub fn step(&mut self, controls: Controls) {
        self.car.step(controls, self.slope(), self.wheels_off as f64 / 4.0);
        self.update_location();
    }

    /// Updates location, progress and time after the car has moved by one step.
    fn update_location(&mut self) {
        let before = self.location.s_m;
        self.location = self.track.locate_near(self.car.x, self.car.y, self.location.station);
        let length = self.track.length_m;
        let mut way = self.location.s_m - before;
        if way > length / 2.0 {
            way -= length;
        } else if way < -length / 2.0 {
            way += length;
        }
        self.progress_m += way * self.sign();
        self.steps += 1;
        self.update_wheels();
    }

    /// Counts the wheels off the road and checks whether one touches a wall.
    fn update_wheels(&mut self) {
        (self.wheels_off, self.at_wall) = (0, false);
        for (x, y) in self.car.wheels() {
            let wheel = self.track.locate_near(x, y, self.location.station);
            let half = self.track.stations[wheel.station].width_m / 2.0;
            self.wheels_off += usize::from(wheel.offset_m.abs() > half);
            if wheel.offset_m.abs() > half + WALL_GAP_M {
                self.at_wall |= self.track.wall_at(wheel.s_m, wheel.offset_m > 0.0).is_some();
            }
        }
    }

    /// The body as the cameras need it: on the road's plane, following slope and banking, never inside the land.
    pub fn body_pose(&self) -> BodyPose {
        let s = self.track.at(self.location.s_m);
        let offset = self.location.offset_m;
        // Gradient of the road's plane, east and north.
        let gx = s.slope * s.tx - s.crossfall * s.ty;
        let gy = s.slope * s.ty + s.crossfall * s.tx;
        let plane = s.z - s.crossfall * offset.clamp(-s.width_m, s.width_m);
        let z = if offset.abs() > s.width_m / 2.0 {
            let land = self.track.world().terrain.height(self.car.x as f32, self.car.y as f32);
            plane.max(f64::from(land))
        } else {
            plane
        };
        let (hx, hy) = (self.car.hx, self.car.hy);
        let forward = vec3(hx as f32, hy as f32, (gx * hx + gy * hy) as f32).unit();
        let right = forward.cross(vec3(-gx as f32, -gy as f32, 1.0)).unit();
        BodyPose {
            origin: vec3(self.car.x as f32, self.car.y as f32, z as f32),
            forward,
            right,
            up: right.cross(forward),
        }
    }
}

fn placed(track: &Track, start: Start, speed_mps: f64) -> Car {
    let s = track.at(start.s_m);
    let sign = if start.reverse { -1.0 } else { 1.0 };
    let (tx, ty) = (s.tx * sign, s.ty * sign);
    let (sin, cos) = sin_cos(-start.heading_deg.to_radians());
    Car::new(s.x + ty * start.offset_m, s.y - tx * start.offset_m, tx * cos - ty * sin, tx * sin + ty * cos, speed_mps)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn positive_errors_are_to_the_right_in_both_directions() {
        let track = Track::load("lake").unwrap();
        for reverse in [false, true] {
            let start = Start { s_m: 130.0, reverse, offset_m: 0.4, heading_deg: 3.0 };
            let simulation = Simulation::new(&track, start, 8.0);
            assert!((simulation.cte_m() - 0.4).abs() < 1e-3, "{}", simulation.cte_m());
            assert!((simulation.heading_error() - 3f64.to_radians().sin()).abs() < 1e-3);
            assert_eq!((simulation.wheels_off, simulation.at_wall), (0, false));
        }
    }

    #[test]
    fn wheels_leave_the_road_one_pair_at_a_time_and_walls_are_felt() {
        let track = Track::load("lake").unwrap();
        let at =
            |s_m, offset_m| Simulation::new(&track, Start { s_m, reverse: false, offset_m, heading_deg: 0.0 }, 8.0);
        assert_eq!(at(100.0, 4.3).wheels_off, 2);
        assert_eq!(at(100.0, -6.3).wheels_off, 4);
        assert!(!at(100.0, 4.3).at_wall);
        // On the bridge.
        assert!(!at(570.0, 3.9).at_wall);
        assert!(at(570.0, 4.6).at_wall && at(570.0, -4.6).at_wall);
    }

    #[test]
    fn progress_counts_a_lap_through_the_start() {
        let track = Track::load("coast").unwrap();
        for (reverse, s_m) in [(false, track.length_m - 5.0), (true, 5.0)] {
            let start = Start { s_m, reverse, offset_m: 0.0, heading_deg: 0.0 };
            let mut simulation = Simulation::new(&track, start, 10.0);
            for _ in 0..50 {
                simulation.step(Controls { steering: 0.0, throttle: 0.2 });
            }
            assert!((9.0..11.0).contains(&simulation.progress_m), "{}", simulation.progress_m);
            let is_before_the_start = simulation.location.s_m > 10.0;
            assert_eq!(is_before_the_start, reverse, "{}", simulation.location.s_m);
        }
    }
}
