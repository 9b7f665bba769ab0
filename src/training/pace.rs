//! How fast a run trains, and how long it will take.

use std::time::Instant;

use super::EpochRecord;

/// Follows the batches and epochs of a run.
#[derive(Clone, Debug)]
pub struct Pace {
    epoch: u32,
    epoch_started: Instant,
    images_before: usize,
    /// Images a second of the epoch before.
    last_rate: Option<f64>,
    /// Seconds of the last validation.
    validation_s: f64,
}

/// The pace at a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PaceNow {
    /// Whether the batch is the first of its epoch in this process.
    pub begins_epoch: bool,
    /// Training images a second, if that is known.
    pub images_per_s: Option<f64>,
    /// Time left for the whole run, s, unless it stops early.
    pub left_s: Option<f64>,
}

impl Default for Pace {
    fn default() -> Self {
        Pace { epoch: 0, epoch_started: Instant::now(), images_before: 0, last_rate: None, validation_s: 0.0 }
    }
}

impl Pace {
    /// The pace `now`, when a batch of `epoch` of `epochs` is done, and with it `images` of the epoch's `of` images.
    pub fn batch(&mut self, [epoch, epochs]: [u32; 2], [images, of]: [usize; 2], now: Instant) -> PaceNow {
        let begins_epoch = epoch != self.epoch;
        if begins_epoch {
            (self.epoch, self.epoch_started, self.images_before) = (epoch, now, images);
        }
        // Until more than the first batch is done there is no rate but that of the epoch before.
        let seconds = now.saturating_duration_since(self.epoch_started).as_secs_f64().max(1e-9);
        let rate = images.saturating_sub(self.images_before) as f64 / seconds;
        let images_per_s = Some(rate).filter(|rate| *rate > 0.0).or(self.last_rate);
        let epochs_left = epochs.saturating_sub(epoch) as usize;
        let validations_s = (epochs_left + 1) as f64 * self.validation_s;
        let images_left = (of.saturating_sub(images) + epochs_left * of) as f64;
        PaceNow { begins_epoch, images_per_s, left_s: images_per_s.map(|rate| images_left / rate + validations_s) }
    }

    /// An epoch is done.
    pub fn epoch(&mut self, record: &EpochRecord) {
        self.last_rate = Some(record.images as f64 / record.train_seconds.max(1e-9));
        self.validation_s = (record.seconds - record.train_seconds).max(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn the_rest_of_the_run_counts_its_validations() {
        let mut pace = Pace::default();
        let start = Instant::now();
        let at = |s: u64| start + Duration::from_secs(s);
        let first = pace.batch([1, 3], [10, 100], at(0));
        assert_eq!(first, PaceNow { begins_epoch: true, images_per_s: None, left_s: None });
        let now = pace.batch([1, 3], [50, 100], at(4));
        assert_eq!(now, PaceNow { begins_epoch: false, images_per_s: Some(10.0), left_s: Some(25.0) });
        pace.epoch(&EpochRecord { images: 100, train_seconds: 5.0, seconds: 7.0, ..EpochRecord::default() });
        // 290 images at 20 a second, and two validations of 2 s.
        let now = pace.batch([2, 3], [10, 100], at(9));
        assert_eq!(now, PaceNow { begins_epoch: true, images_per_s: Some(20.0), left_s: Some(9.5 + 4.0) });
    }
}
