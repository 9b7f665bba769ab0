//! Transfer: a run that starts from the weights of a model.

use std::path::Path;

use steersman_kernels::Isa;

use super::data::Data;
use super::request::TransferRequest;
use crate::engine::network::{Network, Parameters, Tensor};
use crate::error::{Error, Result};
use crate::model_file::{Model, Transfer};
use crate::recipe::Recipe;

/// The start of a run with transferred weights.
#[derive(Debug)]
pub(super) struct Start {
    pub transfer: Transfer,
    pub parameters: Parameters,
    /// The rows that the model was trained on, sorted.
    pub rows: Vec<u64>,
    /// Held-out tracks that the model was trained on.
    pub trained_on_held_out: Vec<String>,
    /// Recipe of the model.
    recipe: Recipe,
}

impl Start {
    /// Takes over from the model in `file` what fits the network of `recipe`: a layer whose tensors all have the same names and
    /// shapes there. The others are drawn as `seed` says.
    ///
    /// # Errors
    ///
    /// As [`Model::load`] and [`Network::freeze`]; [`Error::Usage`] if no layer fits, or a layer to be frozen does not.
    pub fn load(file: &Path, request: &TransferRequest, recipe: &Recipe, seed: u64) -> Result<Start> {
        let model = Model::load(file)?;
        let theirs = model.recipe.network(Isa::PORTABLE)?;
        let mut ours = recipe.network(Isa::PORTABLE)?;
        ours.freeze(&request.freeze)?;
        let mut parameters = ours.initialize(seed);
        let named = request.model.display().to_string();
        let mut transfer = Transfer { model: named.clone(), frozen: request.freeze.clone(), ..Transfer::default() };
        for layer in ours.layers().iter().filter(|layer| !layer.params.is_empty()) {
            let of_layer = |tensor: &&Tensor| tensor.name.split_once('.').is_some_and(|(name, _)| name == layer.name);
            let pairs: Option<Vec<(&Tensor, &Tensor)>> = ours
                .tensors()
                .iter()
                .filter(of_layer)
                .map(|tensor| Some((tensor, same_tensor(&theirs, tensor)?)))
                .collect();
            let list = if pairs.is_some() { &mut transfer.taken } else { &mut transfer.fresh };
            list.push(layer.name.clone());
            for (to, from) in pairs.into_iter().flatten() {
                parameters.tensor_mut(to).copy_from_slice(model.parameters.tensor(from));
            }
        }
        if transfer.taken.is_empty() {
            return Err(Error::Usage(format!("no layer of {named} has the name and the shape of one of the recipe's")));
        }
        if let Some(layer) = transfer.frozen.iter().find(|layer| transfer.fresh.contains(layer)) {
            return Err(Error::Usage(format!(
                "layer `{layer}` cannot be frozen: {named} has none of that name and shape, so its weights would stay random"
            )));
        }
        let trained_on_held_out = model.record.trained_on_held_out;
        Ok(Start { transfer, parameters, rows: model.training_rows, trained_on_held_out, recipe: model.recipe })
    }

    /// Messages for the user.
    pub fn notices(&self, recipe: &Recipe, data: &Data) -> Vec<String> {
        let Transfer { model, taken, fresh, frozen } = &self.transfer;
        let list = |names: &[String]| if names.is_empty() { "none".into() } else { names.join(", ") };
        let mut notices = vec![format!(
            "weights from {model}: {}; fresh weights: {}; frozen: {}",
            list(taken),
            list(fresh),
            list(frozen)
        )];
        if self.recipe.preprocessing != recipe.preprocessing {
            notices.push(format!("{model} was trained with another [preprocessing] than this recipe's"));
        }
        let (seen, all) = data.validation_rows_among(&self.rows);
        if seen > 0 {
            notices.push(format!(
                "{seen} of {all} validation rows belong to what {model} was trained on: the validation error will look too good"
            ));
        }
        notices
    }
}

/// The tensor of `network` with the name and shape of `tensor`.
fn same_tensor<'a>(network: &'a Network, tensor: &Tensor) -> Option<&'a Tensor> {
    network.tensors().iter().find(|other| other.name == tensor.name && other.spec.shape == tensor.spec.shape)
}
