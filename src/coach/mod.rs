//! The coach: a page on which a person looks through a recording, and leaves rows out.
//!
//! [`Coach`] serves the page to browsers on this machine, with the same guards as the [live page](crate::live). It opens at once:
//! rows come as arrays and pictures as they lie on the disk, while what the models answer and what is suspicious is found in the
//! background. No picture and no row is ever changed: [`Exclusions`](crate::dataset::Exclusions) says where it is written.

mod desk;
mod server;

use std::net::{Ipv4Addr, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use std::thread::JoinHandle;

use crate::dataset::{Description, ImageCheck, LeftOut, load_rows};
use crate::error::{Error, Result};
use crate::net::{http, loopback};
use crate::pilot::Pilot;
use desk::Desk;

/// Default port of the page.
pub const DEFAULT_PORT: u16 = 4569;

/// Serves the page in threads of its own until it is dropped.
#[derive(Debug)]
pub struct Coach {
    desk: Arc<Desk>,
    address: SocketAddr,
    threads: Vec<JoinHandle<()>>,
}

impl Coach {
    /// Serves the page for the recording at `path`, of which the user says `said`, at `port` of the loopback address; 0 takes any
    /// free port. Each of `models`, by its name, is asked about every row. `pool` does the work in the background.
    ///
    /// # Errors
    ///
    /// As [`load_with`](crate::dataset::load_with) and [`Exclusions::of`](crate::dataset::Exclusions::of); [`Error::Data`] for a
    /// recording without rows, [`Error::System`] with the remedy if the port cannot be had.
    pub fn start(
        path: &Path,
        said: &Description,
        models: Vec<(String, Pilot)>,
        port: u16,
        pool: rayon::ThreadPool,
    ) -> Result<Coach> {
        let recording = pool.install(|| load_rows(path, said, ImageCheck::Skip, LeftOut::Keep))?;
        recording.require_unit()?;
        let (names, pilots) = models.into_iter().unzip();
        let desk = Arc::new(Desk::new(recording, names)?);
        let in_use = "end it, or give another --port; 0 takes any free one";
        let listener = http::listen(SocketAddr::from((Ipv4Addr::LOCALHOST, port)), in_use)?;
        let fault = |e: std::io::Error| Error::System(format!("cannot serve the page: {e}"));
        let address = listener.local_addr().map_err(fault)?;
        let mut coach = Coach { desk, address, threads: Vec::new() };
        let desk = coach.desk.clone();
        let thread = std::thread::Builder::new().name("coach".into());
        let serve = move || {
            loopback::listen(&listener, &|| desk.is_over(), &|peer| server::serve(peer, address.port(), &desk));
        };
        coach.threads.push(thread.spawn(serve).map_err(fault)?);
        let desk = coach.desk.clone();
        let thread = std::thread::Builder::new().name("coach looks".into());
        let look = move || pool.install(|| desk.look(pilots));
        coach.threads.push(thread.spawn(look).map_err(fault)?);
        Ok(coach)
    }

    /// The address to open in a browser.
    pub fn url(&self) -> String {
        format!("http://{}/", self.address)
    }

    /// The file in which the rows that are left out are written.
    pub fn saves_to(&self) -> &Path {
        self.desk.saves_to()
    }

    /// Rows that are left out now.
    pub fn left_out(&self) -> usize {
        self.desk.left_out()
    }
}

impl Drop for Coach {
    fn drop(&mut self) {
        self.desk.end();
        for thread in self.threads.drain(..) {
            // A panic is an end, too.
            let _ = thread.join();
        }
    }
}
