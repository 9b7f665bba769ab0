//! The path that a recording was driven along, and the steering that leads back to it.
//!
//! People's wheels jump between zero and full lock, above all at a keyboard; the path they drive is smooth. Dead reckoning finds it:
//! steering, speed and time move a bicycle model from row to row. The steering that leads a car to a point of the path a little way
//! ahead (pure pursuit, Coulter 1992) is a smooth label for every row, and for views from beside the path as well.
//!
//! Only neighbouring stretches of a path are ever compared, so the drift of dead reckoning does no harm.

use super::camera::CarGeometry;

/// A place of the rear axle in the world, and where the car points.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// m.
    pub x_m: f64,
    /// m.
    pub y_m: f64,
    /// rad, anticlockwise from x.
    pub heading: f64,
}

impl Pose {
    /// The pose after `distance_m` on an arc of `curvature` (1/m, + = right).
    pub fn moved(self, distance_m: f64, curvature: f64) -> Pose {
        let turn = -distance_m * curvature;
        let middle = self.heading + turn / 2.0;
        // The chord of an arc is shorter than the arc by sin(x) / x of half the turn.
        let half = turn / 2.0;
        let chord_m = if half.abs() < 1e-6 { distance_m } else { distance_m * libm::sin(half) / half };
        Pose {
            x_m: self.x_m + chord_m * libm::cos(middle),
            y_m: self.y_m + chord_m * libm::sin(middle),
            heading: self.heading + turn,
        }
    }

    /// The pose `offset` away from this one.
    pub fn displaced(self, offset: Offset) -> Pose {
        let (sin, cos) = (libm::sin(self.heading), libm::cos(self.heading));
        Pose {
            x_m: self.x_m + offset.ahead_m * cos + offset.right_m * sin,
            y_m: self.y_m + offset.ahead_m * sin - offset.right_m * cos,
            heading: self.heading - offset.turn,
        }
    }

    /// Where `other` is, seen from here.
    pub fn offset_to(self, other: Pose) -> Offset {
        let (sin, cos) = (libm::sin(self.heading), libm::cos(self.heading));
        let (dx, dy) = (other.x_m - self.x_m, other.y_m - self.y_m);
        Offset {
            right_m: dx * sin - dy * cos,
            ahead_m: dx * cos + dy * sin,
            turn: wrapped(self.heading - other.heading),
        }
    }
}

/// A pose in the coordinates of another one.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Offset {
    /// Aside, m, + = right.
    pub right_m: f64,
    /// Ahead, m.
    pub ahead_m: f64,
    /// Turn, rad, + = right.
    pub turn: f64,
}

/// How far ahead of the rear axle a driver aims: a time, but never nearer than a distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LookAhead {
    /// s.
    pub seconds: f64,
    /// Shortest distance, m.
    pub min_m: f64,
}

impl LookAhead {
    /// 0.7 s, with a shortest distance of two wheelbases.
    pub fn usual(geometry: &CarGeometry) -> LookAhead {
        LookAhead { seconds: 0.7, min_m: 2.0 * geometry.wheelbase_m }
    }

    /// Distance at `speed_mps`, m.
    pub fn distance_m(self, speed_mps: f64) -> f64 {
        (self.seconds * speed_mps).max(self.min_m)
    }
}

/// Where the rear axle was at each row of a session.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DrivenPath {
    poses: Vec<Pose>,
    /// Way driven up to each row, m; never falls.
    along_m: Vec<f64>,
}

impl DrivenPath {
    /// Dead reckoning from the rows of a session: `time_s`, `speed_mps` and `steering` ([-1, 1], + = right) of each. The path
    /// begins at the origin along x.
    ///
    /// # Panics
    ///
    /// If the lengths differ.
    pub fn dead_reckon(geometry: &CarGeometry, time_s: &[f64], speed_mps: &[f64], steering: &[f64]) -> DrivenPath {
        assert!(time_s.len() == speed_mps.len() && time_s.len() == steering.len(), "rows of a session");
        let mut path = DrivenPath::default();
        let (mut pose, mut along_m) = (Pose::default(), 0.0);
        for i in 0..time_s.len() {
            if i > 0 {
                let dt_s = (time_s[i] - time_s[i - 1]).max(0.0);
                let distance_m = 0.5 * (speed_mps[i] + speed_mps[i - 1]).max(0.0) * dt_s;
                let curvature = 0.5 * (geometry.curvature(steering[i]) + geometry.curvature(steering[i - 1]));
                pose = pose.moved(distance_m, curvature);
                along_m += distance_m;
            }
            path.poses.push(pose);
            path.along_m.push(along_m);
        }
        path
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.poses.len()
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.poses.is_empty()
    }

