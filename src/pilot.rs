//! A trained model at the wheel: image in, steering out, and throttle or speed of models that give one.

use std::path::Path;
use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView3, ArrayView4, ArrayViewD, ArrayViewMut1, Axis};
use rayon::prelude::*;
use steersman_kernels::Isa;

use crate::cluster::message::Message;
use crate::dataset::OutputKind;
use crate::dataset::preprocess::Preprocessor;
use crate::engine::network::{Network, ObservationPlan, Parameters, Predictor};
use crate::error::{Error, Result};
use crate::files::limits::read_up_to;
use crate::model_file::{Model, TrainingRecord};
use crate::picture::{
    RgbImage,
    decode::{MAX_FILE_LEN, MAX_SIDE, decode_rgb_within},
};
use crate::recipe::Recipe;

/// What a model answers for an image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Answer {
    /// Steering: roughly in [−1, 1], positive to the right; not clamped.
    pub steering: f32,
    /// Throttle: roughly in [−1, 1], negative to brake; not clamped. Of models with such an output.
    pub throttle: Option<f32>,
    /// Speed to drive at, as a share of [`Outputs::top_speed_mph`](crate::dataset::Outputs::top_speed_mph); not clamped. Of models with
    /// such an output.
    pub speed: Option<f32>,
}

/// A model that predicts the steering of one image after the other on the calling thread.
///
/// The same code evaluates recordings, answers `predict` and drives, so all of them see an image alike. Clones share the network;
/// give each thread its own.
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
    about: Arc<About>,
    predictor: Predictor,
    /// Planned on the first call that observes the layers.
    observation: Option<ObservationPlan>,
    preprocessor: Preprocessor,
    /// A decoded image file.
    image: RgbImage,
    /// An image of the caller that is not contiguous, in standard order.
    pixels: Vec<u8>,
    /// The preprocessed image, before scaling.
    planes: Vec<u8>,
    /// Input of the network.
    input: Vec<f32>,
    /// Outputs of the network.
    outputs: Vec<f32>,
}

