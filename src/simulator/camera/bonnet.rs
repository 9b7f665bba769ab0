//! The car's bonnet, as each of the three cameras sees it.

use std::ops::Range;

use crate::simulator::camera::pinhole::{HEIGHT, Mount, RgbFrame, WIDTH};
use crate::simulator::camera::view::SPAN;
use crate::simulator::scenery::light::Variant;

/// Row at which the bonnet begins in a column; `HEIGHT` where there is none.
fn top(mount: Mount, column: usize) -> f32 {
    let x = column as f32 + 0.5;
    let none = HEIGHT as f32;
    let quarter = |u: f32| if u.abs() < 1.0 { none - 24.0 * (1.0 - u * u * u * u).sqrt() } else { none };
    match mount {
        Mount::Center => {
            let u = (x - 166.0) / 106.0;
            (142.0 + 17.0 * u * u * (0.75 + 0.25 * u * u)).min(none)
        }
        Mount::Left => quarter((WIDTH as f32 - x) / 135.0),
        Mount::Right => quarter(x / 122.0),
    }
}

fn colour(mount: Mount, column: usize, depth: f32) -> [f32; 3] {
    let x = column as f32;
    if depth < 1.2 {
        return [58.0, 52.0, 44.0];
    }
    if mount == Mount::Center {
        // The rim, a dark seam, and the scoop behind it.
        if depth < 8.5 {
            let k = 1.0 - 0.045 * (depth - 4.0).abs();
            [152.0 * k, 138.0 * k, 116.0 * k]
        } else if depth < 10.0 {
            [44.0, 42.0, 40.0]
        } else {
            [168.0, 174.0, 176.0]
        }
    } else {
        let lamp = if mount == Mount::Left { 204.0 } else { 102.0 };
        if (x - lamp).abs() < 9.0 && (2.5..10.5).contains(&depth) {
            return [236.0, 234.0, 228.0];
        }
        let k = 1.05 - 0.018 * depth;
        [142.0 * k, 128.0 * k, 108.0 * k]
    }
}

/// The bonnet as one camera sees it.
struct Picture {
    /// Pixels that it covers, with their colours.
    pixels: Vec<(usize, [u8; 3])>,
    /// For each row the spans of [`SPAN`] pixels that lie wholly behind it; they are neighbours.
    hidden: Vec<Range<usize>>,
}

impl Picture {
    fn paint(mount: Mount) -> Picture {
        let depth = |row: usize, column: usize| row as f32 + 0.5 - top(mount, column);
        let mut pixels = Vec::new();
        let mut hidden = Vec::new();
        for row in 0..HEIGHT {
            for column in (0..WIDTH).filter(|column| depth(row, *column) > 0.0) {
                let rgb = colour(mount, column, depth(row, column)).map(|c| c as u8);
                pixels.push((row * WIDTH + column, rgb));
            }
            let is_hidden = |k: &usize| (k * SPAN..(k + 1) * SPAN).all(|column| depth(row, column) > 0.0);
            let first = (0..WIDTH / SPAN).find(is_hidden).unwrap_or(0);
            hidden.push(first..first + (first..WIDTH / SPAN).take_while(is_hidden).count());
        }
        Picture { pixels, hidden }
    }
}

/// The bonnet as each camera sees it, painted once.
pub(crate) struct Bonnet([Picture; 3]);

impl Default for Bonnet {
    fn default() -> Self {
        Bonnet(Mount::ALL.map(Picture::paint))
    }
}

impl Bonnet {
    fn picture(&self, mount: Mount) -> &Picture {
        match mount {
            Mount::Center => &self.0[0],
            Mount::Left => &self.0[1],
            Mount::Right => &self.0[2],
        }
    }

    /// Spans of a row of which nothing is seen.
    pub(crate) fn hidden_spans(&self, mount: Mount, row: usize) -> Range<usize> {
        self.picture(mount).hidden[row].clone()
    }

    /// Draws the bonnet over the bottom of the picture.
    pub(crate) fn draw(&self, mount: Mount, variant: &Variant, frame: &mut RgbFrame) {
        let (pixels, _) = frame.pixels.as_chunks_mut::<3>();
        for (at, rgb) in &self.picture(mount).pixels {
            for ((out, tone), value) in pixels[*at].iter_mut().zip(&variant.tone).zip(rgb) {
                *out = tone[usize::from(*value)];
            }
        }
    }
}
