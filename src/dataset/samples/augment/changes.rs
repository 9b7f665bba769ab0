//! The changes themselves, on pictures `[h][w][3]`.

use steersman_kernels::{Isa, pixels};

/// Grey levels times `factor`, rounded and clamped.
pub(super) fn factors(factor: f64) -> [u8; 256] {
    std::array::from_fn(|grey| (grey as f64 * factor).round().min(255.0) as u8)
}

/// Moves the picture `columns` to the right (to the left if negative) and repeats the edge column.
pub(super) fn shift(rgb: &mut [u8], width: usize, columns: isize) {
    let by = columns.unsigned_abs().min(width - 1);
    for row in rgb.chunks_exact_mut(width * 3) {
        if columns > 0 {
            row.copy_within(..(width - by) * 3, by * 3);
            for column in 0..by {
                row.copy_within(by * 3..by * 3 + 3, column * 3);
            }
        } else {
            row.copy_within(by * 3.., 0);
            for column in width - by..width {
                row.copy_within((width - by - 1) * 3..(width - by) * 3, column * 3);
            }
        }
    }
}

/// Darkens what lies left (or right) of the line from `top` to `bottom`, both shares of the width.
pub(super) fn shadow(rgb: &mut [u8], width: usize, top: f64, bottom: f64, left: bool, table: &[u8; 256]) {
    let rows = rgb.len() / (width * 3);
    for (y, row) in rgb.chunks_exact_mut(width * 3).enumerate() {
        let along = (y as f64 + 0.5) / rows as f64;
        let edge = ((top + (bottom - top) * along) * width as f64).round() as usize * 3;
        let (before, after) = row.split_at_mut(edge);
        let dark = if left { before } else { after };
        dark.iter_mut().for_each(|grey| *grey = table[usize::from(*grey)]);
    }
}

/// A band across the picture, in shares of its width and height.
pub(super) struct Band {
    /// Where it begins, from the left edge.
    pub from: f64,
    /// How far it reaches to the right.
    pub length: f64,
    /// Its middle at the left edge, from the top.
    pub height: f64,
    /// How much lower its middle is at the right edge.
    pub tilt: f64,
    /// From its upper to its lower rim.
    pub thickness: f64,
}

impl Band {
    pub fn darken(&self, rgb: &mut [u8], width: usize, table: &[u8; 256]) {
        let rows = rgb.len() / (width * 3);
        let column_at = |share: f64| ((share * width as f64).round().max(0.0) as usize).min(width);
        for x in column_at(self.from)..column_at(self.from + self.length) {
            let middle = self.height + self.tilt * (x as f64 + 0.5) / width as f64;
            let row_at = |share: f64| ((share * rows as f64).round().max(0.0) as usize).min(rows);
            for y in row_at(middle - 0.5 * self.thickness)..row_at(middle + 0.5 * self.thickness) {
                let at = (y * width + x) * 3;
                rgb[at..at + 3].iter_mut().for_each(|grey| *grey = table[usize::from(*grey)]);
            }
        }
    }
}

/// Darkens or lightens a line from `top` at the upper rim to `bottom` at the lower, both shares of the width. It is drawn in
/// perspective: fine above, up to 4 pixels wide below for `wide` 1.
pub(super) fn line(rgb: &mut [u8], width: usize, top: f64, bottom: f64, wide: f64, table: &[u8; 256]) {
    let rows = rgb.len() / (width * 3);
    for (y, row) in rgb.chunks_exact_mut(width * 3).enumerate() {
        let along = (y as f64 + 0.5) / rows as f64;
        let from = (top + (bottom - top) * along) * width as f64;
        let to = from + 0.7 + 3.3 * wide * along;
        let [from, to] = [from, to].map(|column| column.round().clamp(0.0, width as f64) as usize * 3);
        row[from..to].iter_mut().for_each(|grey| *grey = table[usize::from(*grey)]);
    }
}

/// Turns the hue by `turn` rad, multiplies the distance from gray by `saturation` and each channel by its `tint`, then the
/// distance from the mean grey level by `contrast`.
///
/// The turn is about the axis of grays in RGB (Rodrigues' formula with the axis (1, 1, 1) / sqrt 3): it keeps the sum of the
/// three channels.
pub(super) fn recolour(rgb: &mut [u8], turn: f64, saturation: f64, tint: [f64; 3], contrast: f64) {
    let (sin, cos) = turn.sin_cos();
    let (along, aside) = ((1.0 - saturation * cos) / 3.0, saturation * sin / 3f64.sqrt());
    // The matrix is circulant: the diagonal, then the two others in turn.
    let (d, a, b) = (saturation * cos + along, along - aside, along + aside);
    let rows = [[d, a, b], [b, d, a], [a, b, d]];
    let sums = rgb.chunks_exact(3).fold([0u64; 3], |sums, px| std::array::from_fn(|k| sums[k] + u64::from(px[k])));
    let means = sums.map(|sum| sum as f64 / (rgb.len() / 3).max(1) as f64);
    let dot = |row: &[f64; 3]| row[0] * means[0] + row[1] * means[1] + row[2] * means[2];
    let grey = (0..3).map(|k| tint[k] * dot(&rows[k])).sum::<f64>() / 3.0;
    let rows: [[f32; 3]; 3] = std::array::from_fn(|k| rows[k].map(|v| (v * tint[k] * contrast) as f32));
    // Half a grey level more, as the conversion to bytes cuts off.
    let offset = (grey * (1.0 - contrast) + 0.5) as f32;
    pixels::recolour(Isa::best(), &rows, offset, rgb);
}
