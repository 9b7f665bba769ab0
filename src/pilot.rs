//! A trained model at the wheel: image in, steering out.

use std::path::Path;
use std::sync::Arc;

use steersman_kernels::Isa;

use crate::dataset::preprocess::Preprocessor;
use crate::engine::network::{InferencePlan, Network, ObservationPlan, Parameters};
use crate::error::{Error, Result};
use crate::files::limits::read_up_to;
use crate::model_file::Model;
use crate::picture::{
    RgbImage,
    decode::{MAX_FILE_LEN, MAX_SIDE, decode_rgb_within},
};
use crate::recipe::Recipe;
use crate::simulator::{DriveState, Driver, HEIGHT, RgbFrame, WIDTH};

/// A model with everything planned to predict one image after the other on the calling thread.
///
/// The same code evaluates recordings, answers `predict` and drives, so all of them see an image alike. After the first image
/// of a size nothing is allocated. Clones share the network; give each thread its own.
///
/// ```no_run
/// use std::path::Path;
/// use steersman::pilot::Pilot;
///
/// let mut pilot = Pilot::load(Path::new("runs/lenet-1/model.safetensors"))?;
/// let jpeg = std::fs::read("frame.jpg").unwrap();
/// let steering = pilot.steer_encoded(&jpeg)?;
/// println!("{steering:+.3}, that is {:+.1} degrees", pilot.recipe().full_lock_deg * f64::from(steering));
/// # Ok::<(), steersman::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct Pilot {
    model: Arc<Loaded>,
    plan: InferencePlan,
    /// Planned when somebody first wants to see what the layers make of an image.
    observation: Option<ObservationPlan>,
    preprocessor: Preprocessor,
    image: RgbImage,
    planes: Vec<u8>,
    input: Vec<f32>,
}

/// What the clones of a pilot share.
#[derive(Debug)]
struct Loaded {
    recipe: Recipe,
    network: Network,
    parameters: Parameters,
    trained_on_held_out: Vec<String>,
}

impl Pilot {
    /// The pilot of the model file `path`.
    ///
    /// # Errors
    ///
    /// As [`Model::load`].
    pub fn load(path: &Path) -> Result<Pilot> {
        Pilot::new(Model::load(path)?, Isa::best())
    }

    /// The pilot of `model`, with the vector code of `isa`.
    ///
    /// # Errors
    ///
    /// [`Error::Network`] if the recipe's layers do not fit.
    pub fn new(model: Model, isa: Isa) -> Result<Pilot> {
        let Model { recipe, parameters, record, .. } = model;
        let trained_on_held_out = record.trained_on_held_out;
        let network = recipe.network(isa)?;
        let [height, width] = recipe.preprocessing.source;
        let mut plan = InferencePlan::new(&network, 1);
        plan.prepare(&network, &parameters);
        Ok(Pilot {
            plan,
            observation: None,
            preprocessor: recipe.preprocessing.plan(height, width)?,
            image: RgbImage::default(),
            planes: vec![0; recipe.preprocessing.output_len()],
            input: vec![0.0; recipe.preprocessing.output_len()],
            model: Arc::new(Loaded { recipe, network, parameters, trained_on_held_out }),
        })
    }

    /// How the model was made.
    pub fn recipe(&self) -> &Recipe {
        &self.model.recipe
    }

    /// Held-out tracks that the model was trained on all the same.
    pub fn trained_on_held_out(&self) -> &[String] {
        &self.model.trained_on_held_out
    }

    /// The network that steers.
    pub fn network(&self) -> &Network {
        &self.model.network
    }

    /// The numbers of the network.
    pub fn parameters(&self) -> &Parameters {
        &self.model.parameters
    }

    /// Steering for an RGB image, `[height][width][3]`. Roughly in [−1, 1], positive to the right; not clamped.
    ///
    /// # Errors
    ///
    /// [`Error::Input`] if the image has no pixels, or not as many as it says.
    pub fn steer(&mut self, height: usize, width: usize, rgb: &[u8]) -> Result<f32> {
        self.look_at(height, width, rgb)?;
        let mut steering = [0.0];
        self.plan.run_prepared(&self.model.network, &self.model.parameters, &self.input, &mut steering);
        Ok(steering[0])
    }

