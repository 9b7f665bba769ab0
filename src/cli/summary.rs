//! `steersman summary`: the layer table.

use std::path::PathBuf;

use clap::Args;
use steersman_kernels::Isa;

use super::RecipeArgs;
use crate::error::Result;
use crate::model_file::Model;

/// Print the layer table of a recipe or a model
#[derive(Debug, Args)]
pub struct SummaryArgs {
    /// A model file; without one, the recipe's network is shown
    #[arg(value_name = "MODEL", conflicts_with = "recipe")]
    model: Option<PathBuf>,
    #[command(flatten)]
    recipe: RecipeArgs,
}

pub fn run(args: SummaryArgs) -> Result<()> {
    let recipe = match &args.model {
        Some(path) => {
            let model = Model::load(path)?;
            println!("{}: recipe {}, {}", path.display(), model.recipe.name, training_line(&model));
            model.recipe
        }
        None => args.recipe.find()?,
    };
    println!("{}: {}\n", recipe.name, recipe.about);
    print!("{}", recipe.network(Isa::best())?.summary());
    Ok(())
}

fn training_line(model: &Model) -> String {
    let record = &model.record;
    format!(
        "{} epochs on {} (seed {}, {}), validation MSE {}",
        record.epochs,
        record.recordings.join(", "),
        record.seed,
        record.isa,
        super::or_dash(record.val_mse, 4)
    )
}
