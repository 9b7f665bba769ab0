//! How much of the validation frames the training frames give away.
//!
//! Two measures. *Within a second*: the share of validation rows with a training row of the same session at most 1 s
//! away; it needs the times alone. *Near twins*: the share of validation frames of the centre camera that look the same
//! as a training frame. For that each frame is reduced to 16x8 grey levels (means over every second row and column of
//! each cell, of the rows the network sees), and two frames are near twins if these differ by less than 4 levels of 256
//! on average. That is about what a car at 30 mph sees change in a tenth of a second: with a split by single rows a
//! fifth to a third of the validation frames of real drives have a near twin.

use super::Item;
use super::split::Split;
use crate::dataset::recording::Recording;
use crate::picture::RgbImage;
use crate::text::percent;
use rayon::prelude::*;
use serde::Serialize;

/// Cells of a thumbnail, across and down.
const CELLS: [usize; 2] = [16, 8];
/// Bytes of a thumbnail.
const THUMBNAIL: usize = CELLS[0] * CELLS[1];
/// Two thumbnails are near twins below this mean difference in grey levels.
const TWIN_LEVELS: usize = 4;
/// Training frames compared with one validation frame at most, the nearest in mean brightness first.
const MAX_COMPARED: usize = 4096;
/// Rows of a side whose frames are kept for the comparison at most, 128 bytes each: of a longer side every second one, every third and so on.
const MAX_KEPT: usize = 1 << 17;
/// A training row this near in time gives a validation row away, in milliseconds.
const NEAR_MS: i64 = 1000;

/// What the training side gives away of the validation side.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LeakAudit {
    /// Validation rows.
    pub validation_rows: usize,
    /// Those with a training row of the same session within 1 s.
    pub within_one_second: usize,
}

impl LeakAudit {
    /// Looks at the times of both sides of `split`.
    pub fn of(split: &Split, recordings: &[Recording]) -> Self {
        let within = |item: &&Item| {
            let recording = &recordings[usize::from(item.recording)];
            let row = item.row as usize;
            let session = &recording.sessions[recording.sessions.partition_point(|session| session.end <= row)];
            // Times do not go back within a session, so the nearest training rows are the neighbours in order.
            let after =
                split.training.partition_point(|other| (other.recording, other.row) < (item.recording, item.row));
            let neighbours = [after.checked_sub(1), Some(after)].into_iter().flatten();
            neighbours.filter_map(|i| split.training.get(i)).any(|other| {
                other.recording == item.recording
                    && session.contains(&(other.row as usize))
                    && recording.rows[other.row as usize].time_ms.abs_diff(recording.rows[row].time_ms)
                        <= NEAR_MS as u64
            })
        };
        Self {
            validation_rows: split.validation.len(),
            within_one_second: split.validation.iter().filter(within).count(),
        }
    }

    /// Share of the validation rows with a training row of the same session within 1 s.
    pub fn share(&self) -> f64 {
        self.within_one_second as f64 / self.validation_rows.max(1) as f64
    }

    /// The audit in words.
    pub fn summary(&self) -> String {
        let percent = percent(100.0 * self.share());
        format!("leak audit: {percent} % of the validation rows have a training row within 1 s in the same session")
    }
}

/// A frame, reduced to what survives JPEG noise.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Thumbnail(Box<[u8; THUMBNAIL]>);

impl Thumbnail {
    /// Reduces the rows from `rows[0]` to before `rows[1]` of an image, of a picture `source_height` rows high.
    pub fn of(image: &RgbImage, rows: [usize; 2], source_height: usize) -> Self {
        let [top, bottom] = rows.map(|row| row * image.height / source_height.max(1));
        let mut cells = Box::new([0; THUMBNAIL]);
        let edge = |i: usize, n: usize, begin: usize, end: usize| begin + i * (end - begin) / n;
        for (i, cell) in cells.iter_mut().enumerate() {
            let (x, y) = (i % CELLS[0], i / CELLS[0]);
            let (left, right) = (edge(x, CELLS[0], 0, image.width), edge(x + 1, CELLS[0], 0, image.width));
            let (first, end) = (edge(y, CELLS[1], top, bottom), edge(y + 1, CELLS[1], top, bottom));
            let (mut sum, mut count) = (0, 0);
            for row in (first..end.max(first + 1).min(image.height)).step_by(2) {
                for column in (left..right.max(left + 1).min(image.width)).step_by(2) {
                    let at = (row * image.width + column) * 3;
                    let [r, g, b] = [0, 1, 2].map(|c| u32::from(image.pixels[at + c]));
                    sum += r + 2 * g + b;
                    count += 4;
                }
            }
            *cell = (sum / count.max(1)) as u8;
        }
        Self(cells)
    }

    /// Number of cells.
    pub(super) const LEN: usize = THUMBNAIL;

    /// Its cells.
    pub(super) fn cells(&self) -> &[u8] {
        &*self.0
    }

    /// One with these cells, [`LEN`](Thumbnail::LEN) many.
    pub(super) fn of_cells(cells: &[u8]) -> Option<Self> {
        cells.try_into().ok().map(|cells| Self(Box::new(cells)))
    }

    fn total(&self) -> u32 {
        self.0.iter().map(|&cell| u32::from(cell)).sum()
    }

    fn is_twin_of(&self, other: &Self) -> bool {
        let sum: u32 = self.0.iter().zip(&*other.0).map(|(&a, &b)| u32::from(a.abs_diff(b))).sum();
        (sum as usize) < TWIN_LEVELS * THUMBNAIL
    }
}

