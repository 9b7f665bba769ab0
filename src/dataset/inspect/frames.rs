//! What the pictures of the centre camera tell about a recording: whether they are all different, and how the car turned.

use std::collections::HashMap;
use std::hash::{DefaultHasher, Hash, Hasher};

use rayon::prelude::*;

use crate::Result;
use crate::dataset::recording::{Recording, View};
use crate::observer::{Observer, Progress, Tally};
use crate::picture::{RgbImage, decode::decode_rgb};

/// Rows that a thread looks at in one go.
const CHUNK: usize = 128;
/// Part of the picture's height that shows what is far away, around the horizon of Udacity's camera (0.355): it moves
/// sideways when the car turns, and hardly at all when it only drives on.
const FAR: [f64; 2] = [0.20, 0.42];
/// Columns that the far part is reduced to.
const COLUMNS: usize = 160;
/// Largest movement between two frames that is looked for, in those columns.
const REACH: isize = 24;
/// Columns of the moving mean that is taken off, so that only details are compared.
const DETAIL: usize = 17;
/// Smallest correlation of two frames' details at which their movement is believed.
const BELIEVED: f64 = 0.6;
/// Cells that the whole picture is reduced to, across and down.
const CELLS: [usize; 2] = [40, 20];
/// Two frames are the same picture below this mean difference of the cells, in grey levels.
const SAME_LEVELS: f64 = 0.25;

/// One frame of the centre camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frame {
    /// Height and width of the picture.
    pub size: [usize; 2],
    /// Mean grey level, 0 to 255.
    pub brightness: f32,
    /// How fast what is far away moves to the left, in widths of the picture per second, up to the next frame of the session:
    /// positive while the car turns to the right. `None` where the frames do not tell.
    pub turn: Option<f32>,
    /// Whether it is the same picture as the frame before, but for noise.
    pub frozen: bool,
    /// The row of an earlier frame whose file is the same, byte for byte.
    pub copy_of: Option<usize>,
}

/// Looks at the centre image of every row; `None` where it cannot be read. `observer` is told the share that is done.
///
/// # Errors
///
/// The observer's own.
pub fn look(recording: &Recording, observer: &mut (dyn Observer<Progress> + Send)) -> Result<Vec<Option<Frame>>> {
    let rows = recording.rows.len();
    let tally = Tally::new(rows, observer);
    let chunks: Vec<usize> = (0..rows).step_by(CHUNK).collect();
    let looked: Vec<Vec<Option<(u64, Frame)>>> = chunks
        .into_par_iter()
        .map(|first| {
            let found = look_at(recording, first, (first + CHUNK).min(rows));
            tally.add(found.len())?;
            Ok(found)
        })
        .collect::<Result<_>>()?;
    let mut seen = HashMap::new();
    let marked = looked.into_iter().flatten().enumerate().map(|(row, found)| {
        found.map(|(hash, frame)| match *seen.entry(hash).or_insert(row) {
            earlier if earlier < row => Frame { copy_of: Some(earlier), ..frame },
            _ => frame,
        })
    });
    Ok(marked.collect())
}

/// The frames of the rows from `first` to before `end`, with hashes of their files.
fn look_at(recording: &Recording, first: usize, end: usize) -> Vec<Option<(u64, Frame)>> {
    let mut eye = Eye::default();
    let mut sketch_of = |row: usize| eye.look(recording, row);
    let mut before = first.checked_sub(1).and_then(&mut sketch_of);
    let mut found: Vec<Option<(u64, Frame)>> = Vec::new();
    // One more than asked for: the turn of the last frame needs its follower.
    for row in first..(end + 1).min(recording.rows.len()) {
        let sketch = sketch_of(row);
        let joined = recording.sessions[recording.session_of(row)].start != row;
        let pair = before.as_ref().zip(sketch.as_ref()).filter(|_| joined);
        if let Some((before, sketch)) = pair
            && row > first
            && let Some(Some((_, frame))) = found.last_mut()
        {
            let seconds = (recording.rows[row].time_ms - recording.rows[row - 1].time_ms) as f64 / 1000.0;
            let moved = movement(&before.details, &sketch.details).filter(|_| seconds > 0.0);
            frame.turn = moved.map(|columns| (columns / COLUMNS as f64 / seconds) as f32);
        }
        if row < end {
            let frozen = pair.is_some_and(|(before, sketch)| before.is_same(sketch));
            found.push(sketch.as_ref().map(|sketch| {
                let brightness = sketch.cells.iter().sum::<f32>() / sketch.cells.len() as f32;
                (sketch.hash, Frame { size: sketch.size, brightness, turn: None, frozen, copy_of: None })
            }));
        }
        before = sketch;
    }
    found
}