    /// Pose at each row.
    pub fn poses(&self) -> &[Pose] {
        &self.poses
    }

    /// Way driven up to `row`, m.
    pub fn along_m(&self, row: usize) -> f64 {
        self.along_m[row]
    }

    /// Length, m.
    pub fn length_m(&self) -> f64 {
        self.along_m.last().copied().unwrap_or(0.0)
    }

    /// The last row that the car had passed after `along_m`; the first row before the start.
    pub fn row_at(&self, along_m: f64) -> usize {
        self.along_m.partition_point(|&way_m| way_m <= along_m).saturating_sub(1)
    }

    /// The pose after `along_m`, on a straight line between rows; `None` before the start and beyond the end.
    pub fn pose_at(&self, along_m: f64) -> Option<Pose> {
        if !(0.0..=self.length_m()).contains(&along_m) || self.is_empty() {
            return None;
        }
        let row = self.row_at(along_m);
        let pose = self.poses[row];
        let Some(next) = self.poses.get(row + 1) else { return Some(pose) };
        let gap_m = self.along_m[row + 1] - self.along_m[row];
        let share = if gap_m > 0.0 { (along_m - self.along_m[row]) / gap_m } else { 0.0 };
        let between = |from: f64, to: f64| from + share * (to - from);
        Some(Pose {
            x_m: between(pose.x_m, next.x_m),
            y_m: between(pose.y_m, next.y_m),
            heading: between(pose.heading, next.heading),
        })
    }

    /// The steering that leads a car at `pose` to the point of the path `ahead_m` past `along_m`; `None` if the path ends before.
    /// It may lie beyond [-1, 1]. See [`CarGeometry::steering_towards`].
    pub fn pursuit(&self, geometry: &CarGeometry, pose: Pose, along_m: f64, ahead_m: f64) -> Option<f64> {
        let to = pose.offset_to(self.pose_at(along_m + ahead_m)?);
        Some(geometry.steering_towards(to.right_m, to.ahead_m, ahead_m))
    }

    /// The path label of `row`: pursuit of the path from the row's own pose. `None` near the end of the session.
    pub fn label(&self, geometry: &CarGeometry, row: usize, ahead_m: f64) -> Option<f64> {
        self.pursuit(geometry, self.poses[row], self.along_m[row], ahead_m)
    }

    /// Where along the path a car at `pose` is, and its offset from the path there. The search begins at `along_m` and goes
    /// no farther than `reach_m` either way.
    pub fn locate(&self, pose: Pose, along_m: f64, reach_m: f64) -> (f64, Offset) {
        let mut at_m = along_m.clamp(0.0, self.length_m());
        // The offset ahead says how far to go on; on an arc a few rounds meet the foot of the perpendicular.
        let (low_m, high_m) = ((at_m - reach_m).max(0.0), (at_m + reach_m).min(self.length_m()));
        for _ in 0..8 {
            let here = self.pose_at(at_m).unwrap_or_default();
            let ahead_m = here.offset_to(pose).ahead_m;
            let next_m = (at_m + ahead_m).clamp(low_m, high_m);
            let done = (next_m - at_m).abs() < 1e-6;
            at_m = next_m;
            if done {
                break;
            }
        }
        (at_m, self.pose_at(at_m).unwrap_or_default().offset_to(pose))
    }
}

/// An angle in (-pi, pi].
fn wrapped(angle: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let turns = ((angle - PI) / TAU).ceil();
    angle - turns * TAU
}

#[cfg(test)]
mod tests {
    use super::*;

    fn car() -> CarGeometry {
        CarGeometry::preset("udacity").unwrap()
    }

    /// 10 m/s at 10 rows a second, with this steering.
    fn path(steering: impl Fn(usize) -> f64, rows: usize) -> DrivenPath {
        let time_s: Vec<f64> = (0..rows).map(|i| i as f64 * 0.1).collect();
        let steering: Vec<f64> = (0..rows).map(steering).collect();
        DrivenPath::dead_reckon(&car(), &time_s, &vec![10.0; rows], &steering)
    }

