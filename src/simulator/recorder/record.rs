//! Records drives of the expert in the format of Udacity's simulator.

use std::fs;
use std::path::Path;

use rayon::prelude::*;

use crate::dataset::{DESCRIPTION_FILE, Description};
use crate::files::new_folder::NewFolder;
use crate::observer::{Observer, Progress, Tally};
use crate::simulator::camera::foreign_car;
use crate::simulator::recorder::expert_drive::drive_expert;
use crate::simulator::recorder::options::{RecordOptions, RecordingInfo};
use crate::simulator::recorder::sample::Sample;
use crate::simulator::recorder::writer::{LogLines, Photographer, has_sides};
use crate::simulator::scenery::light::Variant;
use crate::simulator::track::Track;
use crate::{Error, Result};

/// Records a drive of the expert into the new folder `out`: `driving_log.csv`, `IMG/`, `recording.toml` and `steersman.toml`, which
/// names the camera.
///
/// Pictures are taken on all threads; the files do not depend on their number.
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
    if !(options.laps > 0.0 && options.laps <= 1000.0) {
        return Err(Error::Usage(format!("laps {}: more than 0 and at most 1000 can be recorded", options.laps)));
    }
    options.check()?;
    let samples = drive_expert(track, options);
    write_recording(track, options, &samples, out, observer)
}

/// Takes the pictures of `samples` and writes a recording, as [`record`] does.
///
/// # Errors
/// As [`record`].
pub fn write_recording(
    track: &Track,
    options: &RecordOptions,
    samples: &[Sample],
    out: &Path,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<RecordingInfo> {
    let folder = NewFolder::create(out)?;
    let info = fill(track, options, samples, &folder, out, observer).map_err(|error| folder.explain(error))?;
    folder.finish()?;
    Ok(info)
}

/// Writes the files of a recording into `folder`, which will be called `out`.
fn fill(
    track: &Track,
    options: &RecordOptions,
    samples: &[Sample],
    folder: &NewFolder,
    out: &Path,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<RecordingInfo> {
    let images = folder.unfinished().join("IMG");
    fs::create_dir(&images).map_err(Error::io(&images))?;
    let world = track.world();
    let variant = Variant::new(world, options.seed);
    let tally = Tally::new(samples.len(), observer);
    let photographer = || Photographer::new(options.car.as_ref());
    samples.par_iter().try_for_each_init(photographer, |photographer, sample| {
        photographer.take(world, &variant, sample, &images)?;
        tally.add(1)
    })?;
    let log = folder.unfinished().join("driving_log.csv");
    let lines = LogLines::new(options.format, out, has_sides(options.car.as_ref()))?;
    let mut text = lines.header().as_bytes().to_vec();
    let rows = samples.iter().try_for_each(|sample| match &options.car {
        Some(car) => {
            let steering = foreign_car::steering(sample.steering, car);
            let speed_mph = sample.speed_mph / foreign_car::scale(car);
            lines.row(&Sample { steering, speed_mph, ..sample.clone() }, &mut text)
        }
        None => lines.row(sample, &mut text),
    });
    rows.and_then(|()| fs::write(&log, text)).map_err(Error::io(&log))?;
    let description = folder.unfinished().join(DESCRIPTION_FILE);
    let camera = match &options.car {
        Some(car) => Description { camera: Some(car.into()), ..Description::default() }.to_toml()?,
        None => "[camera]\npreset = \"steersman\"\n".into(),
    };
    fs::write(&description, camera).map_err(Error::io(&description))?;
    let info = RecordingInfo::new(track, options, samples.len());
    info.write(folder.unfinished())?;
    Ok(info)
}
