//! What several commands take: a recipe, a model, recordings, a camera, who gives the throttle, and where the output goes.

mod camera;
mod model;
mod output;
mod recipe;
mod recording;
mod throttle;

pub(crate) use camera::camera_preset;
pub(crate) use model::{load_model, load_pilot, model_file};
pub(crate) use output::{new_folder, refuse_existing};
pub(crate) use recipe::RecipeArgs;
pub(crate) use recording::RecordingArgs;
pub(crate) use throttle::Throttle;
