//! Random changes to training images: brightness, a shadow, a horizontal shift. Validation and driving never see them.
//!
//! They act on the RGB stage of preprocessing (cropped, before the colour conversion), in this order: shift, shadow,
//! brightness. Each is drawn anew for every sample and epoch.

use super::preprocess::Preprocessing;
use crate::random::{uniform, unit};
use crate::{Error, Result};
use rand::Rng;
use serde::{Deserialize, Serialize};

/// The `[augmentation]` table of a recipe; everything is off by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Range of the factor that all grey levels are multiplied by (clamped at 255).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub brightness: Option<[f64; 2]>,
    /// Probability of a shadow: one side of a random line from the top to the bottom edge is darkened.
    pub shadow_probability: f64,
    /// Range of the factor that grey levels in the shadow are multiplied by; smaller is darker.
    pub shadow_strength: [f64; 2],
    /// Largest shift to the left or right, in source pixels. The edge column fills what comes into view.
    pub shift_px: f64,
    /// Steering added for each source pixel that the picture moves to the right: the road seems to lie to the right,
    /// so the car has to steer there. Needed with `shift_px`; 0.002 to 0.003 is usual.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shift_steering_per_px: Option<f64>,
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            brightness: None,
            shadow_probability: 0.0,
            shadow_strength: [0.2, 0.5],
            shift_px: 0.0,
            shift_steering_per_px: None,
        }
    }
}

impl Augmentation {
    /// Whether anything is changed at all.
    pub fn is_active(&self) -> bool {
        self.brightness.is_some() || self.shadow_probability > 0.0 || self.shift_px > 0.0
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        let wrong = |key: &str, must: &str| Err(Error::Usage(format!("[augmentation] {key}: {must}")));
        let is_range = |[low, high]: [f64; 2]| 0.0 <= low && low <= high && high <= 10.0;
        if !self.brightness.is_none_or(is_range) {
            return wrong("brightness", "must be [low, high] with 0 <= low <= high <= 10");
        }
        if !is_range(self.shadow_strength) {
            return wrong("shadow_strength", "must be [low, high] with 0 <= low <= high <= 10");
        }
        if !(0.0..=1.0).contains(&self.shadow_probability) {
            return wrong("shadow_probability", "must be 0 to 1");
        }
        if !(0.0..=1000.0).contains(&self.shift_px) {
            return wrong("shift_px", "must be 0 to 1000 source pixels");
        }
        if self.shift_px > 0.0 && !self.shift_steering_per_px.is_some_and(f64::is_finite) {
            return wrong("shift_steering_per_px", "must be given with shift_px, for example 0.002");
        }
        Ok(())
    }

    /// Changes `rgb` (`[h][w][3]`, the RGB stage of `preprocessing`) and returns what is added to the steering.
    pub fn apply(&self, preprocessing: &Preprocessing, rgb: &mut [u8], rng: &mut impl Rng) -> f32 {
        let [_, width] = preprocessing.rgb_size();
        let mut steering = 0.0;
        if let Some(per_px) = self.shift_steering_per_px.filter(|_| self.shift_px > 0.0) {
            // Whole pixels of the stage, so that picture and label agree exactly.
            let source_px = preprocessing.source_px_per_rgb_px();
            let columns = (uniform(rng, -self.shift_px, self.shift_px) / source_px).round();
            shift(rgb, width, columns as isize);
            steering = (columns * source_px * per_px) as f32;
        }
        if self.shadow_probability > 0.0 {
            // All numbers are drawn in any case, so that one setting does not disturb the numbers of the next.
            let [chance, top, bottom, side] = [unit(rng), unit(rng), unit(rng), unit(rng)];
            let factor = uniform(rng, self.shadow_strength[0], self.shadow_strength[1]);
            if chance < self.shadow_probability {
                shadow(rgb, width, top, bottom, side < 0.5, &factors(factor));
            }
        }
        if let Some([low, high]) = self.brightness {
            let table = factors(uniform(rng, low, high));
            rgb.iter_mut().for_each(|grey| *grey = table[usize::from(*grey)]);
        }
        steering
    }
}

/// Grey levels times `factor`, rounded and clamped.
fn factors(factor: f64) -> [u8; 256] {
    std::array::from_fn(|grey| (grey as f64 * factor).round().min(255.0) as u8)
}

