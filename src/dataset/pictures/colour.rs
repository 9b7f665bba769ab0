//! Colour spaces in 8 bits, with OpenCV's conventions and rounding.
//!
//! The write-ups and the student projects this project follows all preprocess with OpenCV, so its integers are the
//! specification: the same fixed-point coefficients, tables and roundings are used here.
//!
//! Input is interleaved RGB (`[h][w][3]`), output is planar (`[c][h][w]`), as the network wants it.

use serde::{Deserialize, Serialize};
use std::sync::LazyLock;

/// Colour space of the network's input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Colour {
    /// Red, green, blue.
    #[default]
    Rgb,
    /// Blue, green, red: what a network saw that was trained on the images of OpenCV's `imread`.
    Bgr,
    /// Y, U, V with BT.601 weights, U and V centred at 128 (`COLOR_RGB2YUV`).
    Yuv,
    /// The same with red and blue exchanged: what `COLOR_RGB2YUV` gave up to OpenCV 3.1, and what
    /// `COLOR_BGR2YUV` gives when it is handed RGB data.
    YuvOld,
    /// Hue 0–179 (two degrees a step), saturation, value (`COLOR_RGB2HSV`).
    Hsv,
    /// The saturation plane of [`Colour::Hsv`] alone: one channel.
    Saturation,
    /// Hue 0–179, lightness, saturation (`COLOR_RGB2HLS`).
    Hls,
    /// CIE L*a*b* under D65 from sRGB; L scaled to 0–255, a and b centred at 128 (`COLOR_RGB2Lab`).
    Lab,
    /// Luminance, BT.601 weights (`COLOR_RGB2GRAY`): one channel.
    Gray,
}

impl Colour {
    /// All of them.
    pub const ALL: [Colour; 9] = [
        Colour::Rgb,
        Colour::Bgr,
        Colour::Yuv,
        Colour::YuvOld,
        Colour::Hsv,
        Colour::Saturation,
        Colour::Hls,
        Colour::Lab,
        Colour::Gray,
    ];

    /// Name in recipes.
    pub fn name(self) -> &'static str {
        ["rgb", "bgr", "yuv", "yuv-old", "hsv", "saturation", "hls", "lab", "gray"][self as usize]
    }

    /// Names of the planes.
    pub fn plane_names(self) -> &'static [&'static str] {
        match self {
            Colour::Rgb => &["red", "green", "blue"],
            Colour::Bgr => &["blue", "green", "red"],
            Colour::Yuv => &["Y", "U", "V"],
            Colour::YuvOld => &["Y", "U", "V (red and blue exchanged)"],
            Colour::Hsv => &["hue", "saturation", "value"],
            Colour::Saturation => &["saturation"],
            Colour::Hls => &["hue", "lightness", "saturation"],
            Colour::Lab => &["L*", "a*", "b*"],
            Colour::Gray => &["luminance"],
        }
    }

    /// Number of planes.
    pub fn channels(self) -> usize {
        match self {
            Colour::Saturation | Colour::Gray => 1,
            _ => 3,
        }
    }

    /// Converts interleaved RGB `[pixels][3]` to planes `[channels][pixels]`.
    ///
    /// # Panics
    /// If the lengths do not fit: `planes` must hold `rgb.len() / 3 * channels` bytes.
    pub fn planes(self, rgb: &[u8], planes: &mut [u8]) {
        let pixels = rgb.len() / 3;
        assert_eq!(planes.len(), pixels * self.channels(), "planes of {self:?} for {pixels} pixels");
        match self {
            Colour::Rgb => three(rgb, planes, |p| p),
            Colour::Bgr => three(rgb, planes, |[r, g, b]| [b, g, r]),
            Colour::Yuv => three(rgb, planes, yuv),
            Colour::YuvOld => three(rgb, planes, |[r, g, b]| yuv([b, g, r])),
            Colour::Hsv => {
                let tables = &*HSV;
                three(rgb, planes, |p| hsv(tables, p));
            }
            Colour::Saturation => {
                let tables = &*HSV;
                one(rgb, planes, |p| saturation(tables, p));
            }
            Colour::Hls => three(rgb, planes, hls),
            Colour::Lab => {
                let tables = &*LAB;
                three(rgb, planes, |p| lab(tables, p));
            }
            Colour::Gray => one(rgb, planes, gray),
        }
    }
}

/// Applies `convert` to every pixel and deals the results out to three planes.
#[inline(always)]
fn three(rgb: &[u8], planes: &mut [u8], convert: impl Fn([u8; 3]) -> [u8; 3]) {
    let (first, rest) = planes.split_at_mut(rgb.len() / 3);
    let (second, third) = rest.split_at_mut(rgb.len() / 3);
    let outputs = first.iter_mut().zip(second).zip(third);
    for (pixel, ((a, b), c)) in rgb.as_chunks::<3>().0.iter().zip(outputs) {
        [*a, *b, *c] = convert(*pixel);
    }
}

