//! The video of a recording: what the camera saw and how the driver steered, beside what a model would have done.

use std::path::Path;

use super::film::{Video, ended_early};
use super::onlooker::Onlooker;
use super::painter::{Captions, FilmFrame, FilmScales, Painter};
use super::summary::VideoSummary;
use crate::dataset::{Recording, View};
use crate::error::{Error, Result};
use crate::observer::{Observer, Progress};
use crate::picture::decode::decode_rgb;
use crate::simulator::car::dynamics::MAX_STEER_DEG;

/// Pictures a second where no session has two rows.
const LONE_ROW_HZ: f64 = 20.0;

/// Writes the video of `recording` to the new file `out`: `fps` pictures a second, or as many as were recorded.
/// Sessions follow each other without the time between them. `observer` is told the share that is done. If it
/// returns [`Error::Interrupted`], what there is by then is written, and the second value is `true`.
///
/// # Errors
///
/// As [`Recording::require_usable`] and [`Video::create`]; [`Error::Io`] and [`Error::Data`] for a picture that cannot be read.
pub fn film(
    recording: &Recording,
    out: &Path,
    mut onlooker: Option<Onlooker>,
    fps: Option<f64>,
    observer: &mut dyn Observer<Progress>,
) -> Result<(VideoSummary, bool)> {
    recording.require_usable()?;
    let full_lock_deg = onlooker.as_ref().map_or(MAX_STEER_DEG, Onlooker::full_lock_deg);
    let own = recording.rate_hz().unwrap_or(LONE_ROW_HZ);
    let names = Captions {
        title: name(&recording.path),
        subtitle: format!("recording, {} rows, {own:.3} Hz", recording.rows.len()).replace(".000", ""),
        model: onlooker.as_ref().map(|_| "model"),
        reference: "driver",
    };
    let angles = recording.rows.iter().map(|row| f64::from(row.steering) * full_lock_deg);
    let scales = FilmScales::covering(angles, std::iter::empty());
    let saliency = onlooker.as_ref().is_some_and(Onlooker::colours);
    let mut video =
        Video::create(out, Painter::new(names, scales, None, saliency), fps.unwrap_or(own.clamp(1.0, 60.0)))?;
    let mut frame = FilmFrame::default();
    let mut session_begins_s = 0.0;
    let (mut stopped, mut unreadable) = (false, 0);
    'sessions: for session in &recording.sessions {
        let first_ms = recording.rows[session.start].time_ms;
        for row in session.clone() {
            let at = &recording.rows[row];
            // One bad picture does not cost the video; without any good one there is none.
            if let Err(error) = read(recording, row, &mut frame) {
                unreadable += 1;
                if unreadable == recording.rows.len() {
                    return Err(error);
                }
                continue;
            }
            let looked = onlooker.as_mut().map(|onlooker| onlooker.look(&mut frame.picture)).transpose()?;
            frame.time_s = session_begins_s + (at.time_ms - first_ms) as f64 / 1000.0;
            frame.model_deg = looked.map(|(deg, _)| deg);
            frame.answered_in = looked.map(|(_, took)| took);
            frame.reference_deg = Some(f64::from(at.steering) * full_lock_deg);
            frame.speed_mph = Some(f64::from(at.speed_mph)).filter(|mph| mph.is_finite());
            video.show(&frame)?;
            if ended_early(observer.observe(Progress((row + 1) as f64 / recording.rows.len() as f64)))? {
                stopped = true;
                break 'sessions;
            }
        }
        session_begins_s += recording.session_s(session) + 1.0 / own;
    }
    let text = if stopped { "stopped" } else { "end of the recording" };
    Ok((VideoSummary { unreadable, ..video.finish(text)? }, stopped))
}

/// The folder of a recording, also where its log was named.
fn name(path: &Path) -> String {
    let folder = if path.is_file() { path.parent().unwrap_or(path) } else { path };
    let folder = folder.canonicalize().unwrap_or(folder.to_path_buf());
    folder.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

fn read(recording: &Recording, row: usize, frame: &mut FilmFrame) -> Result<()> {
    let mut bytes = Vec::new();
    recording.read_picture(row, View::Centre, &mut bytes)?;
    let place = || recording.image_path(row, View::Centre).unwrap_or_default();
    decode_rgb(&bytes, &mut frame.picture).map_err(|message| Error::data(place(), message))
}
