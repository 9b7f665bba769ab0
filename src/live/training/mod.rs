//! The page of a training that is under way: how far it is, and below that the report of the run, drawn again as epochs end.
//!
//! The same report lies in the run folder afterwards, as `report.html`.

mod server;

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::error::{Error, Result};
use crate::net::{http, loopback};
use crate::report::pages::run;
use crate::training::{Pace, TrainingEvent};

/// Default port of the page.
pub const DEFAULT_PORT: u16 = 4570;
/// Batches of an epoch whose losses are kept; of more, every second one is dropped.
const MAX_LOSSES: usize = 400;
/// Words of the run that are kept.
const MAX_NOTICES: usize = 20;
/// The report is drawn again after this many times the time that it took: watching must not slow the training down.
const REST: u32 = 10;
/// A page that has asked within this time is open.
const OPEN_TIME: Duration = Duration::from_secs(5);
/// Pause between two looks whether a report is drawn.
const WAIT: Duration = Duration::from_millis(20);
/// Longest wait for open pages to fetch the last words and the last report.
const FAREWELL: Duration = Duration::from_secs(6);

/// What the page shows above the report.
#[derive(Clone, Debug, Default, Serialize)]
struct State {
    /// The run folder.
    run: String,
    /// What is being done, if it is no training: recording or driving.
    work: Option<String>,
    /// Share of that work, 0 to 1.
    share: f64,
    epoch: u32,
    epochs: u32,
    images: usize,
    of: usize,
    images_per_s: Option<f64>,
    left_s: Option<f64>,
    /// Losses of batches of this epoch, thinned out.
    losses: Vec<f64>,
    notices: Vec<String>,
    /// Number of the report to show; 0 for none yet.
    report: u64,
    /// The last words.
    over: Option<String>,
}

/// The report of the run so far.
#[derive(Debug, Default)]
struct Report {
    /// Folder of the run.
    folder: Option<PathBuf>,
    /// Counts what could be drawn: an epoch or the end of a run.
    newest: u64,
    /// What was drawn.
    drawn: u64,
    html: String,
    ended: Option<Instant>,
    took: Duration,
    /// Whether a thread draws it now.
    is_being_drawn: bool,
    /// Whether it lies in the folder.
    finished: bool,
}

/// What the training and the connections share.
#[derive(Debug)]
struct Desk {
    state: Mutex<State>,
    report: Mutex<Report>,
    pace: Mutex<Pace>,
    last_asked: Mutex<Option<Instant>>,
    closed: Mutex<bool>,
    pool: rayon::ThreadPool,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    // A thread that panicked can leave at most a figure that the next event overwrites.
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Desk {
    /// The state as JSON.
    fn state(&self) -> String {
        *lock(&self.last_asked) = Some(Instant::now());
        // With the last words comes the last report.
        let is_over = lock(&self.state).over.is_some();
        let report = if is_over { lock(&self.report).newest } else { self.report_to_show() };
        let mut state = lock(&self.state);
        state.report = report;
        serde_json::to_string(&*state).expect("numbers, words and lists can be written as JSON")
    }

    /// Number of the report that a page should show now: the one that was drawn while a newer one would come too soon.
    fn report_to_show(&self) -> u64 {
        let report = lock(&self.report);
        let rests = report.ended.is_some_and(|ended| ended.elapsed() < report.took * REST);
        if report.drawn != 0 && (rests || report.is_being_drawn) && !report.finished {
            report.drawn
        } else {
            report.newest
        }
    }

    /// The newest report. The training never waits while it is drawn.
    fn report(&self) -> Result<String> {
        let (folder, newest, finished) = loop {
            let mut report = lock(&self.report);
            match &report.folder {
                Some(folder) if report.drawn != report.newest && !report.is_being_drawn => {
                    let wanted = (folder.clone(), report.newest, report.finished);
                    report.is_being_drawn = true;
                    break wanted;
                }
                // Another page has asked for the same.
                Some(_) if report.drawn != report.newest && !self.is_over() => {}
                _ => return Ok(report.html.clone()),
            }
            drop(report);
            std::thread::sleep(WAIT);
        };
        let began = Instant::now();
        let path = folder.join("report.html");
        let html = match finished {
            true => std::fs::read_to_string(&path).map_err(Error::io(&path)),
            false => self.pool.install(|| run::render_so_far(&folder)),
        };
        let mut report = lock(&self.report);
        (report.is_being_drawn, report.took, report.ended) = (false, began.elapsed(), Some(Instant::now()));
        report.html = html?;
        report.drawn = newest;
        Ok(report.html.clone())
    }

    fn is_over(&self) -> bool {
        *lock(&self.closed)
    }
}

/// Serves the page in threads of its own until it is dropped.
#[derive(Debug)]
pub struct TrainingPage {
    desk: Arc<Desk>,
    address: SocketAddr,
    listener: Option<JoinHandle<()>>,
}

impl TrainingPage {
    /// Serves the page at `port` of the loopback address; 0 takes any free port.
    ///
    /// # Errors
    ///
    /// [`Error::System`] with the remedy if the port cannot be had.
    pub fn start(port: u16) -> Result<TrainingPage> {
        let fault = |e: &dyn std::fmt::Display| Error::System(format!("cannot serve the page: {e}"));
        // One thread: the others train.
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().map_err(|e| fault(&e))?;
        let in_use = "end it, or give another --port; 0 takes any free one";
        let listener = http::listen(SocketAddr::from((Ipv4Addr::LOCALHOST, port)), in_use)?;
        let address = listener.local_addr().map_err(|e| fault(&e))?;
        let desk = Arc::new(Desk {
            state: Mutex::default(),
            report: Mutex::default(),
            pace: Mutex::default(),
            last_asked: Mutex::default(),
            closed: Mutex::default(),
            pool,
        });
        let shared = desk.clone();
        let thread = std::thread::Builder::new().name("training page".into());
        let serve = move || {
            loopback::listen(&listener, &|| shared.is_over(), &|peer| server::serve(peer, address.port(), &shared));
        };
        let listener = Some(thread.spawn(serve).map_err(|e| fault(&e))?);
        Ok(TrainingPage { desk, address, listener })
    }

