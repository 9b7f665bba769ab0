//! Seeing as another car: its cameras' mount and lens, and its wheels' angle.
//!
//! A small car drives on a model of the track: a world in which the car would be as long as the simulator's own. So a donkeycar with a
//! wheelbase of 0.26 m drives at 1:11, where a road of 8 m is 0.72 m wide and a camera 0.2 m high looks from 2.2 m; its dynamics are those of the
//! simulator's car.

use crate::dataset::resize::{Interpolation, Resizer};
use crate::geometry::CarGeometry;
use crate::simulator::camera::pinhole::{Camera, FOCAL_PX, HEIGHT, Mount, RgbFrame, WIDTH};
use crate::simulator::camera::renderer::Renderer;
use crate::simulator::car::pose::BodyPose;
use crate::simulator::scenery::light::Variant;
use crate::simulator::scenery::world::World;

/// Distance from the rear axle to the middle of the simulator's car, m.
const REAR_AXLE_M: f64 = 1.6;
/// Relative difference of the focal length, in pixels of the simulator's picture, that makes another lens.
const SAME_LENS: f64 = 0.005;
/// Wheelbase of the longest small car, m.
const MAX_SMALL_WHEELBASE_M: f64 = 0.6;
/// Shortest focal length that can be rendered, in pixels of the simulator's picture, and longest, which still shows a road.
const FOCAL_RANGE_PX: std::ops::RangeInclusive<f64> = 90.0..=300.0;

/// By how much the track is larger than the model of it on which `car` drives: 1 for a car of usual size.
pub fn scale(car: &CarGeometry) -> f64 {
    let is_small = (0.1..=MAX_SMALL_WHEELBASE_M).contains(&car.wheelbase_m);
    if is_small { CarGeometry::simulator().wheelbase_m / car.wheelbase_m } else { 1.0 }
}

/// `car` as large as its track.
fn full_size(car: &CarGeometry) -> CarGeometry {
    let scale = scale(car);
    CarGeometry {
        height_m: scale * car.height_m,
        ahead_m: scale * car.ahead_m,
        side_offsets_m: car.side_offsets_m.map(|offset_m| scale * offset_m),
        // A small car is scaled to the simulator's wheelbase; this is exact.
        wheelbase_m: if scale == 1.0 { car.wheelbase_m } else { CarGeometry::simulator().wheelbase_m },
        ..car.clone()
    }
}

/// The picture of a car as a part of the simulator's.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Lens {
    /// Focal length in pixels of the simulator's picture.
    focal_px: f64,
    /// Rows and columns in the middle of the simulator's picture: even numbers, so that the optical axis stays in the middle.
    part: [usize; 2],
}

impl Lens {
    fn of(car: &CarGeometry) -> Lens {
        let [height, width] = car.image.map(|pixels| pixels as f64);
        let per_pixel = (HEIGHT as f64 / height).min(WIDTH as f64 / width);
        let part = [height, width].map(|side| 2 * (side * per_pixel / 2.0).round().max(1.0) as usize);
        Lens { focal_px: car.focal_px * per_pixel, part }
    }

    /// Whether it is the simulator's own.
    fn is_own(&self) -> bool {
        let focal = self.focal_px / f64::from(FOCAL_PX);
        self.part == [HEIGHT, WIDTH] && (focal - 1.0).abs() <= SAME_LENS
    }
}

/// Why the simulator cannot see as `car`; `None` if it can.
pub fn trouble(car: &CarGeometry) -> Option<String> {
    let lens = Lens::of(car);
    if !FOCAL_RANGE_PX.contains(&lens.focal_px) {
        let [height, width] = car.image;
        let across_deg = 2.0 * (0.5 * width as f64 / car.focal_px).atan().to_degrees();
        return Some(format!(
            "its lens shows {across_deg:.0} degrees across ({width}x{height} pixels at a focal length of {:.1}): in pixels of the simulator's \
             320x160 the focal length is {:.1}, and {} to {} can be simulated",
            car.focal_px,
            lens.focal_px,
            FOCAL_RANGE_PX.start(),
            FOCAL_RANGE_PX.end()
        ));
    }
    let scale = scale(car);
    let (name_of_height, height, pitch) = match scale == 1.0 {
        true => ("height_m", 0.6..=2.0, 0.0..=16.0),
        false => ("height_m on the scale of the track", 1.6..=3.0, 0.0..=25.0),
    };
    let full = full_size(car);
    let ranges = [
        (name_of_height, full.height_m, height),
        ("pitch_deg", car.pitch_deg, pitch),
        ("yaw_deg", car.yaw_deg, -5.0..=5.0),
        ("roll_deg", car.roll_deg, -5.0..=5.0),
        ("wheelbase_m", full.wheelbase_m, 1.5..=4.5),
    ];
    let (name, value, range) = ranges.into_iter().find(|(_, value, range)| !range.contains(value))?;
    Some(format!("its {name} is {value}, and {} to {} can be simulated", range.start(), range.end()))
}

