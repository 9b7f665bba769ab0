//! How long threads work on a part of the work, summed over all of them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Adds up the time of what it is given to run. One that is off, the default, only runs it. Clones share the sum.
#[derive(Clone, Debug, Default)]
pub struct Stopwatch(Option<Arc<AtomicU64>>);

impl Stopwatch {
    /// One that measures, from 0.
    pub fn on() -> Stopwatch {
        Stopwatch(Some(Arc::default()))
    }

    /// Runs `work`. It should not wait for other threads: while it waits, rayon lets it do their work.
    #[inline]
    pub fn time<T>(&self, work: impl FnOnce() -> T) -> T {
        if self.0.is_none() {
            return work();
        }
        let started = Instant::now();
        let result = work();
        self.add(started.elapsed());
        result
    }

    /// Adds time that was measured otherwise.
    pub fn add(&self, time: Duration) {
        if let Some(nanoseconds) = &self.0 {
            nanoseconds.fetch_add(time.as_nanos() as u64, Ordering::Relaxed);
        }
    }

    /// The sum so far, in seconds.
    pub fn seconds(&self) -> f64 {
        self.0.as_ref().map_or(0.0, |nanoseconds| nanoseconds.load(Ordering::Relaxed) as f64 * 1e-9)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_share_the_sum_and_one_that_is_off_stays_at_0() {
        let (on, off) = (Stopwatch::on(), Stopwatch::default());
        let pause = Duration::from_millis(3);
        for watch in [&on, &on.clone(), &off] {
            assert_eq!(
                watch.time(|| {
                    std::thread::sleep(pause);
                    7
                }),
                7
            );
        }
        on.add(Duration::from_secs(1));
        off.add(Duration::from_secs(1));
        assert!(on.seconds() >= 1.006, "{}", on.seconds());
        assert_eq!(off.seconds(), 0.0);
    }
}
