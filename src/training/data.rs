//! The data of a run: recordings, split, and the loaders of both sides.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::ArrayView4;
use sha2::{Digest, Sha256};

use super::run_folder::RunInfo;
use crate::dataset::cache::{CacheSpec, Overflow};
use crate::dataset::leak::LeakAudit;
use crate::dataset::loader::{Batch, Loader, LoaderSpec};
use crate::dataset::split::{Split, split};
use crate::dataset::takeover;
use crate::dataset::whole::split_whole;
use crate::dataset::{self, Description, DrivenSessions, ImageCheck, Item, Recording, Targets, View};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};
use crate::files::atomic_file;
use crate::geometry::LookAhead;
use crate::recipe::Recipe;

/// The images of the share of `batch`, `(n, c, h, w)`, for a network whose input is `input`.
pub(super) fn images(input: Shape, batch: &Batch) -> ArrayView4<'_, f32> {
    ArrayView4::from_shape(input.batch(batch.share.len()), &batch.x)
        .expect("a loader makes images of the network's input shape")
}

/// Where the recordings of a run are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sources<'a> {
    /// Those that are split, or trained on if there are some to validate on.
    pub paths: &'a [PathBuf],
    /// The validation side, if not a share of the rows of the first.
    pub validate: &'a [PathBuf],
    /// Views that a model met, which are always trained on.
    pub also: &'a [PathBuf],
    /// The simulator's set, of which each epoch draws some.
    pub simulator: &'a [PathBuf],
}

/// Recordings that have been read and split.
#[derive(Debug)]
pub(crate) struct Data {
    recordings: Arc<[Recording]>,
    /// The number of those that can be driven on, and of those before the simulator's.
    driven: usize,
    simulated: usize,
    targets: Arc<Targets>,
    split: Split,
    leak: LeakAudit,
    loader: LoaderSpec,
    notices: Vec<String>,
}

impl Data {
    /// The data of the run `info`, with `cache_mib` for decoded images.
    ///
    /// # Errors
    ///
    /// As [`Data::prepare`].
    pub fn of_run(info: &RunInfo, recipe: &Recipe, cache_mib: usize) -> Result<Data> {
        let sources =
            Sources { paths: &info.recordings, validate: &info.validate, also: &info.also, simulator: &info.simulator };
        Data::prepare(sources, &info.said, recipe, info.seed, cache_mib)
    }

