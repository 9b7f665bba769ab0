//! steersman learns to steer a car from its front camera, and drives with what it learned. Everything that computes is
//! written out here: layers, backward passes, optimizer, simulator; on the CPU, without a framework.
//!
//! # A tour
//!
//! | room (module) | what happens there |
//! |---|---|
//! | [`dataset`] | reads a recording, splits it *before* anything is augmented, decodes each picture once and preprocesses it |
//! | [`recipe`] | the experiment: preprocessing, network, samples, split, optimizer |
//! | [`engine`] | [layers](engine::layers) with their backward passes, [networks](engine::network) and the plans that run them, the [optimizer](engine::optimizer) |
//! | [`training`] | goes through the epochs and writes the run folder |
//! | [`model_file`], [`pilot`] | what remains of a run; a model that steers |
//! | [`evaluation`], [`simulator`], [`replay`] | how well a model predicts; how well it drives on a track, and on a recording |
//! | [`geometry`] | camera and car of a recording, the driven path, views from beside it |
//! | [`report`], [`live`], [`coach`] | pages, pictures and films; a drive in the browser; cleaning a recording there |
//! | [`serve`], [`udacity`], [`simulator_client`] | drives Udacity's simulator; its messages; our simulator in its place |
//! | [`donkeysim`] | our simulator in the place of donkeycar's |
//! | [`exchange`] | models of other programs in, ours out for them |
//! | [`main_job`], [`cli`], `python` | what `train` does without a recording; the command line; the Python package |
//!
//! Dependencies point one way, from the Python package and the command line down to `steersman-kernels`, which holds all vector code
//! and every `unsafe` line; `tests/rooms.rs` states the order and keeps it. Below the rooms of the table lie `error`, `text`, `observer`,
//! `picture`, `metrics`, `files` and `net`, which any of them may use. The [glossary](#glossary) at the end explains the words.
//!
//! # Three promises
//!
//! - **The same bits.** Every random choice is keyed by seed, purpose, epoch and sample ([`random`](engine::random)), and sums are added in
//!   an order that does not depend on the number of threads. On the same instruction set, a seed gives the same weights on
//!   any number of threads, with or without a cache, stopped and resumed or not.
//! - **No allocation** in a training step or a prediction once the buffers are planned.
//! - **Evaluation changes nothing**: it borrows the parameters shared.
//!
//! # Steer with a trained model
//!
//! ```no_run
//! use std::path::Path;
//! use ndarray::Array3;
//! use steersman::pilot::Pilot;
//!
//! let mut pilot = Pilot::load(Path::new("runs/lenet-1/model.safetensors"))?;
//! let image = Array3::<u8>::zeros((160, 320, 3)); // height, width, RGB; `steer_encoded` and `steer_file` take JPEG and PNG
//! let steering = pilot.steer(image.view())?; // roughly in [-1, 1], positive to the right
//! println!("{:+.1} degrees", pilot.recipe().full_lock_deg * f64::from(steering));
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! [`exchange`] writes the same model as ONNX, TensorFlow Lite, C or Rust for programs that do not link this crate.
//!
//! # Train on a recording of your own
//!
//! A recording is a folder with a `driving_log.csv`, or a donkeycar tub; `data/sample` is a very short one.
//!
//! ```
//! use steersman::observer::StopSignal;
//! use steersman::recipe::Recipe;
//! use steersman::training::{TrainRequest, TrainingEvent, train};
//!
//! # let folder = tempfile::tempdir().unwrap();
//! # let out = folder.path().join("run");
//! # /*
//! let out = "runs/mine".into();
//! # */
//! // The recipe is the experiment: preprocessing, network, split, optimizer. A path ending in .toml names one of your own.
//! let recipe = Recipe::find("lenet", &["epochs=2".into(), "batch=16".into()])?;
//! let request = TrainRequest { seed: 7, ..TrainRequest::new(vec!["data/sample".into()], recipe, out) };
//! let stop = StopSignal::default(); // requested from elsewhere, it ends the run after the current batch
//! let mut observer = |event| {
//!     match event {
//!         TrainingEvent::Notice(text) => println!("{text}"),
//!         TrainingEvent::Begin { .. } | TrainingEvent::Batch { .. } => {}
//!         TrainingEvent::Epoch { record, of } => println!("epoch {} of {of}: loss {:.4}", record.epoch, record.train_loss),
//!     }
//!     Ok(())
//! };
//! let result = train(request, &mut observer, &stop)?;
//! println!("{}: mean squared error {:?} on the validation side", result.model.display(), result.val_mse);
//! # assert!(result.model.is_file() && result.epochs == 2);
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! # Train on numbers of your own
//!
//! ```
//! use ndarray::{arr1, arr2};
//! use steersman::engine::layers::DenseSpec;
//! use steersman::engine::network::{Network, StepInput, TrainingPlan};
//! use steersman::engine::optimizer::{Optimizer, OptimizerSpec};
//! use steersman::engine::tensor::{Initializer, Shape};
//! use steersman::engine::loss::Loss;
//! use steersman_kernels::Isa;
//!
//! // y = x1 − x2, learned by one dense layer.
//! let layers = [DenseSpec { units: 1, init: Initializer::GlorotUniform }.into()];
//! let network = Network::new(Shape::vector(2), &layers, Isa::best())?;
//! let (x, labels) = (arr2(&[[1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [0.5, 1.0]]), arr1(&[1.0, -1.0, 0.0, -0.5]));
//! let x = x.into_shape_with_order((4, 2, 1, 1)).unwrap(); // a vector of 2 is an image of 2 channels, 1 row, 1 column
//!
//! let spec = OptimizerSpec::Sgd { learning_rate: 0.3, momentum: 0.0, l2: 0.0, decoupled_weight_decay: 0.0 };
//! let mut parameters = network.initialize(1);
//! let mut plan = TrainingPlan::new(&network, labels.len());
//! let mut optimizer = Optimizer::new(spec, None, network.tensors(), network.isa());
//! for step in 0..200 {
//!     let input = StepInput { x: x.view(), labels: labels.view(), seed: 1, step };
//!     plan.step(&network, &mut parameters, &Loss::default(), input);
//!     let norm = plan.gradient_norm();
//!     optimizer.step(0.3, &mut parameters.values, plan.gradient_mut(), norm);
//! }
//! let [w1, w2, bias] = parameters.values[..] else { unreachable!("two weights and a bias") };
//! assert!((w1 - 1.0).abs() < 0.01 && (w2 + 1.0).abs() < 0.01 && bias.abs() < 0.01);
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! # Add a layer
//!
//! A layer is its forward pass and its hand-written backward pass; [`gradcheck`](engine::layers::gradcheck) compares the two by finite
//! differences, and panics with the name of the tensor if they disagree. What else makes it a layer that recipes can name
//! stands in [`layers`](engine::layers); how to add a recipe, in [`recipe`].
//!
//! ```
//! use steersman::engine::layers::gradcheck::check_layer;
//! use steersman::engine::layers::{Grads, Layer, Pair, Pass};
//! use steersman::engine::tensor::Shape;
//!
//! /// Softplus: `y = ln(1 + eˣ)`, `dx = dy / (1 + e⁻ˣ)`.
//! #[derive(Debug)]
//! struct Softplus {
//!     shape: Shape,
//! }
//!
//! impl Layer for Softplus {
//!     fn input(&self) -> Shape {
//!         self.shape
//!     }
//!
//!     fn output(&self) -> Shape {
//!         self.shape
//!     }
//!
//!     fn infer(&self, _: &[f32], _: &[f32], _: usize, x: &[f32], y: &mut [f32], _: &mut [f32]) {
//!         for (y, x) in y.iter_mut().zip(x) {
//!             *y = x.max(0.0) + (-x.abs()).exp().ln_1p(); // eˣ itself would overflow
//!         }
//!     }
//!
//!     fn forward(&self, params: &[f32], _: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
//!         self.infer(params, &[], n, x, y, scratch); // training is no different
//!     }
//!
//!     fn backward(&self, _: &[f32], _: &Pass, _: usize, pair: Pair, dx: Option<&mut [f32]>, _: Grads) {
//!         let Some(dx) = dx else { return };
//!         for ((dx, dy), x) in dx.iter_mut().zip(pair.dy).zip(pair.x) {
//!             *dx = dy / (1.0 + (-x).exp());
//!         }
//!     }
//! }
//!
//! check_layer(&Softplus { shape: Shape::new(2, 3, 5) }, 3);
//! ```
#![doc = include_str!("glossary.md")]
#![forbid(unsafe_code)]
#![cfg_attr(
    all(feature = "training", not(feature = "cli")),
    allow(dead_code, unused_imports, reason = "the smaller feature sets use a part of what the rooms share")
)]

