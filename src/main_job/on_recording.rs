//! The end of `train RECORDING`: what the model is worth on the recordings it was trained on.

use std::path::Path;

use super::job::write_json;
use crate::dataset::{Item, View};
use crate::error::Result;
use crate::observer::StopSignal;
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::replay::{RecordingVerdict, Side, judge};
use crate::training::{Data, RunFolder};

/// Judges the model of the finished run in `folder` on both sides of its split, and writes that to `replay.json` there. Call it
/// inside a rayon pool.
///
/// # Errors
///
/// As [`Pilot::load`] and [`judge`]; [`Error::Data`](crate::Error::Data) if the recordings cannot be read any more;
/// [`Error::Interrupted`](crate::Error::Interrupted) if `stop` is requested.
pub fn judge_run(path: &Path, stop: &StopSignal) -> Result<RecordingVerdict> {
    let folder = RunFolder::open(path)?;
    let (info, recipe) = (folder.info()?, folder.recipe()?);
    let pilot = Pilot::load(&folder.model())?;
    let data = Data::of_run(&info, &recipe, 0)?;
    let sides = sides(&data);
    let new_driver = || {
        let mut pilot = pilot.clone();
        Ok(move |picture: &RgbImage| pilot.steer(picture.view()))
    };
    let verdict = judge(data.driven(), &sides, recipe.full_lock_deg, new_driver, stop)?;
    write_json(path, RunFolder::REPLAY, &verdict)?;
    Ok(verdict)
}

/// Both sides of the split of `data`: the training side, without views that a model met on it, and the validation side if there is
/// one.
pub(super) fn sides(data: &Data) -> Vec<Side> {
    let split = data.split();
    [("training", &split.training), ("validation", &split.validation)]
        .into_iter()
        .filter(|(_, items)| !items.is_empty())
        .map(|(name, items)| {
            let recordings = data.driven().len();
            let of_centre = |item: &&Item| {
                usize::from(item.recording) < recordings && item.cameras().any(|camera| camera == View::Centre)
            };
            let rows = items.iter().filter(of_centre).map(|item| (usize::from(item.recording), item.row as usize));
            Side { name, rows: rows.collect() }
        })
        .collect()
}