/// What is kept of a picture to compare it with its neighbours.
struct Sketch {
    hash: u64,
    size: [usize; 2],
    details: Vec<f32>,
    cells: Vec<f32>,
}

impl Sketch {
    fn of(file: &[u8], image: &RgbImage) -> Sketch {
        let mut hasher = DefaultHasher::new();
        file.hash(&mut hasher);
        let [top, bottom] = FAR.map(|share| (share * image.height as f64) as usize);
        Sketch {
            hash: hasher.finish(),
            size: [image.height, image.width],
            details: details(&means(image, top..bottom.max(top + 1), 1, COLUMNS)),
            cells: means(image, 0..image.height, CELLS[1], CELLS[0]),
        }
    }

    fn is_same(&self, other: &Sketch) -> bool {
        let difference: f32 = self.cells.iter().zip(&other.cells).map(|(a, b)| (a - b).abs()).sum();
        f64::from(difference) < SAME_LEVELS * self.cells.len() as f64
    }
}

#[derive(Default)]
struct Eye {
    file: Vec<u8>,
    image: RgbImage,
}

impl Eye {
    fn look(&mut self, recording: &Recording, row: usize) -> Option<Sketch> {
        recording.read_picture(row, View::Centre, &mut self.file).ok()?;
        decode_rgb(&self.file, &mut self.image).ok()?;
        Some(Sketch::of(&self.file, &self.image))
    }
}

/// Mean grey levels of `down` x `across` cells of some rows of a picture. Small pictures repeat pixels.
fn means(image: &RgbImage, rows: std::ops::Range<usize>, down: usize, across: usize) -> Vec<f32> {
    let edge = |i: usize, n: usize, begin: usize, len: usize| begin + i * len / n;
    let mut means = Vec::with_capacity(down * across);
    for y in 0..down {
        let (top, bottom) = (edge(y, down, rows.start, rows.len()), edge(y + 1, down, rows.start, rows.len()));
        for x in 0..across {
            let (left, right) = (edge(x, across, 0, image.width), edge(x + 1, across, 0, image.width));
            let (mut sum, mut count) = (0u32, 0u32);
            for row in top..bottom.max(top + 1) {
                for column in left..right.max(left + 1) {
                    let [r, g, b] = image.pixel(row, column).map(u32::from);
                    sum += r + 2 * g + b;
                    count += 4;
                }
            }
            means.push(sum as f32 / count as f32);
        }
    }
    means
}

/// What is left when the moving mean is taken off.
fn details(levels: &[f32]) -> Vec<f32> {
    let half = DETAIL / 2;
    let around = |i: usize| &levels[i.saturating_sub(half)..(i + half + 1).min(levels.len())];
    (0..levels.len()).map(|i| levels[i] - around(i).iter().sum::<f32>() / around(i).len() as f32).collect()
}

/// By how many columns the details moved to the left from `before` to `after`, to a fraction of a column; `None` where no
/// movement makes them alike.
fn movement(before: &[f32], after: &[f32]) -> Option<f64> {
    let alike = |shift: isize| {
        // The detail at column i before is at i - shift after.
        let first = shift.max(0) as usize;
        let end = (before.len() as isize + shift.min(0)) as usize;
        let (mut product, mut a_square, mut b_square) = (0.0f64, 1e-9, 1e-9);
        for i in first..end {
            let (a, b) = (f64::from(before[i]), f64::from(after[(i as isize - shift) as usize]));
            product += a * b;
            a_square += a * a;
            b_square += b * b;
        }
        product / (a_square * b_square).sqrt()
    };
    let alike: Vec<f64> = (-REACH..=REACH).map(alike).collect();
    let best = (0..alike.len()).max_by(|&a, &b| alike[a].total_cmp(&alike[b]))?;
    if alike[best] < BELIEVED || best == 0 || best + 1 == alike.len() {
        return None;
    }
    Some(best as f64 - REACH as f64 + peak_offset([alike[best - 1], alike[best], alike[best + 1]]))
}

