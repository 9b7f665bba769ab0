//! Training: the loop over epochs, validation, checkpoints, and the run folder with the results.
//!
//! | file of the run folder | content |
//! |---|---|
//! | `recipe.toml` | the recipe with every entry resolved |
//! | `run.json` | recordings, seed, version: the rest of what `--resume` needs |
//! | `from.safetensors` | the model that the run began from, with `--from` |
//! | `split.csv` | which row went to which side |
//! | `history.csv` | one line an epoch |
//! | `model.safetensors` | the best model, by validation loss |
//! | `last.safetensors` | the model of the last epoch; with early stopping, in the end the best one |
//! | `checkpoint.safetensors` | the state of the run, from which it resumes |
//! | `checksums.txt` | SHA-256 of the text files above, as `sha256sum` writes it; they are checked when they are read |
//! | `.lock` | there while a process works on the run; the system releases it with the process |
//! | `report.html` | the run in pictures; see [`crate::report::pages::run`] |
//! | `replay.json` | what the model is worth on its recordings: errors, and drives on their pictures |
//! | `result.json` | what `train --json` prints; its presence says that the run is finished |

mod averaged;
mod begin;
mod checkpoint;
mod data;
mod history;
mod outcome;
mod pace;
mod profile;
mod request;
mod run;
mod run_folder;
mod together;
mod transfer;
mod validation;

pub use crate::engine::loss::Loss;
pub use begin::{resume, resume_with, train};
pub(crate) use data::Data;
pub use history::{EpochRecord, read_history};
pub use pace::{Pace, PaceNow};
pub use profile::ProfileReport;
pub use request::{DEFAULT_CACHE_MIB, TrainRequest, TrainResult, TrainingEvent, TransferRequest};
pub(crate) use run_folder::{NewRun, RunFolder, RunInfo};
pub use together::take_part;
