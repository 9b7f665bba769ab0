//! Drawing on pictures.

use super::RgbImage;

impl RgbImage {
    /// Draws a line of `thickness` pixels between two points (x, y); what lies outside is cut off.
    pub(crate) fn draw_line(&mut self, from: [f64; 2], to: [f64; 2], thickness: f64, rgb: [u8; 3]) {
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
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_cover_what_lies_on_them_and_stay_inside() {
        let mut picture = RgbImage::filled(20, 20, [0; 3]);
        picture.draw_line([-30.0, 10.0], [50.0, 10.0], 3.0, [200; 3]);
        assert!((0..20).all(|x| picture.pixel(10, x) == [200; 3] && picture.pixel(13, x) == [0; 3]));
    }
}
