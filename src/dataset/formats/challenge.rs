//! Udacity's second challenge: logs whose rows are single pictures, with angles in radians at the steering wheel.

use std::path::{Path, PathBuf};

use super::text::Lines;
use super::udacity::{is_header, number_of, split_fields};
use super::{Format, files_ending, only, parent};
use crate::dataset::description::Unit;
use crate::dataset::recording::file_name;
use crate::dataset::rows::{Entry, Rows};
use crate::dataset::store::Store;
use crate::dataset::unusable::Reason;
use crate::{Error, Result};

/// Logs of all cameras: `interpolated.csv`.
pub(super) const FORMAT: Format = Format {
    id: "udacity-challenge-2",
    name: "Udacity challenge 2",
    marks: "a `.csv` with the columns `timestamp`, `frame_id`, `filename`, `angle`; one row a picture",
    labels: "radians of the steering wheel, 400 degrees are full lock; `timestamp` in nanoseconds",
    unit: Unit::WheelRadians,
    hz: 20.0,
    cameras: 3,
    find: |store, path| find(store, path, &["timestamp", "frame_id", "filename", "angle"]),
    base: |_, log| parent(log),
    read,
};

/// Labels of single frames: `frame_id,steering_angle`.
pub(super) const FRAMES: Format = Format {
    id: "udacity-challenge-2-frames",
    name: "Udacity challenge 2, single frames",
    marks: "a `.csv` with the columns `frame_id` and `steering_angle`; pictures `FRAME_ID.jpg` or `.png`",
    labels: "radians of the steering wheel, 400 degrees are full lock; `frame_id` in nanoseconds",
    unit: Unit::WheelRadians,
    hz: 20.0,
    cameras: 1,
    find: |store, path| find(store, path, &["frame_id", "steering_angle"]),
    base: |_, log| parent(log),
    read: read_frames,
};

/// Pictures of the side cameras belong to the centre picture that is at most this far away, in milliseconds.
const MAX_APART_MS: i64 = 50;
/// Miles per hour in a metre per second.
const MPH_PER_MPS: f64 = 2.236_936_3;

/// The columns of `wanted` in a header; `None` if one is not there.
fn columns<const N: usize>(header: &[&str], wanted: [&str; N]) -> Option<[usize; N]> {
    let mut places = [0; N];
    for (place, name) in places.iter_mut().zip(wanted) {
        *place = header.iter().position(|found| found.trim().eq_ignore_ascii_case(name))?;
    }
    Some(places)
}

fn find(store: &Store, path: &Path, wanted: &[&str]) -> Result<Option<PathBuf>> {
    let mut logs = files_ending(store, path, &["csv"])?;
    logs.retain(|log| {
        let Ok(mut lines) = Lines::open(store, log) else { return false };
        let Ok(Some((_, first))) = lines.next() else { return false };
        let header = split_fields(&first, ',');
        is_header(&header) && wanted.iter().all(|name| columns(&header, [*name]).is_some())
    });
    only(path, logs)
}

/// The time of a stamp in nanoseconds, in milliseconds; its digits do not fit into a floating-point number.
fn time_ms(stamp: &str) -> Option<i64> {
    let stamp = stamp.trim();
    let whole = stamp.split('.').next()?;
    let nanoseconds: i64 = whole.parse().ok()?;
    (nanoseconds >= 0).then_some(nanoseconds / 1_000_000)
}

fn read(store: &Store, path: &Path, rows: &mut Rows) -> Result<()> {
    rows.read_from(&file_name(path));
    let mut lines = Lines::open(store, path).map_err(Error::io(path))?;
    let header = lines.next().map_err(Error::io(path))?.map_or_else(String::new, |(_, header)| header.into_owned());
    let header = split_fields(&header, ',');
    let Some([stamp, camera, file, angle]) = columns(&header, ["timestamp", "frame_id", "filename", "angle"]) else {
        return Err(Error::data(path, "the header names no timestamp, frame_id, filename and angle"));
    };
    let speed = columns(&header, ["speed"]).map(|[place]| place);
    let mut centre: Vec<Entry> = Vec::new();
    let mut sides: [Vec<(i64, String)>; 2] = Default::default();
    while let Some((number, text)) = lines.next().map_err(Error::io(path))? {
        if text.trim().is_empty() {
            continue;
        }
        let fields = split_fields(&text, ',');
        let field = |place: usize| fields.get(place).copied().unwrap_or("").trim();
        let parsed = time_ms(field(stamp)).zip(number_of(field(angle)));
        let line = match parsed {
            Some((time_ms, steering)) => {
                let (file, camera) = (field(file).to_owned(), field(camera).to_lowercase());
                let speed_mph = speed.and_then(|place| number_of(field(place))).unwrap_or(f64::NAN) * MPH_PER_MPS;
                match camera.as_str() {
                    camera if camera.starts_with("left") => sides[0].push((time_ms, file)),
                    camera if camera.starts_with("right") => sides[1].push((time_ms, file)),
                    _ => centre.push(Entry {
                        images: [Some(file), None, None],
                        steering,
                        speed_mph: speed_mph as f32,
                        time_ms: Some(time_ms),
                        ..Entry::at(number)
                    }),
                }
                Ok(())
            }
            None => Err(format!("no row of {} fields with a time and an angle", header.len())),
        };
        match line {
            Ok(()) => {}
            Err(detail) => rows.unusable(number, Reason::NotANumber, &detail),
        }
    }
    sides.iter_mut().for_each(|side| side.sort());
    for mut entry in centre {
        let time_ms = entry.time_ms.unwrap_or(0);
        for (side, pictures) in sides.iter().enumerate() {
            let after = pictures.partition_point(|(other, _)| *other < time_ms);
            let near = [after.checked_sub(1), Some(after)].into_iter().flatten().filter_map(|i| pictures.get(i));
            let nearest = near.min_by_key(|(other, _)| (other - time_ms).abs());
            entry.images[side + 1] =
                nearest.filter(|(other, _)| (other - time_ms).abs() <= MAX_APART_MS).map(|(_, file)| file.clone());
        }
        rows.push(entry)?;
    }
    Ok(())
}

fn read_frames(store: &Store, path: &Path, rows: &mut Rows) -> Result<()> {
    rows.read_from(&file_name(path));
    let mut lines = Lines::open(store, path).map_err(Error::io(path))?;
    let header = lines.next().map_err(Error::io(path))?.map_or_else(String::new, |(_, header)| header.into_owned());
    let header = split_fields(&header, ',');
    let Some([frame, angle]) = columns(&header, ["frame_id", "steering_angle"]) else {
        return Err(Error::data(path, "the header names no frame_id and steering_angle"));
    };
    let folder = parent(path);
    let places = [folder.clone(), folder.join("center"), folder.join("IMG")];
    while let Some((number, text)) = lines.next().map_err(Error::io(path))? {
        let fields = split_fields(&text, ',');
        let field = |place: usize| fields.get(place).copied().unwrap_or("").trim();
        let (id, steering) = (field(frame).to_owned(), number_of(field(angle)));
        match steering {
            Some(steering) if !id.is_empty() => {
                let png = format!("{id}.png");
                let is_png = places.iter().any(|place| store.is_file(&place.join(&png)));
                let time_ms = time_ms(&id);
                rows.push(Entry {
                    images: [Some(if is_png { png } else { format!("{id}.jpg") }), None, None],
                    steering,
                    time_ms,
                    ..Entry::at(number)
                })?;
            }
            _ if id.is_empty() => {}
            _ => rows.unusable(number, Reason::NotANumber, "no angle"),
        }
    }
    Ok(())
}
