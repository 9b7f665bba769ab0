//! PNG, without what says nothing about its pixels.

use std::borrow::Cow;
use std::io::Cursor;

use super::{PNG_SIGNATURE, check_pixels, image_size};
use crate::picture::RgbImage;

/// Most memory that decoding a PNG may take, bytes.
const MAX_DECODED_LEN: u64 = 64 << 20;

pub(super) fn decode_png(bytes: &[u8], max_side: usize, image: &mut RgbImage) -> Result<(), String> {
    let [height, width] = image_size(bytes)?;
    check_pixels(height, width)?;
    let bytes = without_metadata(bytes);
    let mut reader = image::ImageReader::with_format(Cursor::new(&*bytes), image::ImageFormat::Png);
    let mut limits = image::Limits::default();
    limits.max_image_width = Some(max_side as u32);
    limits.max_image_height = Some(max_side as u32);
    limits.max_alloc = Some(MAX_DECODED_LEN);
    reader.limits(limits);
    let decoded = reader.decode().map_err(|error| format!("the PNG cannot be decoded: {error}"))?.into_rgb8();
    (image.height, image.width) = (decoded.height() as usize, decoded.width() as usize);
    image.pixels.clear();
    image.pixels.extend_from_slice(decoded.as_raw());
    Ok(())
}

/// A PNG without the chunks that say nothing about its pixels: profiles and texts, of which a few bytes can unpack to
/// hundreds of megabytes.
pub(super) fn without_metadata(bytes: &[u8]) -> Cow<'_, [u8]> {
    let mut kept = PNG_SIGNATURE.to_vec();
    let mut rest = &bytes[PNG_SIGNATURE.len()..];
    while let [a, b, c, d, kind @ ..] = rest
        && let Some(kind) = kind.first_chunk::<4>()
    {
        let len = u32::from_be_bytes([*a, *b, *c, *d]) as usize;
        // Length, kind and checksum stand around the content.
        let (chunk, after) = rest.split_at(len.saturating_add(12).min(rest.len()));
        if !matches!(kind, b"iCCP" | b"tEXt" | b"zTXt" | b"iTXt") {
            kept.extend_from_slice(chunk);
        }
        rest = after;
    }
    kept.extend_from_slice(rest);
    if kept.len() == bytes.len() { Cow::Borrowed(bytes) } else { Cow::Owned(kept) }
}