    /// Reads the recordings, of which the user says `said`, and splits them as `recipe` says; with recordings to validate on, these
    /// are the validation side and all others the training side.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] and [`Error::Data`] for recordings that cannot be used, or if a side would be empty.
    pub fn prepare(
        Sources { paths, validate, also, simulator }: Sources,
        said: &Description,
        recipe: &Recipe,
        seed: u64,
        cache_mib: usize,
    ) -> Result<Data> {
        let mut recordings = Vec::new();
        let mut notices = Vec::new();
        // What the user says of the recordings does not count for views and drives, which steersman wrote itself.
        let of_own = Description::default();
        let of_user = paths.iter().chain(validate).map(|path| (path, said));
        for (path, said) in of_user.chain(also.iter().chain(simulator).map(|path| (path, &of_own))) {
            let mut recording = dataset::load_with(path, said, ImageCheck::Verify)?;
            recording.require_usable()?;
            recording.hash_pictures();
            notices.extend(recording.notices_for(&recipe.preprocessing));
            recordings.push(recording);
        }
        let driven = paths.len() + validate.len();
        let simulated = driven + also.len();
        let [of_user, views, drives] =
            [&recordings[..driven], &recordings[driven..simulated], &recordings[simulated..]];
        let targets = recipe.targets(of_user, views, drives)?;
        notices.extend_from_slice(targets.notices());
        let mut split = match validate {
            [] => split(&recordings[..driven], &targets, &recipe.split, &recipe.samples, &recipe.balance, seed)?,
            _ => {
                let of_split = &recordings[..driven];
                split_whole(of_split, paths.len(), &targets, &recipe.samples, &recipe.balance, seed)?
            }
        };
        split.train_on(&recordings[..simulated], driven, &targets)?;
        let taken_over = takeover::weigh(&mut split, &recordings, &recipe.samples, seed)?;
        if taken_over > 0 {
            let weight = recipe.samples.takeover_weight;
            split.notices.push(format!("{taken_over} training rows in which a person took over count {weight} times"));
        }
        if !simulator.is_empty() {
            split.draw_from(&recordings, simulated, &targets, &recipe.samples, &recipe.balance, seed)?;
            split.notices.push(format!(
                "the simulator's set of {} recordings is trained on as well: of its {} rows each epoch draws so many images that \
                 they are {:.0} % of it (samples.simulator_share)",
                simulator.len(),
                split.simulator.len(),
                100.0 * recipe.samples.simulator_share
            ));
        }
        notices.push(split.summary());
        let leak = LeakAudit::of(&split, &recordings);
        notices.push(leak.summary());
        let loader = LoaderSpec {
            preprocessing: recipe.preprocessing.clone(),
            samples: recipe.samples.clone(),
            augmentation: recipe.augmentation.clone(),
            batch: recipe.batch,
            seed,
            cache: CacheSpec {
                memory_bytes: cache_mib.saturating_mul(1 << 20),
                overflow: Overflow::File,
                folder: None,
            },
        };
        Ok(Data {
            recordings: recordings.into(),
            driven,
            simulated,
            targets: targets.into(),
            split,
            leak,
            loader,
            notices,
        })
    }

    /// Messages for the user about the recordings and the split.
    pub fn notices(&self) -> &[String] {
        &self.notices
    }

    /// The recordings, in the order of the command line; then views that a model met, then the simulator's.
    pub fn recordings(&self) -> &[Recording] {
        &self.recordings
    }

    /// All but those of the simulator's set.
    pub fn without_simulator(&self) -> &[Recording] {
        &self.recordings[..self.simulated]
    }

    /// Those of them that were driven along a path, not views that a model met.
    pub fn driven(&self) -> &[Recording] {
        &self.recordings[..self.driven]
    }

    /// The labels of the recordings.
    pub fn targets(&self) -> &Targets {
        &self.targets
    }

    /// Both sides.
    pub fn split(&self) -> &Split {
        &self.split
    }

    /// Share of validation rows with a training row of the same session within a second, in percent.
    pub fn leak_percent(&self) -> f64 {
        100.0 * self.leak.share()
    }

    /// [`Recording::row_id`] of each training row, sorted.
    pub fn training_row_ids(&self) -> Vec<u64> {
        let mut ids: Vec<u64> = self.split.trained_on().map(|item| self.row_id(item)).collect();
        ids.sort_unstable();
        ids.dedup();
        ids
    }

    /// The number of validation rows whose [`Recording::row_id`] is among the sorted `rows`, and the number of all validation rows.
    pub fn validation_rows_among(&self, rows: &[u64]) -> (usize, usize) {
        let mut ids: Vec<u64> = self.split.validation.iter().map(|item| self.row_id(item)).collect();
        ids.sort_unstable();
        ids.dedup();
        (ids.iter().filter(|id| rows.binary_search(id).is_ok()).count(), ids.len())
    }

    /// A hash over the rows of both sides, and over what their labels go by beside the recorded steering: geometry, path and time, in hexadecimal digits.
    pub fn rows_hash(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(self.targets.geometry_text());
        let sides = [&self.split.training, &self.split.validation];
        let simulator = Some(&self.split.simulator).filter(|rows| !rows.is_empty());
        for side in sides.into_iter().chain(simulator) {
            hash.update((side.len() as u64).to_le_bytes());
            for item in side {
                hash.update(self.row_id(item).to_le_bytes());
                self.targets.hash(
                    *item,
                    self.recordings[usize::from(item.recording)].rows[item.row as usize].steering,
                    &mut |bits| {
                        hash.update(bits.to_le_bytes());
                    },
                );
                item.cameras().for_each(|camera| hash.update([camera as u8]));
            }
        }
        self.split.times.iter().for_each(|times| hash.update(times.to_le_bytes()));
        hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
    }

