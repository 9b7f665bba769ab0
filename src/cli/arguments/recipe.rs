//! `--recipe` and `--set`.

use std::path::Path;

use clap::Args;

use super::load_model;
use crate::error::Result;
use crate::recipe::Recipe;

/// Which recipe, and what to change in it.
#[derive(Clone, Debug, Args)]
pub(crate) struct RecipeArgs {
    /// A built-in recipe (default, calm, recording, hyper, hyper-prelu, lenet, pilotnet, donkey) or a recipe file [default: recording
    /// with a recording, else default]
    #[arg(long, value_name = "NAME|FILE")]
    recipe: Option<String>,
    /// Change an entry of the recipe, as in epochs=3 or optimizer.learning_rate=1e-4
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
}

impl RecipeArgs {
    pub(crate) fn is_given(&self) -> bool {
        self.recipe.is_some() || !self.overrides.is_empty()
    }

    pub(crate) fn find(&self) -> Result<Recipe> {
        self.find_or("default")
    }

    /// The recipe that is named, or else the built-in one called `default`.
    pub(crate) fn find_or(&self, default: &str) -> Result<Recipe> {
        Recipe::find(self.recipe.as_deref().unwrap_or(default), &self.overrides)
    }

    /// The recipe that is named, or else that of the model in the file `from`.
    pub(crate) fn find_or_of(&self, from: &Path) -> Result<Recipe> {
        match self.recipe {
            Some(_) => self.find(),
            None => Recipe::parse(&from.display().to_string(), &load_model(from)?.recipe.to_toml()?, &self.overrides),
        }
    }
}
