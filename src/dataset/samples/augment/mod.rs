//! Random changes to training images: another place beside the path, a horizontal shift, shadows, lines, colours, brightness.
//! Validation and driving never see them.
//!
//! They act on the RGB stage of preprocessing (cropped, before the colour conversion), in this order: view, shift, shadows,
//! lines, colours, brightness, block noise. Each is drawn anew for every sample and epoch.

mod changes;
mod noise;

use super::spec::Correction;
use crate::dataset::pictures::preprocess::Preprocessing;
use crate::engine::random::{below, uniform, unit};
use crate::geometry::Offset;
use crate::{Error, Result};
use rand::Rng;
use serde::{Deserialize, Serialize};

use changes::{Band, factors, line, recolour, shadow, shift};
use noise::{MAX_BLOCK, block_noise, pixel_noise};

/// The entry `view` of `[augmentation]`: the picture is warped to what a car beside the driven path would see, and the label is the
/// steering that leads it back (Bojarski et al. 2016, PilotNet).
///
/// It is made of the nearest of the cameras that `samples.side_cameras` lets in.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewSpec {
    /// Largest distance from the path to either side, m.
    pub offset_m: f64,
    /// Largest turn from the path to either side, deg.
    pub turn_deg: f64,
    /// Share of the samples that are warped; the others stay as they were taken.
    #[serde(default = "always")]
    pub probability: f64,
}

fn always() -> f64 {
    1.0
}

impl ViewSpec {
    /// Draws where the car stands; `None` for a sample that stays as it was taken.
    pub fn draw(&self, rng: &mut impl Rng) -> Option<Offset> {
        let chance = unit(rng);
        let right_m = uniform(rng, -self.offset_m, self.offset_m);
        let turn = uniform(rng, -self.turn_deg, self.turn_deg).to_radians();
        (chance < self.probability).then_some(Offset { right_m, ahead_m: 0.0, turn })
    }
}

/// The `[augmentation]` table of a recipe; everything is off by default.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Augmentation {
    /// Views from beside the driven path.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<ViewSpec>,
    /// Range of the factor that all grey levels are multiplied by (clamped at 255).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub brightness: Option<[f64; 2]>,
    /// Probability of a shadow: one side of a random line from the top to the bottom edge is darkened.
    pub shadow_probability: f64,
    /// Probability of a shadow that falls across: a band between the left and the right edge, as of a tree or a post.
    pub band_probability: f64,
    /// Range of the factor that grey levels in a shadow are multiplied by; smaller is darker.
    pub shadow_strength: [f64; 2],
    /// Largest number of straight lines across the picture that are darkened or lightened: seams, wires, wheel tracks, of which
    /// none is the edge of the road.
    pub lines: u32,
    /// Range of the factor that grey levels in a line are multiplied by (clamped at 255).
    pub line_strength: [f64; 2],
    /// Largest shift to the left or right, in source pixels. The edge column fills what comes into view.
    pub shift_px: f64,
    /// Steering added for each source pixel that the picture moves to the right: the road seems to lie to the right,
    /// so the car has to steer there. Needed with `shift_px`; 0.002 to 0.003 is usual. Or `"geometry"`: the shift counts as a turn
    /// of the camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shift_steering_per_px: Option<Correction>,
    /// Largest turn of the hue either way, in degrees: a turn about the axis of grays.
    pub hue_deg: f64,
    /// Range of the factor of the distance from gray: 0 leaves a gray picture.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saturation: Option<[f64; 2]>,
    /// Range of the factors, one for each channel, that red, green and blue are multiplied by: the tint of the light.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tint: Option<[f64; 2]>,
    /// Range of the factor of the distance from the picture's mean grey level.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub contrast: Option<[f64; 2]>,
    /// Noise like a JPEG's, which changes from frame to frame: an error of each block of 8x8 source pixels (at most 64x64 of the cropped
    /// picture) in the three coarsest coefficients of its cosine transform, in brightness. Each error is drawn up to an amplitude in grey levels, and the amplitude of a
    /// picture between 0 and this.
    #[serde(skip_serializing_if = "is_zero")]
    pub block_noise: f64,
    /// Noise of single pixels and channels, which changes from frame to frame: grain, and texture too fine for the picture. Each error is
    /// drawn up to an amplitude in grey levels, and the amplitude of a picture between 0 and this.
    #[serde(skip_serializing_if = "is_zero")]
    pub pixel_noise: f64,
}