    /// A hash over the pictures of both sides, in hexadecimal digits: the bytes of those of the centre camera, the lengths of
    /// the files of the others.
    pub fn pictures_hash(&self) -> String {
        let mut hash = Sha256::new();
        for item in self.split.training.iter().chain(&self.split.validation).chain(&self.split.simulator) {
            let recording = &self.recordings[usize::from(item.recording)];
            hash.update(recording.picture_hash(item.row as usize).unwrap_or_default().to_le_bytes());
            for camera in item.cameras().filter(|camera| *camera != View::Centre) {
                hash.update(recording.picture_len(item.row as usize, camera).to_le_bytes());
            }
        }
        hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
    }

    /// The steering that follows the driven path, for each row of each recording where there is one.
    ///
    /// # Errors
    ///
    /// [`Error::Data`] if no row of the validation side has one.
    pub fn path_labels(&self) -> Result<Vec<Vec<Option<f32>>>> {
        let labels = |recording: &Recording| {
            let geometry = recording.geometry.clone();
            let look_ahead = LookAhead::usual(&geometry);
            DrivenSessions::of(recording, geometry).path_labels(look_ahead)
        };
        let labels: Vec<Vec<Option<f32>>> = self.recordings.iter().map(labels).collect();
        let validation = &self.split.validation;
        if !validation.is_empty()
            && validation.iter().all(|item| labels[usize::from(item.recording)][item.row as usize].is_none())
        {
            let message = "keep_by = \"path\": no validation row has a path ahead of it, because the car stands or the sessions are \
                           too short; keep_by = \"loss\" needs none";
            return Err(Error::Data { place: "the recordings".into(), message: message.into() });
        }
        Ok(labels)
    }

    /// Writes `split.csv`: recording, line of its log, side (`simulator` for rows of its set, which are trained on too), cameras,
    /// steering.
    ///
    /// # Errors
    ///
    /// [`Error::Io`].
    pub fn write_split(&self, path: &Path) -> Result<()> {
        let failed = |e: csv::Error| Error::data(path, e.to_string());
        let mut writer = csv::Writer::from_writer(Vec::new());
        writer.write_record(["recording", "line", "side", "cameras", "steering"]).map_err(failed)?;
        for (side, items) in [
            ("training", &self.split.training),
            ("simulator", &self.split.simulator),
            ("validation", &self.split.validation),
        ] {
            for item in items {
                let recording = &self.recordings[usize::from(item.recording)];
                let row = &recording.rows[item.row as usize];
                let cameras: Vec<_> = item.cameras().map(|camera| camera.name()).collect();
                let (path, line) = (recording.path.display().to_string(), row.line.to_string());
                let (cameras, steering) = (cameras.join(" "), row.steering.to_string());
                writer.write_record([path.as_str(), &line, side, &cameras, &steering]).map_err(failed)?;
            }
        }
        let bytes = writer.into_inner().map_err(|e| Error::data(path, e.to_string()))?;
        atomic_file::write(path, &bytes)
    }

    /// The loaders of both sides; no validation loader if nothing is held out.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if the cache file cannot be created.
    pub fn into_loaders(self) -> Result<(Loader, Option<Loader>)> {
        let (training, validation) = Loader::pair(&self.recordings, &self.targets, &self.split, &self.loader)?;
        Ok((training, (validation.images() > 0).then_some(validation)))
    }

    fn row_id(&self, item: &Item) -> u64 {
        self.recordings[usize::from(item.recording)].row_id(item.row as usize)
    }
}
