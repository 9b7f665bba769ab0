//! A stopwatch for one kind of work, summed over threads.
//!
//! It counts CPU time of the thread, which neither other programs nor a slow disk prolong; where the system does not provide it,
//! and in an engine that is compiled alone, wall time.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Runs work and sums its time. A stopwatch that is off (the default) only runs the work. Clones share the sum.
#[derive(Clone, Debug, Default)]
pub struct Stopwatch(Option<Arc<AtomicU64>>);

impl Stopwatch {
    /// One that measures, from 0.
    pub fn on() -> Stopwatch {
        Stopwatch(Some(Arc::default()))
    }

    /// Runs `work` and adds its time. `work` should not wait for other threads: a waiting rayon thread runs their tasks, which would
    /// count here.
    #[inline]
    pub fn time<T>(&self, work: impl FnOnce() -> T) -> T {
        if self.0.is_none() {
            return work();
        }
        let elapsed = thread_clock();
        let result = work();
        self.add(elapsed());
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

/// Starts a clock of this thread, and answers what reads it.
#[cfg(feature = "training")]
fn thread_clock() -> impl Fn() -> Duration {
    let (clock, cpu) = (Instant::now(), cpu_time::ThreadTime::try_now());
    move || cpu.as_ref().map_or_else(|_| clock.elapsed(), cpu_time::ThreadTime::elapsed)
}

/// Starts a clock, and answers what reads it.
#[cfg(not(feature = "training"))]
fn thread_clock() -> impl Fn() -> Duration {
    let clock = Instant::now();
    move || clock.elapsed()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clones_share_the_sum_and_one_that_is_off_stays_at_0() {
        let (on, off) = (Stopwatch::on(), Stopwatch::default());
        let mut numbers = vec![1u64; 1000];
        let mut work = || {
            let started = Instant::now();
            while started.elapsed() < Duration::from_millis(5) {
                numbers.iter_mut().for_each(|x| *x = x.wrapping_mul(6_364_136_223_846_793_005) + 1);
            }
            numbers[0]
        };
        for watch in [&on, &on.clone(), &off] {
            assert_ne!(watch.time(&mut work), 1);
        }
        let worked = on.seconds();
        // Of 10 ms on the clock other programs may have taken a part.
        assert!(worked > 0.0 && worked < 10.0, "{worked}");
        on.clone().add(Duration::from_secs(1));
        off.add(Duration::from_secs(1));
        assert!((on.seconds() - worked - 1.0).abs() < 1e-6, "{}", on.seconds());
        assert_eq!(off.seconds(), 0.0);
    }
}
