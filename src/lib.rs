//! steersman learns to steer a car from its front camera, and drives with what it learned. Everything that computes is
//! written out here: layers, backward passes, optimizer, simulator; on the CPU, without a framework.
//!
//! # A tour
//!
//! A frame's way to the wheels: [`dataset`] reads a recording, splits it *before* anything is augmented, decodes each image
//! once and preprocesses it; a [`recipe`] says how, and what network to train; [`network`] plans the buffers of its
//! [`layers`] and runs them; [`training`] goes through the epochs, follows the gradient with an [`optimizer`] and writes the
//! run folder; [`model_file`] is what remains; a [`pilot`] loads it and steers. [`report`] measures how well it predicts,
//! and [`simulator`] how well it drives. [`exchange`] reads models of other
//! programs. [`cli`] is the command line.
//!
//! Dependencies point one way: `steersman-kernels` (all vector code and every `unsafe` line) ← [`tensor`] ← [`layers`] ←
//! [`network`] (with the [`loss`]) ← [`optimizer`] ← [`training`]; [`dataset`] and [`simulator`] know no network.
//!
//! # Three promises
//!
//! - **The same bits.** Every random choice is keyed by seed, purpose, epoch and sample ([`random`]), and sums are added in
//!   an order that does not depend on the number of threads. On one level of vector code, a seed gives the same weights on
//!   any number of threads, with or without a cache, stopped and resumed or not.
//! - **No allocation** in a training step or a prediction once the buffers are planned.
//! - **Evaluation changes nothing**: it borrows the parameters shared.
//!
//! # Predict with a trained model
//!
//! ```no_run
//! use std::path::Path;
//! use steersman::pilot::Pilot;
//!
//! let mut pilot = Pilot::load(Path::new("runs/lenet-1/model.safetensors"))?;
//! let steering = pilot.steer_file(Path::new("frame.jpg"))?;
//! println!("{steering:+.3}");
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! # Train on numbers of your own
//!
//! ```
//! use steersman::network::{LayerSpec, Network, StepInput, TrainingPlan};
//! use steersman::optimizer::{Optimizer, OptimizerSpec};
//! use steersman::tensor::{Initializer, Shape};
//! use steersman::loss::Loss;
//! use steersman_kernels::Isa;
//!
//! // y = x1 − x2, learned by one dense layer.
//! let layers = [LayerSpec::Dense { units: 1, init: Initializer::GlorotUniform }];
//! let network = Network::new(Shape::vector(2), &layers, Isa::best())?;
//! let (x, labels) = ([1.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.5, 1.0], [1.0, -1.0, 0.0, -0.5]);
//!
//! let spec = OptimizerSpec::Sgd { learning_rate: 0.3, momentum: 0.0, l2: 0.0, decoupled_weight_decay: 0.0 };
//! let mut parameters = network.initialize(1);
//! let mut plan = TrainingPlan::new(&network, labels.len());
//! let mut optimizer = Optimizer::new(spec, None, &network);
//! for step in 0..200 {
//!     let input = StepInput { x: &x, labels: &labels, seed: 1, step };
//!     plan.step(&network, &mut parameters, &Loss::default(), input);
//!     let norm = plan.gradient_norm();
//!     optimizer.step(0.3, &mut parameters.values, plan.gradient_mut(), norm);
//! }
//! let [w1, w2, bias] = parameters.values[..] else { unreachable!("two weights and a bias") };
//! assert!((w1 - 1.0).abs() < 0.01 && (w2 + 1.0).abs() < 0.01 && bias.abs() < 0.01);
//! # Ok::<(), steersman::Error>(())
//! ```
//!
//! How to add a layer stands in [`layers`], how to add a recipe in [`recipe`].
#![forbid(unsafe_code)]

pub mod atomic_file;
pub mod cli;
pub mod dataset;
pub mod error;
pub mod exchange;
pub mod layers;
pub mod loss;
pub mod main_job;
pub mod model_file;
pub mod network;
pub mod new_folder;
pub mod optimizer;
pub mod pilot;
pub mod random;
pub mod recipe;
pub mod report;
pub mod serve;
pub mod simulator;
pub mod tensor;
pub mod training;

pub use error::{Error, Result};
