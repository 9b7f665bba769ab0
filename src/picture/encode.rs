//! Encoding of pictures as JPEG and PNG, and as `data:` addresses for pages that stand alone.

use data_encoding::BASE64;
use image::{ExtendedColorType, ImageEncoder};

use super::RgbImage;

/// JPEG quality of pictures in pages: a camera frame takes about 8 kB.
const QUALITY: u8 = 78;

impl RgbImage {
    /// The picture as JPEG; no bytes for an empty picture.
    pub(crate) fn to_jpeg(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let (width, height) = (self.width as u16, self.height as u16);
        if !self.pixels.is_empty() {
            let encoder = jpeg_encoder::Encoder::new(&mut bytes, QUALITY);
            let encoded = encoder.encode(&self.pixels, width, height, jpeg_encoder::ColorType::Rgb);
            encoded.expect("a picture in memory has as many pixels as it says, and no side beyond 8192");
        }
        bytes
    }

    /// The picture as PNG; no bytes for an empty picture.
    pub(crate) fn to_png(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        if !self.pixels.is_empty() {
            let (width, height) = (self.width as u32, self.height as u32);
            let encoder = image::codecs::png::PngEncoder::new(&mut bytes);
            let encoded = encoder.write_image(&self.pixels, width, height, ExtendedColorType::Rgb8);
            encoded.expect("a picture in memory has as many pixels as it says");
        }
        bytes
    }

    /// The picture as JPEG in a `data:` address.
    pub(crate) fn jpeg_address(&self) -> String {
        format!("data:image/jpeg;base64,{}", BASE64.encode(&self.to_jpeg()))
    }

    /// The picture as PNG in a `data:` address.
    pub(crate) fn png_address(&self) -> String {
        format!("data:image/png;base64,{}", BASE64.encode(&self.to_png()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::picture::decode::decode_rgb;

    #[test]
    fn pictures_come_back_from_png_and_from_addresses() {
        let picture = RgbImage::from_fn(5, 9, |row, column| [row as u8 * 40, column as u8 * 20, 128]);
        let mut decoded = RgbImage::default();
        decode_rgb(&picture.to_png(), &mut decoded).unwrap();
        assert_eq!(decoded, picture);
        let address = picture.jpeg_address();
        let bytes = BASE64.decode(address.strip_prefix("data:image/jpeg;base64,").unwrap().as_bytes()).unwrap();
        decode_rgb(&bytes, &mut decoded).unwrap();
        assert_eq!((decoded.height, decoded.width), (5, 9));
        assert!(RgbImage::default().to_png().is_empty() && RgbImage::default().to_jpeg().is_empty());
    }
}
