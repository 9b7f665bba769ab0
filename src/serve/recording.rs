//! Records a drive: the pictures and the commands, in the format of Udacity's simulator.
//!
//! The log has the seven columns of the original, and `mode`: `user` where a person steered, else `pilot`. Left and right stay empty, because telemetry has one camera. A picture is
//! stored with the bytes that arrived. Another thread writes, so that a slow disk costs rows and not time.

use std::fs::{self, File};
use std::io::{BufWriter, ErrorKind, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use super::helm::FrameTime;
use crate::dataset::udacity_writer::{HEADER_WITH_MODE, picture_name, write_row};
use crate::error::{Error, Result};
use crate::files::new_folder::create_now;
use crate::udacity::Command;

/// Largest number of rows that wait for the disk: one or two seconds of driving.
const MAX_QUEUED: usize = 64;

/// Time in the names of pictures between two drives on simulated time, ms, so that they are not read as one.
const BETWEEN_DRIVES_MS: u64 = 60_000;

/// One answered frame.
#[derive(Debug)]
pub struct Row {
    /// Time of the frame, ms since 1970.
    pub time_ms: u64,
    /// The picture, encoded.
    pub image: Vec<u8>,
    /// The command.
    pub command: Command,
    /// Speed, mph.
    pub speed_mph: f64,
    /// Whether a person steered.
    pub by_user: bool,
}

/// A finished recording.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct Recorded {
    /// The folder.
    pub folder: PathBuf,
    /// Rows written.
    pub rows: u64,
    /// Those of them in which a person steered.
    pub by_user: u64,
    /// Rows that were left out because the disk was too slow.
    pub dropped: u64,
}

/// A recording under way.
#[derive(Debug)]
pub struct Recorder {
    folder: PathBuf,
    sender: SyncSender<Row>,
    writer: JoinHandle<(u64, Option<Error>)>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    dropped: u64,
    /// Rows in which a person steered.
    by_user: u64,
    last_ms: u64,
    /// Where simulated time 0 lies, ms since 1970.
    simulated_from_ms: u64,
    /// Simulated time of the last row, s, unless it had none.
    simulated_s: Option<f64>,
}

/// What happened to a row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Queued {
    /// It will be written.
    Yes,
    /// It is left out, because the disk is too slow.
    Dropped,
    /// Nothing can be written any more; [`Recorder::finish`] says why.
    Failed,
}

impl Recorder {
    /// Begins a recording in the new folder `folder`.
    ///
    /// # Errors
    ///
    /// If the folder exists or cannot be written.
    pub fn start(folder: &Path) -> Result<Recorder> {
        create_now(folder)?;
        let images = folder.join("IMG");
        fs::create_dir(&images).map_err(Error::io(&images))?;
        let log = folder.join("driving_log.csv");
        let file = BufWriter::new(File::create_new(&log).map_err(Error::io(&log))?);
        let (sender, receiver) = sync_channel(MAX_QUEUED);
        let thread = std::thread::Builder::new().name("recording".into());
        let writer = thread.spawn(move || write_all(&images, &log, file, &receiver)).map_err(Error::io(folder))?;
        let state = State { dropped: 0, by_user: 0, last_ms: 0, simulated_from_ms: now_ms(), simulated_s: None };
        Ok(Recorder { folder: folder.into(), sender, writer, state: Mutex::new(state) })
    }