/// Where between −0.5 and 0.5 the parabola through three values with the largest in the middle has its peak.
pub(super) fn peak_offset([left, middle, right]: [f64; 3]) -> f64 {
    let bend = left - 2.0 * middle + right;
    if bend < 0.0 { (0.5 * (left - right) / bend).clamp(-0.5, 0.5) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::{jpeg_of, recording_of};
    use crate::observer::Unobserved;

    fn scene(shift: f64) -> Vec<f32> {
        let level = |i: usize| {
            let x = i as f64 + shift;
            (60.0 * (x * 0.31).sin() + 40.0 * (x * 0.083).cos() + 30.0 * (x * 0.57).sin()) as f32
        };
        details(&(0..COLUMNS).map(level).collect::<Vec<_>>())
    }

    #[test]
    fn movement_is_found_to_a_fraction_of_a_column() {
        for shift in [-11.0, -2.5, 0.0, 0.3, 7.0] {
            let found = movement(&scene(0.0), &scene(shift)).unwrap();
            assert!((found - shift).abs() < 0.15, "{shift}: {found}");
        }
        assert_eq!(movement(&scene(0.0), &vec![0.0; COLUMNS]), None);
    }

    #[test]
    fn turns_copies_and_frozen_frames_are_found() {
        let folder = tempfile::tempdir().unwrap();
        let images = folder.path().join("IMG");
        std::fs::create_dir(&images).unwrap();
        // The scene moves 8 of 320 pixels to the left from frame to frame; row 3 repeats row 2, row 5 is the file of row 0.
        let picture = |step: usize| {
            let pixels = (0..160 * 320).flat_map(|at| {
                let x = (at % 320 + 8 * step) as f64;
                [(128.0 + 60.0 * (x * 0.15).sin() + 40.0 * (x * 0.041).cos()) as u8; 3]
            });
            jpeg_of(320, 160, &pixels.collect::<Vec<_>>())
        };
        let mut log = String::new();
        for (row, step) in [0, 1, 2, 2, 3, 0].into_iter().enumerate() {
            let name = format!("center_2026_01_01_00_00_00_{row}00.jpg");
            let mut bytes = picture(step);
            if row == 3 {
                bytes.extend([0; 4]); // another file of the same picture
            }
            std::fs::write(images.join(&name), bytes).unwrap();
            log += &format!("IMG/{name},,,0.1,1,0,9\n");
        }
        std::fs::write(folder.path().join("driving_log.csv"), log).unwrap();
        let recording = crate::dataset::load(folder.path()).unwrap();
        assert_eq!(recording.rows.len(), 6);
        let frames: Vec<Frame> = look(&recording, &mut Unobserved).unwrap().into_iter().map(Option::unwrap).collect();
        let turn = f64::from(frames[0].turn.unwrap());
        assert!((turn - 8.0 / 320.0 / 0.1).abs() < 0.02, "{turn}");
        assert!(frames[2].turn.unwrap().abs() < 0.01);
        assert_eq!(frames.iter().map(|f| f.frozen).collect::<Vec<_>>(), [false, false, false, true, false, false]);
        assert_eq!(frames.iter().map(|f| f.copy_of).collect::<Vec<_>>(), [None, None, None, None, None, Some(0)]);
        assert_eq!(frames[5].turn, None);
    }

    #[test]
    fn images_that_are_not_there_are_left_out() {
        assert_eq!(look(&recording_of(&[0.0, 0.1], 100), &mut Unobserved).unwrap(), [None, None]);
    }
}
