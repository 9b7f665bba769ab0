//! Training: the loop, validation, checkpoints, and the run folder that holds what comes of it.
//!
//! | file of the run folder | what it is |
//! |---|---|
//! | `recipe.toml` | the recipe with every entry resolved |
//! | `run.json` | recordings, seed, version: what `--resume` needs besides |
//! | `from.safetensors` | the model that the run began from, with `--from` |
//! | `split.csv` | which row went to which side |
//! | `history.csv` | one line an epoch |
//! | `model.safetensors` | the best model, by validation loss |
//! | `last.safetensors` | the model of the last epoch; with early stopping, in the end the best one |
//! | `checkpoint.safetensors` | where the run stands |
//! | `checksums.txt` | SHA-256 of the text files above, as `sha256sum` writes it; they are checked when they are read |
//! | `.lock` | there while a process works on the run; the system releases it with the process |
//! | `report.html` | the run in pictures; see [`crate::report::pages::run`] |
//! | `result.json` | what `train --json` prints; its presence says that the run is finished |

mod checkpoint;
mod data;
mod history;
mod profile;
mod run_folder;
mod session;
mod transfer;
mod validation;

pub use crate::engine::loss::Loss;
pub use checkpoint::{Progress, State};
pub use data::Data;
pub use history::{EpochRecord, read_history, write_history};
pub use profile::ProfileReport;
pub use run_folder::{RunFolder, RunInfo, RunLock};
pub use session::{TrainRequest, TrainResult, TrainingEvent, resume, train};
pub use transfer::TransferRequest;
pub use validation::{Validation, ValidationResult};
