//! Camera mount, lens and car of a recording.

use serde::{Deserialize, Serialize};

use crate::error::{Error, Result};

/// Where the camera sits, how it sees, and how the car turns.
///
/// Lenses are pinholes without distortion. Pixel centres lie at halves, the optical axis goes through the middle of the picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CarGeometry {
    /// Height and width of the picture that `focal_px` refers to, pixels.
    pub image: [usize; 2],
    /// Focal length, both axes, pixels.
    pub focal_px: f64,
    /// Height of the camera above the ground, m.
    pub height_m: f64,
    /// Distance of the camera ahead of the rear axle, m.
    pub ahead_m: f64,
    /// Downward pitch of the camera, deg.
    pub pitch_deg: f64,
    /// Yaw of the camera to the right, deg.
    pub yaw_deg: f64,
    /// Roll of the camera, deg; positive if its right side is up.
    pub roll_deg: f64,
    /// Places of the left and of the right camera beside the centre camera, m, + = right.
    pub side_offsets_m: [f64; 2],
    /// Distance between the axles, m.
    pub wheelbase_m: f64,
    /// Angle of the front wheels at steering 1, deg.
    pub full_lock_deg: f64,
}

/// The presets: name, what it stands for, geometry.
const PRESETS: [(&str, &str, CarGeometry); 4] = [
    ("udacity", "Udacity's simulator: the cameras are rolled by 1.2 and turned by 0.7 degrees", UDACITY),
    (
        "udacity-straight",
        "Udacity's car with level cameras that look straight ahead",
        CarGeometry { yaw_deg: 0.0, roll_deg: 0.0, side_offsets_m: [-0.815, 0.815], ..UDACITY },
    ),
    ("steersman", "the built-in simulator, whose car stands level and has Udacity's cameras", STEERSMAN),
    ("donkeycar", "a small car with a wide lens 0.2 m above the ground", DONKEYCAR),
];

/// The cameras of Udacity's car as they are mounted: prefab of its simulator, version 2 (field of view 60 degrees vertical, 320x160).
const STEERSMAN: CarGeometry = CarGeometry {
    image: [160, 320],
    focal_px: 138.564_06,
    height_m: 1.2,
    ahead_m: 2.6,
    pitch_deg: 9.5,
    yaw_deg: 0.723,
    roll_deg: 1.201,
    side_offsets_m: [-0.806, 0.825],
    wheelbase_m: 2.87,
    full_lock_deg: 25.0,
};

/// Udacity's car as it drives: its body rides 4 cm higher than it stands, with its nose up. Fitted to the side cameras of a recording
/// (`inspect --fit-camera`): the warp's error over the ground falls from 0.68 of that without a warp to 0.46.
const UDACITY: CarGeometry = CarGeometry { height_m: 1.24, pitch_deg: 7.6, ..STEERSMAN };

/// A donkeycar of scale 1:10: a lens of about 90 degrees across, pictures of 160x120.
const DONKEYCAR: CarGeometry = CarGeometry {
    image: [120, 160],
    focal_px: 80.0,
    height_m: 0.2,
    ahead_m: 0.25,
    pitch_deg: 20.0,
    yaw_deg: 0.0,
    roll_deg: 0.0,
    side_offsets_m: [0.0, 0.0],
    wheelbase_m: 0.26,
    full_lock_deg: 25.0,
};

impl CarGeometry {
    /// Name of the preset for recordings that say nothing of their camera.
    pub const USUAL: &str = "udacity";
    /// Name of the preset for small cars that say nothing of their camera.
    pub const USUAL_SMALL: &str = "donkeycar";

    /// That of the built-in simulator.
    pub fn simulator() -> CarGeometry {
        STEERSMAN
    }

    /// Names of the presets, each with what it stands for.
    pub fn presets() -> impl Iterator<Item = (&'static str, &'static str)> {
        PRESETS.iter().map(|(name, about, _)| (*name, *about))
    }

    /// The preset `name`, if there is one.
    pub fn preset(name: &str) -> Option<CarGeometry> {
        PRESETS.iter().find(|(known, ..)| *known == name).map(|(_, _, geometry)| geometry.clone())
    }