/// Applies `convert` to every pixel.
#[inline(always)]
fn one(rgb: &[u8], plane: &mut [u8], convert: impl Fn([u8; 3]) -> u8) {
    for (pixel, out) in rgb.as_chunks::<3>().0.iter().zip(plane) {
        *out = convert(*pixel);
    }
}

fn to_u8(x: i32) -> u8 {
    x.clamp(0, 255) as u8
}

/// `x / 2^bits`, rounded half up.
fn descale(x: i32, bits: u32) -> i32 {
    (x + (1 << (bits - 1))) >> bits
}

/// Y = 0.299 R + 0.587 G + 0.114 B, U = 0.492 (B − Y) + 128, V = 0.877 (R − Y) + 128, in 14-bit fixed point.
#[inline(always)]
fn yuv([r, g, b]: [u8; 3]) -> [u8; 3] {
    let [r, g, b] = [r, g, b].map(i32::from);
    let y = descale(4899 * r + 9617 * g + 1868 * b, 14);
    let u = descale(8061 * (b - y), 14) + 128;
    let v = descale(14369 * (r - y), 14) + 128;
    [y as u8, to_u8(u), to_u8(v)]
}

/// 0.299 R + 0.587 G + 0.114 B in 15-bit fixed point.
#[inline(always)]
fn gray([r, g, b]: [u8; 3]) -> u8 {
    descale(9798 * i32::from(r) + 19235 * i32::from(g) + 3735 * i32::from(b), 15) as u8
}

/// Reciprocals in 12-bit fixed point: 255 / v for the saturation, 180 / (6 d) for the hue.
pub(crate) struct HsvTables {
    pub saturation: [i32; 256],
    pub hue: [i32; 256],
}

pub(crate) static HSV: LazyLock<HsvTables> = LazyLock::new(|| {
    let table = |numerator: f64| {
        std::array::from_fn(|i| if i == 0 { 0 } else { (numerator * 4096.0 / i as f64).round_ties_even() as i32 })
    };
    HsvTables { saturation: table(255.0), hue: table(30.0) }
});

#[inline(always)]
fn saturation(tables: &HsvTables, [r, g, b]: [u8; 3]) -> u8 {
    let value = r.max(g).max(b);
    let spread = value - r.min(g).min(b);
    descale(i32::from(spread) * tables.saturation[usize::from(value)], 12) as u8
}

#[inline(always)]
fn hsv(tables: &HsvTables, pixel: [u8; 3]) -> [u8; 3] {
    let value = pixel.into_iter().max().unwrap_or(0);
    let [r, g, b] = pixel.map(i32::from);
    let spread = i32::from(value) - r.min(g).min(b);
    let sector = if i32::from(value) == r {
        g - b
    } else if i32::from(value) == g {
        b - r + 2 * spread
    } else {
        r - g + 4 * spread
    };
    let hue = descale(sector * tables.hue[spread as usize], 12);
    let hue = if hue < 0 { hue + 180 } else { hue };
    [to_u8(hue), saturation(tables, pixel), value]
}

#[inline(always)]
fn hls(pixel: [u8; 3]) -> [u8; 3] {
    let [r, g, b] = pixel.map(|x| f32::from(x) * (1.0 / 255.0));
    let (max, min) = (r.max(g).max(b), r.min(g).min(b));
    let (sum, spread) = (max + min, max - min);
    let lightness = sum * 0.5;
    let (mut hue_deg, mut saturation) = (0.0, 0.0);
    if spread > f32::EPSILON {
        saturation = if lightness < 0.5 { spread / sum } else { spread / (2.0 - max - min) };
        let step = 60.0 / spread;
        hue_deg = if max == r {
            (g - b) * step
        } else if max == g {
            (b - r) * step + 120.0
        } else {
            (r - g) * step + 240.0
        };
        if hue_deg < 0.0 {
            hue_deg += 360.0;
        }
    }
    [hue_deg * 0.5, lightness * 255.0, saturation * 255.0].map(|x| x.round_ties_even() as u8)
}

/// L*a*b* in fixed point: sRGB to linear light with 3 extra bits, the cube root with 15 bits.
pub(crate) struct LabTables {
    pub linear: [i32; 256],
    pub root: Vec<i32>,
    /// Linear RGB to X, Y, Z over the D65 white point, 12 bits.
    pub xyz: [[i32; 3]; 3],
}

/// 116 and −16 of the lightness, scaled by 255/100; the second in 15-bit fixed point.
pub(crate) const L_SCALE: i32 = (116 * 255 + 50) / 100;
pub(crate) const L_SHIFT: i32 = -((16 * 255 * (1 << 15) + 50) / 100);

