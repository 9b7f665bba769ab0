//! Helpers of the tests of this module.

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
