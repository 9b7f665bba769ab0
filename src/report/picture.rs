//! Pictures for pages and files: RGB in memory, cut, mirrored, enlarged, encoded.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use image::{ExtendedColorType, ImageEncoder};

use crate::dataset::decode::{RgbImage, decode_rgb};
use crate::dataset::{Camera, Recording};

/// Colour of what a person steers, [`palette::BLUE`](super::palette::BLUE).
pub const HUMAN: [u8; 3] = [0x00, 0x72, 0xb2];
/// Colour of what a model steers: [`palette::ORANGE`](super::palette::ORANGE), lighter.
pub const MODEL: [u8; 3] = [0xff, 0xb0, 0x00];
/// Steering lines are drawn at this many times the angle of the wheels.
pub const STEERING_SCALE: f64 = 2.0;
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

    /// Draws a line of `thickness` pixels between two points (x, y); what lies outside is cut off.
    pub fn draw_line(&mut self, from: [f64; 2], to: [f64; 2], thickness: f64, rgb: [u8; 3]) {
        let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
        let length = dx.hypot(dy).max(1e-9);
        let half = thickness / 2.0;
        let range = |a: f64, b: f64, end: usize| {
            let low = (a.min(b) - half).floor().clamp(0.0, end as f64) as usize;
            low..((a.max(b) + half).ceil() + 1.0).clamp(0.0, end as f64) as usize
        };
        for row in range(from[1], to[1], self.height) {
            for column in range(from[0], to[0], self.width) {
                let (x, y) = (column as f64 - from[0], row as f64 - from[1]);
                let along = ((x * dx + y * dy) / length).clamp(0.0, length);
                let apart = (x - along * dx / length).hypot(y - along * dy / length);
                // Half a pixel of transition, so that the edge is smooth.
                let cover = (half + 0.5 - apart).clamp(0.0, 1.0);
                if cover > 0.0 {
                    let below = self.pixel(row, column);
                    let mixed = |k: usize| f64::from(below[k]) + (f64::from(rgb[k]) - f64::from(below[k])) * cover;
                    self.set_pixel(row, column, std::array::from_fn(|k| mixed(k).round() as u8));
                }
            }
        }
    }

    /// Draws a steering angle as a line from the middle of the lower edge, outlined so that it shows on any ground.
    pub fn draw_steering(&mut self, wheels_deg: f64, rgb: [u8; 3]) {
        let (height, width) = (self.height as f64, self.width as f64);
        let (sin, cos) = (STEERING_SCALE * wheels_deg).clamp(-85.0, 85.0).to_radians().sin_cos();
        let from = [width / 2.0, height * 0.98];
        let to = [from[0] + 0.45 * height * sin, from[1] - 0.45 * height * cos];
        let thickness = (height / 50.0).max(1.5);
        self.draw_line(from, to, thickness + 2.0, [255; 3]);
        self.draw_line(from, to, thickness, rgb);
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
    fn lines_cover_what_lies_on_them_and_stay_inside() {
        let mut picture = RgbImage::filled(20, 20, [0; 3]);
        picture.draw_line([-30.0, 10.0], [50.0, 10.0], 3.0, [200; 3]);
        assert!((0..20).all(|x| picture.pixel(10, x) == [200; 3] && picture.pixel(13, x) == [0; 3]));
        let mut picture = RgbImage::filled(100, 200, [0; 3]);
        picture.draw_steering(22.5, HUMAN);
        // Twice 22.5 degrees: as far to the right as up.
        assert_eq!(picture.pixel(98 - 20, 100 + 20), HUMAN);
        assert_eq!(picture.pixel(98 - 20, 100 - 20), [0; 3]);
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
