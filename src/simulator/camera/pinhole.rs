//! The cameras of Udacity's car: where they sit, where they look, and which pixel shows which point.

use ndarray::ArrayView3;

use crate::simulator::car::pose::BodyPose;
use crate::simulator::math::{Vec3, sin_cos, vec3};

/// Width of a picture, pixels.
pub const WIDTH: usize = 320;
/// Height of a picture, pixels.
pub const HEIGHT: usize = 160;
/// Focal length in pixels, both axes: half the height over the tangent of half the vertical field of view of 60 degrees.
pub const FOCAL_PX: f32 = 138.564_06;

/// A picture as a camera takes it, row by row from the top, three bytes (red, green, blue) a pixel; 320x160 unless the camera is that
/// of another car.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RgbFrame {
    /// Height and width, pixels.
    pub size: [usize; 2],
    /// `height * width * 3` bytes.
    pub pixels: Vec<u8>,
}

impl Default for RgbFrame {
    fn default() -> Self {
        RgbFrame::new([HEIGHT, WIDTH])
    }
}

impl RgbFrame {
    /// A black picture.
    pub fn new(size: [usize; 2]) -> RgbFrame {
        RgbFrame { size, pixels: vec![0; size[0] * size[1] * 3] }
    }

    /// The pixels as an array, `(height, width, 3)`.
    ///
    /// # Panics
    ///
    /// Panics if there are not `height · width · 3` bytes of them.
    pub fn view(&self) -> ArrayView3<'_, u8> {
        let [height, width] = self.size;
        ArrayView3::from_shape((height, width, 3), &self.pixels).expect("height · width · 3 bytes")
    }
}

/// The three cameras of the recording car.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mount {
    /// In the middle; the one that drives.
    Center,
    /// 0.806 m to the left.
    Left,
    /// 0.825 m to the right.
    Right,
}

impl Mount {
    /// All three in the order of the log's columns.
    pub const ALL: [Mount; 3] = [Mount::Center, Mount::Left, Mount::Right];

    /// Prefix of the file names in `IMG/`.
    pub fn name(self) -> &'static str {
        match self {
            Mount::Center => "center",
            Mount::Left => "left",
            Mount::Right => "right",
        }
    }

    /// Place in the body: metres to the right, up and forward of the middle of the car on the ground.
    pub fn place_m(self) -> [f32; 3] {
        match self {
            Mount::Center => [0.0, 1.2, 1.0],
            Mount::Left => [-0.806, 1.2, 0.984],
            Mount::Right => [0.825, 1.2, 0.999],
        }
    }
}

/// Downward pitch, yaw to the right and roll (right side up) of every camera in the body, deg.
pub const PITCH_YAW_ROLL_DEG: [f64; 3] = [9.5, 0.723, 1.201];

/// A camera placed in the world.
#[derive(Clone, Copy, Debug)]
pub struct Camera {
    /// Where the light is gathered.
    pub eye: Vec3,
    /// Along the optical axis.
    pub forward: Vec3,
    /// To the right in the picture.
    pub right: Vec3,
    /// Up in the picture.
    pub up: Vec3,
    /// Focal length in pixels of the 320x160, both axes.
    pub focal_px: f32,
}

impl Camera {
    /// The camera `mount` of a car whose body is at `body`.
    pub fn new(body: &BodyPose, mount: Mount) -> Camera {
        Camera::placed(body, mount.place_m(), PITCH_YAW_ROLL_DEG)
    }

    /// A camera at `place_m` in the body, turned as said: see [`Mount::place_m`] and `PITCH_YAW_ROLL_DEG`.
    ///
    /// Rotations are applied in Unity's order: roll, then pitch, then yaw. The lens is the simulator's own.
    pub fn placed(body: &BodyPose, place_m: [f32; 3], pitch_yaw_roll_deg: [f64; 3]) -> Camera {
        let [(sp, cp), (sy, cy), (sr, cr)] = pitch_yaw_roll_deg.map(|deg| {
            let (sin, cos) = sin_cos(deg.to_radians());
            (sin as f32, cos as f32)
        });
        // Body coordinates: right, up, forward.
        let pitched = |[x, y, z]: [f32; 3]| [x, y * cp - z * sp, y * sp + z * cp];
        let yawed = |[x, y, z]: [f32; 3]| [x * cy + z * sy, y, z * cy - x * sy];
        let world = |[x, y, z]: [f32; 3]| body.right * x + body.up * y + body.forward * z;
        Camera {
            eye: body.origin + world(place_m),
            forward: world(yawed(pitched([0.0, 0.0, 1.0]))),
            right: world(yawed(pitched([cr, sr, 0.0]))),
            up: world(yawed(pitched([-sr, cr, 0.0]))),
            focal_px: FOCAL_PX,
        }
    }