pub(crate) static LAB: LazyLock<LabTables> = LazyLock::new(|| {
    let linear = |i: usize| {
        let x = i as f64 / 255.0;
        let light = if x <= 0.04045 { x / 12.92 } else { ((x + 0.055) / 1.055).powf(2.4) };
        (255.0 * 8.0 * light).round_ties_even() as i32
    };
    let root = |i: usize| {
        let x = i as f64 / (255.0 * 8.0);
        let y = if x < 216.0 / 24389.0 { x * (841.0 / 108.0) + 16.0 / 116.0 } else { x.cbrt() };
        (32768.0 * y).round_ties_even() as i32
    };
    let to_xyz = [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]];
    let white = [0.950456, 1.0, 1.088754];
    LabTables {
        linear: std::array::from_fn(linear),
        root: (0..256 * 12).map(root).collect(),
        xyz: std::array::from_fn(|i| to_xyz[i].map(|m: f64| (4096.0 * m / white[i]).round_ties_even() as i32)),
    }
});

/// L = 116 f(Y) − 16, a = 500 (f(X) − f(Y)) + 128, b = 200 (f(Y) − f(Z)) + 128.
#[inline(always)]
fn lab(tables: &LabTables, pixel: [u8; 3]) -> [u8; 3] {
    let [r, g, b] = pixel.map(|x| tables.linear[usize::from(x)]);
    let [fx, fy, fz] = tables.xyz.map(|[cr, cg, cb]| tables.root[descale(r * cr + g * cg + b * cb, 12) as usize]);
    let l = descale(L_SCALE * fy + L_SHIFT, 15);
    let a = descale(500 * (fx - fy) + (128 << 15), 15);
    let b = descale(200 * (fy - fz) + (128 << 15), 15);
    [l, a, b].map(to_u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn convert(colour: Colour, pixel: [u8; 3]) -> Vec<u8> {
        let mut out = vec![0; colour.channels()];
        colour.planes(&pixel, &mut out);
        out
    }

    #[test]
    fn known_colours() {
        // From the definitions; red has hue 0, green 120 deg = 60 steps, blue 240 deg = 120 steps.
        let (red, green, blue, grey) = ([255, 0, 0], [0, 255, 0], [0, 0, 255], [100, 100, 100]);
        assert_eq!(convert(Colour::Rgb, [1, 2, 3]), [1, 2, 3]);
        assert_eq!(convert(Colour::Bgr, [1, 2, 3]), [3, 2, 1]);
        assert_eq!(convert(Colour::Yuv, red), [76, 91, 255]);
        assert_eq!(convert(Colour::YuvOld, red), [29, 239, 103]);
        assert_eq!(convert(Colour::Yuv, grey), [100, 128, 128]);
        assert_eq!(convert(Colour::Hsv, red), [0, 255, 255]);
        assert_eq!(convert(Colour::Hsv, green), [60, 255, 255]);
        assert_eq!(convert(Colour::Hsv, blue), [120, 255, 255]);
        assert_eq!(convert(Colour::Hsv, [100, 50, 75]), [165, 128, 100]);
        assert_eq!(convert(Colour::Saturation, [100, 50, 75]), [128]);
        assert_eq!(convert(Colour::Saturation, [0, 0, 0]), [0]);
        assert_eq!(convert(Colour::Hls, blue), [120, 128, 255]);
        assert_eq!(convert(Colour::Hls, grey), [0, 100, 0]);
        assert_eq!(convert(Colour::Lab, [255, 255, 255]), [255, 128, 128]);
        assert_eq!(convert(Colour::Lab, red), [136, 208, 195]);
        assert_eq!(convert(Colour::Lab, [0, 0, 0]), [0, 128, 128]);
        assert_eq!(convert(Colour::Gray, red), [76]);
        assert_eq!(convert(Colour::Gray, [255, 255, 255]), [255]);
    }

    #[test]
    fn the_saturation_plane_is_that_of_hsv() {
        let pixels: Vec<u8> = (0..=255_u8).flat_map(|max| (0..=max).flat_map(move |min| [min, max, min])).collect();
        let n = pixels.len() / 3;
        let (mut hsv, mut saturation) = (vec![0; 3 * n], vec![0; n]);
        Colour::Hsv.planes(&pixels, &mut hsv);
        Colour::Saturation.planes(&pixels, &mut saturation);
        assert_eq!(hsv[n..2 * n], saturation);
    }

    #[test]
    fn planes_are_planar() {
        let mut out = [0; 6];
        Colour::Rgb.planes(&[1, 2, 3, 4, 5, 6], &mut out);
        assert_eq!(out, [1, 4, 2, 5, 3, 6]);
    }

    #[test]
    fn every_colour_converts_without_overflow() {
        let steps = [0, 1, 63, 127, 128, 200, 254, 255];
        for colour in [Colour::Yuv, Colour::YuvOld, Colour::Hsv, Colour::Hls, Colour::Lab, Colour::Gray] {
            for r in steps {
                for g in steps {
                    for b in steps {
                        let out = convert(colour, [r, g, b]);
                        if matches!(colour, Colour::Hsv | Colour::Hls) {
                            assert!(out[0] < 180 || (colour == Colour::Hls && out[0] == 180), "{colour:?} {out:?}");
                        }
                    }
                }
            }
        }
    }
}
