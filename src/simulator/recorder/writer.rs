//! The files of a recording: pictures, the log's lines, and a writer that adds one row after the other.

use std::fs::{self, File};
use std::io::{self, Seek as _, SeekFrom, Write as _};
use std::path::{Path, PathBuf};

use crate::dataset::udacity_writer::{HEADER, picture_name, write_row};
use crate::geometry::CarGeometry;
use crate::simulator::camera::foreign_car::{Eye, has_side_cameras};
use crate::simulator::camera::jpeg;
use crate::simulator::camera::pinhole::Mount;
use crate::simulator::recorder::options::LogFormat;
use crate::simulator::recorder::sample::Sample;
use crate::simulator::scenery::light::Variant;
use crate::simulator::scenery::world::World;
use crate::simulator::track::Track;
use crate::{Error, Result};

/// Takes the pictures of rows. Keeps its buffers.
pub(crate) struct Photographer {
    eye: Eye,
    has_sides: bool,
}

/// Whether there are side cameras on `car`, or on the simulator's own.
pub(crate) fn has_sides(car: Option<&CarGeometry>) -> bool {
    car.is_none_or(has_side_cameras)
}

impl Photographer {
    /// With the cameras of `car`, or those of the simulator's own.
    pub fn new(car: Option<&CarGeometry>) -> Photographer {
        Photographer { eye: Eye::new(car), has_sides: has_sides(car) }
    }

    /// The pictures of all cameras as JPEG files, in their order.
    pub fn take(&mut self, world: &World, variant: &Variant, sample: &Sample) -> Result<Vec<Vec<u8>>> {
        let picture = |mount: &Mount| {
            let mut bytes = Vec::new();
            jpeg::encode(self.eye.see(world, variant, &sample.body, *mount), &mut bytes)?;
            Ok(bytes)
        };
        mounts(self.has_sides).iter().map(picture).collect()
    }
}

/// Writes the `pictures` that were taken at the simulated time `time_s` into the folder `images`.
pub(crate) fn write_pictures(pictures: &[Vec<u8>], time_s: f64, images: &Path) -> Result<()> {
    for (mount, bytes) in Mount::ALL.iter().zip(pictures) {
        let path = images.join(image_name(*mount, time_s));
        fs::write(&path, bytes).map_err(Error::io(&path))?;
    }
    Ok(())
}

/// The cameras in the order of the log's columns; the centre camera is the first.
fn mounts(has_sides: bool) -> &'static [Mount] {
    if has_sides { &Mount::ALL } else { &Mount::ALL[..1] }
}

/// Noon of 1 January 2026, UTC, where simulated time begins in names of pictures: ms since 1970.
const BEGIN_MS: u64 = 1_767_268_800_000;

/// Name of the picture of `mount` at the simulated time `time_s`.
fn image_name(mount: Mount, time_s: f64) -> String {
    picture_name(mount.name(), BEGIN_MS + (time_s * 1000.0).round() as u64)
}

/// The lines of a log, in its format.
pub(crate) struct LogLines {
    format: LogFormat,
    /// The folder of the pictures as the log names it.
    images: PathBuf,
    has_sides: bool,
}

impl LogLines {
    /// For a recording in the folder `out`, with side cameras or without.
    pub fn new(format: LogFormat, out: &Path, has_sides: bool) -> Result<LogLines> {
        let images = match format {
            LogFormat::Sample => PathBuf::from("IMG"),
            LogFormat::V2 => std::path::absolute(out).map_err(Error::io(out))?.join("IMG"),
        };
        Ok(LogLines { format, images, has_sides })
    }

