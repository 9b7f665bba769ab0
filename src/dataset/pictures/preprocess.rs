//! From a camera image to the network's input: the same code for training, evaluation and driving.
//!
//! The stages, in order:
//! 1. scale the image to the `source` size, if it has another one;
//! 2. keep the rows that show the road; with `blur` smooth them;
//! 3. resize, rounded to 8 bits;
//! 4. convert the colours, to planes `[c][h][w]` (with `colour_first` before stage 3);
//! 5. network input = grey level * `scale` + `offset`.
//!
//! The last RGB picture on this way, the *RGB stage*, is where augmentation acts: the resized picture, or with
//! `colour_first` the kept rows. [`Preprocessor`] can stop there and go on later.

use super::blur::Blur;
use super::colour::Colour;
use super::resize::{Interpolation, Resizer};
use crate::{Error, Result};
use serde::{Deserialize, Serialize};
use steersman_kernels::Isa;

/// Largest height or width of an image or of the network's input, in pixels.
const MAX_SIDE: usize = 8192;

/// The `[preprocessing]` table of a recipe; also stored in the model file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Preprocessing {
    /// Height and width that `rows` refers to, in pixels. An image of another size is scaled to it first.
    pub source: [usize; 2],
    /// Rows kept, from the first to before the second.
    pub rows: [usize; 2],
    /// Smooth the kept rows with a Gaussian of 3x3 pixels, weights 1, 2, 1 in each direction.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub blur: bool,
    /// Height and width of the network's input, in pixels.
    pub resize: [usize; 2],
    /// How the kept rows are resized.
    pub interpolation: Interpolation,
    /// Colour space of the network's input.
    pub colour: Colour,
    /// Convert the colours before the resize instead of after.
    pub colour_first: bool,
    /// Factor from grey level to network input.
    pub scale: f64,
    /// Added after `scale`.
    pub offset: f64,
}

impl Default for Preprocessing {
    /// The whole 160x320 picture in RGB, grey levels as they are.
    fn default() -> Self {
        Self {
            source: [160, 320],
            rows: [0, 160],
            blur: false,
            resize: [160, 320],
            interpolation: Interpolation::Linear,
            colour: Colour::Rgb,
            colour_first: false,
            scale: 1.0,
            offset: 0.0,
        }
    }
}

impl Preprocessing {
    /// Checks that the sizes fit each other.
    ///
    /// # Errors
    /// [`Error::Usage`] naming the key of the table that is wrong.
    pub fn validate(&self) -> Result<()> {
        let wrong = |key: &str, message: String| Err(Error::Usage(format!("[preprocessing] {key}: {message}")));
        for (key, size) in [("source", self.source), ("resize", self.resize)] {
            if size.iter().any(|n| !(1..=MAX_SIDE).contains(n)) {
                return wrong(key, format!("height and width must be 1 to {MAX_SIDE}, found {size:?}"));
            }
        }
        let [first, end] = self.rows;
        if first >= end || end > self.source[0] {
            let height = self.source[0];
            return wrong("rows", format!("must be [first, end] with first < end <= {height}, found [{first}, {end}]"));
        }
        if !self.scale.is_finite() || !self.offset.is_finite() {
            return wrong("scale, offset", "must be finite numbers".into());
        }
        Ok(())
    }

    /// Shape of the network's input: channels, height, width.
    pub fn output(&self) -> [usize; 3] {
        [self.colour.channels(), self.resize[0], self.resize[1]]
    }

    /// Number of values of the network's input.
    pub fn output_len(&self) -> usize {
        self.output().iter().product()
    }

    /// Height and width of the RGB stage.
    pub fn rgb_size(&self) -> [usize; 2] {
        if self.colour_first { [self.rows[1] - self.rows[0], self.source[1]] } else { self.resize }
    }

    /// Bytes of the RGB stage, `[h][w][3]`.
    pub fn rgb_len(&self) -> usize {
        let [h, w] = self.rgb_size();
        h * w * 3
    }

    /// Source pixels per pixel of the RGB stage, in the horizontal direction.
    pub fn source_px_per_rgb_px(&self) -> f64 {
        self.source[1] as f64 / self.rgb_size()[1] as f64
    }

    /// A notice for the reader where images of `size` (height, width) are scaled to `source` before anything else.
    pub fn size_notice(&self, size: [usize; 2]) -> Option<String> {
        let ([h, w], [source_h, source_w]) = (size, self.source);
        (size != self.source).then(|| {
            format!("images of {w}x{h} pixels are scaled to {source_w}x{source_h}, which the recipe is written for")
        })
    }

