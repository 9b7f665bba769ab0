//! Records drives of the expert in the format of Udacity's simulator.

use std::fs;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::cluster::tasks::run;
use crate::dataset::{DESCRIPTION_FILE, Description};
use crate::files::new_folder::NewFolder;
use crate::observer::{Observer, Progress, Tally};
use crate::simulator::camera::foreign_car;
use crate::simulator::recorder::expert_drive::drive_expert;
use crate::simulator::recorder::options::{RecordOptions, RecordingInfo};
use crate::simulator::recorder::photograph::{Part, Photographs, Recent, Taken};
use crate::simulator::recorder::sample::Sample;
use crate::simulator::recorder::writer::{LogLines, has_sides, write_pictures};
use crate::simulator::road::spec::TrackSpec;
use crate::simulator::track::Track;
use crate::simulator::trial::wheel::Wheel;
use crate::{Error, Result};

/// Rows of a task that are aimed at, fewest and most: some pictures, so that the message costs little beside them, and so many that
/// several ranks seldom need the same visible world.
const TASK_ROWS: Range<usize> = 32..256;
/// Tasks that are wanted.
const TASKS: usize = 64;

/// A recording to make.
pub struct RecordRequest<'a> {
    /// The track.
    pub track: &'a Track,
    /// How it is driven and recorded.
    pub options: RecordOptions,
    /// The new folder.
    pub out: PathBuf,
}

