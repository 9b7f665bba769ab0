//! Pictures in memory: 8-bit RGB, read from and written as JPEG and PNG, cut, mirrored, enlarged and drawn on.
//!
//! Every room that handles a picture uses [`RgbImage`]; this room knows no other room.

pub mod decode;
mod draw;
mod encode;

use ndarray::ArrayView3;

/// An 8-bit RGB picture, `[height][width][3]`. The buffer is reused from picture to picture.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RgbImage {
    /// Height in pixels.
    pub height: usize,
    /// Width in pixels.
    pub width: usize,
    /// Pixels, row by row, red first.
    pub pixels: Vec<u8>,
}

impl RgbImage {
    /// The pixels as an array, `(height, width, 3)`.
    ///
    /// # Panics
    ///
    /// Panics if there are not `height · width · 3` bytes of them.
    pub fn view(&self) -> ArrayView3<'_, u8> {
        ArrayView3::from_shape((self.height, self.width, 3), &self.pixels).expect("height · width · 3 bytes")
    }

    /// A picture of one colour.
    pub(crate) fn filled(height: usize, width: usize, rgb: [u8; 3]) -> RgbImage {
        RgbImage { height, width, pixels: rgb.repeat(height * width) }
    }

    /// A picture whose pixels are `rgb(row, column)`.
    pub(crate) fn from_fn(height: usize, width: usize, rgb: impl Fn(usize, usize) -> [u8; 3]) -> RgbImage {
        let pixels = (0..height * width).flat_map(|at| rgb(at / width, at % width)).collect();
        RgbImage { height, width, pixels }
    }

    /// A grey picture of 8-bit levels, row by row.
    pub(crate) fn grey(height: usize, width: usize, levels: &[u8]) -> RgbImage {
        RgbImage::from_fn(height, width, |row, column| [levels[row * width + column]; 3])
    }

    /// The pixel at `row` and `column`.
    pub(crate) fn pixel(&self, row: usize, column: usize) -> [u8; 3] {
        let at = (row * self.width + column) * 3;
        [self.pixels[at], self.pixels[at + 1], self.pixels[at + 2]]
    }

    /// Sets the pixel at `row` and `column`.
    pub(crate) fn set_pixel(&mut self, row: usize, column: usize, rgb: [u8; 3]) {
        let at = (row * self.width + column) * 3;
        self.pixels[at..at + 3].copy_from_slice(&rgb);
    }

    /// The mirror image: left and right exchanged.
    pub(crate) fn mirrored(&self) -> RgbImage {
        RgbImage::from_fn(self.height, self.width, |row, column| self.pixel(row, self.width - 1 - column))
    }

    /// The picture with each pixel as a square of `factor` by `factor` pixels.
    pub(crate) fn enlarged(&self, factor: usize) -> RgbImage {
        RgbImage::from_fn(self.height * factor, self.width * factor, |r, c| self.pixel(r / factor, c / factor))
    }

    /// Copies `other` to (`top`, `left`) and cuts off what does not fit.
    pub(crate) fn paste(&mut self, other: &RgbImage, top: usize, left: usize) {
        for row in 0..other.height.min(self.height.saturating_sub(top)) {
            for column in 0..other.width.min(self.width.saturating_sub(left)) {
                self.set_pixel(top + row, left + column, other.pixel(row, column));
            }
        }
    }
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
}
