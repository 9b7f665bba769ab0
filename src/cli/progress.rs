//! How a run shows itself: a bar and live curves on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::or_dash;
use crate::report::charts::sparkline::sparkline;
use crate::training::{EpochRecord, Observer};

/// Time between plain progress lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);
/// Time between two drawings of the curves.
const CURVE_INTERVAL: Duration = Duration::from_millis(200);
/// Characters of a curve.
const CURVE: usize = 30;

/// Prints to standard error.
pub struct Progress {
    bar: Option<ProgressBar>,
    epoch: u32,
    epoch_started: Instant,
    images_before: usize,
    last_line: Instant,
    /// Losses of the batches of the epoch under way.
    batch_losses: Vec<f64>,
    /// Of the epochs that are done: training and validation loss.
    losses: [Vec<f64>; 2],
    /// Whether the run is to measure where its time goes.
    profile: bool,
}

impl Progress {
    /// For a run that is about to begin.
    pub fn new() -> Progress {
        let style = "epoch {prefix} [{bar:30}] {pos}/{len} images, {eta} left, {msg}";
        let style = ProgressStyle::with_template(style).expect("the template is valid").progress_chars("=> ");
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(0).with_style(style));
        let now = Instant::now();
        Progress {
            bar,
            epoch: 0,
            epoch_started: now,
            images_before: 0,
            last_line: now,
            batch_losses: Vec::new(),
            losses: Default::default(),
            profile: false,
        }
    }

    /// The same, for a run that measures where its time goes if `profile` says so.
    pub fn with_profile(self, profile: bool) -> Progress {
        Progress { profile, ..self }
    }

    fn print(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| eprintln!("{text}")),
            None => eprintln!("{text}"),
        }
    }

    /// The curves below the bar: the losses of the epoch's batches, and those of the epochs before.
    fn curves(&self) -> String {
        let mut text = String::new();
        let [training, validation] = &self.losses;
        for (name, values) in [("this epoch", &self.batch_losses), ("training", training), ("validation", validation)] {
            if let Some(last) = values.last() {
                text += &format!("\n  {name:<10} loss {:<CURVE$} {last:.4}", sparkline(values, CURVE));
            }
        }
        text
    }
}

impl Observer for Progress {
    fn notice(&mut self, text: &str) {
        self.print(text);
    }

    fn wants_profile(&self) -> bool {
        self.profile
    }

    fn progress(&mut self, epoch: u32, images: usize, of: usize, loss: f64) {
        if epoch != self.epoch {
            (self.epoch, self.epoch_started, self.images_before) = (epoch, Instant::now(), images);
            self.batch_losses.clear();
            if let Some(bar) = &self.bar {
                bar.set_prefix(epoch.to_string());
                bar.set_length(of as u64);
                bar.reset();
            }
        }
        // Until more than the first batch is done there is no rate.
        let rate = (images - self.images_before) as f64 / self.epoch_started.elapsed().as_secs_f64().max(1e-9);
        let rate = Some(rate).filter(|rate| *rate > 0.0);
        match &self.bar {
            Some(bar) => {
                self.batch_losses.push(loss);
                if self.last_line.elapsed() >= CURVE_INTERVAL {
                    self.last_line = Instant::now();
                    bar.set_message(format!("{} images/s{}", or_dash(rate, 0), self.curves()));
                }
                bar.set_position(images as u64);
            }
            None if self.last_line.elapsed() >= PLAIN_INTERVAL => {
                self.last_line = Instant::now();
                let estimate = rate.map_or(String::new(), |rate| {
                    let left = (of - images) as f64 / rate;
                    format!(", {rate:.0} images/s, {left:.0} s left in this epoch")
                });
                eprintln!("epoch {epoch}: {images}/{of} images{estimate}");
            }
            None => {}
        }
    }

    fn epoch(&mut self, record: &EpochRecord, of: u32) {
        self.losses[0].push(record.train_loss);
        self.losses[1].extend(record.val_mse);
        if let Some(bar) = &self.bar {
            bar.set_position(bar.length().unwrap_or(0));
        }
        self.last_line = Instant::now();
        self.print(&format!(
            "epoch {:>2}/{of}  loss {:.4}  val {}  centre {}  MAE {} deg  {} of zero's  {:.0} images/s  {:.1} s",
            record.epoch,
            record.train_loss,
            or_dash(record.val_mse, 4),
            or_dash(record.val_center_mse, 4),
            or_dash(record.val_mae_deg, 2),
            or_dash(record.relative_to_zero, 2),
            record.images as f64 / record.train_seconds,
            record.seconds,
        ));
        if record.epoch == of
            && let Some(bar) = &self.bar
        {
            bar.finish_and_clear();
        }
    }
}
