//! Progress of work that knows the share it has done: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::error::Result;
use crate::observer::{Observer, Progress, StopSignal};
use crate::text::escaped;

/// Time between plain progress lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);
/// Steps of the bar.
const STEPS: f64 = 1000.0;

/// Prints to standard error, and ends the work it watches on request.
pub struct ShareBar {
    what: String,
    bar: Option<ProgressBar>,
    last_line: Instant,
    stop: StopSignal,
}

impl ShareBar {
    /// For the work `what`, as in `driving on lake`, which `stop` ends.
    pub fn new(what: impl Into<String>, stop: &StopSignal) -> ShareBar {
        let what = escaped(&what.into()).into_owned();
        let style = ProgressStyle::with_template("{prefix} [{bar:30}] {percent} %, {eta} left");
        let style = style.expect("the template is valid").progress_chars("=> ");
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(STEPS as u64).with_style(style));
        if let Some(bar) = &bar {
            bar.set_prefix(what.clone());
        }
        ShareBar { what, bar, last_line: Instant::now(), stop: stop.clone() }
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
            Some(bar) => bar.set_position(bar.position().max((share * STEPS) as u64)),
            None => {
                if self.last_line.elapsed() >= PLAIN_INTERVAL {
                    self.last_line = Instant::now();
                    eprintln!("{}: {:.0} %", self.what, share * 100.0);
                }
            }
        }
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
