//! `steersman summary`: the layer table.

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;
use steersman_kernels::Isa;

use super::arguments::{RecipeArgs, load_model, refuse_existing};
use super::terminal::{counted, or_dash, print, print_json};
use crate::engine::network::{NamedLayer, Network};
use crate::error::Result;
use crate::files::atomic_file;
use crate::model_file::Model;
use crate::recipe::Recipe;
use crate::report::charts::network_diagram;

/// Print the layer table of a recipe or a model, or draw it
#[derive(Debug, Args)]
pub struct SummaryArgs {
    /// A model file; without one, the recipe's network is shown
    #[arg(value_name = "MODEL", conflicts_with = "recipe")]
    model: Option<PathBuf>,
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Draw the network into this SVG file, which must not exist
    #[arg(long, value_name = "FILE")]
    svg: Option<PathBuf>,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Table {
    recipe: String,
    layers: Vec<Row>,
    params: usize,
    trainable_params: usize,
    non_trainable_params: usize,
    multiply_adds: u64,
}

#[derive(Serialize)]
struct Row {
    name: String,
    kind: String,
    /// Channels, height, width.
    output: [usize; 3],
    params: usize,
    multiply_adds: u64,
}

impl Table {
    fn of(recipe: &Recipe, network: &Network) -> Table {
        let row = |named: &NamedLayer| Row {
            name: named.name.clone(),
            kind: named.spec.describe(),
            output: [named.layer.output().c, named.layer.output().h, named.layer.output().w],
            params: named.params.len() + named.statistics.len(),
            multiply_adds: named.layer.multiply_adds(),
        };
        let (trainable_params, non_trainable_params) = (network.count(true), network.count(false));
        Table {
            recipe: recipe.name.clone(),
            layers: network.layers().iter().map(row).collect(),
            params: trainable_params + non_trainable_params,
            trainable_params,
            non_trainable_params,
            multiply_adds: network.multiply_adds(),
        }
    }
}

pub fn run(args: SummaryArgs) -> Result<()> {
    let (recipe, text) = match &args.model {
        Some(path) => {
            let model = load_model(path)?;
            let text = of_model(path, &model)?;
            (model.recipe, text)
        }
        None => {
            let recipe = args.recipe.find()?;
            let table = recipe.network(Isa::best())?.summary();
            let text = format!("{}: {}\n\n{table}", recipe.name, recipe.about);
            (recipe, text)
        }
    };
    let network = recipe.network(Isa::best())?;
    if let Some(path) = &args.svg {
        refuse_existing(path)?;
        let title =
            if recipe.about.is_empty() { recipe.name.clone() } else { format!("{}: {}", recipe.name, recipe.about) };
        atomic_file::write(path, network_diagram::draw(&network, &title).as_bytes())?;
        eprintln!("wrote {}", path.display());
    }
    if args.json {
        return print_json(&Table::of(&recipe, &network));
    }
    print(&text)
}

/// The text for the model that was read from `path`.
///
/// # Errors
///
/// [`Error::Network`](crate::Error::Network) if its layers do not fit.
pub(crate) fn of_model(path: &Path, model: &Model) -> Result<String> {
    let table = model.recipe.network(Isa::best())?.summary();
    Ok(format!("model {}\n{}\n{table}", path.display(), about(model)))
}

/// Recipe and training of a model, a line each.
fn about(model: &Model) -> String {
    let (record, recipe) = (&model.record, &model.recipe);
    let trained = if record.epochs == 0 && record.recordings.is_empty() {
        "not trained here".into()
    } else {
        let on = match &record.recordings[..] {
            [only] => only.clone(),
            several => counted(several.len(), "recording"),
        };
        let (epochs, seed, isa) = (counted(record.epochs as usize, "epoch"), record.seed, &record.isa);
        format!("trained {epochs} on {on}, seed {seed}, {isa}")
    };
    let error = or_dash(record.val_mse, 4);
    format!("recipe {}: {}\n{trained}\nvalidation MSE {error}\n", recipe.name, recipe.about)
}
