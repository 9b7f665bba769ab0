//! The pictures that a model is examined with: image files, a recording, or a lap of the expert in the simulator.

use std::path::{Path, PathBuf};

use crate::dataset::{self, View};
use crate::error::{Error, Result};
use crate::files::limits::read_up_to;
use crate::picture::RgbImage;
use crate::picture::decode::{MAX_FILE_LEN, decode_rgb};
use crate::simulator::camera::jpeg::RoundTrip;
use crate::simulator::recorder::expert_drive::drive_expert;
use crate::simulator::recorder::sample::Sample;
use crate::simulator::{Camera, HEIGHT, Mount, RecordOptions, Renderer, RgbFrame, Track, Variant, WIDTH};

/// Where the pictures come from.
pub enum Footage {
    /// Files, with the label where there is one, and a name.
    Files(Vec<(PathBuf, Option<f32>, String)>),
    /// The expert's drive on a track.
    Drive {
        /// The track.
        track: Box<Track>,
        /// Its light.
        variant: Box<Variant>,
        /// Moments of the drive.
        samples: Vec<Sample>,
    },
}

/// Buffers for reading or rendering pictures; each thread has its own.
#[derive(Default)]
pub struct FootageBuffers {
    renderer: Renderer,
    frame: RgbFrame,
    jpeg: RoundTrip,
}

impl Footage {
    /// Image files and recordings, in their order.
    ///
    /// # Errors
    ///
    /// As [`dataset::load`]; [`Error::Io`] for what is not there.
    pub fn of_paths(paths: &[PathBuf]) -> Result<Footage> {
        let mut files = Vec::new();
        for path in paths {
            let metadata = std::fs::metadata(path).map_err(Error::io(path))?;
            let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
            if metadata.is_dir() || extension == "csv" || extension == "json" {
                let recording = dataset::load(path)?;
                recording.require_usable()?;
                for row in 0..recording.rows.len() {
                    if let Some(image) = recording.image_path(row, View::Centre) {
                        let name = format!("line {}", recording.rows[row].line);
                        files.push((image, Some(recording.rows[row].steering), name));
                    }
                }
            } else {
                files.push((path.clone(), None, path.file_name().unwrap_or_default().to_string_lossy().into_owned()));
            }
        }
        Ok(Footage::Files(files))
    }

    /// A lap of the expert on the track called `name`, drawn by `seed`.
    ///
    /// # Errors
    ///
    /// As [`Track::load`].
    pub fn of_track(name: &str, seed: u64) -> Result<Footage> {
        let track = Track::load(name)?;
        let samples = drive_expert(&track, &RecordOptions { seed, ..Default::default() });
        let variant = Box::new(Variant::new(track.world(), seed));
        Ok(Footage::Drive { track: Box::new(track), variant, samples })
    }

    /// Number of pictures.
    pub fn len(&self) -> usize {
        match self {
            Footage::Files(files) => files.len(),
            Footage::Drive { samples, .. } => samples.len(),
        }
    }

    /// Whether there is no picture.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Steering of the recorded driver, or of the expert, at picture `i`.
    pub fn label(&self, i: usize) -> Option<f32> {
        match self {
            Footage::Files(files) => files[i].1,
            Footage::Drive { samples, .. } => Some(samples[i].steering as f32),
        }
    }

    /// A name for picture `i`.
    pub fn name(&self, i: usize) -> String {
        match self {
            Footage::Files(files) => files[i].2.clone(),
            Footage::Drive { track, samples, .. } => format!("{} at {:.1} s", track.name(), samples[i].time_s),
        }
    }

    /// Picture `i`.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] for a file that cannot be read or is no image.
    pub fn picture(&self, i: usize, buffers: &mut FootageBuffers, image: &mut RgbImage) -> Result<()> {
        match self {
            Footage::Files(files) => {
                let path: &Path = &files[i].0;
                let bytes = read_up_to(path, MAX_FILE_LEN, "a picture")?;
                decode_rgb(&bytes, image).map_err(|message| Error::data(path, message))
            }
            Footage::Drive { track, variant, samples } => {
                let FootageBuffers { renderer, frame, jpeg } = buffers;
                let view = Camera::new(&samples[i].body, Mount::Center);
                renderer.render(track.world(), variant, &view, Mount::Center, frame);
                jpeg.apply(frame)?;
                (image.height, image.width) = (HEIGHT, WIDTH);
                image.pixels.clone_from(&frame.pixels);
                Ok(())
            }
        }
    }
}
