//! How a run shows itself: a bar and live curves on a terminal, plain lines elsewhere.

use std::io::IsTerminal;
use std::path::Path;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use super::{ShareBar, duration, or_dash};
use crate::error::Result;
use crate::live::training::TrainingPage;
use crate::main_job::job::JobEvent;
use crate::observer::{Observer, Progress, StopSignal};
use crate::report::charts::sparkline::sparkline;
use crate::training::{EpochRecord, Pace, TrainingEvent};

/// Time between plain progress lines.
const PLAIN_INTERVAL: Duration = Duration::from_secs(10);
/// Time between two drawings of the curves.
const CURVE_INTERVAL: Duration = Duration::from_millis(200);
/// Characters of a curve.
const CURVE: usize = 30;

/// Shows a training run on standard error.
pub struct TrainingDisplay {
    bar: Option<ProgressBar>,
    pace: Pace,
    last_line: Instant,
    /// Losses of the batches of the epoch under way.
    batch_losses: Vec<f64>,
    /// Of the epochs that are done: training and validation loss.
    losses: [Vec<f64>; 2],
}

impl TrainingDisplay {
    /// For a run that is about to begin.
    pub fn new() -> TrainingDisplay {
        let style = "epoch {prefix} [{bar:16}] {msg}";
        let style = ProgressStyle::with_template(style).expect("the template is valid").progress_chars("=> ");
        let bar = std::io::stderr().is_terminal().then(|| ProgressBar::new(0).with_style(style));
        TrainingDisplay {
            bar,
            pace: Pace::default(),
            last_line: Instant::now(),
            batch_losses: Vec::new(),
            losses: Default::default(),
        }
    }

    /// Takes the bar off the terminal, so that what is printed next stays.
    pub fn finish(&mut self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
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

impl Observer<TrainingEvent> for TrainingDisplay {
    fn observe(&mut self, event: TrainingEvent) -> Result<()> {
        match event {
            // A job trains several times.
            TrainingEvent::Begin { .. } => {
                self.pace = Pace::default();
                self.batch_losses.clear();
                self.losses = Default::default();
            }
            TrainingEvent::Notice(text) => self.print(&text),
            TrainingEvent::Batch { epoch, epochs, images, of, loss } => self.batch([epoch, epochs], images, of, loss),
            TrainingEvent::Epoch { record, of } => self.epoch(&record, of),
        }
        Ok(())
    }
}

impl TrainingDisplay {
    /// A batch of `epoch` of `epochs` is done; `images` of the epoch's `of` images were seen.
    fn batch(&mut self, [epoch, epochs]: [u32; 2], images: usize, of: usize, loss: f64) {
        let now = self.pace.batch([epoch, epochs], [images, of], Instant::now());
        if now.begins_epoch {
            self.batch_losses.clear();
            if let Some(bar) = &self.bar {
                bar.set_prefix(format!("{epoch}/{epochs}"));
                bar.set_length(of as u64);
                bar.reset();
            }
        }
        let left = now.left_s.map_or(String::new(), |left_s| format!(", {} left", duration(left_s)));
        let rate = now.images_per_s.map_or(String::new(), |rate| format!(", {rate:.0} images/s"));
        match &self.bar {
            Some(bar) => {
                self.batch_losses.push(loss);
                // The first line says at once what is known.
                if self.last_line.elapsed() >= CURVE_INTERVAL || self.batch_losses.len() == 2 {
                    self.last_line = Instant::now();
                    bar.set_message(format!("{images}/{of} images{rate}{left}{}", self.curves()));
                }
                bar.set_position(images as u64);
            }
            None if self.last_line.elapsed() >= PLAIN_INTERVAL => {
                self.last_line = Instant::now();
                eprintln!("epoch {epoch}/{epochs}: {images}/{of} images{rate}{left}");
            }
            None => {}
        }
    }

    fn epoch(&mut self, record: &EpochRecord, of: u32) {
        self.pace.epoch(record);
        self.losses[0].push(record.train_loss);
        self.losses[1].extend(record.val_mse);
        if let Some(bar) = &self.bar {
            bar.set_position(bar.length().unwrap_or(0));
        }
        self.last_line = Instant::now();
        self.print(&format!(
            "epoch {:>2}/{of}  loss {:.4}  val {}  centre {}  MAE {} deg  {} of zero's{}  {:.0} images/s  {:.1} s",
            record.epoch,
            record.train_loss,
            or_dash(record.val_mse, 4),
            or_dash(record.val_center_mse, 4),
            or_dash(record.val_mae_deg, 2),
            or_dash(record.relative_to_zero, 2),
            beside_steering(record.val_throttle_mae, record.val_speed_mae_mph),
            record.images as f64 / record.train_seconds,
            record.seconds,
        ));
        if record.epoch == of {
            self.finish();
        }
    }
}

/// The mean absolute error of the output beside the steering, if there is one.
pub(crate) fn beside_steering(throttle_mae: Option<f64>, speed_mae_mph: Option<f64>) -> String {
    let throttle = throttle_mae.map_or(String::new(), |mae| format!("  throttle MAE {mae:.3}"));
    let speed = speed_mae_mph.map_or(String::new(), |mae| format!("  speed MAE {mae:.2} mph"));
    throttle + &speed
}

/// Shows a main job on standard error: its training runs, and a bar for each of its other parts; with a page, there as well.
pub struct JobDisplay {
    training: TrainingDisplay,
    bar: Option<ShareBar>,
    page: Option<TrainingPage>,
    stop: StopSignal,
}

impl JobDisplay {
    /// For a job that is about to begin, which `stop` ends.
    pub fn new(stop: &StopSignal) -> JobDisplay {
        JobDisplay { training: TrainingDisplay::new(), bar: None, page: None, stop: stop.clone() }
    }

    /// The same, that also shows everything on `page`.
    pub fn with_page(self, page: Option<TrainingPage>) -> JobDisplay {
        JobDisplay { page, ..self }
    }

    /// Ends the page with these words; `folder` is that of the run.
    pub fn close_page(&mut self, words: &str, folder: Option<&Path>) {
        if let Some(page) = self.page.take() {
            page.finish(words, folder);
        }
    }

    /// As [`TrainingDisplay::finish`].
    pub fn finish(&mut self) {
        self.bar = None;
        self.training.finish();
    }
}

impl Observer<JobEvent> for JobDisplay {
    fn observe(&mut self, event: JobEvent) -> Result<()> {
        if let Some(page) = &self.page {
            match &event {
                JobEvent::Notice(_) => {}
                JobEvent::Begin { what } => page.work(Some(what)),
                JobEvent::Progress(Progress(share)) => page.share(*share),
                JobEvent::End => page.work(None),
                JobEvent::Training(event) => page.show(event),
            }
        }
        match event {
            JobEvent::Notice(text) => eprintln!("{text}"),
            JobEvent::Begin { what } => self.bar = Some(ShareBar::new(what, &self.stop)),
            JobEvent::Progress(progress) => self.bar.iter_mut().try_for_each(|bar| bar.observe(progress))?,
            JobEvent::End => self.bar = None,
            JobEvent::Training(event) => self.training.observe(event)?,
        }
        Ok(())
    }
}