/// Whether `car` has cameras on both sides.
pub fn has_side_cameras(car: &CarGeometry) -> bool {
    car.side_offsets_m != [0.0; 2]
}

/// The camera `mount` of `car` on a body at `body`.
fn camera(body: &BodyPose, mount: Mount, car: &CarGeometry) -> Camera {
    let car = full_size(car);
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
pub fn steering(steering: f64, car: &CarGeometry) -> f64 {
    let (own, car) = (CarGeometry::simulator(), full_size(car));
    match (own.wheelbase_m, own.full_lock_deg) == (car.wheelbase_m, car.full_lock_deg) {
        true => steering,
        false => car.steering_for(own.curvature(steering)).clamp(-1.0, 1.0),
    }
}

/// The steering with which the simulator's car drives as `car` does with `steering`.
pub fn steering_of(steering: f64, car: &CarGeometry) -> f64 {
    let (own, car) = (CarGeometry::simulator(), full_size(car));
    match (own.wheelbase_m, own.full_lock_deg) == (car.wheelbase_m, car.full_lock_deg) {
        true => steering,
        false => own.steering_for(car.curvature(steering.clamp(-1.0, 1.0))),
    }
}

/// Takes pictures as a car does; keeps its buffers.
pub struct Eye {
    /// The simulator's own car if there is none.
    car: Option<CarGeometry>,
    renderer: Renderer,
    whole: RgbFrame,
    cut: Option<Cut>,
}

/// A picture that is a part of the simulator's.
struct Cut {
    lens: Lens,
    resizer: Resizer,
    part: Vec<u8>,
    picture: RgbFrame,
}

impl Eye {
    /// The eye of `car`, for which there must be no [`trouble`].
    pub fn new(car: Option<&CarGeometry>) -> Eye {
        let lens = car.map(|car| (car, Lens::of(car))).filter(|(_, lens)| !lens.is_own());
        let cut = lens.map(|(car, lens)| Cut {
            lens,
            resizer: Resizer::new(lens.part, car.image, 3, Interpolation::Area),
            part: Vec::new(),
            picture: RgbFrame::new(car.image),
        });
        Eye { car: car.cloned(), renderer: Renderer::default(), whole: RgbFrame::default(), cut }
    }

    /// Height and width of its pictures.
    pub fn size(&self) -> [usize; 2] {
        self.cut.as_ref().map_or(self.whole.size, |cut| cut.picture.size)
    }

    /// What the camera `mount` sees of `world` in the light of `variant` from a body at `body`.
    pub fn see(&mut self, world: &World, variant: &Variant, body: &BodyPose, mount: Mount) -> &RgbFrame {
        let mut camera = match &self.car {
            Some(car) => camera(body, mount, car),
            None => Camera::new(body, mount),
        };
        let Some(Cut { lens, resizer, part, picture }) = &mut self.cut else {
            self.renderer.render(world, variant, &camera, mount, &mut self.whole);
            return &self.whole;
        };
        camera.focal_px = lens.focal_px as f32;
        // The bonnet belongs to the simulator's own car and lens.
        self.renderer.render(world, variant, &camera, None, &mut self.whole);
        let [rows, columns] = lens.part;
        let (top, left) = ((HEIGHT - rows) / 2, (WIDTH - columns) / 2);
        part.clear();
        for row in self.whole.pixels.chunks_exact(3 * WIDTH).skip(top).take(rows) {
            part.extend_from_slice(&row[3 * left..3 * (left + columns)]);
        }
        resizer.apply(part, &mut picture.pixels);
        picture
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
    fn a_donkeycar_sees_the_road_from_low_above_a_model_of_the_track() {
        let donkey = CarGeometry::preset("donkeycar").unwrap();
        assert_eq!((scale(&donkey) * 26.0).round(), 287.0);
        assert_eq!(
            steering(0.37, &donkey),
            0.37,
            "its wheels turn as far, and its circles are as much smaller as the track"
        );
        let track = Track::load("lake").unwrap();
        let body = drive_expert(&track, &RecordOptions { laps: 0.01, ..Default::default() })[0].body;
        let seen = camera(&body, Mount::Center, &donkey);
        let height_m = (seen.eye - body.origin).dot(body.up);
        assert!((f64::from(height_m) / scale(&donkey) - 0.2).abs() < 1e-4, "{height_m}");
        let mut eye = Eye::new(Some(&donkey));
        let variant = Variant::new(track.world(), 1);
        assert_eq!(eye.size(), [120, 160]);
        let picture = eye.see(track.world(), &variant, &body, Mount::Center).clone();
        assert_eq!((picture.size, picture.pixels.len()), ([120, 160], 120 * 160 * 3));
        // The road lies in the lower half and the sky, which is bluer, in the upper rows: at 90 degrees across and 20 down the horizon
        // stands 80 tan 20° = 29 rows above the middle.
        let mean = |rows: std::ops::Range<usize>, colour: usize| {
            let pixels = picture.pixels[rows.start * 480..rows.end * 480].chunks_exact(3);
            pixels.map(|pixel| f64::from(pixel[colour])).sum::<f64>() / (rows.len() * 160) as f64
        };
        assert!(mean(0..20, 2) > mean(0..20, 0) + 5.0, "{} {}", mean(0..20, 2), mean(0..20, 0));
        assert!((mean(90..120, 2) - mean(90..120, 0)).abs() < 30.0);
        // A point ahead falls on the pixel that the geometry says.
        let mut camera = seen;
        camera.focal_px = Lens::of(&donkey).focal_px as f32;
        let (column, row) = camera.project(camera.eye + camera.forward * 10.0 + camera.right * 5.0).unwrap();
        assert!(
            (f64::from(column) - 160.0 - 0.5 * 80.0 * 4.0 / 3.0).abs() < 0.01 && (row - 80.0).abs() < 0.01,
            "{column}"
        );
    }

    #[test]
    fn the_optical_axis_of_a_part_stays_in_its_middle() {
        let donkey = CarGeometry::preset("donkeycar").unwrap();
        let narrow = CarGeometry { image: [100, 31], focal_px: 100.0, ..donkey.clone() };
        let flat = CarGeometry { image: [31, 100], focal_px: 50.0, ..donkey.clone() };
        let track = Track::load("lake").unwrap();
        let body = drive_expert(&track, &RecordOptions { laps: 0.01, ..Default::default() })[0].body;
        for car in [donkey, narrow, flat] {
            let lens = Lens::of(&car);
            let [rows, columns] = lens.part;
            let (top, left) = ((HEIGHT - rows) / 2, (WIDTH - columns) / 2);
            assert_eq!([2 * top + rows, 2 * left + columns], [HEIGHT, WIDTH], "{lens:?}");
            // A point ahead on the optical axis falls on the middle of the part.
            let mut camera = camera(&body, Mount::Center, &car);
            camera.focal_px = lens.focal_px as f32;
            let (column, row) = camera.project(camera.eye + camera.forward * 10.0).unwrap();
            let place = [row - top as f32, column - left as f32];
            assert!((place[0] - rows as f32 / 2.0).abs() < 1e-3, "{lens:?} {place:?}");
            assert!((place[1] - columns as f32 / 2.0).abs() < 1e-3, "{lens:?} {place:?}");
            // Its shape is that of the car's picture.
            let shape = columns as f64 / rows as f64 / (car.image[1] as f64 / car.image[0] as f64);
            assert!((shape - 1.0).abs() < 0.02, "{lens:?}");
        }
    }

    #[test]
    fn the_own_lens_gives_the_own_picture_to_the_bit() {
        let track = Track::load("lake").unwrap();
        let body = drive_expert(&track, &RecordOptions { laps: 0.01, ..Default::default() })[0].body;
        let variant = Variant::new(track.world(), 1);
        let mut usual = RgbFrame::default();
        Renderer::default().render(
            track.world(),
            &variant,
            &Camera::new(&body, Mount::Center),
            Mount::Center,
            &mut usual,
        );
        assert_eq!(*Eye::new(None).see(track.world(), &variant, &body, Mount::Center), usual);
        assert_eq!(Eye::new(CarGeometry::preset("udacity").as_ref()).size(), usual.size);
    }

    #[test]
    fn what_cannot_be_simulated_is_refused_with_what_can() {
        let of = |name: &str| trouble(&CarGeometry::preset(name).unwrap());
        assert_eq!([of("steersman"), of("udacity"), of("udacity-straight"), of("donkeycar")], [None, None, None, None]);
        let double = CarGeometry { image: [320, 640], focal_px: 277.128, ..CarGeometry::simulator() };
        assert!(trouble(&double).is_none() && Lens::of(&double).is_own(), "the same lens on a finer sensor");
        let fish_eye = CarGeometry { focal_px: 40.0, ..CarGeometry::preset("donkeycar").unwrap() };
        assert!(trouble(&fish_eye).unwrap().contains("127 degrees across"), "{:?}", trouble(&fish_eye));
        let low = CarGeometry { height_m: 0.2, ..CarGeometry::simulator() };
        assert!(trouble(&low).unwrap().contains("height_m is 0.2, and 0.6 to 2"));
        let flat = CarGeometry { height_m: 0.1, ..CarGeometry::preset("donkeycar").unwrap() };
        assert!(trouble(&flat).unwrap().contains("on the scale of the track is 1.1"), "{:?}", trouble(&flat));
    }
}