/// One row in how many is compared, of a side of `rows` rows.
pub(super) fn compared_every(rows: usize) -> usize {
    rows.div_ceil(MAX_KEPT).max(1)
}

/// How many validation frames look the same as a training frame.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct NearTwins {
    /// Validation frames of the centre camera.
    pub frames: usize,
    /// Those with a near twin on the training side.
    pub twins: usize,
    /// One row in how many was compared, of the validation and of the training side; 1 unless there are very many.
    pub one_row_in: [usize; 2],
}

impl NearTwins {
    /// Compares each validation frame with the training frames.
    ///
    /// Twins cannot differ more in mean brightness than they may differ at all, so only training frames within 4 levels
    /// of mean brightness are compared, and of those at most the 4096 nearest. They are one row in `one_row_in` of
    /// the validation and of the training side.
    pub fn count(validation: &[&Thumbnail], training: &[&Thumbnail], one_row_in: [usize; 2]) -> Self {
        let mut sorted: Vec<(u32, &Thumbnail)> = training.iter().map(|frame| (frame.total(), *frame)).collect();
        sorted.sort_by_key(|(total, _)| *total);
        let reach = (TWIN_LEVELS * THUMBNAIL) as u32;
        let has_twin = |frame: &&&Thumbnail| {
            let total = frame.total();
            let middle = sorted.partition_point(|(other, _)| *other < total);
            let begin = sorted
                .partition_point(|(other, _)| *other + reach < total)
                .max(middle.saturating_sub(MAX_COMPARED / 2));
            let end = sorted.partition_point(|(other, _)| *other <= total + reach).min(middle + MAX_COMPARED / 2);
            sorted[begin..end].iter().any(|(_, other)| frame.is_twin_of(other))
        };
        Self { frames: validation.len(), twins: validation.par_iter().filter(has_twin).count(), one_row_in }
    }

    /// Share of the validation frames that have a near twin.
    pub fn share(&self) -> f64 {
        self.twins as f64 / self.frames.max(1) as f64
    }

    /// The count in words.
    pub fn summary(&self) -> String {
        let percent = percent(100.0 * self.share());
        let compared = match self.one_row_in {
            [1, 1] => String::new(),
            [validation, training] => format!(
                "; looked at was one validation row in {validation} beside one training row in {training}, so there may be more"
            ),
        };
        format!(
            "leak audit: {percent} % of the validation frames (centre camera) are nearly identical to a training frame \
             (mean difference below {TWIN_LEVELS} grey levels at {}x{} cells){compared}",
            CELLS[0], CELLS[1]
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(seed: usize) -> RgbImage {
        let pixels = (0..64 * 128).flat_map(|i| [((i / 128 + i % 128) * (seed + 1) / 2) as u8; 3]).collect();
        RgbImage { height: 64, width: 128, pixels }
    }

    #[test]
    fn thumbnails_are_means_of_the_rows_asked_for() {
        let mut image = RgbImage { height: 64, width: 128, pixels: vec![10; 64 * 128 * 3] };
        image.pixels[32 * 128 * 3..].fill(200);
        assert!(Thumbnail::of(&image, [80, 160], 160).0.iter().all(|&cell| cell == 200));
        assert!(Thumbnail::of(&image, [0, 80], 160).0.iter().all(|&cell| cell == 10));
        let tiny = RgbImage { height: 8, width: 8, pixels: vec![33; 8 * 8 * 3] };
        assert!(Thumbnail::of(&tiny, [40, 138], 160).0.iter().all(|&cell| cell == 33));
    }

    #[test]
    fn twins_are_found_and_others_are_not() {
        let frames: Vec<Thumbnail> = (0..20).map(|i| Thumbnail::of(&picture(i), [0, 64], 64)).collect();
        let mut noisy = picture(3);
        for (i, value) in noisy.pixels.iter_mut().enumerate() {
            *value = value.saturating_add((i % 3) as u8);
        }
        let noisy = Thumbnail::of(&noisy, [0, 64], 64);
        let training: Vec<&Thumbnail> = frames[..10].iter().collect();
        let validation = [&noisy, &frames[15], &frames[7]];
        assert_eq!(
            NearTwins::count(&validation, &training, [1; 2]),
            NearTwins { frames: 3, twins: 2, one_row_in: [1; 2] }
        );
        let few = NearTwins { frames: 5000, twins: 1, one_row_in: [1; 2] };
        assert!(few.summary().contains(": <0.1 % of the validation frames") && few.summary().ends_with("cells)"));
        assert!(
            NearTwins { one_row_in: [1, 9], ..few }
                .summary()
                .ends_with("one validation row in 1 beside one training row in 9, so there may be more")
        );
        assert_eq!(NearTwins::count(&validation, &[], [1; 2]).twins, 0);
        assert_eq!(NearTwins::count(&[], &training, [1; 2]).share(), 0.0);
    }

    #[test]
    fn however_long_a_side_is_no_more_than_so_many_frames_are_kept() {
        for rows in [0, 1, 1000, MAX_KEPT, MAX_KEPT + 1, 9_000_000] {
            let every = compared_every(rows);
            assert!(rows.div_ceil(every) <= MAX_KEPT && (rows <= MAX_KEPT) == (every == 1), "{rows}: one in {every}");
        }
    }
}