/// What the clones of a pilot share beside the network.
#[derive(Debug)]
struct About {
    recipe: Recipe,
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
        Ok(Pilot {
            predictor: Predictor::new(network, parameters, 1),
            observation: None,
            preprocessor: recipe.preprocessing.plan(height, width)?,
            image: RgbImage::default(),
            planes: vec![0; recipe.preprocessing.output_len()],
            input: vec![0.0; recipe.preprocessing.output_len()],
            pixels: Vec::new(),
            outputs: vec![0.0; recipe.outputs.count()],
            about: Arc::new(About { recipe, trained_on_held_out }),
        })
    }

    /// The recipe of the model.
    pub fn recipe(&self) -> &Recipe {
        &self.about.recipe
    }

    /// Held-out tracks that the model was trained on nevertheless.
    pub fn trained_on_held_out(&self) -> &[String] {
        &self.about.trained_on_held_out
    }

    /// The network that steers.
    pub fn network(&self) -> &Network {
        self.predictor.network()
    }

    /// The parameters of the network.
    pub fn parameters(&self) -> &Parameters {
        self.predictor.parameters()
    }

    /// The tensor `name` of the network, as in `conv1.weight`: an array of its shape, `(out, in, kh, kw)` for a convolution.
    /// [`Network::tensors`] lists the names.
    pub fn weights(&self, name: &str) -> Option<ArrayViewD<'_, f32>> {
        Some(self.parameters().array(self.network().tensor(name)?))
    }

    /// Steering for an RGB image, `(height, width, 3)`: roughly in [−1, 1], positive to the right; not clamped.
    ///
    /// An image that is contiguous in standard order is read where it lies, any other is copied first. After the first image of a
    /// size nothing is allocated.
    ///
    /// # Errors
    ///
    /// [`Error::Input`] if the image has no pixels, or not three colours.
    pub fn steer(&mut self, image: ArrayView3<u8>) -> Result<f32> {
        Ok(self.answer(image)?.steering)
    }

    /// All that the model answers for an RGB image; see [`steer`](Self::steer).
    ///
    /// # Errors
    ///
    /// As [`steer`](Self::steer).
    pub fn answer(&mut self, image: ArrayView3<u8>) -> Result<Answer> {
        self.preprocess(image)?;
        self.run_network();
        Ok(self.last_answer())
    }

    /// The outputs for the network's input.
    fn run_network(&mut self) {
        let input = ArrayView4::from_shape(self.predictor.network().input().batch(1), &self.input);
        let input = input.expect("preprocessing gives an image of the network's input shape");
        self.predictor.run(input, ArrayViewMut1::from(&mut self.outputs));
    }

    /// The outputs of the last call by their names.
    fn last_answer(&self) -> Answer {
        let output = |kind| self.about.recipe.outputs.index(kind).map(|index| self.outputs[index]);
        Answer { steering: self.outputs[0], throttle: output(OutputKind::Throttle), speed: output(OutputKind::Speed) }
    }

    /// Steering for each of `images`, `(n, height, width, 3)`; the images are shared out over the rayon pool. The bits are those of
    /// [`steer`](Self::steer).
    ///
    /// # Errors
    ///
    /// As [`steer`](Self::steer).
    pub fn predict(&self, images: ArrayView4<u8>) -> Result<Array1<f32>> {
        let steer = |pilot: &mut Pilot, index: usize| pilot.steer(images.index_axis(Axis(0), index));
        let steering = (0..images.len_of(Axis(0))).into_par_iter().map_init(|| self.clone(), steer);
        Ok(Array1::from(steering.collect::<Result<Vec<f32>>>()?))
    }

    /// All outputs for each of `images`, `(n, height, width, 3)`, as `(n, outputs)` in the order of the recipe's `outputs`.
    ///
    /// # Errors
    ///
    /// As [`steer`](Self::steer).
    pub fn predict_outputs(&self, images: ArrayView4<u8>) -> Result<Array2<f32>> {
        let (n, outputs) = (images.len_of(Axis(0)), self.outputs.len());
        let mut all = Array2::zeros((n, outputs));
        let rows = all.as_slice_mut().expect("a new array is in standard order").par_chunks_exact_mut(outputs);
        rows.enumerate()
            .map_init(
                || self.clone(),
                |pilot, (index, row)| {
                    pilot.answer(images.index_axis(Axis(0), index))?;
                    row.copy_from_slice(&pilot.outputs);
                    Ok(())
                },
            )
            .collect::<Result<()>>()?;
        Ok(all)
    }

    /// [`steer`](Self::steer) that calls `seen` with the index in [`Network::layers`] and the output, `[c][h][w]`, of each layer that
    /// computes something. The answer has the bits of `steer`; what is seen is computed apart, layer by layer, up to rounding.
    ///
    /// # Errors
    ///
    /// As [`steer`](Self::steer).
    pub fn steer_observed(&mut self, image: ArrayView3<u8>, seen: &mut dyn FnMut(usize, &[f32])) -> Result<f32> {
        self.preprocess(image)?;
        let (network, parameters) = (self.predictor.network(), self.predictor.parameters());
        let plan = self.observation.get_or_insert_with(|| ObservationPlan::new(network));
        plan.run(network, parameters, &self.input, &mut self.outputs, seen);
        // The network runs a second time, in its plan: layers that run as one round otherwise than one by one, so the answer of the
        // first pass may differ in its last bits, and in its plan they never write what is between them, which is to be seen.
        self.run_network();
        Ok(self.outputs[0])
    }

    /// Writes the network's input for an RGB image.
    fn preprocess(&mut self, image: ArrayView3<u8>) -> Result<()> {
        let (height, width, colours) = image.dim();
        if colours != 3 || image.is_empty() {
            let found = format!("({height}, {width}, {colours})");
            return Err(Error::Input(format!("an RGB image has the shape (height, width, 3), not {found}")));
        }
        if self.preprocessor.image_size() != [height, width] {
            self.preprocessor = self.about.recipe.preprocessing.plan(height, width)?;
        }
        let rgb = match image.to_slice() {
            Some(rgb) => rgb,
            None => {
                self.pixels.clear();
                self.pixels.extend(image);
                &self.pixels
            }
        };
        self.preprocessor.apply(rgb, &mut self.planes);
        self.about.recipe.preprocessing.to_input(&self.planes, &mut self.input);
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
        Ok(self.answer_encoded_within(bytes, max_side)?.steering)
    }

    /// All that the model answers for a JPEG or PNG image of at most `max_side` pixels in height and width.
    ///
    /// # Errors
    ///
    /// As [`Pilot::steer_encoded`].
    pub fn answer_encoded_within(&mut self, bytes: &[u8], max_side: usize) -> Result<Answer> {
        let mut image = std::mem::take(&mut self.image);
        let answer = match decode_rgb_within(bytes, max_side, &mut image) {
            Ok(()) => self.answer(image.view()),
            Err(message) => Err(Error::Codec(message)),
        };
        self.image = image;
        answer
    }

    /// Steering for an image file.
    ///
    /// # Errors
    ///
    /// [`Error::Io`] if it cannot be read, [`Error::Data`] if it is no image.
    pub fn steer_file(&mut self, path: &Path) -> Result<f32> {
        Ok(self.answer_file(path)?.steering)
    }

    /// All that the model answers for an image file.
    ///
    /// # Errors
    ///
    /// As [`Pilot::steer_file`].
    pub fn answer_file(&mut self, path: &Path) -> Result<Answer> {
        let bytes = read_up_to(path, MAX_FILE_LEN, "a picture")?;
        self.answer_encoded_within(&bytes, MAX_SIDE).map_err(|e| match e {
            Error::Codec(message) | Error::Input(message) => Error::data(path, message),
            other => other,
        })
    }
}

