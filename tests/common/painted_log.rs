//! A driving log in Udacity's format with painted pictures: a bright stripe stands where the road goes.

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use image::codecs::jpeg::JpegEncoder;
use image::{ExtendedColorType, RgbImage};

/// How many pixels the stripe moves for a steering of 1.
const SWING_PX: f64 = 120.0;

/// Steering of row `row`: a slow weave.
pub fn steering(row: usize) -> f64 {
    0.6 * (row as f64 * 0.11).sin()
}

/// Writes a log of `rows` at 10 Hz into `folder`; image names end in `suffix`.
pub fn write(folder: &Path, rows: usize, suffix: &str) -> PathBuf {
    fs::create_dir_all(folder.join("IMG")).unwrap();
    let mut log = String::from("center,left,right,steering,throttle,brake,speed\n");
    for row in 0..rows {
        let ms = row * 100;
        let time = format!("2026_01_01_00_{:02}_{:02}_{:03}", ms / 60_000, ms / 1000 % 60, ms % 1000);
        let mut names = Vec::new();
        for (camera, shift_px) in [("center", 0.0), ("left", 18.0), ("right", -18.0)] {
            let name = format!("IMG/{camera}_{time}{suffix}.jpg");
            fs::write(folder.join(&name), picture(row, 160.0 + shift_px + SWING_PX * steering(row))).unwrap();
            names.push(name);
        }
        writeln!(log, "{}, {}, {}, {}, 0.8, 0, 20.5", names[0], names[1], names[2], steering(row)).unwrap();
    }
    let path = folder.join("driving_log.csv");
    fs::write(&path, log).unwrap();
    path
}

/// A JPEG of 320x160 pixels with a saturated stripe around column `middle_px`. The upper left corner spells `row` in squares, so that
/// no two rows have the same picture.
fn picture(row: usize, middle_px: f64) -> Vec<u8> {
    let image = RgbImage::from_fn(320, 160, |x, y| {
        if y < 8 && x < 128 {
            return image::Rgb(if row >> (x / 8) & 1 == 1 { [250; 3] } else { [5; 3] });
        }
        let distance = (f64::from(x) - middle_px).abs();
        if distance < 12.0 { image::Rgb([230, 60, 40]) } else { image::Rgb([90, 90, 80 + (y / 4) as u8]) }
    });
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, 60);
    encoder.encode(&image, 320, 160, ExtendedColorType::Rgb8).unwrap();
    bytes
}
