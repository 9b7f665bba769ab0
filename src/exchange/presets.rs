//! Preprocessing of known projects, for models that come without theirs.

use crate::dataset::preprocess::Preprocessing;
use crate::error::{Error, Result};
use crate::recipe::{Recipe, SHIPPED};
use crate::suggestion::did_you_mean;

/// Name and text of each file in `data/preprocessing/`, by name; the files say where they come from.
pub const PRESETS: &[(&str, &str)] = include!(concat!(env!("OUT_DIR"), "/preprocessing.rs"));

/// The preprocessing `name`: a preset, that of a built-in recipe, or a TOML file (the table alone, or a recipe's).
///
/// # Errors
///
/// [`Error::Usage`] for an unknown name, naming the nearest; [`Error::Io`] and [`Error::Data`] for a file.
pub fn find(name: &str) -> Result<Preprocessing> {
    if let Some((_, text)) = PRESETS.iter().find(|(preset, _)| *preset == name) {
        return parse(name, text);
    }
    if SHIPPED.iter().any(|(recipe, _)| *recipe == name) {
        return Ok(Recipe::find(name, &[])?.preprocessing);
    }
    if name.ends_with(".toml") || std::path::Path::new(name).components().count() > 1 {
        return parse(name, &std::fs::read_to_string(name).map_err(Error::io(name))?);
    }
    let names: Vec<&str> = PRESETS.iter().chain(SHIPPED).map(|(name, _)| *name).collect();
    Err(Error::Usage(format!(
        "there is no preprocessing `{name}`{}; built in are {}; one of your own is given as FILE.toml",
        did_you_mean(name, &names),
        names.join(", ")
    )))
}

fn parse(place: &str, text: &str) -> Result<Preprocessing> {
    let wrong = |message: String| Error::data(place, message.trim_end());
    let mut table: toml::Table = text.parse().map_err(|e: toml::de::Error| wrong(e.to_string()))?;
    if let Some(toml::Value::Table(inner)) = table.remove("preprocessing") {
        table = inner;
    }
    let preprocessing: Preprocessing = table.try_into().map_err(|e: toml::de::Error| wrong(e.to_string()))?;
    preprocessing.validate().map_err(|e| wrong(e.to_string()))?;
    Ok(preprocessing)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_preset_is_valid_and_the_write_ups_agree_with_their_recipes() {
        for (name, _) in PRESETS {
            find(name).unwrap();
        }
        assert_eq!(find("diz-vara").unwrap(), find("hyper").unwrap());
        assert_eq!(find("oargueta").unwrap(), find("lenet").unwrap());
    }

    #[test]
    fn a_file_holds_the_table_or_a_recipe() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.toml");
        let path = path.to_str().unwrap();
        for text in ["rows = [3, 9]", "epochs = 3\n[preprocessing]\nrows = [3, 9]"] {
            std::fs::write(path, text).unwrap();
            assert_eq!(find(path).unwrap().rows, [3, 9]);
        }
        for (text, expected) in [("rows = [9, 3]", "rows"), ("row = [3, 9]", "unknown field `row`"), ("rows", "p.toml")]
        {
            std::fs::write(path, text).unwrap();
            assert!(find(path).unwrap_err().to_string().contains(expected));
        }
        let unknown = find("naokishibuja").unwrap_err().to_string();
        assert!(unknown.contains("did you mean `naokishibuya`?"), "{unknown}");
    }
}