fn is_zero(number: &f64) -> bool {
    *number == 0.0
}

impl Default for Augmentation {
    fn default() -> Self {
        Self {
            view: None,
            brightness: None,
            shadow_probability: 0.0,
            band_probability: 0.0,
            shadow_strength: [0.2, 0.5],
            lines: 0,
            line_strength: [0.4, 1.6],
            shift_px: 0.0,
            shift_steering_per_px: None,
            hue_deg: 0.0,
            saturation: None,
            tint: None,
            contrast: None,
            block_noise: 0.0,
            pixel_noise: 0.0,
        }
    }
}

impl Augmentation {
    /// Whether anything is changed at all.
    pub fn is_active(&self) -> bool {
        self.view.is_some()
            || self.brightness.is_some()
            || self.band_probability > 0.0
            || self.shadow_probability > 0.0
            || self.shift_px > 0.0
            || self.lines > 0
            || self.block_noise > 0.0
            || self.pixel_noise > 0.0
            || self.changes_colours()
    }

    fn changes_colours(&self) -> bool {
        self.hue_deg > 0.0 || self.saturation.is_some() || self.tint.is_some() || self.contrast.is_some()
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key.
    pub fn validate(&self) -> Result<()> {
        let wrong = |key: &str, must: &str| Err(Error::Usage(format!("[augmentation] {key}: {must}")));
        let is_range = |[low, high]: [f64; 2]| 0.0 <= low && low <= high && high <= 10.0;
        let ranges = [
            ("brightness", self.brightness),
            ("shadow_strength", Some(self.shadow_strength)),
            ("line_strength", Some(self.line_strength)),
            ("saturation", self.saturation),
            ("tint", self.tint),
            ("contrast", self.contrast),
        ];
        if let Some((key, _)) = ranges.into_iter().find(|(_, range)| !range.is_none_or(is_range)) {
            return wrong(key, "must be [low, high] with 0 <= low <= high <= 10");
        }
        if self.lines > 100 {
            return wrong("lines", "must be 0 to 100");
        }
        for (key, amplitude) in [("block_noise", self.block_noise), ("pixel_noise", self.pixel_noise)] {
            if !(0.0..=64.0).contains(&amplitude) {
                return wrong(key, "must be 0 to 64 grey levels");
            }
        }
        if !(0.0..=180.0).contains(&self.hue_deg) {
            return wrong("hue_deg", "must be 0 to 180");
        }
        if !(0.0..=1.0).contains(&self.shadow_probability) {
            return wrong("shadow_probability", "must be 0 to 1");
        }
        if !(0.0..=1.0).contains(&self.band_probability) {
            return wrong("band_probability", "must be 0 to 1");
        }
        if !(0.0..=1000.0).contains(&self.shift_px) {
            return wrong("shift_px", "must be 0 to 1000 source pixels");
        }
        if self.shift_px > 0.0 && !self.shift_steering_per_px.is_some_and(|by| by.fixed().is_finite()) {
            return wrong("shift_steering_per_px", "must be given with shift_px, for example 0.002, or \"geometry\"");
        }
        if let Some(view) = self.view {
            if !(0.0..=5.0).contains(&view.offset_m) {
                return wrong("view.offset_m", "must be 0 to 5 m");
            }
            if !(0.0..=45.0).contains(&view.turn_deg) {
                return wrong("view.turn_deg", "must be 0 to 45 degrees");
            }
            if !(0.0..=1.0).contains(&view.probability) {
                return wrong("view.probability", "must be 0 to 1");
            }
        }
        Ok(())
    }

    /// Changes `rgb` (`[h][w][3]`, the RGB stage of `preprocessing`), all but the view, and returns by how many source pixels the
    /// picture moved to the right.
    pub fn apply(&self, preprocessing: &Preprocessing, rgb: &mut [u8], rng: &mut impl Rng) -> f64 {
        let [_, width] = preprocessing.rgb_size();
        let mut moved_px = 0.0;
        if self.shift_px > 0.0 {
            // Whole pixels of the stage, so that picture and label agree exactly.
            let source_px = preprocessing.source_px_per_rgb_px();
            let columns = (uniform(rng, -self.shift_px, self.shift_px) / source_px).round();
            shift(rgb, width, columns as isize);
            moved_px = columns * source_px;
        }
        if self.shadow_probability > 0.0 {
            // All numbers are drawn in any case, so that one setting does not disturb the numbers of the next.
            let [chance, top, bottom, side] = [unit(rng), unit(rng), unit(rng), unit(rng)];
            let factor = uniform(rng, self.shadow_strength[0], self.shadow_strength[1]);
            if chance < self.shadow_probability {
                shadow(rgb, width, top, bottom, side < 0.5, &factors(factor));
            }
        }
        if self.band_probability > 0.0 {
            let [chance, from, length, height, thickness] = [(); 5].map(|()| unit(rng));
            let tilt = uniform(rng, -0.5, 0.5);
            let factor = uniform(rng, self.shadow_strength[0], self.shadow_strength[1]);
            if chance < self.band_probability {
                let band =
                    Band { from: from - 0.3, length: 0.3 + length, height, tilt, thickness: 0.02 + 0.23 * thickness };
                band.darken(rgb, width, &factors(factor));
            }
        }
        for _ in 0..below(rng, self.lines as usize + 1) {
            // From anywhere at the horizon or beside the picture to anywhere near the car.
            let [top, bottom, wide] = [unit(rng), uniform(rng, -1.0, 2.0), unit(rng)];
            let table = factors(uniform(rng, self.line_strength[0], self.line_strength[1]));
            line(rgb, width, top, bottom, wide, &table);
        }
        if self.changes_colours() {
            let drawn = |range: Option<[f64; 2]>, rng: &mut _| {
                let [low, high] = range.unwrap_or([1.0, 1.0]);
                uniform(rng, low, high)
            };
            let turn = uniform(rng, -self.hue_deg, self.hue_deg).to_radians();
            let saturation = drawn(self.saturation, rng);
            let tint = [(); 3].map(|()| drawn(self.tint, rng));
            let contrast = drawn(self.contrast, rng);
            recolour(rgb, turn, saturation, tint, contrast);
        }
        if let Some([low, high]) = self.brightness {
            let table = factors(uniform(rng, low, high));
            rgb.iter_mut().for_each(|grey| *grey = table[usize::from(*grey)]);
        }
        if self.block_noise > 0.0 {
            let amplitude = uniform(rng, 0.0, self.block_noise);
            let source_rows_per_row =
                (preprocessing.rows[1] - preprocessing.rows[0]) as f64 / preprocessing.rgb_size()[0] as f64;
            let side = |source_px: f64| ((8.0 / source_px).round() as usize).clamp(1, MAX_BLOCK);
            let block = [side(source_rows_per_row), side(preprocessing.source_px_per_rgb_px())];
            block_noise(rgb, width, block, amplitude, rng);
        }
        if self.pixel_noise > 0.0 {
            pixel_noise(rgb, uniform(rng, 0.0, self.pixel_noise), rng);
        }
        moved_px
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::random::{Purpose, rng};

    fn preprocessing() -> Preprocessing {
        Preprocessing { source: [8, 20], rows: [0, 8], resize: [4, 10], ..Default::default() }
    }

    /// A picture whose grey level is ten times the column.
    fn columns() -> Vec<u8> {
        (0..4 * 10).flat_map(|i| [(i % 10 * 10) as u8; 3]).collect()
    }

    #[test]
    fn pictures_move_by_as_much_as_is_said() {
        let augmentation = Augmentation { shift_px: 6.0, ..Default::default() };
        let mut seen = std::collections::BTreeSet::new();
        for stream in 0..200 {
            let mut rgb = columns();
            let moved_px = augmentation.apply(&preprocessing(), &mut rgb, &mut rng(1, Purpose::Test, 0, stream));
            // One column of the stage is two source pixels. Column 5 shows what was `moved` columns to its left.
            let moved = (moved_px / 2.0) as i32;
            assert!(moved_px == f64::from(moved) * 2.0 && moved.abs() <= 3);
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
    fn bands_darken_what_lies_between_their_rims() {
        let mut rgb = vec![100; 4 * 10 * 3];
        let band = Band { from: 0.3, length: 0.5, height: 0.25, tilt: 0.5, thickness: 0.5 };
        band.darken(&mut rgb, 10, &factors(0.5));
        let dark = |y: usize| (0..10).filter(|x| rgb[(y * 10 + x) * 3] == 50).collect::<Vec<_>>();
        // Columns 3 to 7; two of four rows, lower to the right: the middle is at 0.25 + 0.05 (x + 0.5).
        assert_eq!([dark(0), dark(1), dark(2), dark(3)], [vec![], vec![3, 4, 5, 6], vec![3, 4, 5, 6, 7], vec![7]]);
        let bands = Augmentation { band_probability: 0.5, shadow_strength: [0.5, 0.5], ..Default::default() };
        assert!(bands.is_active() && bands.validate().is_ok());
        let mut seen = 0;
        for stream in 0..1000 {
            let mut rgb = vec![100; 4 * 10 * 3];
            assert_eq!(bands.apply(&preprocessing(), &mut rgb, &mut rng(4, Purpose::Test, 0, stream)), 0.0);
            seen += usize::from(rgb.contains(&50));
        }
        // Thin bands and those beside the picture may touch no pixel.
        assert!((250..=520).contains(&seen), "{seen}");
    }

    #[test]
    fn lines_are_narrow_and_not_more_than_asked_for() {
        let lines = Augmentation { lines: 2, line_strength: [0.5, 0.5], ..Default::default() };
        assert!(lines.is_active());
        let mut seen = std::collections::BTreeSet::new();
        for stream in 0..500 {
            let mut rgb = vec![100; 4 * 10 * 3];
            assert_eq!(lines.apply(&preprocessing(), &mut rgb, &mut rng(3, Purpose::Test, 0, stream)), 0.0);
            // Where two lines cross, grey levels are halved twice.
            assert!(rgb.iter().all(|grey| [100, 50, 25].contains(grey)));
            let dark = rgb.chunks_exact(30).map(|row| row.iter().filter(|&&grey| grey < 100).count() / 3).max();
            assert!(dark <= Some(8), "{dark:?}");
            seen.insert(dark);
        }
        assert!(seen.contains(&Some(0)) && seen.len() > 3, "{seen:?}");
    }

    #[test]
    fn colours_turn_about_the_axis_of_grays_and_spread_about_the_mean() {
        let changed = |turn_deg: f64, saturation, tint, contrast| {
            let mut rgb = vec![200, 80, 40, 90, 90, 90];
            recolour(&mut rgb, turn_deg.to_radians(), saturation, tint, contrast);
            rgb
        };
        assert_eq!(changed(0.0, 1.0, [1.0; 3], 1.0), [200, 80, 40, 90, 90, 90]);
        // A third of the circle makes green of red, and so on; grays stay.
        assert_eq!(changed(120.0, 1.0, [1.0; 3], 1.0), [40, 200, 80, 90, 90, 90]);
        assert_eq!(changed(0.0, 0.0, [1.0; 3], 1.0), [107, 107, 107, 90, 90, 90]);
        assert_eq!(changed(0.0, 1.0, [1.1, 1.0, 0.5], 1.0), [220, 80, 20, 99, 90, 45]);
        // The mean grey level is 98.3.
        assert_eq!(changed(0.0, 1.0, [1.0; 3], 0.5), [149, 89, 69, 94, 94, 94]);
        assert_eq!(changed(0.0, 1.0, [1.0; 3], 2.0), [255, 62, 0, 82, 82, 82]);
        let turned = changed(40.0, 0.8, [1.0; 3], 1.0);
        assert!((turned[..3].iter().map(|&c| i32::from(c)).sum::<i32>() - 320).abs() <= 1, "{turned:?}");
    }

    #[test]
    fn colours_are_drawn_anew_and_without_them_nothing_changes() {
        let table = "hue_deg = 40\nsaturation = [0.2, 1.5]\ntint = [0.8, 1.2]\ncontrast = [0.5, 1.5]";
        let colours: Augmentation = toml::from_str(table).unwrap();
        assert!(colours.is_active() && colours.validate().is_ok());
        let draw = |augmentation: &Augmentation, stream| {
            let mut rgb: Vec<u8> = (0..4 * 10 * 3).map(|i| (i * 2) as u8).collect();
            assert_eq!(augmentation.apply(&preprocessing(), &mut rgb, &mut rng(1, Purpose::Test, 0, stream)), 0.0);
            rgb
        };
        assert_ne!(draw(&colours, 0), draw(&colours, 1));
        assert_eq!(draw(&colours, 0), draw(&colours, 0));
        assert_eq!(draw(&Augmentation::default(), 0)[..4], [0, 2, 4, 6]);
    }

    #[test]
    fn views_are_drawn_within_their_bounds_and_as_often_as_is_said() {
        let view: ViewSpec = toml::from_str("offset_m = 1.0\nturn_deg = 6.0\nprobability = 0.25").unwrap();
        let drawn: Vec<Offset> =
            (0..4000).filter_map(|stream| view.draw(&mut rng(3, Purpose::View, 0, stream))).collect();
        assert!((900..1100).contains(&drawn.len()), "{}", drawn.len());
        assert!(drawn.iter().all(|o| o.right_m.abs() <= 1.0 && o.turn.abs() <= 6f64.to_radians() && o.ahead_m == 0.0));
        let reaches = |of: fn(&Offset) -> f64| drawn.iter().map(of).fold(0.0, f64::max);
        assert!(reaches(|o| o.right_m) > 0.98 && reaches(|o| -o.turn) > 0.1);
        let always: ViewSpec = toml::from_str("offset_m = 1.0\nturn_deg = 6.0").unwrap();
        assert!((0..100).all(|stream| always.draw(&mut rng(3, Purpose::View, 0, stream)).is_some()));
    }

    #[test]
    fn tables_are_checked() {
        for (wrong, key) in [
            ("offset_m = 6, turn_deg = 1", "view.offset_m"),
            ("offset_m = 1, turn_deg = nan", "view.turn_deg"),
            ("offset_m = 1, turn_deg = 1, probability = 2", "view.probability"),
        ] {
            let table: Augmentation = toml::from_str(&format!("view = {{ {wrong} }}")).unwrap();
            let error = table.validate().unwrap_err().to_string();
            assert!(table.is_active() && error.contains(key), "{error}");
        }
        assert!(toml::from_str::<Augmentation>("view = { offset_m = 1 }").is_err());
        assert!(!Augmentation::default().is_active() && Augmentation::default().validate().is_ok());
        let shift: Augmentation = toml::from_str("shift_px = 50").unwrap();
        assert!(shift.is_active() && shift.validate().unwrap_err().to_string().contains("shift_steering_per_px"));
        assert!(toml::from_str::<Augmentation>("brightness = [1.2, 0.8]").unwrap().validate().is_err());
        assert!(toml::from_str::<Augmentation>("blur = 1").is_err());
        for wrong in ["hue_deg = 200", "saturation = [-1, 1]", "tint = [1, 0.5]", "contrast = [0, 11]"] {
            let key = wrong.split(' ').next().unwrap();
            let error = toml::from_str::<Augmentation>(wrong).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(key), "{error}");
        }
    }
}
