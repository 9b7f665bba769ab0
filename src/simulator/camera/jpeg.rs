//! JPEG as Udacity's simulator writes it: quality 75, colour at half resolution (4:2:0).

use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;

use crate::simulator::camera::pinhole::RgbFrame;
use crate::{Error, Result};

/// Quality of the pictures.
pub const QUALITY: u8 = 75;

/// Appends the JPEG of `frame` to `out`.
///
/// # Errors
/// If the frame has not the pixels of its size, or is higher or wider than 65,535.
pub fn encode(frame: &RgbFrame, out: &mut Vec<u8>) -> Result<()> {
    let mut encoder = Encoder::new(out, QUALITY);
    encoder.set_sampling_factor(SamplingFactor::F_2_2);
    let [height, width] = frame.size.map(|side| u16::try_from(side).unwrap_or(0));
    encoder
        .encode(&frame.pixels, width, height, ColorType::Rgb)
        .map_err(|e| Error::Codec(format!("a picture could not be encoded as JPEG: {e}")))
}

/// Decodes a JPEG of the size of `frame` into it.
///
/// # Errors
/// If the bytes are no JPEG of that size.
pub fn decode(bytes: &[u8], frame: &mut RgbFrame) -> Result<()> {
    let fail = |e: &dyn std::fmt::Display| Error::Codec(format!("a JPEG could not be decoded: {e}"));
    frame.pixels.resize(frame.size[0] * frame.size[1] * 3, 0);
    JpegDecoder::new(ZCursor::new(bytes)).decode_into(&mut frame.pixels).map_err(|e| fail(&e))
}

/// Encodes a frame and decodes it again, as a driver receives it. Keeps its buffer.
#[derive(Default)]
pub struct RoundTrip {
    bytes: Vec<u8>,
}

impl RoundTrip {
    /// Replaces `frame` by its decoded JPEG.
    ///
    /// # Errors
    /// As [`encode`] and [`decode`].
    pub fn apply(&mut self, frame: &mut RgbFrame) -> Result<()> {
        self.bytes.clear();
        encode(frame, &mut self.bytes)?;
        decode(&self.bytes, frame)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::WIDTH;

    #[test]
    fn a_round_trip_changes_a_smooth_picture_little_and_keeps_its_colours() {
        let mut frame = RgbFrame::default();
        for (at, pixel) in frame.pixels.chunks_exact_mut(3).enumerate() {
            let (x, y) = (at % WIDTH, at / WIDTH);
            pixel.copy_from_slice(&[(x / 2) as u8, 90, (y + 40) as u8]);
        }
        let before = frame.clone();
        RoundTrip::default().apply(&mut frame).unwrap();
        let worst = frame.pixels.iter().zip(&before.pixels).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(frame != before && worst <= 8, "{worst}");
    }

    #[test]
    fn something_else_is_refused() {
        assert!(decode(b"no picture", &mut RgbFrame::default()).is_err());
    }
}
