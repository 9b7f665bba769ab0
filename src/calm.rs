//! How calm a drive is, in measures that a passenger would recognise.

use serde::{Deserialize, Serialize};

use crate::statistics::quantile;

/// A turn of the wheel back by more than this is a reversal, deg of the front wheels.
const REVERSAL_DEG: f64 = 1.0;

/// The car at one frame of a drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CalmFrame {
    /// Time since the start, s.
    pub time_s: f64,
    /// Angle of the front wheels that the driver asked for, deg.
    pub angle_deg: f64,
    /// Where the car points, deg.
    pub heading_deg: f64,
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Whether the car was just put back: it begins anew.
    pub put_back: bool,
}

/// How calm a drive is. Pairs of frames between which the car was put back count for nothing.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Calm {
    /// Wheel reversals a minute (Markkula and Engström 2006): times that the front wheels turn back by more than 1 degree from
    /// where they were furthest, to either side.
    pub reversals_per_min: f64,
    /// 95th percentile of the change of the front wheels' angle from frame to frame, deg.
    pub angle_change_p95_deg: f64,
    /// Root mean square of the lateral jerk, m/s³: the rate of the lateral acceleration, speed times rate of the car's heading. It
    /// is what the car does, so latency, noise and the grip of the tyres are in it.
    pub lateral_jerk_rms_mps3: f64,
}

impl Calm {
    /// The measures over all `drives` together, each with its frames and its time in s.
    pub fn of(drives: impl IntoIterator<Item = (Vec<CalmFrame>, f64)>) -> Calm {
        let (mut reversals, mut time_s, mut changes_deg) = (0, 0.0, Vec::new());
        let (mut jerk_squares, mut jerks) = (0.0, 0usize);
        for (frames, of_drive_s) in drives {
            time_s += of_drive_s;
            for way in frames.chunk_by(|_, next| !next.put_back) {
                reversals += count_reversals(way.iter().map(|frame| frame.angle_deg));
                changes_deg.extend(way.windows(2).map(|pair| (pair[1].angle_deg - pair[0].angle_deg).abs()));
                let accelerations: Vec<[f64; 2]> = way.windows(2).filter_map(lateral_acceleration).collect();
                for pair in accelerations.windows(2) {
                    let jerk = (pair[1][1] - pair[0][1]) / (pair[1][0] - pair[0][0]);
                    jerk_squares += jerk * jerk;
                    jerks += 1;
                }
            }
        }
        changes_deg.sort_by(f64::total_cmp);
        Calm {
            reversals_per_min: f64::from(reversals) / (time_s / 60.0).max(1e-9),
            angle_change_p95_deg: quantile(&changes_deg, 0.95),
            lateral_jerk_rms_mps3: (jerk_squares / jerks.max(1) as f64).sqrt(),
        }
    }
}

/// Time halfway between two frames, s, and the lateral acceleration between them, m/s².
fn lateral_acceleration(pair: &[CalmFrame]) -> Option<[f64; 2]> {
    let (a, b) = (&pair[0], &pair[1]);
    let dt_s = b.time_s - a.time_s;
    let turn_deg = (b.heading_deg - a.heading_deg + 180.0).rem_euclid(360.0) - 180.0;
    let speed_mps = 0.5 * (a.speed_mps + b.speed_mps);
    (dt_s > 0.0).then(|| [0.5 * (a.time_s + b.time_s), speed_mps * turn_deg.to_radians() / dt_s])
}

