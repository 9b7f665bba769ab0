//! Work that takes long: without Python's lock, on a pool of threads, with progress, and ended by Ctrl-C.

use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use pyo3::prelude::*;
use pyo3::types::{IntoPyDict, PyDict};
use rayon::ThreadPool;

use super::arrays::plain;
use super::exceptions::warn;
use crate::error::{Error, Result};
use crate::main_job::job::JobEvent;
use crate::observer::{Observer, Progress, StopSignal};
use crate::training::TrainingEvent;

/// Time between two looks at signals and progress.
const TICK: Duration = Duration::from_millis(50);
/// A warning seems to come from the line that called the function of the package around the native one.
const OF_CALLER: i32 = 2;

/// Something to tell Python.
enum News {
    /// This share of the work is done, 0 to 1.
    Share(f64),
    /// A part of the work begins.
    Begin(String),
    Notice(String),
    Training(TrainingEvent),
}

impl News {
    /// Whether later news of the same kind make these superfluous.
    fn is_passing(&self) -> bool {
        matches!(self, News::Share(_) | News::Training(TrainingEvent::Batch { .. }))
    }

    /// The dictionary that a callback gets.
    fn dict<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        match self {
            News::Share(share) => [("share", share)].into_py_dict(py),
            News::Begin(what) => [("begin", what)].into_py_dict(py),
            News::Notice(text) | News::Training(TrainingEvent::Notice(text)) => [("notice", text)].into_py_dict(py),
            News::Training(TrainingEvent::Begin { folder }) => [("folder", folder)].into_py_dict(py),
            News::Training(TrainingEvent::Batch { epoch, epochs, images, of, loss }) => {
                let dict = [("epoch", *epoch as usize), ("epochs", *epochs as usize), ("images", *images), ("of", *of)]
                    .into_py_dict(py)?;
                dict.set_item("loss", loss)?;
                Ok(dict)
            }
            News::Training(TrainingEvent::Epoch { record, of }) => {
                let dict = [("epochs", *of)].into_py_dict(py)?;
                dict.set_item("record", plain(py, record)?)?;
                Ok(dict)
            }
        }
    }
}

/// What the working thread has to say, and whether it has ended.
#[derive(Default)]
struct Said {
    news: Vec<News>,
    over: bool,
}

/// Told by the work what happens; the thread that called from Python passes it on. Clones tell the same one.
#[derive(Clone, Default)]
pub(super) struct Reporter {
    said: Arc<(Mutex<Said>, Condvar)>,
    /// Requested by Ctrl-C and by exceptions of callbacks.
    pub stop: StopSignal,
}

impl Reporter {
    fn lock(&self) -> MutexGuard<'_, Said> {
        self.said.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn say(&self, news: News) {
        let mut said = self.lock();
        match said.news.last_mut() {
            Some(last) if last.is_passing() && news.is_passing() => *last = news,
            _ => said.news.push(news),
        }
    }

    /// Tells the user something.
    pub fn notice(&self, text: impl Into<String>) {
        self.say(News::Notice(text.into()));
    }

    /// Waits until the work is over, or a moment; returns what is new, and whether it is over.
    fn wait(&self) -> (Vec<News>, bool) {
        let (_, wake) = &*self.said;
        let waited = wake.wait_timeout_while(self.lock(), TICK, |said| !said.over);
        let (mut said, _) = waited.unwrap_or_else(PoisonError::into_inner);
        (std::mem::take(&mut said.news), said.over)
    }
}

impl Observer<Progress> for Reporter {
    fn observe(&mut self, Progress(share): Progress) -> Result<()> {
        self.say(News::Share(share));
        self.stop.check()
    }
}

impl Observer<TrainingEvent> for Reporter {
    /// Never ends the work: training takes the stop signal itself, and saves.
    fn observe(&mut self, event: TrainingEvent) -> Result<()> {
        self.say(News::Training(event));
        Ok(())
    }
}

impl Observer<JobEvent> for Reporter {
    fn observe(&mut self, event: JobEvent) -> Result<()> {
        match event {
            JobEvent::Notice(text) => self.say(News::Notice(text)),
            JobEvent::Begin { what } => self.say(News::Begin(what)),
            JobEvent::Progress(progress) => return self.observe(progress),
            JobEvent::End => {}
            JobEvent::Training(event) => return self.observe(event),
        }
        Ok(())
    }
}

/// Says that the work is over, however it ends.
struct Ending(Reporter);

impl Drop for Ending {
    fn drop(&mut self) {
        self.0.lock().over = true;
        self.0.said.1.notify_all();
    }
}

/// Does `job` on `threads` threads (0: one for each core) without Python's lock. `progress`, if any, is called with a dictionary for
/// what happens; notices are warnings. An exception of either, and Ctrl-C, stop the job.
///
/// # Errors
///
/// The job's error; the exception that stopped it, `KeyboardInterrupt` for Ctrl-C.
pub(super) fn run<T: Send>(
    py: Python,
    threads: usize,
    progress: Option<&Bound<PyAny>>,
    job: impl FnOnce(&mut Reporter) -> Result<T> + Send,
) -> PyResult<T> {
    let pool = pool(threads)?;
    let reporter = Reporter::default();
    let mut stopped_by = None;
    let result = std::thread::scope(|scope| {
        let mut of_job = reporter.clone();
        let worker = scope.spawn(move || {
            let _ending = Ending(of_job.clone());
            pool.install(|| job(&mut of_job))
        });
        loop {
            let (news, over) = py.detach(|| reporter.wait());
            let told = news.iter().try_for_each(|news| tell(py, progress, news));
            if let Err(exception) = told.and_then(|()| py.check_signals()) {
                reporter.stop.request();
                stopped_by.get_or_insert(exception);
            }
            if over {
                break py.detach(|| worker.join());
            }
        }
    });
    let result = result.unwrap_or_else(|panic| std::panic::resume_unwind(panic));
    match stopped_by {
        Some(exception) => Err(exception),
        None => Ok(result?),
    }
}

fn tell(py: Python, progress: Option<&Bound<PyAny>>, news: &News) -> PyResult<()> {
    if let News::Notice(text) | News::Training(TrainingEvent::Notice(text)) = news {
        return warn(py, text, OF_CALLER);
    }
    match progress {
        Some(progress) => progress.call1((news.dict(py)?,)).map(drop),
        None => Ok(()),
    }
}

/// The pool of one thread a core, and the process that started it: its threads do not live on in a fork.
static POOL: Mutex<Option<(u32, Arc<ThreadPool>)>> = Mutex::new(None);

/// A pool of `threads` (0: one for each core).
///
/// # Errors
///
/// [`Error::System`] if the system does not give so many threads.
pub(super) fn pool(threads: usize) -> Result<Arc<ThreadPool>> {
    let new = || {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.map(Arc::new)
            .map_err(|e| Error::System(format!("cannot start {threads} threads: {e}; give a smaller number")))
    };
    if threads > 0 {
        return new();
    }
    let mut kept = POOL.lock().unwrap_or_else(PoisonError::into_inner);
    match &*kept {
        Some((process, pool)) if *process == std::process::id() => Ok(pool.clone()),
        _ => {
            let pool = new()?;
            // The pool of the process that this one was forked from has no threads to wait for.
            std::mem::forget(kept.replace((std::process::id(), pool.clone())));
            Ok(pool)
        }
    }
}