/// Moves the picture `columns` to the right (to the left if negative) and repeats the edge column.
fn shift(rgb: &mut [u8], width: usize, columns: isize) {
    let by = columns.unsigned_abs().min(width - 1);
    for row in rgb.chunks_exact_mut(width * 3) {
        if columns > 0 {
            row.copy_within(..(width - by) * 3, by * 3);
            for column in 0..by {
                row.copy_within(by * 3..by * 3 + 3, column * 3);
            }
        } else {
            row.copy_within(by * 3.., 0);
            for column in width - by..width {
                row.copy_within((width - by - 1) * 3..(width - by) * 3, column * 3);
            }
        }
    }
}

/// Darkens what lies left (or right) of the line from `top` to `bottom`, both shares of the width.
fn shadow(rgb: &mut [u8], width: usize, top: f64, bottom: f64, left: bool, table: &[u8; 256]) {
    let rows = rgb.len() / (width * 3);
    for (y, row) in rgb.chunks_exact_mut(width * 3).enumerate() {
        let along = (y as f64 + 0.5) / rows as f64;
        let edge = ((top + (bottom - top) * along) * width as f64).round() as usize * 3;
        let (before, after) = row.split_at_mut(edge);
        let dark = if left { before } else { after };
        dark.iter_mut().for_each(|grey| *grey = table[usize::from(*grey)]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, rng};

    fn preprocessing() -> Preprocessing {
        Preprocessing { source: [8, 20], rows: [0, 8], resize: [4, 10], ..Default::default() }
    }

    /// A picture whose grey level is ten times the column.
    fn columns() -> Vec<u8> {
        (0..4 * 10).flat_map(|i| [(i % 10 * 10) as u8; 3]).collect()
    }

    #[test]
    fn the_label_moves_with_the_picture() {
        let augmentation = Augmentation { shift_px: 6.0, shift_steering_per_px: Some(0.01), ..Default::default() };
        let mut seen = std::collections::BTreeSet::new();
        for stream in 0..200 {
            let mut rgb = columns();
            let steering = augmentation.apply(&preprocessing(), &mut rgb, &mut rng(1, Purpose::Test, 0, stream));
            // One column of the stage is two source pixels. Column 5 shows what was `moved` columns to its left.
            let moved = (steering / 0.02).round() as i32;
            assert!((steering - moved as f32 * 0.02).abs() < 1e-6 && moved.abs() <= 3);
            assert_eq!(i32::from(rgb[15]), 50 - 10 * moved);
            assert_eq!(i32::from(rgb[0]), (-10 * moved).max(0));
            assert_eq!(i32::from(rgb[27]), (90 - 10 * moved).min(90));
            seen.insert(moved);
        }
        assert_eq!(seen.len(), 7);
    }

    #[test]
    fn brightness_scales_and_clamps() {
        let augmentation = Augmentation { brightness: Some([1.5, 1.5]), ..Default::default() };
        let mut rgb = [0, 100, 200, 255].repeat(30);
        assert_eq!(augmentation.apply(&preprocessing(), &mut rgb, &mut rng(1, Purpose::Test, 0, 0)), 0.0);
        assert_eq!(rgb[..4], [0, 150, 255, 255]);
    }

    #[test]
    fn shadows_fall_on_one_side_as_often_as_asked() {
        let augmentation = Augmentation { shadow_probability: 0.25, shadow_strength: [0.5, 0.5], ..Default::default() };
        let mut shadows = 0;
        for stream in 0..2000 {
            let mut rgb = vec![100; 4 * 10 * 3];
            augmentation.apply(&preprocessing(), &mut rgb, &mut rng(2, Purpose::Test, 0, stream));
            shadows += usize::from(rgb.contains(&50));
            for row in rgb.chunks_exact(30) {
                assert!(row.iter().all(|&grey| grey == 50 || grey == 100));
                assert!(row.windows(2).filter(|pair| pair[0] != pair[1]).count() <= 1);
            }
        }
        // A line near the border can leave the picture as it is, so a few less than 500.
        assert!((400..=560).contains(&shadows), "{shadows}");
    }

    #[test]
    fn tables_are_checked() {
        assert!(!Augmentation::default().is_active() && Augmentation::default().validate().is_ok());
        let shift: Augmentation = toml::from_str("shift_px = 50").unwrap();
        assert!(shift.is_active() && shift.validate().unwrap_err().to_string().contains("shift_steering_per_px"));
        assert!(toml::from_str::<Augmentation>("brightness = [1.2, 0.8]").unwrap().validate().is_err());
        assert!(toml::from_str::<Augmentation>("blur = 1").is_err());
    }
}