    /// Plans the preprocessing of images of `height` x `width` pixels.
    ///
    /// # Errors
    /// As [`Preprocessing::validate`]; also if the image has no pixels or more than 8192 in a direction.
    pub fn plan(&self, height: usize, width: usize) -> Result<Preprocessor> {
        self.validate()?;
        if [height, width].iter().any(|n| !(1..=MAX_SIDE).contains(n)) {
            return Err(Error::Input(format!("cannot preprocess an image of {width}x{height} pixels")));
        }
        let from = [height, width];
        let to_source = (from != self.source).then(|| {
            let shrinks = height >= self.source[0] && width >= self.source[1];
            let method = if shrinks { Interpolation::Area } else { Interpolation::Linear };
            Resizer::new(from, self.source, 3, method)
        });
        let kept = [self.rows[1] - self.rows[0], self.source[1]];
        let channels = if self.colour_first { self.colour.channels() } else { 3 };
        // With the colours first, every plane is resized on its own.
        let resizer = Resizer::new(kept, self.resize, if self.colour_first { 1 } else { channels }, self.interpolation);
        Ok(Preprocessor {
            source_image: vec![0; if to_source.is_some() { self.source[0] * self.source[1] * 3 } else { 0 }],
            rgb: vec![0; self.rgb_len()],
            kept_planes: vec![0; if self.colour_first { kept[0] * kept[1] * channels } else { 0 }],
            blur: self.blur.then(|| (Blur::new(kept), vec![0; kept[0] * kept[1] * 3])),
            from,
            to_source,
            resizer,
            spec: self.clone(),
        })
    }

    /// Turns grey levels into network input: `grey * scale + offset`, in f32.
    ///
    /// # Panics
    /// If the lengths differ.
    pub fn to_input(&self, planes: &[u8], out: &mut [f32]) {
        steersman_kernels::pixels::u8_to_f32(Isa::best(), planes, self.scale as f32, self.offset as f32, out);
    }
}

/// A planned [`Preprocessing`] for one size of image, with its buffers.
#[derive(Debug, Clone)]
pub struct Preprocessor {
    spec: Preprocessing,
    from: [usize; 2],
    to_source: Option<Resizer>,
    /// With its result.
    blur: Option<(Blur, Vec<u8>)>,
    resizer: Resizer,
    source_image: Vec<u8>,
    rgb: Vec<u8>,
    kept_planes: Vec<u8>,
}

impl Preprocessor {
    /// Height and width of the images this was planned for.
    pub fn image_size(&self) -> [usize; 2] {
        self.from
    }

    /// The table this was planned from.
    pub fn spec(&self) -> &Preprocessing {
        &self.spec
    }

    /// All stages: an RGB image `[h][w][3]` to 8-bit planes `[c][h][w]`.
    ///
    /// # Panics
    /// If the lengths are not those planned for.
    pub fn apply(&mut self, image: &[u8], planes: &mut [u8]) {
        let mut rgb = std::mem::take(&mut self.rgb);
        self.to_rgb_stage(image, &mut rgb);
        self.finish(&rgb, planes);
        self.rgb = rgb;
    }

    /// An RGB image `[h][w][3]` up to the RGB stage (see the module), `[h][w][3]`.
    ///
    /// # Panics
    /// If the lengths are not those planned for.
    pub fn to_rgb_stage(&mut self, image: &[u8], rgb: &mut [u8]) {
        let image = match &mut self.to_source {
            Some(resizer) => {
                resizer.apply(image, &mut self.source_image);
                &self.source_image
            }
            None => image,
        };
        let [height, width] = self.spec.source;
        assert_eq!(image.len(), height * width * 3, "image of {:?} pixels", self.from);
        let mut kept = &image[self.spec.rows[0] * width * 3..self.spec.rows[1] * width * 3];
        if let Some((blur, blurred)) = &mut self.blur {
            blur.apply(kept, blurred);
            kept = blurred;
        }
        if self.spec.colour_first { rgb.copy_from_slice(kept) } else { self.resizer.apply(kept, rgb) }
    }