    /// Angle of the front wheels that belongs to `steering`, rad, + = right.
    pub fn wheel_angle(&self, steering: f64) -> f64 {
        (steering * self.full_lock_deg).to_radians()
    }

    /// Curvature of the rear axle's path at `steering`, 1/m, + = right.
    pub fn curvature(&self, steering: f64) -> f64 {
        libm::tan(self.wheel_angle(steering)) / self.wheelbase_m
    }

    /// The steering that leads the rear axle to a point `right_m` aside and `ahead_m` ahead, `look_ahead_m` along the path; it may lie
    /// beyond [-1, 1].
    ///
    /// The circle through the rear axle, tangent to the car, that meets a point `right` aside at the distance `l` has the curvature
    /// `2 right / l²`. A distance that is shorter than half the way along the path counts as half of it.
    pub fn steering_towards(&self, right_m: f64, ahead_m: f64, look_ahead_m: f64) -> f64 {
        let square = (right_m * right_m + ahead_m * ahead_m).max(0.25 * look_ahead_m * look_ahead_m);
        self.steering_for(2.0 * right_m / square)
    }

    /// The steering whose path has the curvature `curvature`, 1/m; beyond [-1, 1] if the car cannot turn as sharply.
    pub fn steering_for(&self, curvature: f64) -> f64 {
        libm::atan(curvature * self.wheelbase_m).to_degrees() / self.full_lock_deg
    }
}

/// What `steersman.toml` says of the geometry: a preset, and entries that differ from it.
///
/// ```toml
/// [camera]
/// preset = "udacity"
/// roll_deg = 0.0
/// ```
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GeometryEntry {
    /// Name of a preset; the one for the recording's format when absent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub preset: Option<String>,
    /// See [`CarGeometry::image`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub image: Option<[usize; 2]>,
    /// See [`CarGeometry::focal_px`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub focal_px: Option<f64>,
    /// See [`CarGeometry::height_m`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height_m: Option<f64>,
    /// See [`CarGeometry::ahead_m`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ahead_m: Option<f64>,
    /// See [`CarGeometry::pitch_deg`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pitch_deg: Option<f64>,
    /// See [`CarGeometry::yaw_deg`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub yaw_deg: Option<f64>,
    /// See [`CarGeometry::roll_deg`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub roll_deg: Option<f64>,
    /// See [`CarGeometry::side_offsets_m`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub side_offsets_m: Option<[f64; 2]>,
    /// See [`CarGeometry::wheelbase_m`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub wheelbase_m: Option<f64>,
    /// See [`CarGeometry::full_lock_deg`].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub full_lock_deg: Option<f64>,
}

impl From<&CarGeometry> for GeometryEntry {
    /// Every entry said, and no preset.
    fn from(geometry: &CarGeometry) -> Self {
        GeometryEntry {
            preset: None,
            image: Some(geometry.image),
            focal_px: Some(geometry.focal_px),
            height_m: Some(geometry.height_m),
            ahead_m: Some(geometry.ahead_m),
            pitch_deg: Some(geometry.pitch_deg),
            yaw_deg: Some(geometry.yaw_deg),
            roll_deg: Some(geometry.roll_deg),
            side_offsets_m: Some(geometry.side_offsets_m),
            wheelbase_m: Some(geometry.wheelbase_m),
            full_lock_deg: Some(geometry.full_lock_deg),
        }
    }
}

impl GeometryEntry {
    /// Whether nothing need be assumed: a preset is named, or every entry is there.
    pub fn is_complete(&self) -> bool {
        let said = [
            self.image.is_some(),
            self.focal_px.is_some(),
            self.height_m.is_some(),
            self.ahead_m.is_some(),
            self.pitch_deg.is_some(),
            self.yaw_deg.is_some(),
            self.roll_deg.is_some(),
            self.side_offsets_m.is_some(),
            self.wheelbase_m.is_some(),
            self.full_lock_deg.is_some(),
        ];
        self.preset.is_some() || said.iter().all(|said| *said)
    }

