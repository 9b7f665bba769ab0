//! Recording as another car: its cameras' mount and its wheels' angle, with the lens of the simulator's own cameras.

use crate::geometry::CarGeometry;
use crate::simulator::camera::pinhole::{Camera, FOCAL_PX, HEIGHT, Mount, WIDTH};
use crate::simulator::car::pose::BodyPose;

/// Distance from the rear axle to the middle of the simulator's car, m.
const REAR_AXLE_M: f64 = 1.6;
/// Relative difference of the focal length, in pixels of the simulator's picture, that makes another lens.
const SAME_LENS: f64 = 0.005;

/// Why the simulator cannot record as `car`; `None` if it can.
pub fn trouble(car: &CarGeometry) -> Option<String> {
    let [height, width] = car.image.map(|pixels| pixels as f64);
    let focal_px = car.focal_px * HEIGHT as f64 / height;
    let is_same = (focal_px / f64::from(FOCAL_PX) - 1.0).abs() <= SAME_LENS;
    if !is_same || (width / height * HEIGHT as f64 / WIDTH as f64 - 1.0).abs() > SAME_LENS {
        let [own, theirs] = [(WIDTH as f64, HEIGHT as f64, f64::from(FOCAL_PX)), (width, height, car.focal_px)]
            .map(|(width, height, focal_px)| format!("{width}x{height} pixels at a focal length of {focal_px:.1}"));
        return Some(format!("its lens is another one: the simulator's is {own}, this is {theirs}"));
    }
    let ranges = [
        ("height_m", car.height_m, 0.6..=2.0),
        ("pitch_deg", car.pitch_deg, 0.0..=16.0),
        ("yaw_deg", car.yaw_deg, -5.0..=5.0),
        ("roll_deg", car.roll_deg, -5.0..=5.0),
        ("wheelbase_m", car.wheelbase_m, 1.5..=4.5),
    ];
    let (name, value, range) = ranges.into_iter().find(|(_, value, range)| !range.contains(value))?;
    Some(format!("its {name} is {value}, and {} to {} can be simulated", range.start(), range.end()))
}

/// The camera `mount` of `car` on a body at `body`.
pub(super) fn camera(body: &BodyPose, mount: Mount, car: &CarGeometry) -> Camera {
    let [left_m, right_m] = car.side_offsets_m;
    let right_m = match mount {
        Mount::Center => 0.0,
        Mount::Left => left_m,
        Mount::Right => right_m,
    };
    let place_m = [right_m, car.height_m, car.ahead_m - REAR_AXLE_M].map(|m| m as f32);
    Camera::placed(body, place_m, [car.pitch_deg, car.yaw_deg, car.roll_deg])
}

/// The steering with which `car` drives as the simulator's car does with `steering`.
pub(super) fn steering(steering: f64, car: &CarGeometry) -> f64 {
    let own = CarGeometry::simulator();
    match (own.wheelbase_m, own.full_lock_deg) == (car.wheelbase_m, car.full_lock_deg) {
        true => steering,
        false => car.steering_for(own.curvature(steering)).clamp(-1.0, 1.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::recorder::expert_drive::drive_expert;
    use crate::simulator::{RecordOptions, Track};

    #[test]
    fn the_own_car_is_recorded_as_ever_and_others_from_where_they_see() {
        let track = Track::load("lake").unwrap();
        let body = drive_expert(&track, &RecordOptions { laps: 0.01, ..Default::default() })[0].body;
        let own = CarGeometry::simulator();
        assert_eq!(trouble(&own), None);
        for mount in Mount::ALL {
            let (usual, same) = (Camera::new(&body, mount), camera(&body, mount, &own));
            // The side cameras sit up to 1.6 cm further back; directions are the same.
            let apart = usual.eye - same.eye;
            assert!((apart.x * apart.x + apart.y * apart.y + apart.z * apart.z).sqrt() < 0.017, "{mount:?}");
            assert!((usual.forward.x, usual.up.z) == (same.forward.x, same.up.z), "{mount:?}");
        }
        let higher = CarGeometry { height_m: 1.5, pitch_deg: 0.0, roll_deg: 0.0, yaw_deg: 0.0, ..own.clone() };
        let seen = camera(&body, Mount::Right, &higher);
        let from_body = seen.eye - body.origin;
        let along =
            |axis: crate::simulator::math::Vec3| from_body.x * axis.x + from_body.y * axis.y + from_body.z * axis.z;
        let place = [along(body.right), along(body.up), along(body.forward)];
        assert!(place.iter().zip([0.825, 1.5, 1.0]).all(|(found, m)| (found - m).abs() < 1e-4), "{place:?}");
    }

    #[test]
    fn a_car_that_turns_the_wheels_less_is_labelled_with_more_steering() {
        let own = CarGeometry::simulator();
        assert_eq!(steering(0.3, &own), 0.3);
        let half = CarGeometry { full_lock_deg: 12.5, ..own.clone() };
        assert!((steering(0.3, &half) - 0.6).abs() < 1e-12 && steering(0.9, &half) == 1.0);
        // Twice as long, it needs twice the tangent.
        let long = CarGeometry { wheelbase_m: 2.0 * own.wheelbase_m, ..own.clone() };
        assert!((long.curvature(steering(0.3, &long)) - own.curvature(0.3)).abs() < 1e-12);
    }

    #[test]
    fn other_lenses_and_small_cars_are_refused() {
        let of = |name: &str| trouble(&CarGeometry::preset(name).unwrap());
        assert_eq!([of("steersman"), of("udacity"), of("udacity-straight")], [None, None, None]);
        assert!(of("donkeycar").unwrap().contains("lens"));
        let double = CarGeometry { image: [320, 640], focal_px: 277.128, ..CarGeometry::simulator() };
        assert_eq!(trouble(&double), None, "the same lens on a finer sensor");
        let low = CarGeometry { height_m: 0.2, ..CarGeometry::simulator() };
        assert!(trouble(&low).unwrap().contains("height_m is 0.2, and 0.6 to 2"));
    }
}