    #[test]
    fn a_steady_wheel_drives_a_circle_and_is_its_own_label() {
        for steering in [-0.5, -0.1, 0.0, 0.2, 0.8] {
            let path = path(|_| steering, 100);
            assert!((path.length_m() - 99.0).abs() < 1e-9);
            for row in [0, 10, 80] {
                let label = path.label(&car(), row, 7.0).unwrap();
                assert!((label - steering).abs() < 0.02, "{steering}: {label}");
            }
            assert_eq!(path.label(&car(), 95, 7.0), None);
            if steering > 0.0 {
                // To the right: the car turns clockwise, towards negative y.
                assert!(path.poses()[3].y_m < 0.0 && path.poses()[3].heading < 0.0);
                let radius_m = 1.0 / car().curvature(steering);
                let far = path.poses().iter().map(|p| p.y_m).fold(0.0, f64::min);
                assert!(far >= -2.0 * radius_m - 0.01);
            }
        }
    }

    #[test]
    fn a_jumping_wheel_has_a_label_that_hardly_jumps() {
        let path = path(|i| if i % 10 < 2 { 0.5 } else { 0.0 }, 200);
        let labels: Vec<f64> = (50..150).map(|row| path.label(&car(), row, 10.0).unwrap()).collect();
        let mean = labels.iter().sum::<f64>() / 100.0;
        assert!((mean - 0.1).abs() < 0.01, "{mean}");
        // The wheel jumps by 0.5 from row to row, its label by less than a fifth of that.
        assert!(labels.windows(2).all(|pair| (pair[1] - pair[0]).abs() < 0.1), "{labels:?}");
        assert!(labels.iter().all(|label| (label - mean).abs() < 0.1), "{labels:?}");
    }

    #[test]
    fn beside_the_path_the_steering_leads_back() {
        let path = path(|_| 0.0, 100);
        let aside = |right_m, turn| {
            let pose = path.poses()[10].displaced(Offset { right_m, ahead_m: 0.0, turn });
            path.pursuit(&car(), pose, path.along_m(10), 7.0).unwrap()
        };
        // 0.8 m to the right of a straight path, 7 m ahead: 2 * -0.8 / (49 + 0.64) 1/m, times 2.87 m, is atan 5.29 deg of 25.
        assert!((aside(0.8, 0.0) + 0.2113).abs() < 1e-3, "{}", aside(0.8, 0.0));
        assert_eq!(aside(-0.8, 0.0), -aside(0.8, 0.0));
        assert!(aside(0.0, 0.1) < -0.1, "turned to the right, it steers left");
    }

    #[test]
    fn offsets_are_inverse_and_places_are_found_again() {
        let path = path(|i| 0.3 * (i as f64 / 15.0).sin(), 200);
        for (row, offset) in [(20, (0.7, 0.1)), (90, (-0.9, -0.2)), (150, (0.0, 0.0))] {
            let offset = Offset { right_m: offset.0, ahead_m: 0.0, turn: offset.1 };
            let pose = path.poses()[row].displaced(offset);
            let back = path.poses()[row].offset_to(pose);
            assert!((back.right_m - offset.right_m).abs() < 1e-12 && (back.turn - offset.turn).abs() < 1e-12);
            assert!(back.ahead_m.abs() < 1e-12);
            let (at_m, found) = path.locate(pose, path.along_m(row) - 3.0, 5.0);
            assert!((at_m - path.along_m(row)).abs() < 0.1, "{at_m} {}", path.along_m(row));
            assert!((found.right_m - offset.right_m).abs() < 0.02 && (found.turn - offset.turn).abs() < 0.02);
        }
        assert!((wrapped(3.5 * std::f64::consts::PI) + 0.5 * std::f64::consts::PI).abs() < 1e-12);
    }

    #[test]
    fn a_session_without_rows_or_without_motion_has_no_labels() {
        let empty = DrivenPath::dead_reckon(&car(), &[], &[], &[]);
        assert!(empty.is_empty() && empty.pose_at(0.0).is_none());
        let standing = DrivenPath::dead_reckon(&car(), &[0.0, 0.1], &[0.0, 0.0], &[1.0, 1.0]);
        assert_eq!((standing.length_m(), standing.label(&car(), 0, 5.0)), (0.0, None));
    }
}
