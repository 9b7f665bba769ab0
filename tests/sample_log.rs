//! `data/sample/`, a small log of our own simulator for tests and benches, and the code that draws it.
//!
//! To draw it anew: `STEERSMAN_REMAKE_SAMPLE=1 cargo test --release --test sample_log`.

use std::fs;
use std::path::Path;

use steersman::observer::Unobserved;
use steersman::picture::{RgbImage, decode::decode_rgb};
use steersman::simulator::{RecordOptions, Track, record};

/// Every ninth frame of a 10 Hz drive: neighbours stay within the second that makes them one session.
const EVERY: usize = 9;
/// JPEG quality, low enough for 300 kB in all.
const QUALITY: u8 = 16;
const MAX_BYTES: u64 = 300_000;

/// Draws the sample log into `folder`.
fn draw(folder: &Path) {
    let scratch = tempfile::tempdir().unwrap();
    let drive = scratch.path().join("drive");
    let options = RecordOptions { laps: 0.18, seed: 1, ..RecordOptions::default() };
    record(&Track::load("lake").unwrap(), &options, &drive, &mut Unobserved).unwrap();

    fs::create_dir_all(folder.join("IMG")).unwrap();
    let log = fs::read_to_string(drive.join("driving_log.csv")).unwrap();
    let (header, rows) = log.split_once('\n').unwrap();
    let kept: Vec<&str> = rows.lines().step_by(EVERY).collect();
    fs::write(folder.join("driving_log.csv"), format!("{header}\n{}\n", kept.join("\n"))).unwrap();
    let mut image = RgbImage::default();
    for name in kept.iter().flat_map(|row| row.split(',').take(3)).map(str::trim) {
        decode_rgb(&fs::read(drive.join(name)).unwrap(), &mut image).unwrap();
        let mut bytes = Vec::new();
        let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, QUALITY);
        encoder.set_sampling_factor(jpeg_encoder::SamplingFactor::F_2_2);
        let (width, height) = (image.width as u16, image.height as u16);
        encoder.encode(&image.pixels, width, height, jpeg_encoder::ColorType::Rgb).unwrap();
        fs::write(folder.join(name), bytes).unwrap();
    }
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder.join("IMG")).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn the_sample_log_is_what_the_simulator_draws() {
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample");
    if std::env::var_os("STEERSMAN_REMAKE_SAMPLE").is_some() {
        fs::remove_dir_all(&sample).unwrap_or_default();
        draw(&sample);
    }
    let fresh = tempfile::tempdir().unwrap();
    draw(fresh.path());
    assert_eq!(names(&sample), names(fresh.path()));
    let mut total = 0;
    for name in names(&sample) {
        let [mut ours, mut theirs] = [RgbImage::default(), RgbImage::default()];
        for (folder, image) in [(sample.as_path(), &mut ours), (fresh.path(), &mut theirs)] {
            let bytes = fs::read(folder.join("IMG").join(&name)).unwrap();
            total += bytes.len() as u64 / 2;
            decode_rgb(&bytes, image).unwrap();
        }
        // Another platform's sine may move an edge by a hair.
        let difference: u64 = ours.pixels.iter().zip(&theirs.pixels).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
        assert!(difference < 2 * ours.pixels.len() as u64, "{name} looks different");
    }
    assert!(total <= MAX_BYTES, "{total} bytes");
}