    /// From the RGB stage to 8-bit planes `[c][h][w]`.
    ///
    /// # Panics
    /// If the lengths are not those planned for.
    pub fn finish(&mut self, rgb: &[u8], planes: &mut [u8]) {
        let colour = self.spec.colour;
        if !self.spec.colour_first {
            return colour.planes(rgb, planes);
        }
        colour.planes(rgb, &mut self.kept_planes);
        let channels = colour.channels();
        let (from, to) = (self.kept_planes.len() / channels, planes.len() / channels);
        for (kept, plane) in self.kept_planes.chunks_exact(from).zip(planes.chunks_exact_mut(to)) {
            self.resizer.apply(kept, plane);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(h: usize, w: usize) -> Vec<u8> {
        (0..h * w * 3).map(|i| (i.wrapping_mul(2_654_435_761) >> 13) as u8).collect()
    }

    fn small() -> Preprocessing {
        Preprocessing { source: [8, 12], rows: [2, 6], resize: [2, 6], ..Default::default() }
    }

    #[test]
    fn rows_are_kept_then_resized() {
        let image: Vec<u8> = (0..8).flat_map(|row| [row * 10; 12 * 3]).collect();
        let mut planes = vec![0; 3 * 2 * 6];
        small().plan(8, 12).unwrap().apply(&image, &mut planes);
        // Rows 2, 3 and 4, 5 average to 25 and 45 in each of the three planes.
        let expected: Vec<u8> = [25, 45].repeat(3).into_iter().flat_map(|grey| [grey; 6]).collect();
        assert_eq!(planes, expected);
    }

    #[test]
    fn the_kept_rows_are_smoothed_before_they_are_resized() {
        // Rows 0, 0, 160, 0, 0, 240, 0, 0; the last lies outside of what is kept, and so does its light.
        let image: Vec<u8> = [0, 0, 160, 0, 0, 240, 0, 0].into_iter().flat_map(|grey| [grey; 12 * 3]).collect();
        let spec = Preprocessing { rows: [1, 5], resize: [4, 12], blur: true, ..small() };
        let mut planes = vec![0; spec.output_len()];
        spec.plan(8, 12).unwrap().apply(&image, &mut planes);
        let column: Vec<u8> = planes.iter().step_by(12).copied().take(4).collect();
        assert_eq!(column, [80, 80, 40, 0]);
        let halved = Preprocessing { resize: [2, 6], ..spec };
        let mut planes = vec![0; halved.output_len()];
        halved.plan(8, 12).unwrap().apply(&image, &mut planes);
        assert_eq!((planes[0], planes[6]), (80, 20));
    }

    #[test]
    fn stopping_at_the_rgb_stage_changes_nothing() {
        for colour_first in [false, true] {
            for colour in [Colour::Rgb, Colour::Saturation, Colour::Yuv] {
                for (interpolation, blur) in [(Interpolation::Linear, true), (Interpolation::Area, false)] {
                    let spec = Preprocessing { colour, colour_first, interpolation, blur, resize: [3, 5], ..small() };
                    let mut preprocessor = spec.plan(8, 12).unwrap();
                    let (mut whole, mut rgb) = (vec![0; spec.output_len()], vec![0; spec.rgb_len()]);
                    preprocessor.apply(&picture(8, 12), &mut whole);
                    preprocessor.to_rgb_stage(&picture(8, 12), &mut rgb);
                    let mut staged = vec![1; spec.output_len()];
                    preprocessor.finish(&rgb, &mut staged);
                    assert_eq!(whole, staged, "{colour:?} {colour_first}");
                }
            }
        }
    }

    #[test]
    fn the_order_of_colour_and_resize_matters_for_saturation() {
        // Columns of dark red and black: their mean colour is as saturated as red is.
        let image: Vec<u8> = [[200, 0, 0], [0, 0, 0]].concat().repeat(6 * 8);
        let spec = Preprocessing { colour: Colour::Saturation, ..small() };
        let run = |spec: Preprocessing| {
            let mut planes = vec![0; spec.output_len()];
            spec.plan(8, 12).unwrap().apply(&image, &mut planes);
            planes[0]
        };
        assert_eq!(run(spec.clone()), 255);
        assert_eq!(run(Preprocessing { colour_first: true, ..spec }), 128);
    }

    #[test]
    fn another_size_is_scaled_to_the_source_first() {
        let grey = vec![77; 4 * 5 * 3];
        let mut planes = vec![0; small().output_len()];
        small().plan(4, 5).unwrap().apply(&grey, &mut planes);
        assert!(planes.iter().all(|&x| x == 77));
        assert_eq!(small().size_notice([8, 12]), None);
        assert!(small().size_notice([4, 5]).unwrap().contains("5x4 pixels are scaled to 12x8"));
    }

    #[test]
    fn input_is_scaled_grey_levels() {
        let spec = Preprocessing { scale: 1.0 / 255.0, offset: -0.5, ..small() };
        let mut out = [0.0; 3];
        spec.to_input(&[0, 255, 51], &mut out);
        assert_eq!(out[0], -0.5);
        assert!((out[1] - 0.5).abs() < 1e-6 && (out[2] + 0.3).abs() < 1e-6);
    }

    #[test]
    fn impossible_tables_are_errors_that_name_the_key() {
        for (spec, key) in [
            (Preprocessing { rows: [6, 2], ..small() }, "rows"),
            (Preprocessing { rows: [0, 9], ..small() }, "rows"),
            (Preprocessing { resize: [0, 4], ..small() }, "resize"),
            (Preprocessing { source: [8, 100_000], ..small() }, "source"),
            (Preprocessing { scale: f64::NAN, ..small() }, "scale"),
        ] {
            let message = spec.plan(8, 12).unwrap_err().to_string();
            assert!(message.contains(key), "{message}");
        }
        assert!(small().plan(0, 12).is_err());
    }

    #[test]
    fn the_table_reads_from_toml() {
        let spec: Preprocessing = toml::from_str(
            "source = [160, 320]\nrows = [40, 138]\nresize = [64, 64]\ninterpolation = 'area'\n\
             colour = 'saturation'\ncolour_first = true",
        )
        .unwrap();
        assert_eq!(spec.output(), [1, 64, 64]);
        assert_eq!((spec.rgb_size(), spec.scale), ([98, 320], 1.0));
        assert!(!toml::to_string(&spec).unwrap().contains("blur"), "files of models without it stay as they were");
        assert!(toml::from_str::<Preprocessing>("colours = 'rgb'").is_err());
        assert_eq!(toml::from_str::<Preprocessing>("colour = 'yuv-old'").unwrap().colour, Colour::YuvOld);
    }
}
