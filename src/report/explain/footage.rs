//! The pictures that a model is examined with: image files, a recording, or a lap of the expert in the simulator.

use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use crate::dataset::{self, Description, ImageCheck, Recording, View};
use crate::error::{Error, Result};
use crate::files::limits::read_up_to;
use crate::picture::RgbImage;
use crate::picture::decode::{MAX_FILE_LEN, decode_rgb, starts_as_image};
use crate::simulator::camera::jpeg::RoundTrip;
use crate::simulator::recorder::expert_drive::drive_expert;
use crate::simulator::recorder::sample::Sample;
use crate::simulator::{Camera, HEIGHT, Mount, RecordOptions, Renderer, RgbFrame, Track, Variant, WIDTH};

/// Where the pictures come from.
pub enum Footage {
    /// Files and rows of recordings.
    Recorded(Vec<Source>),
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

/// A recorded picture.
pub enum Source {
    /// An image file.
    File(PathBuf),
    /// The centre camera's picture of a row.
    Row(Arc<Recording>, usize),
}

/// Buffers for reading or rendering pictures; each thread has its own.
#[derive(Default)]
pub struct FootageBuffers {
    renderer: Renderer,
    frame: RgbFrame,
    jpeg: RoundTrip,
    bytes: Vec<u8>,
}

impl Footage {
    /// Image files and recordings, of which the user says `said`, in their order.
    ///
    /// # Errors
    ///
    /// As [`dataset::load_with`]; [`Error::Io`] for what is not there.
    pub fn of_paths(paths: &[PathBuf], said: &Description) -> Result<Footage> {
        let mut pictures = Vec::new();
        for path in paths {
            if is_picture(path) {
                pictures.push(Source::File(path.clone()));
                continue;
            }
            let recording = dataset::load_with(path, said, ImageCheck::Verify)?;
            recording.require_usable()?;
            let recording = Arc::new(recording);
            pictures.extend((0..recording.rows.len()).map(|row| Source::Row(Arc::clone(&recording), row)));
        }
        Ok(Footage::Recorded(pictures))
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
            Footage::Recorded(pictures) => pictures.len(),
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
            Footage::Recorded(pictures) => match &pictures[i] {
                Source::File(_) => None,
                Source::Row(recording, row) => Some(recording.rows[*row].steering),
            },
            Footage::Drive { samples, .. } => Some(samples[i].steering as f32),
        }
    }

    /// A name for picture `i`.
    pub fn name(&self, i: usize) -> String {
        match self {
            Footage::Recorded(pictures) => match &pictures[i] {
                Source::File(path) => path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                Source::Row(recording, row) => format!("line {}", recording.rows[*row].line),
            },
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
            Footage::Recorded(pictures) => {
                let path = match &pictures[i] {
                    Source::File(path) => {
                        buffers.bytes = read_up_to(path, MAX_FILE_LEN, "a picture")?;
                        path.clone()
                    }
                    Source::Row(recording, row) => {
                        recording.read_picture(*row, View::Centre, &mut buffers.bytes)?;
                        recording.image_path(*row, View::Centre).unwrap_or_default()
                    }
                };
                decode_rgb(&buffers.bytes, image).map_err(|message| Error::data(path, message))
            }
            Footage::Drive { track, variant, samples } => {
                let FootageBuffers { renderer, frame, jpeg, .. } = buffers;
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

/// Whether `path` is an image file, by its first bytes or its name.
fn is_picture(path: &Path) -> bool {
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    let named = ["jpg", "jpeg", "png"].iter().any(|picture| extension == *picture);
    let mut head = Vec::new();
    // Opening a FIFO would wait for ever.
    let regular = std::fs::metadata(path).is_ok_and(|metadata| metadata.is_file());
    let mut read = || File::open(path).and_then(|file| file.take(8).read_to_end(&mut head));
    regular && (named || read().is_ok() && starts_as_image(&head))
}