    /// Copies `image` and hands a row to the writer. Never waits.
    pub fn push(&self, time: FrameTime, image: &[u8], command: Command, speed_mph: f64, by_user: bool) -> Queued {
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let taken_ms = match time {
            FrameTime::Arrival(_) => {
                state.simulated_s = None;
                now_ms()
            }
            FrameTime::Simulated(time_s) => {
                let simulated_ms = (time_s.max(0.0) * 1e3).round() as u64;
                // Time that goes back begins another drive, as does the first frame after frames with the server's time.
                if state.last_ms > 0 && state.simulated_s.is_none_or(|last_s| time_s < last_s) {
                    state.simulated_from_ms = (state.last_ms + BETWEEN_DRIVES_MS).saturating_sub(simulated_ms);
                }
                state.simulated_s = Some(time_s);
                state.simulated_from_ms.saturating_add(simulated_ms)
            }
        };
        // The names must differ, and the rows keep the order of the frames.
        let time_ms = taken_ms.clamp(state.last_ms + 1, state.last_ms.max(now_ms()) + 24 * 3_600_000);
        let row = Row { time_ms, image: image.to_vec(), command, speed_mph, by_user };
        match self.sender.try_send(row) {
            Ok(()) => {
                state.last_ms = time_ms;
                state.by_user += u64::from(by_user);
                Queued::Yes
            }
            Err(TrySendError::Full(_)) => {
                state.dropped += 1;
                Queued::Dropped
            }
            Err(TrySendError::Disconnected(_)) => Queued::Failed,
        }
    }

    /// Rows so far in which a person steered.
    pub fn rows_by_user(&self) -> u64 {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner).by_user
    }

    /// Waits until all rows are written, and removes a recording without a row.
    ///
    /// # Errors
    ///
    /// [`Error::EndedEarly`] if a row could not be written. The rows before it stay, and the error names their folder.
    pub fn finish(self) -> Result<Recorded> {
        let Recorder { folder, sender, writer, state } = self;
        drop(sender);
        let (rows, trouble) = writer.join().map_err(|_| Error::Fault("the recording ended early".into()))?;
        if let Some(cause) = trouble {
            let kept = format!("the {rows} rows before are in {}", folder.display());
            return Err(Error::EndedEarly { cause: Box::new(cause), kept });
        }
        let State { dropped, by_user, .. } = state.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        if rows == 0 {
            remove_empty(&folder)?;
        }
        Ok(Recorded { folder, rows, by_user, dropped })
    }
}

/// Removes a recording without a row, except for files that others have put there.
fn remove_empty(folder: &Path) -> Result<()> {
    let log = folder.join("driving_log.csv");
    fs::remove_file(&log).map_err(Error::io(&log))?;
    for made in [&folder.join("IMG"), folder] {
        match fs::remove_dir(made) {
            Err(error) if error.kind() == ErrorKind::DirectoryNotEmpty => {}
            removed => removed.map_err(Error::io(made))?,
        }
    }
    Ok(())
}

fn now_ms() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or(Duration::ZERO).as_millis() as u64
}

/// Writes rows until the sender is dropped or a row cannot be written. Returns their number and the error; the log then ends
/// with the last whole row.
fn write_all(images: &Path, log: &Path, mut file: BufWriter<File>, rows: &Receiver<Row>) -> (u64, Option<Error>) {
    let mut written = 0;
    let mut good_len = 0;
    let mut write = |row: Option<Row>, good_len: &mut u64| -> Result<()> {
        match row {
            None => file.write_all(HEADER_WITH_MODE.as_bytes()).and_then(|()| file.flush()).map_err(Error::io(log))?,
            Some(row) => write_row_and_picture(images, log, &mut file, &row)?,
        }
        *good_len = file.get_ref().metadata().map_err(Error::io(log))?.len();
        Ok(())
    };
    let mut result = write(None, &mut good_len);
    while result.is_ok()
        && let Ok(row) = rows.recv()
    {
        result = write(Some(row), &mut good_len);
        written += u64::from(result.is_ok());
    }
    if result.is_err() {
        // What the buffer still holds is part of a row.
        let (file, _) = file.into_parts();
        let _ = file.set_len(good_len);
    }
    (written, result.err())
}