/// Records a drive of the expert into the new folder `out`: `driving_log.csv`, `IMG/`, `recording.toml` and `steersman.toml`, which
/// names the camera.
///
/// Pictures are taken on all threads of this rayon pool, and on those of other ranks; the files do not depend on their number.
///
/// # Errors
/// If `out` exists, if something cannot be written, or if the observer returns an error. Nothing is left behind then: the folder
/// gets its name when it is whole.
pub fn record(
    track: &Track,
    options: &RecordOptions,
    out: &Path,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<RecordingInfo> {
    let request = RecordRequest { track, options: options.clone(), out: out.into() };
    record_all(&[request], observer).map(|mut infos| infos.remove(0))
}

/// Makes several recordings at once, each as [`record`] does.
///
/// # Errors
/// As [`record`]. Folders that are whole stay.
pub fn record_all(
    requests: &[RecordRequest],
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<Vec<RecordingInfo>> {
    check(requests)?;
    let rows: Vec<Vec<Sample>> =
        requests.par_iter().map(|request| drive_expert(request.track, &request.options)).collect();
    let work = photographs(requests, None);
    let counts = rows.iter().zip(&work.recordings).map(|(rows, (track, _))| (*track, rows.len()));
    let tasks = cut(&counts.collect::<Vec<_>>());
    let part = |(recording, range): &(usize, Range<usize>)| {
        let rows = rows[*recording][range.clone()].to_vec();
        Part { recording: *recording, first: range.start, rows: Some(rows) }
    };
    let task = |number: usize| tasks[number].iter().map(part).collect();
    make(requests, &work, tasks.len(), task, rows.iter().map(Vec::len), observer)
}

/// The same, but `wheel` drives, in the place of the expert in all but the share `expert_share` of the seconds; the labels are the expert's
/// steering all the same.
///
/// # Errors
/// As [`record_all`].
pub fn record_driven(
    requests: &[RecordRequest],
    wheel: &Wheel,
    expert_share: f64,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<Vec<RecordingInfo>> {
    check(requests)?;
    let work = photographs(requests, Some((wheel.clone(), expert_share)));
    let task = |recording: usize| vec![Part { recording, first: 0, rows: None }];
    // How many rows there are is known when they are driven, all in one task.
    make(requests, &work, requests.len(), task, requests.iter().map(|_| usize::MAX), observer)
}

fn check(requests: &[RecordRequest]) -> Result<()> {
    requests.iter().try_for_each(|RecordRequest { options, .. }| {
        if !(options.laps > 0.0 && options.laps <= 1000.0) {
            return Err(Error::Usage(format!("laps {}: more than 0 and at most 1000 can be recorded", options.laps)));
        }
        options.check()
    })
}

/// The work of `requests`, with each track once.
fn photographs(requests: &[RecordRequest], driver: Option<(Wheel, f64)>) -> Photographs {
    let mut tracks: Vec<&Track> = Vec::new();
    let mut recordings = Vec::with_capacity(requests.len());
    for RecordRequest { track, options, .. } in requests {
        let known = tracks.iter().position(|known| std::ptr::eq(*known, *track));
        recordings.push((known.unwrap_or(tracks.len()), options.clone()));
        if known.is_none() {
            tracks.push(track);
        }
    }
    let tracks: Vec<TrackSpec> = tracks.iter().map(|track| track.spec.clone()).collect();
    Photographs { tracks, recordings, driver, recent: Recent::default() }
}

/// Rows of recordings, each with its track and its number of rows, in tasks: some of one recording, or of neighbouring ones on the same
/// track.
fn cut(recordings: &[(usize, usize)]) -> Vec<Vec<(usize, Range<usize>)>> {
    let all: usize = recordings.iter().map(|(_, rows)| rows).sum();
    let wanted = (all / TASKS).clamp(TASK_ROWS.start, TASK_ROWS.end);
    let numbered: Vec<(usize, (usize, usize))> = recordings.iter().copied().enumerate().collect();
    let mut tasks = Vec::new();
    for of_track in numbered.chunk_by(|(_, (a, _)), (_, (b, _))| a == b) {
        let rows: usize = of_track.iter().map(|(_, (_, rows))| rows).sum();
        let count = (rows / wanted).max(1);
        for k in 0..count {
            let task = rows * k / count..rows * (k + 1) / count;
            let mut before = 0;
            let mut parts = Vec::new();
            for (recording, (_, rows)) in of_track {
                let own = task.start.max(before)..task.end.min(before + rows);
                if own.start < own.end {
                    parts.push((*recording, own.start - before..own.end - before));
                }
                before += rows;
            }
            tasks.push(parts);
        }
    }
    tasks
}

/// A recording that is being made.
struct Unfinished {
    /// Until it is whole.
    folder: Option<NewFolder>,
    images: PathBuf,
    rows: Vec<(usize, Sample)>,
    /// Rows in all; not known before they are driven if it is `usize::MAX`.
    wanted: usize,
    info: Option<RecordingInfo>,
}

/// Does all tasks of `work`, and writes what comes of them.
fn make(
    requests: &[RecordRequest],
    work: &Photographs,
    tasks: usize,
    task: impl Fn(usize) -> Vec<Part> + Sync,
    rows: impl Iterator<Item = usize>,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<Vec<RecordingInfo>> {
    let begin = |(request, wanted): (&RecordRequest, usize)| -> Result<Mutex<Unfinished>> {
        let folder = NewFolder::create(&request.out)?;
        let images = folder.unfinished().join("IMG");
        fs::create_dir(&images).map_err(Error::io(&images)).map_err(|error| folder.explain(error))?;
        Ok(Mutex::new(Unfinished { folder: Some(folder), images, rows: Vec::new(), wanted, info: None }))
    };
    let unfinished = requests.iter().zip(rows).map(begin).collect::<Result<Vec<_>>>()?;
    let lock = |recording: usize| unfinished[recording].lock().unwrap_or_else(PoisonError::into_inner);
    let explained = |recording: usize, error: Error| match &lock(recording).folder {
        Some(folder) => folder.explain(error),
        None => error,
    };
    // Answers whether the recording has all its rows now.
    let keep = |taken: Taken| -> Result<bool> {
        let Taken { recording, first, rows, pictures } = taken;
        let images = lock(recording).images.clone();
        let mut of_rows = rows.iter().zip(&pictures);
        of_rows.try_for_each(|(row, pictures)| write_pictures(pictures, row.time_s, &images))?;
        let mut unfinished = lock(recording);
        if unfinished.wanted == usize::MAX {
            unfinished.wanted = rows.len();
        }
        unfinished.rows.extend(rows.into_iter().enumerate().map(|(k, row)| (first + k, row)));
        Ok(unfinished.rows.len() == unfinished.wanted)
    };
    let tally = Tally::new(tasks, observer);
    let ran = run(
        work,
        tasks,
        |number| Ok(task(number)),
        |_, album| {
            let mut whole = Vec::new();
            for taken in album.0 {
                let recording = taken.recording;
                if keep(taken).map_err(|error| explained(recording, error))? {
                    whole.push(recording);
                }
            }
            // Who is stopped here leaves nothing behind.
            tally.add(1)?;
            whole.into_iter().try_for_each(|recording| {
                let finished = finish(&requests[recording], &mut lock(recording));
                finished.map_err(|error| explained(recording, error))
            })
        },
    );
    ran.ended?;
    // A recording without rows has had no task.
    for (request, unfinished) in requests.iter().zip(&unfinished) {
        let mut unfinished = unfinished.lock().unwrap_or_else(PoisonError::into_inner);
        if unfinished.info.is_none() {
            finish(request, &mut unfinished)?;
        }
    }
    let infos = unfinished.into_iter().filter_map(|one| one.into_inner().unwrap_or_else(PoisonError::into_inner).info);
    Ok(infos.collect())
}

/// Writes all but the pictures, and gives the folder its name.
fn finish(request: &RecordRequest, unfinished: &mut Unfinished) -> Result<()> {
    let RecordRequest { track, options, out } = request;
    let Some(folder) = unfinished.folder.take() else { return Ok(()) };
    unfinished.rows.sort_unstable_by_key(|(number, _)| *number);
    let info = RecordingInfo::new(track, options, unfinished.rows.len());
    let rows = std::mem::take(&mut unfinished.rows);
    let written = write_texts(options, &info, rows.into_iter().map(|(_, row)| row), folder.unfinished(), out);
    written.map_err(|error| folder.explain(error))?;
    folder.finish()?;
    unfinished.info = Some(info);
    Ok(())
}

/// Writes log and descriptions of a recording into `folder`, which will be called `out`.
fn write_texts(
    options: &RecordOptions,
    info: &RecordingInfo,
    rows: impl Iterator<Item = Sample>,
    folder: &Path,
    out: &Path,
) -> Result<()> {
    let log = folder.join("driving_log.csv");
    let lines = LogLines::new(options.format, out, has_sides(options.car.as_ref()))?;
    let mut text = lines.header().as_bytes().to_vec();
    let mut as_car = rows.map(|row| match &options.car {
        Some(car) => {
            let steering = foreign_car::steering(row.steering, car);
            let speed_mph = row.speed_mph / foreign_car::scale(car);
            Sample { steering, speed_mph, ..row }
        }
        None => row,
    });
    as_car
        .try_for_each(|row| lines.row(&row, &mut text))
        .and_then(|()| fs::write(&log, text))
        .map_err(Error::io(&log))?;
    let description = folder.join(DESCRIPTION_FILE);
    let camera = match &options.car {
        Some(car) => Description { camera: Some(car.into()), ..Description::default() }.to_toml()?,
        None => "[camera]\npreset = \"steersman\"\n".into(),
    };
    fs::write(&description, camera).map_err(Error::io(&description))?;
    info.write(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every row once and in order, few worlds in a task, and no task far from the others.
    #[test]
    fn tasks_have_each_row_once_and_small_tracks_stay_whole() {
        let large = [(0, 700), (0, 300)];
        let small: Vec<(usize, usize)> = (1..40).flat_map(|track| [(track, 110), (track, 90)]).collect();
        for recordings in [&large[..1], &large[..], &[&large[..], &small].concat(), &[(0, 5)], &[(0, 0), (0, 3)]] {
            let tasks = cut(recordings);
            let mut next = vec![0; recordings.len()];
            for task in &tasks {
                assert!(task.iter().all(|(recording, _)| recordings[*recording].0 == recordings[task[0].0].0));
                for (recording, rows) in task {
                    assert_eq!(rows.start, next[*recording]);
                    next[*recording] = rows.end;
                }
            }
            assert!(next.iter().zip(recordings).all(|(done, (_, rows))| done == rows));
            let rows = |task: &Vec<(usize, Range<usize>)>| task.iter().map(|(_, rows)| rows.len()).sum::<usize>();
            assert!(tasks.iter().all(|task| rows(task) < 2 * TASK_ROWS.end), "{recordings:?}");
        }
        assert_eq!(cut(&[&large[..], &small].concat()).len(), 7 + 39);
    }
}