#[cfg(feature = "training")]
pub mod calm;
#[cfg(feature = "cli")]
pub mod cli;
#[cfg(feature = "training")]
pub mod cluster;
#[cfg(feature = "live")]
pub mod coach;
#[cfg(feature = "training")]
pub mod dataset;
#[cfg(feature = "serve")]
pub mod donkeysim;
pub mod engine;
pub mod error;
#[cfg(feature = "training")]
pub mod evaluation;
#[cfg(feature = "exchange")]
pub mod exchange;
#[cfg(feature = "training")]
pub mod files;
#[cfg(feature = "training")]
pub mod geometry;
#[cfg(feature = "live")]
pub mod live;
#[cfg(feature = "cli")]
pub mod main_job;
#[cfg(feature = "training")]
pub mod metrics;
#[cfg(feature = "training")]
pub mod model_file;
#[cfg(feature = "serve")]
mod net;
#[cfg(feature = "training")]
pub mod observer;
#[cfg(feature = "training")]
pub mod picture;
#[cfg(feature = "training")]
pub mod pilot;
#[cfg(feature = "python")]
mod python;
#[cfg(feature = "training")]
pub mod recipe;
#[cfg(feature = "training")]
pub mod replay;
#[cfg(feature = "report")]
pub mod report;
#[cfg(feature = "serve")]
pub mod serve;
#[cfg(feature = "simulator")]
pub mod simulator;
#[cfg(feature = "serve")]
pub mod simulator_client;
#[cfg(feature = "training")]
mod statistics;
mod suggestion;
#[cfg(feature = "training")]
mod text;
#[cfg(feature = "training")]
pub mod training;
#[cfg(feature = "serve")]
pub mod udacity;

pub use error::{Error, Result};
