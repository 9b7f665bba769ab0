//! What the tests of this module share.

use super::pictures::files::Files;
use super::recording::{Recording, Row, View};
use super::unusable::Unusable;
use crate::geometry::CarGeometry;
use std::fs;
use std::path::{Path, PathBuf};

/// A JPEG of one colour.
pub(crate) fn jpeg(width: u16, height: u16, colour: [u8; 3]) -> Vec<u8> {
    jpeg_of(width, height, &colour.repeat(usize::from(width) * usize::from(height)))
}

/// A JPEG of RGB pixels.
pub(crate) fn jpeg_of(width: u16, height: u16, pixels: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    jpeg_encoder::Encoder::new(&mut bytes, 95)
        .encode(pixels, width, height, jpeg_encoder::ColorType::Rgb)
        .expect("a valid picture encodes");
    bytes
}

/// Writes a small JPEG.
pub(crate) fn write_image(path: &Path) {
    fs::write(path, jpeg(8, 8, [90, 80, 70])).expect("the scratch folder can be written");
}

/// The folder of real recordings, from `STEERSMAN_RECORDINGS`; without it the reason for skipping is printed.
pub(crate) fn recordings_folder() -> Option<PathBuf> {
    let folder = std::env::var_os("STEERSMAN_RECORDINGS").map(PathBuf::from);
    if folder.is_none() {
        eprintln!("skipped: STEERSMAN_RECORDINGS does not name a folder of recordings");
    }
    folder
}

/// A recording without files: one session, a row every `step_ms`, all three cameras.
pub(crate) fn recording_of(steering: &[f32], step_ms: i64) -> Recording {
    let mut files = Files::default();
    let images = View::ALL.map(|camera| Some((Path::new("IMG"), camera.name())));
    let images = files.add(images).expect("three short names fit");
    let rows = steering.iter().enumerate().map(|(i, &steering)| Row {
        steering,
        throttle: 1.0,
        brake: 0.0,
        speed_mph: 20.0,
        taken_over: false,
        excluded: false,
        number: i as u32 + 1,
        time_ms: i as i64 * step_ms,
        line: i as u32 + 1,
        source: 0,
        images,
    });
    Recording {
        path: "memory".into(),
        folder: "memory".into(),
        format: super::formats::FORMATS[3],
        rows: rows.collect(),
        sessions: std::iter::once(0..steering.len()).filter(|session| !session.is_empty()).collect(),
        unusable: Unusable::default(),
        notices: Vec::new(),
        image_size: None,
        geometry: CarGeometry::preset(CarGeometry::USUAL).expect("a preset"),
        camera_named: false,
        times_plausible: true,
        unit_trouble: None,
        picture_hashes: Vec::new(),
        files,
        store: super::store::Store::Disk,
    }
}
