//! Progress of work that knows the share it has done: a bar on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::main_job::job::Stages;
use crate::text::escaped;

/// Time between plain progress lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);
/// Steps of the bar.
const STEPS: f64 = 1000.0;

/// Prints to standard error; may be told from any thread.
pub struct ShareBar {
    what: String,
    bar: Option<ProgressBar>,
    last_line: Mutex<Instant>,
}

impl ShareBar {
    /// For the work `what`, as in `driving on lake`.
    pub fn new(what: impl Into<String>) -> ShareBar {
        let what = escaped(&what.into()).into_owned();
        let style = ProgressStyle::with_template("{prefix} [{bar:30}] {percent} %, {eta} left");
        let style = style.expect("the template is valid").progress_chars("=> ");
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(STEPS as u64).with_style(style));
        if let Some(bar) = &bar {
            bar.set_prefix(what.clone());
        }
        ShareBar { what, bar, last_line: Mutex::new(Instant::now()) }
    }

    /// Prints a line above the bar.
    pub fn print(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{text}")),
            None => eprintln!("{text}"),
        }
    }

    /// Shows that `share`, 0 to 1, is done.
    pub fn set(&self, share: f64) {
        match &self.bar {
            Some(bar) if share >= 1.0 => bar.finish_and_clear(),
            // Threads may report out of order; the bar never runs backwards.
            Some(bar) => bar.set_position(bar.position().max((share * STEPS) as u64)),
            None => {
                // A thread that panicked while printing is no reason to lose the line.
                let mut last = self.last_line.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
                if last.elapsed() >= PLAIN_INTERVAL {
                    *last = Instant::now();
                    eprintln!("{}: {:.0} %", self.what, share * 100.0);
                }
            }
        }
    }
}

impl Drop for ShareBar {
    fn drop(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Shows each stage of a job as a bar of its own.
pub struct Bars;

impl Stages for Bars {
    fn begin(&self, what: &str) -> Box<dyn Fn(f64) + Sync> {
        let bar = ShareBar::new(what);
        Box::new(move |share| bar.set(share))
    }

    fn notice(&self, text: &str) {
        eprintln!("{text}");
    }
}