    /// The geometry: the preset of this entry, or else `usual`, with the entries that differ.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] for an unknown preset, and for numbers that no camera or car has, naming the entry.
    pub fn resolve(&self, usual: &str) -> Result<CarGeometry> {
        let name = self.preset.as_deref().unwrap_or(usual);
        let preset = CarGeometry::preset(name).ok_or_else(|| {
            let known: Vec<_> = CarGeometry::presets().map(|(name, _)| name).collect();
            Error::Usage(format!("[camera] preset {name:?} is unknown; known are {}", known.join(", ")))
        })?;
        let geometry = CarGeometry {
            image: self.image.unwrap_or(preset.image),
            focal_px: self.focal_px.unwrap_or(preset.focal_px),
            height_m: self.height_m.unwrap_or(preset.height_m),
            ahead_m: self.ahead_m.unwrap_or(preset.ahead_m),
            pitch_deg: self.pitch_deg.unwrap_or(preset.pitch_deg),
            yaw_deg: self.yaw_deg.unwrap_or(preset.yaw_deg),
            roll_deg: self.roll_deg.unwrap_or(preset.roll_deg),
            side_offsets_m: self.side_offsets_m.unwrap_or(preset.side_offsets_m),
            wheelbase_m: self.wheelbase_m.unwrap_or(preset.wheelbase_m),
            full_lock_deg: self.full_lock_deg.unwrap_or(preset.full_lock_deg),
        };
        let [left_m, right_m] = geometry.side_offsets_m;
        let checks = [
            (
                "image",
                geometry.image.iter().all(|side| (1..=8192).contains(side)),
                "height and width, 1 to 8192 pixels",
            ),
            ("focal_px", (1.0..=1e5).contains(&geometry.focal_px), "1 to 100000 pixels"),
            ("height_m", (0.01..=100.0).contains(&geometry.height_m), "0.01 to 100 m"),
            ("ahead_m", geometry.ahead_m.abs() <= 100.0, "-100 to 100 m"),
            ("pitch_deg", geometry.pitch_deg.abs() <= 80.0, "-80 to 80 degrees"),
            ("yaw_deg", geometry.yaw_deg.abs() <= 80.0, "-80 to 80 degrees"),
            ("roll_deg", geometry.roll_deg.abs() <= 80.0, "-80 to 80 degrees"),
            ("side_offsets_m", left_m.abs() <= 10.0 && right_m.abs() <= 10.0, "[left, right], -10 to 10 m"),
            ("wheelbase_m", (0.01..=100.0).contains(&geometry.wheelbase_m), "0.01 to 100 m"),
            ("full_lock_deg", (0.1..=80.0).contains(&geometry.full_lock_deg), "0.1 to 80 degrees"),
        ];
        match checks.iter().find(|(_, ok, _)| !ok) {
            Some((key, _, must)) => Err(Error::Usage(format!("[camera] {key}: must be {must}"))),
            None => Ok(geometry),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steering_and_curvature_are_inverse_and_signed() {
        let car = CarGeometry::preset("udacity").unwrap();
        // At full lock the rear axle drives on a circle of 2.87 m / tan 25 deg = 6.155 m.
        assert!((1.0 / car.curvature(1.0) - 6.155).abs() < 1e-3);
        for steering in [-1.0, -0.3, 0.0, 0.02, 0.9] {
            assert!((car.steering_for(car.curvature(steering)) - steering).abs() < 1e-12);
        }
    }

    #[test]
    fn entries_override_the_preset_and_wrong_ones_are_named() {
        let entry: GeometryEntry = toml::from_str("preset = \"udacity\"\nroll_deg = 0.0").unwrap();
        let geometry = entry.resolve("donkeycar").unwrap();
        assert_eq!((geometry.roll_deg, geometry.pitch_deg), (0.0, 7.6));
        assert_eq!(GeometryEntry::default().resolve("donkeycar").unwrap(), DONKEYCAR);
        for (text, named) in [
            ("preset = \"tank\"", "udacity-straight"),
            ("height_m = 0.0", "height_m"),
            ("focal_px = nan", "focal_px"),
            ("side_offsets_m = [inf, 0.0]", "side_offsets_m"),
        ] {
            let error = toml::from_str::<GeometryEntry>(text).unwrap().resolve("udacity").unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
        assert!(toml::from_str::<GeometryEntry>("hight_m = 1.0").is_err());
    }
}
