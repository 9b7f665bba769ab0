//! Decoding of JPEG and PNG images to 8-bit RGB.

mod jpeg;
mod png;

use image::ImageDecoder as _;
use std::io::Cursor;

use super::RgbImage;
use jpeg::decode_jpeg;
use png::decode_png;

/// Largest height or width that is decoded, in pixels.
pub const MAX_SIDE: usize = 8192;

/// Most pixels of an image that is decoded: 16 megapixels.
pub const MAX_PIXELS: usize = 16 << 20;

/// Longest file of a picture that is read, bytes.
pub const MAX_FILE_LEN: u64 = 64 << 20;

/// First bytes of every PNG file.
const PNG_SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Decodes a JPEG or PNG file held in `bytes` into `image`, upright if its EXIF data say how it was held.
///
/// A JPEG whose picture data end early is an error, not a picture with a grey bottom, whether it has an end marker or not.
/// What stands behind the end marker is ignored: some cameras pad their files.
///
/// # Errors
/// A short sentence that says what is wrong with the image; the caller knows its place.
pub fn decode_rgb(bytes: &[u8], image: &mut RgbImage) -> Result<(), String> {
    decode_rgb_within(bytes, MAX_SIDE, image)
}

/// [`decode_rgb`] for images of strangers: what is higher or wider than `max_side` pixels is not decoded.
///
/// # Errors
/// As [`decode_rgb`].
pub fn decode_rgb_within(bytes: &[u8], max_side: usize, image: &mut RgbImage) -> Result<(), String> {
    if bytes.is_empty() {
        Err("the image is empty".into())
    } else if bytes.starts_with(PNG_SIGNATURE) {
        decode_png(bytes, max_side, image)
    } else if bytes.starts_with(&[0xff, 0xd8]) {
        decode_jpeg(bytes, max_side, image)
    } else {
        Err("neither a JPEG nor a PNG image".into())
    }
}

/// Height and width of a JPEG or PNG image as it is decoded, from its header alone.
///
/// # Errors
/// As [`decode_rgb`].
pub fn image_size(bytes: &[u8]) -> Result<[usize; 2], String> {
    if bytes.starts_with(PNG_SIGNATURE) {
        // Other readers would unpack the profiles and texts that stand before the pixels.
        let number = |at: usize| Some(u32::from_be_bytes(*bytes.get(at..)?.first_chunk()?) as usize);
        return match (bytes.get(12..16), number(20), number(16)) {
            (Some(b"IHDR"), Some(height), Some(width)) => Ok([height, width]),
            _ => Err("the PNG has no header".into()),
        };
    }
    let reader = image::ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(|e| e.to_string())?;
    let mut decoder = reader.into_decoder().map_err(|e| e.to_string())?;
    let (width, height) = decoder.dimensions();
    let [height, width] = [height as usize, width as usize];
    let is_jpeg = bytes.starts_with(&[0xff, 0xd8]);
    let turned = is_jpeg && decoder.orientation().is_ok_and(|orientation| orientation.to_exif() > 4);
    Ok(if turned { [width, height] } else { [height, width] })
}

/// Whether the last bytes of an image file hold the end marker of a JPEG or the last chunk of a PNG.
///
/// Some cameras pad the file, so the marker may stand a little before the end.
pub fn ends_complete(tail: &[u8]) -> bool {
    let tail = &tail[tail.len().saturating_sub(64)..];
    let ends_with = |marker: &[u8]| tail.windows(marker.len()).any(|window| window == marker);
    ends_with(&[0xff, 0xd9]) || ends_with(b"IEND")
}

/// Whether the first bytes of a file are those of a JPEG or PNG image.
pub fn starts_as_image(head: &[u8]) -> bool {
    head.starts_with(&[0xff, 0xd8]) || head.starts_with(PNG_SIGNATURE)
}

fn check_pixels(height: usize, width: usize) -> Result<(), String> {
    match height.checked_mul(width) {
        Some(pixels) if pixels <= MAX_PIXELS => Ok(()),
        _ => Err(format!("{width}x{height} pixels; at most 16 megapixels are decoded")),
    }
}

#[cfg(test)]
mod tests;