    /// Direction through the picture point (column, row), scaled so that its component along the axis is 1.
    /// Pixel centres lie at halves.
    pub fn ray(&self, column: f32, row: f32) -> Vec3 {
        self.forward
            + self.right * ((column - WIDTH as f32 / 2.0) / self.focal_px)
            + self.up * ((HEIGHT as f32 / 2.0 - row) / self.focal_px)
    }

    /// Camera coordinates of a point: to the right, up, along the axis, m.
    pub fn view(&self, point: Vec3) -> Vec3 {
        let p = point - self.eye;
        vec3(p.dot(self.right), p.dot(self.up), p.dot(self.forward))
    }

    /// Picture point (column, row) of a point in front of the camera, `None` behind it.
    pub fn project(&self, point: Vec3) -> Option<(f32, f32)> {
        let v = self.view(point);
        (v.z > 0.01).then(|| {
            let f = self.focal_px;
            (WIDTH as f32 / 2.0 + v.x / v.z * f, HEIGHT as f32 / 2.0 - v.y / v.z * f)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn level_body() -> BodyPose {
        BodyPose {
            origin: vec3(10.0, 20.0, 3.0),
            forward: vec3(0.0, 1.0, 0.0),
            right: vec3(1.0, 0.0, 0.0),
            up: vec3(0.0, 0.0, 1.0),
        }
    }

    #[test]
    fn known_points_fall_on_the_expected_pixels() {
        let camera = Camera::new(&level_body(), Mount::Center);
        // A point on the axis of the camera: 10 m along 9.5 degrees down and 0.723 degrees to the right.
        let (p, y) = (9.5f64.to_radians(), 0.723f64.to_radians());
        let axis = vec3((y.sin() * p.cos()) as f32, (y.cos() * p.cos()) as f32, -p.sin() as f32);
        let (column, row) = camera.project(camera.eye + axis * 10.0).unwrap();
        assert!((column - 160.0).abs() < 0.01 && (row - 80.0).abs() < 0.01, "{column} {row}");
        // The horizon straight ahead stands f tan(9.5 deg) above the middle; the yaw moves it f tan(0.723 deg) to the
        // left, and the roll of 1.201 degrees turns this offset about the middle.
        let (column, row) = camera.project(camera.eye + vec3(0.0, 1e6, 0.0)).unwrap();
        assert!((column - 158.75).abs() < 0.3 && (row - 56.8).abs() < 0.3, "{column} {row}");
        // The right end of the horizon is lower in the picture than the left end: the camera's right side is up.
        let left = camera.project(camera.eye + vec3(-1e6, 1e6, 0.0)).unwrap();
        let right = camera.project(camera.eye + vec3(1e6, 1e6, 0.0)).unwrap();
        assert!(right.1 - left.1 > 4.0, "{left:?} {right:?}");
    }

    #[test]
    fn rays_and_projection_are_inverse() {
        let camera = Camera::new(&level_body(), Mount::Left);
        for (column, row) in [(0.5, 159.5), (200.0, 40.0), (319.5, 100.0)] {
            let (c, r) = camera.project(camera.eye + camera.ray(column, row) * 7.0).unwrap();
            assert!((c - column).abs() < 1e-2 && (r - row).abs() < 1e-2);
        }
        assert!(camera.project(camera.eye - camera.forward).is_none());
    }

    #[test]
    fn side_cameras_are_pure_offsets() {
        let [center, left, right] = Mount::ALL.map(|m| Camera::new(&level_body(), m));
        assert_eq!(center.forward, left.forward);
        assert!((center.eye.x - left.eye.x - 0.806).abs() < 1e-5 && (right.eye.x - center.eye.x - 0.825).abs() < 1e-5);
        assert!((center.eye.z - 4.2).abs() < 1e-5);
    }
}