    /// The address to open in a browser.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// Shows what happens in a training.
    pub fn show(&self, event: &TrainingEvent) {
        let mut state = lock(&self.desk.state);
        match event {
            TrainingEvent::Begin { folder } => {
                let work = State { notices: std::mem::take(&mut state.notices), ..State::default() };
                *state = State { run: folder.display().to_string(), ..work };
                *lock(&self.desk.pace) = Pace::default();
                drop(state);
                let mut report = lock(&self.desk.report);
                (report.folder, report.finished) = (Some(folder.clone()), false);
            }
            TrainingEvent::Notice(text) => {
                state.notices.push(text.clone());
                let too_many = state.notices.len().saturating_sub(MAX_NOTICES);
                state.notices.drain(..too_many);
            }
            TrainingEvent::Batch { epoch, epochs, images, of, loss } => {
                let now = lock(&self.desk.pace).batch([*epoch, *epochs], [*images, *of], Instant::now());
                (state.epoch, state.epochs, state.images, state.of) = (*epoch, *epochs, *images, *of);
                (state.images_per_s, state.left_s) = (now.images_per_s, now.left_s);
                if now.begins_epoch {
                    state.losses.clear();
                }
                if state.losses.len() >= MAX_LOSSES {
                    state.losses = state.losses.iter().copied().skip(1).step_by(2).collect();
                }
                state.losses.push(*loss);
                drop(state);
                // The epoch before is on the disk now.
                if now.begins_epoch && *epoch > 1 {
                    self.can_be_drawn(false);
                }
            }
            TrainingEvent::Epoch { record, .. } => lock(&self.desk.pace).epoch(record),
        }
    }

    /// Shows that `work`, which is no training, begins, as in `driving on lake`; `None` when it is done.
    pub fn work(&self, work: Option<&str>) {
        let mut state = lock(&self.desk.state);
        (state.work, state.share) = (work.map(String::from), 0.0);
    }

    /// Shows the share of the work that is done, 0 to 1.
    pub fn share(&self, share: f64) {
        let mut state = lock(&self.desk.state);
        state.share = state.share.max(share);
    }

    /// There is a newer report; `finished` if it lies in the run folder.
    fn can_be_drawn(&self, finished: bool) {
        let mut report = lock(&self.desk.report);
        report.newest += 1;
        report.finished = finished;
    }

    /// Shows the last words and, if it was written, the report in `folder`, and waits a moment for open pages to fetch both.
    pub fn finish(self, words: &str, folder: Option<&Path>) {
        if let Some(folder) = folder.filter(|folder| folder.join("report.html").is_file()) {
            lock(&self.desk.report).folder = Some(folder.into());
            self.can_be_drawn(true);
        }
        {
            let mut state = lock(&self.desk.state);
            (state.over, state.work) = (Some(words.into()), None);
        }
        let began = Instant::now();
        let is_open = || lock(&self.desk.last_asked).is_some_and(|asked| asked.elapsed() < OPEN_TIME);
        let has_seen = || {
            let told = lock(&self.desk.last_asked).is_some_and(|asked| asked > began);
            let report = lock(&self.desk.report);
            told && report.drawn == report.newest
        };
        while is_open() && !has_seen() && began.elapsed() < FAREWELL {
            std::thread::sleep(Duration::from_millis(20));
        }
        // `drop` ends the server.
    }
}

impl Drop for TrainingPage {
    fn drop(&mut self) {
        *lock(&self.desk.closed) = true;
        if let Some(listener) = self.listener.take() {
            // A panic is an end, too.
            let _ = listener.join();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_of_long_epochs_are_thinned_and_notices_bounded() {
        let page = TrainingPage::start(0).unwrap();
        page.show(&TrainingEvent::Begin { folder: "runs/x".into() });
        for batch in 0..1000 {
            let (images, loss) = (batch + 1, batch as f64);
            page.show(&TrainingEvent::Batch { epoch: 1, epochs: 2, images, of: 1000, loss });
            page.show(&TrainingEvent::Notice(format!("note {batch}")));
        }
        let state: serde_json::Value = serde_json::from_str(&page.desk.state()).unwrap();
        let losses: Vec<f64> = state["losses"].as_array().unwrap().iter().map(|loss| loss.as_f64().unwrap()).collect();
        assert!(losses.len() <= MAX_LOSSES && losses.is_sorted() && losses.last() == Some(&999.0), "{losses:?}");
        assert_eq!(state["notices"].as_array().unwrap().len(), MAX_NOTICES);
        assert_eq!((&state["epoch"], &state["images"], &state["report"]), (&1.into(), &1000.into(), &0.into()));
        page.show(&TrainingEvent::Batch { epoch: 2, epochs: 2, images: 1, of: 1000, loss: 0.5 });
        let state: serde_json::Value = serde_json::from_str(&page.desk.state()).unwrap();
        assert_eq!((&state["losses"], &state["report"]), (&serde_json::json!([0.5]), &1.into()));
    }
}