/// Writes a picture and then its line.
fn write_row_and_picture(images: &Path, log: &Path, file: &mut BufWriter<File>, row: &Row) -> Result<()> {
    let name = picture_name("center", row.time_ms);
    let path = images.join(&name);
    fs::write(&path, &row.image).map_err(|source| {
        // Part of a picture is of no use.
        let _ = fs::remove_file(&path);
        Error::io(&path)(source)
    })?;
    let Command { steering, throttle } = row.command;
    let (accelerator, brake, speed) = (throttle.max(0.0), (-throttle).max(0.0), row.speed_mph as f32);
    let picture = format!("IMG/{name}");
    let mut line = Vec::new();
    write_row(&mut line, ", ", [&picture, &"", &""], [steering, accelerator, brake, speed])
        .and_then(|()| {
            line.pop();
            writeln!(line, ", {}", if row.by_user { "user" } else { "pilot" })
        })
        .and_then(|()| file.write_all(&line))
        .and_then(|()| file.flush())
        .map_err(Error::io(log))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Instant;

    use crate::dataset;
    use crate::simulator::RgbFrame;
    use crate::simulator::camera::jpeg;

    fn image() -> Vec<u8> {
        let mut bytes = Vec::new();
        jpeg::encode(&RgbFrame::default(), &mut bytes).unwrap();
        bytes
    }

    #[test]
    fn a_recording_is_read_back_as_it_was_driven() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path().join("drive");
        let recorder = Recorder::start(&folder).unwrap();
        let image = image();
        for frame in 0..20 {
            let command = Command { steering: frame as f32 / 20.0 - 0.5, throttle: frame as f32 / 10.0 - 1.0 };
            let time = FrameTime::Simulated(f64::from(frame) * 0.06);
            let queued = recorder.push(time, &image, command, 12.5, frame >= 15);
            assert_eq!(queued, Queued::Yes);
        }
        let recorded = recorder.finish().unwrap();
        assert_eq!((recorded.rows, recorded.by_user, recorded.dropped), (20, 5, 0));
        let recording = dataset::load(&folder).unwrap();
        assert_eq!((recording.rows.len(), recording.sessions.len()), (20, 1));
        assert!(recording.notices.is_empty(), "{:?}", recording.notices);
        let row = &recording.rows[4];
        assert_eq!((row.steering, row.throttle, row.brake, row.speed_mph), (-0.3, 0.0, 0.6, 12.5));
        let taken_over: Vec<usize> = (0..20).filter(|&row| recording.rows[row].taken_over).collect();
        assert_eq!(taken_over, [15, 16, 17, 18, 19]);
        assert!(Recorder::start(&folder).is_err(), "an existing folder is refused");
        assert_eq!(dataset::load(&folder).unwrap().rows.len(), 20);
    }

    #[test]
    fn frames_of_one_millisecond_get_names_of_their_own() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path().join("drive");
        let recorder = Recorder::start(&folder).unwrap();
        let now = FrameTime::Arrival(Instant::now());
        let queued =
            (0..30).filter(|_| recorder.push(now, b"x", Command::default(), 0.0, false) == Queued::Yes).count();
        let recorded = recorder.finish().unwrap();
        assert_eq!(recorded.rows, queued as u64);
        assert_eq!(fs::read_dir(folder.join("IMG")).unwrap().count(), queued);
    }

    #[test]
    fn two_drives_on_simulated_time_are_two_sessions() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path().join("drive");
        let recorder = Recorder::start(&folder).unwrap();
        for time_s in [0.0, 0.06, 0.1, 0.0, 0.06, 0.1] {
            assert_eq!(
                recorder.push(FrameTime::Simulated(time_s), &image(), Command::default(), 0.0, false),
                Queued::Yes
            );
        }
        recorder.finish().unwrap();
        let recording = dataset::load(&folder).unwrap();
        assert_eq!((recording.rows.len(), recording.sessions.len()), (6, 2));
    }

    #[test]
    fn nothing_recorded_leaves_nothing_behind_but_what_others_put_there() {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path().join("drive");
        assert_eq!(Recorder::start(&folder).unwrap().finish().unwrap().rows, 0);
        assert!(!folder.exists());
        let recorder = Recorder::start(&folder).unwrap();
        fs::write(folder.join("notes.txt"), "wet road").unwrap();
        assert_eq!(recorder.finish().unwrap().rows, 0);
        let left: Vec<_> = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        assert_eq!(left, ["notes.txt"]);
    }
}