/// As a model file, which knows of the training only the held-out tracks.
impl Message for Pilot {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let record =
            TrainingRecord { trained_on_held_out: self.trained_on_held_out().to_vec(), ..TrainingRecord::default() };
        let (recipe, parameters) = (self.recipe().clone(), self.parameters().clone());
        Model { recipe, parameters, record, training_rows: Vec::new() }.to_file(Path::new(OF_RANK_0))
    }

    fn of_bytes(bytes: &[u8]) -> Result<Pilot> {
        Pilot::new(Model::of_file(Path::new(OF_RANK_0), bytes)?, Isa::best())
    }
}

/// What errors call a model that another rank sent.
const OF_RANK_0: &str = "the model of rank 0";

#[cfg(test)]
mod tests {
    use ndarray::{Array3, Array4};

    use super::*;

    fn pilot(name: &str) -> Pilot {
        let recipe = Recipe::find(name, &[]).unwrap();
        let parameters = recipe.network(Isa::best()).unwrap().initialize(1);
        let record = TrainingRecord::default();
        Pilot::new(Model { recipe, parameters, record, training_rows: vec![] }, Isa::best()).unwrap()
    }

    #[test]
    fn every_recipe_steers_an_image_of_any_size() {
        let picture = |h, w| Array3::from_shape_fn((h, w, 3), |(y, x, c)| ((y * 41 + x * 17 + c * 7) % 251) as u8);
        let (usual, small) = (picture(160, 320), picture(120, 160));
        for (name, _) in crate::recipe::SHIPPED {
            let mut pilot = pilot(name);
            let first = pilot.steer(usual.view()).unwrap();
            assert!(pilot.steer(small.view()).unwrap().is_finite());
            assert_eq!(pilot.steer(usual.view()).unwrap(), first, "{name}: an image must not depend on earlier ones");
        }
    }

    #[test]
    fn a_pilot_that_is_sent_steers_as_before() {
        let picture = Array3::from_shape_fn((160, 320, 3), |(y, x, c)| ((y * 41 + x * 17 + c * 7) % 251) as u8);
        let mut pilot = pilot("hyper");
        let mut sent = Pilot::of_bytes(&pilot.to_bytes().unwrap()).unwrap();
        assert_eq!(sent.steer(picture.view()).unwrap(), pilot.steer(picture.view()).unwrap());
        assert_eq!(sent.recipe(), pilot.recipe());
        assert!(Pilot::of_bytes(b"nonsense").unwrap_err().to_string().contains("rank 0"));
    }

    #[test]
    fn a_batch_and_a_view_in_another_memory_order_are_steered_alike() {
        let mut pilot = pilot("lenet");
        let images =
            Array4::from_shape_fn((3, 160, 320, 3), |(n, y, x, c)| ((n * 91 + y * 41 + x * 17 + c * 7) % 251) as u8);
        let one_by_one: Vec<f32> = images.outer_iter().map(|image| pilot.steer(image).unwrap()).collect();
        assert_eq!(pilot.predict(images.view()).unwrap().to_vec(), one_by_one);
        assert!(one_by_one[0] != one_by_one[1]);
        let planes = images.index_axis(Axis(0), 0).permuted_axes([2, 0, 1]).as_standard_layout().into_owned();
        let same_image = planes.view().permuted_axes([1, 2, 0]);
        assert!(same_image.to_slice().is_none());
        assert_eq!(pilot.steer(same_image).unwrap(), one_by_one[0]);
    }

    #[test]
    fn weights_have_the_names_and_shapes_of_the_network() {
        let pilot = pilot("lenet");
        let weight = pilot.weights("conv1.weight").unwrap();
        assert_eq!(weight.shape(), &pilot.network().tensor("conv1.weight").unwrap().spec.shape[..]);
        assert_eq!(weight.iter().next(), pilot.parameters().values.first());
        assert!(pilot.weights("conv9.weight").is_none());
    }

    #[test]
    fn what_is_no_image_is_an_error() {
        let mut pilot = pilot("lenet");
        assert!(pilot.steer(Array3::zeros((160, 320, 4)).view()).is_err());
        assert!(pilot.steer(Array3::zeros((0, 320, 3)).view()).is_err());
        assert_eq!(pilot.steer_encoded(b"GIF89a").unwrap_err().to_string(), "neither a JPEG nor a PNG image");
    }
}