    /// As [`steer`](Self::steer), telling `seen` the place of each layer that computes something, and its output.
    ///
    /// # Errors
    ///
    /// As [`steer`](Self::steer).
    pub fn steer_observed(
        &mut self,
        height: usize,
        width: usize,
        rgb: &[u8],
        seen: &mut dyn FnMut(usize, &[f32]),
    ) -> Result<f32> {
        self.look_at(height, width, rgb)?;
        let Loaded { network, parameters, .. } = &*self.model;
        let mut steering = [0.0];
        let plan = self.observation.get_or_insert_with(|| ObservationPlan::new(network));
        plan.run(network, parameters, &self.input, &mut steering, seen);
        Ok(steering[0])
    }

    /// Makes the network's input of an RGB image.
    fn look_at(&mut self, height: usize, width: usize, rgb: &[u8]) -> Result<()> {
        if rgb.len() != height * width * 3 {
            return Err(Error::Input(format!("{} bytes are no RGB image of {width}x{height} pixels", rgb.len())));
        }
        if self.preprocessor.image_size() != [height, width] {
            self.preprocessor = self.model.recipe.preprocessing.plan(height, width)?;
        }
        self.preprocessor.apply(rgb, &mut self.planes);
        self.model.recipe.preprocessing.to_input(&self.planes, &mut self.input);
        Ok(())
    }

    /// Steering for a JPEG or PNG image.
    ///
    /// # Errors
    ///
    /// [`Error::Codec`] that says what is wrong with the image.
    pub fn steer_encoded(&mut self, bytes: &[u8]) -> Result<f32> {
        self.steer_encoded_within(bytes, MAX_SIDE)
    }

    /// [`Pilot::steer_encoded`] for images of strangers: one that is higher or wider than `max_side` pixels is an error.
    ///
    /// # Errors
    ///
    /// As [`Pilot::steer_encoded`].
    pub fn steer_encoded_within(&mut self, bytes: &[u8], max_side: usize) -> Result<f32> {
        let mut image = std::mem::take(&mut self.image);
        let steering = match decode_rgb_within(bytes, max_side, &mut image) {
            Ok(()) => self.steer(image.height, image.width, &image.pixels),
            Err(message) => Err(Error::Codec(message)),
        };
        self.image = image;
        steering
    }

    /// Steering for an image file.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if it cannot be read, [`Error::Data`] if it is no image.
    pub fn steer_file(&mut self, path: &Path) -> Result<f32> {
        let bytes = read_up_to(path, MAX_FILE_LEN, "a picture")?;
        self.steer_encoded(&bytes).map_err(|e| match e {
            Error::Codec(message) | Error::Input(message) => Error::data(path, message),
            other => other,
        })
    }
}

impl Driver for Pilot {
    fn steer(&mut self, frame: &RgbFrame, _: &DriveState) -> f32 {
        // A frame always has the size it says, so this cannot fail; the simulator takes what is no number as straight ahead.
        Pilot::steer(self, HEIGHT, WIDTH, &frame.pixels).unwrap_or(f32::NAN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model_file::TrainingRecord;

    fn pilot(name: &str) -> Pilot {
        let recipe = Recipe::find(name, &[]).unwrap();
        let parameters = recipe.network(Isa::best()).unwrap().initialize(1);
        let record = TrainingRecord::default();
        Pilot::new(Model { recipe, parameters, record, training_rows: vec![] }, Isa::best()).unwrap()
    }

    #[test]
    fn every_recipe_steers_an_image_of_any_size() {
        let mut pixel = 0u8;
        let mut picture = |len: usize| -> Vec<u8> {
            (0..len)
                .map(|_| {
                    pixel = pixel.wrapping_mul(41).wrapping_add(17);
                    pixel
                })
                .collect()
        };
        let (usual, small) = (picture(160 * 320 * 3), picture(120 * 160 * 3));
        for (name, _) in crate::recipe::SHIPPED {
            let mut pilot = pilot(name);
            let first = pilot.steer(160, 320, &usual).unwrap();
            assert!(pilot.steer(120, 160, &small).unwrap().is_finite());
            assert_eq!(
                pilot.steer(160, 320, &usual).unwrap(),
                first,
                "{name}: an image must not depend on earlier ones"
            );
        }
    }

    #[test]
    fn what_is_no_image_is_an_error() {
        let mut pilot = pilot("lenet");
        assert!(pilot.steer(160, 320, &[0; 7]).is_err());
        assert!(pilot.steer(0, 0, &[]).is_err());
        assert_eq!(pilot.steer_encoded(b"GIF89a").unwrap_err().to_string(), "neither a JPEG nor a PNG image");
    }
}