    /// What stands above the rows.
    pub fn header(&self) -> &'static str {
        match self.format {
            LogFormat::Sample => HEADER,
            LogFormat::V2 => "",
        }
    }

    /// Appends the line of `sample`.
    pub fn row(&self, sample: &Sample, text: &mut Vec<u8>) -> io::Result<()> {
        let separator = if self.format == LogFormat::Sample { ", " } else { "," };
        let [center, left, right] = Mount::ALL.map(|mount| {
            let name = image_name(mount, sample.time_s);
            match self.format {
                _ if !mounts(self.has_sides).contains(&mount) => String::new(),
                LogFormat::Sample => format!("IMG/{name}"),
                LogFormat::V2 => self.images.join(name).display().to_string(),
            }
        });
        let numbers = [sample.steering, sample.throttle, sample.brake, sample.speed_mph].map(|v| v as f32);
        write_row(text, separator, [&center, &left, &right], numbers)
    }
}

/// Writes a recording while it is driven. A row is in the log only once its pictures are on the disk, so whatever happens,
/// what was written can be read.
pub struct RowWriter<'a> {
    world: &'a World,
    variant: Variant,
    photographer: Photographer,
    images: PathBuf,
    lines: LogLines,
    log: PathBuf,
    file: File,
    /// Bytes of whole lines.
    len: u64,
    /// Time, s, and begin in the log of each row.
    rows: Vec<(f64, u64)>,
    text: Vec<u8>,
}

impl<'a> RowWriter<'a> {
    /// Begins a recording on `track`, in the light that `seed` draws, in the existing folder `folder`, which will be called
    /// `out`.
    ///
    /// # Errors
    /// If the files cannot be created.
    pub fn new(track: &'a Track, seed: u64, format: LogFormat, folder: &Path, out: &Path) -> Result<RowWriter<'a>> {
        let images = folder.join("IMG");
        fs::create_dir(&images).map_err(Error::io(&images))?;
        let lines = LogLines::new(format, out, true)?;
        let log = folder.join("driving_log.csv");
        let mut file = File::create_new(&log).map_err(Error::io(&log))?;
        file.write_all(lines.header().as_bytes()).map_err(Error::io(&log))?;
        let world = track.world();
        Ok(RowWriter {
            world,
            variant: Variant::new(world, seed),
            photographer: Photographer::new(None),
            images,
            len: lines.header().len() as u64,
            lines,
            log,
            file,
            rows: Vec::new(),
            text: Vec::new(),
        })
    }

    /// Takes the pictures of `sample` and adds its line.
    ///
    /// # Errors
    /// If something cannot be written. The rows before stay whole.
    pub fn write(&mut self, sample: &Sample) -> Result<()> {
        let pictures = self.photographer.take(self.world, &self.variant, sample)?;
        write_pictures(&pictures, sample.time_s, &self.images)?;
        self.text.clear();
        let written = self.lines.row(sample, &mut self.text).and_then(|()| self.file.write_all(&self.text));
        if let Err(source) = written {
            // Half a line helps nobody. If it cannot be taken back either, readers count it as unusable.
            let _ = self.file.set_len(self.len);
            return Err(Error::Io { path: self.log.clone(), source });
        }
        self.rows.push((sample.time_s, self.len));
        self.len += self.text.len() as u64;
        Ok(())
    }

    /// Number of rows.
    pub fn rows(&self) -> usize {
        self.rows.len()
    }

    /// Takes all rows behind the first `rows` out of the log, and then their pictures.
    ///
    /// # Errors
    /// If something cannot be changed. No row of the log is without its pictures.
    pub fn keep(&mut self, rows: usize) -> Result<()> {
        let Some(&(_, len)) = self.rows.get(rows) else { return Ok(()) };
        let shortened = self.file.set_len(len).and_then(|()| self.file.seek(SeekFrom::Start(len)));
        shortened.map_err(Error::io(&self.log))?;
        self.len = len;
        for (time_s, _) in self.rows.drain(rows..) {
            for mount in Mount::ALL {
                let path = self.images.join(image_name(mount, time_s));
                fs::remove_file(&path).map_err(Error::io(&path))?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_carry_simulated_time() {
        assert_eq!(image_name(Mount::Left, 0.1), "left_2026_01_01_12_00_00_100.jpg");
        assert_eq!(image_name(Mount::Center, 43_261.02), "center_2026_01_02_00_01_01_020.jpg");
    }
}
