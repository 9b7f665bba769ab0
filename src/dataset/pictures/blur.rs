//! Smoothing of 8-bit pictures with the semantics of OpenCV's `GaussianBlur(image, (3, 3), 0)`.
//!
//! Each value becomes the mean of 3x3 with the weights 1, 2, 1 in each direction, rounded half up. Beyond the border the picture is
//! mirrored, without its outermost row or column (`BORDER_REFLECT_101`).

/// Colours of a pixel.
const CHANNELS: usize = 3;

/// A planned blur of `[h][w][3]` bytes.
#[derive(Debug, Clone)]
pub(crate) struct Blur {
    size: [usize; 2],
    /// A row of weighted sums over three source rows.
    sums: Vec<u16>,
}

/// The positions before and after `i` of `n`, mirrored at the border.
pub(crate) fn neighbours(i: usize, n: usize) -> [usize; 2] {
    let last = n - 1;
    [if i == 0 { 1.min(last) } else { i - 1 }, if i == last { last.saturating_sub(1) } else { i + 1 }]
}

impl Blur {
    /// Plans the blur of an image of `size` = [height, width].
    ///
    /// # Panics
    /// If a size is 0.
    pub fn new(size: [usize; 2]) -> Self {
        assert!(size.iter().all(|&n| n > 0), "blur of {size:?}");
        Self { size, sums: vec![0; size[1] * CHANNELS] }
    }

    /// Blurs `src` (`[h][w][3]`) into `dst`.
    ///
    /// # Panics
    /// If the lengths are not those planned for.
    pub fn apply(&mut self, src: &[u8], dst: &mut [u8]) {
        let [h, w] = self.size;
        let row_len = w * CHANNELS;
        assert_eq!([src.len(), dst.len()], [h * row_len; 2], "source and result of a blur of {:?}", self.size);
        for (y, out) in dst.chunks_exact_mut(row_len).enumerate() {
            let row = |y: usize| &src[y * row_len..][..row_len];
            let [above, below] = neighbours(y, h).map(row);
            for (((sum, above), middle), below) in self.sums.iter_mut().zip(above).zip(row(y)).zip(below) {
                *sum = u16::from(*above) + 2 * u16::from(*middle) + u16::from(*below);
            }
            let pixels = self.sums.as_chunks::<CHANNELS>().0;
            for (x, out) in out.as_chunks_mut::<CHANNELS>().0.iter_mut().enumerate() {
                let [left, right] = neighbours(x, w).map(|x| &pixels[x]);
                *out = std::array::from_fn(|c| ((left[c] + 2 * pixels[x][c] + right[c] + 8) >> 4) as u8);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blurred(src: &[u8], size: [usize; 2]) -> Vec<u8> {
        let rgb: Vec<u8> = src.iter().flat_map(|&grey| [grey, 255 - grey, 7]).collect();
        let mut out = vec![0; rgb.len()];
        Blur::new(size).apply(&rgb, &mut out);
        assert!(out.chunks(3).all(|pixel| pixel[2] == 7));
        out.chunks(3).map(|pixel| pixel[0]).collect()
    }

    #[test]
    fn a_bright_pixel_is_spread_by_the_binomial_weights() {
        let mut spot = [0; 25];
        spot[12] = 160;
        let expected = [0, 0, 0, 0, 0, 0, 10, 20, 10, 0, 0, 20, 40, 20, 0, 0, 10, 20, 10, 0, 0, 0, 0, 0, 0];
        assert_eq!(blurred(&spot, [5, 5]), expected);
    }

    #[test]
    fn the_border_is_mirrored_without_its_outermost_pixel() {
        // (2 * 0 + 2 * 40) / 4, (0 + 2 * 40 + 81) / 4 = 40.25, (2 * 81 + 2 * 40) / 4 = 60.5.
        assert_eq!(blurred(&[0, 40, 81], [1, 3]), [20, 40, 61]);
        assert_eq!(blurred(&[0, 40, 81], [3, 1]), [20, 40, 61]);
        assert_eq!(blurred(&[93], [1, 1]), [93]);
    }
}
