//! Progress of work that knows the share it has done: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::duration;
use crate::error::Result;
use crate::observer::{Observer, Progress, StopSignal};
use crate::text::escaped;

/// Time between plain progress lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);
/// Steps of the bar.
const STEPS: f64 = 1000.0;
/// Longest name before the bar, so that the line fits into 80 columns.
const MAX_NAME: usize = 34;
/// Below this share nothing is said of the time that is left.
const MIN_SHARE: f64 = 0.01;

/// Prints to standard error, and ends the work it watches on request.
pub struct ShareBar {
    what: String,
    bar: Option<ProgressBar>,
    started: Instant,
    last_line: Instant,
    stop: StopSignal,
}

impl ShareBar {
    /// For the work `what`, as in `driving on lake`, which `stop` ends.
    pub fn new(what: impl Into<String>, stop: &StopSignal) -> ShareBar {
        let what = escaped(&what.into()).into_owned();
        let style = ProgressStyle::with_template("{prefix} [{bar:20}] {percent} %{msg}");
        let style = style.expect("the template is valid").progress_chars("=> ");
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(STEPS as u64).with_style(style));
        if let Some(bar) = &bar {
            bar.set_prefix(end_of(&what, MAX_NAME));
        }
        let now = Instant::now();
        ShareBar { what, bar, started: now, last_line: now, stop: stop.clone() }
    }

    /// Prints a line above the bar.
    pub fn print(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{text}")),
            None => eprintln!("{text}"),
        }
    }

    /// Shows that `share`, 0 to 1, is done.
    fn set(&mut self, share: f64) {
        match &self.bar {
            Some(bar) if share >= 1.0 => bar.finish_and_clear(),
            // Threads may report out of order; the bar never runs backwards.
            Some(bar) => {
                bar.set_position(bar.position().max((share * STEPS) as u64));
                if let Some(left_s) = left_s(share, self.started.elapsed().as_secs_f64()) {
                    bar.set_message(format!(", {} left", duration(left_s)));
                }
            }
            None => {
                if self.last_line.elapsed() >= PLAIN_INTERVAL {
                    self.last_line = Instant::now();
                    eprintln!("{}: {:.0} %", self.what, share * 100.0);
                }
            }
        }
    }
}

/// Seconds that are left when `share` is done after `elapsed_s`; unknown at the very beginning.
fn left_s(share: f64, elapsed_s: f64) -> Option<f64> {
    (share >= MIN_SHARE && elapsed_s >= 0.5).then(|| elapsed_s * (1.0 - share) / share)
}

/// `text`, or its end behind an ellipsis if it has more than `max_chars` characters.
fn end_of(text: &str, max_chars: usize) -> String {
    let length = text.chars().count();
    if length <= max_chars {
        text.into()
    } else {
        "…".chars().chain(text.chars().skip(length + 1 - max_chars)).collect()
    }
}

impl Observer<Progress> for ShareBar {
    fn observe(&mut self, Progress(share): Progress) -> Result<()> {
        self.set(share);
        self.stop.check()
    }
}

impl Drop for ShareBar {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_is_not_told_before_it_is_known() {
        assert_eq!((left_s(0.0, 3.0), left_s(0.5, 0.1)), (None, None));
        assert!((left_s(0.25, 10.0).unwrap() - 30.0).abs() < 1e-9 && left_s(1.0, 9.0) == Some(0.0));
        assert_eq!((end_of("lake", 6), end_of("runs/a/lake", 6)), ("lake".into(), "…/lake".into()));
    }
}