/// Number of times that `angles_deg` turn back by more than [`REVERSAL_DEG`].
fn count_reversals(angles_deg: impl Iterator<Item = f64>) -> u32 {
    // The furthest to the left and to the right since the last reversal, and the side on which the wheel moves, once that is known.
    let (mut lowest, mut highest) = (f64::INFINITY, f64::NEG_INFINITY);
    let (mut rising, mut count) = (None, 0);
    for angle in angles_deg {
        (lowest, highest) = (lowest.min(angle), highest.max(angle));
        let turned = match rising {
            Some(true) => highest - angle > REVERSAL_DEG,
            Some(false) => angle - lowest > REVERSAL_DEG,
            None => highest - lowest > REVERSAL_DEG,
        };
        if turned {
            count += u32::from(rising.is_some());
            rising = Some(angle == highest || (rising == Some(false)));
            (lowest, highest) = (angle, angle);
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 20 mph.
    const SPEED_MPS: f64 = 8.9408;

    /// A drive of which frame `k` at `k · dt_s` shows what `frame` says: angle of the front wheels and heading, deg.
    fn drive(frames: usize, dt_s: f64, frame: impl Fn(f64) -> (f64, f64)) -> (Vec<CalmFrame>, f64) {
        let frames_of = (0..frames).map(|k| {
            let time_s = k as f64 * dt_s;
            let (angle_deg, heading_deg) = frame(time_s);
            CalmFrame { time_s, angle_deg, heading_deg, speed_mps: SPEED_MPS, put_back: false }
        });
        (frames_of.collect(), frames as f64 * dt_s)
    }

    #[test]
    fn reversals_are_turns_back_by_more_than_a_degree() {
        let count = |angles: &[f64]| count_reversals(angles.iter().copied());
        assert_eq!(count(&[]), 0);
        assert_eq!(count(&[0.0, 5.0, 10.0]), 0, "one way only");
        assert_eq!(count(&[0.0, 2.0, 1.1, 2.0, 1.2, 2.1]), 0, "by less than a degree");
        assert_eq!(count(&[0.0, 2.0, 0.9]), 1);
        assert_eq!(count(&[0.0, 2.0, 1.6, 1.3, 0.9, 0.5, 1.4]), 1, "slowly back, and not again");
        assert_eq!(count(&[0.0, -2.0, 0.0, -2.0]), 2);
        // 20 periods of a sine of 0.6 deg, so swings of 1.2 deg: all its 40 peaks but the first, after half a swing, and the last.
        let sine: Vec<f64> = (0..1000).map(|k| 0.6 * (f64::from(k) * 0.02 * std::f64::consts::TAU).sin()).collect();
        assert_eq!(count(&sine), 38);
        assert_eq!(count(&sine.iter().map(|angle| angle * 0.8).collect::<Vec<_>>()), 0);
    }

    #[test]
    fn a_swaying_car_has_the_figures_of_its_sine() {
        // Heading 2 deg · sin(w t) at 20 mph: the acceleration has the amplitude v · A · w, the jerk v · A · w².
        let (a_deg, w): (f64, f64) = (2.0, 1.5);
        let swaying = drive(4000, 0.05, |t| (3.0 * (w * t).sin(), a_deg * (w * t).sin()));
        let calm = Calm::of([swaying]);
        let jerk = SPEED_MPS * a_deg.to_radians() * w * w / 2f64.sqrt();
        approx::assert_relative_eq!(calm.lateral_jerk_rms_mps3, jerk, max_relative = 5e-3);
        approx::assert_relative_eq!(
            calm.reversals_per_min,
            60.0 * 2.0 * w / std::f64::consts::TAU,
            max_relative = 2e-2
        );
        // The rate 3 w cos(w t) exceeds 0.9969 of its maximum in 5 % of the time.
        approx::assert_relative_eq!(calm.angle_change_p95_deg, 3.0 * w * 0.05 * 0.9969, max_relative = 5e-3);
    }

    #[test]
    fn a_circle_is_calm_whatever_direction_it_passes_through() {
        let radius_m = 2.87 / 5f64.to_radians().tan();
        let rate_deg = (SPEED_MPS / radius_m).to_degrees();
        let circle = drive(2000, 0.05, |t| (5.0, (170.0 + rate_deg * t + 180.0).rem_euclid(360.0) - 180.0));
        let calm = Calm::of([circle]);
        assert_eq!((calm.reversals_per_min, calm.angle_change_p95_deg), (0.0, 0.0));
        assert!(calm.lateral_jerk_rms_mps3 < 1e-6, "{calm:?}");
    }

    #[test]
    fn putting_the_car_back_is_no_movement_of_the_wheel() {
        let mut put_back = drive(200, 0.04, |t| if t < 4.0 { (3.0, 0.0) } else { (-3.0, 90.0) });
        assert!(Calm::of([put_back.clone()]).lateral_jerk_rms_mps3 > 1.0);
        put_back.0[100].put_back = true;
        assert_eq!(Calm::of([put_back]), Calm::default());
        assert_eq!(Calm::of([]), Calm::default());
    }
}
