//! Pictures for pages and files: RGB in memory, cut, mirrored, enlarged, encoded.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use image::{ExtendedColorType, ImageEncoder};

use crate::dataset::decode::{RgbImage, decode_rgb};
use crate::dataset::{Camera, Recording};

/// Quality of JPEGs in pages: a camera frame takes about 8 kB.
const QUALITY: u8 = 78;

impl RgbImage {
    /// A picture of one colour.
    pub fn filled(height: usize, width: usize, rgb: [u8; 3]) -> RgbImage {
        RgbImage { height, width, pixels: rgb.repeat(height * width) }
    }

    /// A picture whose pixels are `rgb(row, column)`.
    pub fn from_fn(height: usize, width: usize, rgb: impl Fn(usize, usize) -> [u8; 3]) -> RgbImage {
        let pixels = (0..height * width).flat_map(|at| rgb(at / width, at % width)).collect();
        RgbImage { height, width, pixels }
    }

    /// A grey picture of 8-bit levels, row by row.
    pub fn grey(height: usize, width: usize, levels: &[u8]) -> RgbImage {
        RgbImage::from_fn(height, width, |row, column| [levels[row * width + column]; 3])
    }

    /// The pixel at `row` and `column`.
    pub fn pixel(&self, row: usize, column: usize) -> [u8; 3] {
        let at = (row * self.width + column) * 3;
        [self.pixels[at], self.pixels[at + 1], self.pixels[at + 2]]
    }

    /// Changes the pixel at `row` and `column`.
    pub fn set_pixel(&mut self, row: usize, column: usize, rgb: [u8; 3]) {
        let at = (row * self.width + column) * 3;
        self.pixels[at..at + 3].copy_from_slice(&rgb);
    }

    /// Left and right exchanged.
    pub fn mirrored(&self) -> RgbImage {
        RgbImage::from_fn(self.height, self.width, |row, column| self.pixel(row, self.width - 1 - column))
    }

    /// Each pixel as a square of `factor` pixels.
    pub fn enlarged(&self, factor: usize) -> RgbImage {
        RgbImage::from_fn(self.height * factor, self.width * factor, |r, c| self.pixel(r / factor, c / factor))
    }

    /// Copies `other` to the place (`top`, `left`); what does not fit is cut off.
    pub fn paste(&mut self, other: &RgbImage, top: usize, left: usize) {
        for row in 0..other.height.min(self.height.saturating_sub(top)) {
            for column in 0..other.width.min(self.width.saturating_sub(left)) {
                self.set_pixel(top + row, left + column, other.pixel(row, column));
            }
        }
    }

    /// As JPEG. An empty picture has no bytes.
    pub fn to_jpeg(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        let (width, height) = (self.width as u16, self.height as u16);
        if !self.pixels.is_empty() {
            let encoder = jpeg_encoder::Encoder::new(&mut bytes, QUALITY);
            let encoded = encoder.encode(&self.pixels, width, height, jpeg_encoder::ColorType::Rgb);
            encoded.expect("a picture in memory has as many pixels as it says, and no side beyond 8192");
        }
        bytes
    }

    /// As PNG. An empty picture has no bytes.
    pub fn to_png(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        if !self.pixels.is_empty() {
            let (width, height) = (self.width as u32, self.height as u32);
            let encoder = image::codecs::png::PngEncoder::new(&mut bytes);
            let encoded = encoder.write_image(&self.pixels, width, height, ExtendedColorType::Rgb8);
            encoded.expect("a picture in memory has as many pixels as it says");
        }
        bytes
    }

    /// As JPEG in a `data:` address.
    pub fn jpeg_address(&self) -> String {
        format!("data:image/jpeg;base64,{}", STANDARD.encode(self.to_jpeg()))
    }

    /// As PNG in a `data:` address.
    pub fn png_address(&self) -> String {
        format!("data:image/png;base64,{}", STANDARD.encode(self.to_png()))
    }
}

/// The picture of `camera` at `row`, if there is one that can be decoded.
pub fn read(recording: &Recording, row: usize, camera: Camera) -> Option<RgbImage> {
    let bytes = std::fs::read(recording.image_path(row, camera)?).ok()?;
    let mut image = RgbImage::default();
    decode_rgb(&bytes, &mut image).ok()?;
    Some(image)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_mirrored_enlarged_and_pasted() {
        let picture = RgbImage::from_fn(2, 3, |row, column| [row as u8, column as u8, 7]);
        assert_eq!(picture.mirrored().pixel(1, 0), [1, 2, 7]);
        let large = picture.enlarged(4);
        assert_eq!((large.height, large.width, large.pixel(7, 11)), (8, 12, [1, 2, 7]));
        let mut sheet = RgbImage::filled(3, 3, [255; 3]);
        sheet.paste(&picture, 1, 1);
        assert_eq!((sheet.pixel(0, 0), sheet.pixel(1, 1), sheet.pixel(2, 2)), ([255; 3], [0, 0, 7], [1, 1, 7]));
    }

    #[test]
    fn pictures_come_back_from_png_and_from_addresses() {
        let picture = RgbImage::from_fn(5, 9, |row, column| [row as u8 * 40, column as u8 * 20, 128]);
        let mut decoded = RgbImage::default();
        decode_rgb(&picture.to_png(), &mut decoded).unwrap();
        assert_eq!(decoded, picture);
        let address = picture.jpeg_address();
        let bytes = STANDARD.decode(address.strip_prefix("data:image/jpeg;base64,").unwrap()).unwrap();
        decode_rgb(&bytes, &mut decoded).unwrap();
        assert_eq!((decoded.height, decoded.width), (5, 9));
        assert!(RgbImage::default().to_png().is_empty() && RgbImage::default().to_jpeg().is_empty());
    }
}
