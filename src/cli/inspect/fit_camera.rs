//! `steersman inspect RECORDING --fit-camera`.

use std::path::PathBuf;

use crate::cli::arguments::RecordingArgs;
use crate::cli::terminal::print;
use crate::error::{Error, Result};
use crate::replay::{ReplayLog, fit_camera};

/// Prints the `[camera]` table of the one recording of `paths`: of its side cameras, what is assumed of it, and what the fit found.
pub fn run(paths: &[PathBuf], reading: &RecordingArgs) -> Result<()> {
    let [path] = paths else {
        return Err(Error::Usage("--fit-camera takes one recording, as each may have a camera of its own".into()));
    };
    let recording = reading.load(path)?;
    recording.require_usable()?;
    recording.camera_notice().iter().for_each(|notice| eprintln!("{notice}"));
    let log = ReplayLog::of_any_length(&recording, recording.geometry.clone());
    let fit = fit_camera(&log)?.ok_or_else(|| {
        let message = "no row has the pictures of three cameras at different places, so there is nothing to fit a mount to; say \
                       [camera] in steersman.toml by hand";
        Error::data(path, message)
    })?;
    let car = &fit.geometry;
    let [left_m, right_m] = car.side_offsets_m;
    print(&format!(
        "# Fitted to {} rows: height_m, pitch_deg and roll_deg. The rest is assumed.\n\
         # The side cameras are predicted to {:.1} grey levels; before to {:.1},\n\
         # and by the centre picture as it is to {:.1}.\n\
         [camera]\n\
         image = {:?}\n\
         focal_px = {:?}\n\
         height_m = {:.3}\n\
         ahead_m = {:?}\n\
         pitch_deg = {:.2}\n\
         yaw_deg = {:?}\n\
         roll_deg = {:.2}\n\
         side_offsets_m = [{left_m:?}, {right_m:?}]\n\
         wheelbase_m = {:?}\n\
         full_lock_deg = {:?}\n",
        fit.rows,
        fit.fitted,
        fit.assumed,
        fit.unwarped,
        car.image,
        car.focal_px,
        car.height_m,
        car.ahead_m,
        car.pitch_deg,
        car.yaw_deg,
        car.roll_deg,
        car.wheelbase_m,
        car.full_lock_deg
    ))
}
