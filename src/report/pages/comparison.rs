//! Several runs side by side on one page: curves, figures, recipes, and the drives that lie in their folders.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::drives::{self, DriveView};
use super::html::Page;
use super::layer_alignment::{LayerEntry, align};
use super::run_list;
use crate::error::{Error, Result};
use crate::recipe::Recipe;
use crate::report::charts::chart::{Axis, Chart, Mark};
use crate::report::charts::palette;
use crate::report::tone::Tone;
use crate::training::{EpochRecord, RunFolder, TrainResult};
use steersman_kernels::Isa;

/// Two charts side by side.
const HALF: [f64; 2] = [552.0, 360.0];

/// A run, read from its folder.
#[derive(Debug)]
pub struct RunView {
    /// Name that tells it from the others.
    pub name: String,
    recipe: Recipe,
    seed: u64,
    /// What it was trained on.
    data: Data,
    history: Vec<EpochRecord>,
    result: Option<TrainResult>,
    drives: Vec<DriveView>,
}

/// What a run was trained on.
#[derive(Debug, Default, PartialEq)]
struct Data {
    /// Names of the recordings, for people.
    names: String,
    /// Hash over the rows of both sides.
    rows_hash: String,
}

/// Reads the runs in `folders`.
///
/// # Errors
///
/// [`Error::Usage`] for what is no run folder, [`Error::Io`] and [`Error::Data`] for what cannot be read.
pub fn read(folders: &[PathBuf]) -> Result<Vec<RunView>> {
    let names = names(folders);
    let read = |(path, name): (&PathBuf, String)| {
        let folder = RunFolder::open(path)?;
        let info = folder.info()?;
        Ok(RunView {
            name,
            recipe: folder.recipe()?,
            seed: info.seed,
            data: Data { names: run_list::recordings(&info.recordings), rows_hash: info.rows_hash },
            history: if folder.file("history.csv").is_file() { folder.history()? } else { Vec::new() },
            result: folder.result()?,
            drives: drives::read(path)?,
        })
    };
    folders.iter().zip(names).map(read).collect()
}

/// Last parts of the paths if they differ, else the whole paths.
fn names(folders: &[PathBuf]) -> Vec<String> {
    let last = |path: &PathBuf| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let short: Vec<String> = folders.iter().map(last).collect();
    let differ = (1..short.len()).all(|i| !short[..i].contains(&short[i]));
    if differ { short } else { folders.iter().map(|path| path.display().to_string()).collect() }
}

/// The page.
///
/// # Errors
///
/// [`Error::Recipe`] and [`Error::Network`] for recipes that cannot be written out or built.
pub fn page(runs: &[RunView]) -> Result<String> {
    let names: Vec<&str> = runs.iter().map(|run| run.name.as_str()).collect();
    let mut page = Page::new("Runs compared", &names.join(", "));
    figures(&mut page, runs)?;
    page.section("Learning curves");
    let same_data = runs.iter().all(|run| run.data.rows_hash == runs[0].data.rows_hash);
    if !same_data {
        page.advice(
            "These runs were trained on different rows (other recordings, another split, other cameras). Each has its own validation \
             curve below: one says nothing about the other. Drives can be compared.",
            Tone::Warning,
        );
    }
    page.drawings(&curves(runs, same_data));
    page.section("What their recipes differ in");
    let (keys, rows) = differences(runs)?;
    if rows.is_empty() {
        page.paragraph(if runs.len() > 1 { "Nothing." } else { "There is only one." });
    } else {
        let headers: Vec<&str> = std::iter::once("entry").chain(names.iter().copied()).collect();
        let rows: Vec<Vec<String>> =
            keys.into_iter().zip(rows).map(|(key, values)| std::iter::once(key).chain(values).collect()).collect();
        page.table(&headers, &rows);
    }
    describe_drives(&mut page, runs);
    Ok(page.finish())
}

fn figures(page: &mut Page, runs: &[RunView]) -> Result<()> {
    page.section("Figures");
    let number = |value: Option<f64>, decimals: usize| value.map_or("-".to_string(), |v| format!("{v:.decimals$}"));
    let mut rows = Vec::new();
    for run in runs {
        let network = run.recipe.network(Isa::PORTABLE)?;
        let best = run
            .history
            .iter()
            .filter(|r| r.val_mse.is_some())
            .min_by(|a, b| a.val_mse.unwrap_or(f64::INFINITY).total_cmp(&b.val_mse.unwrap_or(f64::INFINITY)));
        rows.push(vec![
            run.name.clone(),
            run.recipe.name.clone(),
            run.data.names.clone(),
            run.seed.to_string(),
            crate::engine::network::group_digits(network.count(true) as u64),
            format!("{}{}", run.history.len(), if run.result.is_some() { "" } else { " (unfinished)" }),
            best.map_or("-".into(), |best| best.epoch.to_string()),
            number(run.history.last().map(|last| last.train_loss), 5),
            number(best.and_then(|best| best.val_mse), 5),
            number(best.and_then(|best| best.val_center_mse), 5),
            number(best.and_then(|best| best.val_mae_deg), 2),
            number(best.and_then(|best| best.relative_to_zero), 2),
            number(run.result.as_ref().map(|result| result.seconds), 0),
        ]);
    }
    let headers = [
        "run",
        "recipe",
        "trained on",
        "seed",
        "trainable",
        "epochs",
        "best",
        "training loss, last",
        "validation MSE, best",
        "centre MSE",
        "MAE, degrees",
        "÷ never steering",
        "seconds",
    ];
    page.table(&headers, &rows);
    Ok(())
}

/// The curves of all runs; those of the validation error apart where the runs do not have the same data.
fn curves(runs: &[RunView], same_data: bool) -> Vec<String> {
    let chart = |title: &str, axis: Axis, shown: &[(usize, &RunView)], value: fn(&EpochRecord) -> Option<f64>| {
        shown.iter().fold(Chart::new(title, HALF, Axis::new("epoch"), axis), |chart, (i, run)| {
            let points =
                run.history.iter().filter_map(|record| Some([f64::from(record.epoch), value(record)?])).collect();
            chart.add(&run.name, palette::series(*i), Mark::Line(2.0), points)
        })
    };
    let all: Vec<(usize, &RunView)> = runs.iter().enumerate().collect();
    // On one axis only what can be compared.
    let groups: Vec<&[(usize, &RunView)]> = if same_data { vec![&all] } else { all.chunks(1).collect() };
    let title = |what: &str, group: &[(usize, &RunView)]| match group {
        [(_, run)] if !same_data => format!("{what}, {} on {}", run.name, run.data.names),
        _ => what.into(),
    };
    let loss = || Axis::new("squared error").log();
    let mut charts = vec![chart("Training loss", loss(), &all, |record| Some(record.train_loss))];
    for group in groups {
        charts.push(chart(&title("Validation MSE", group), loss(), group, |record| record.val_mse));
        let what = title("Mean absolute error, centre camera", group);
        charts.push(chart(&what, Axis::new("degrees"), group, |record| record.val_mae_deg));
    }
    charts.push(chart("Learning rate", Axis::new("learning rate"), &all, |record| Some(record.learning_rate)));
    charts.iter().map(Chart::draw).collect()
}

/// The entries that differ between the recipes, with the value in each run.
fn differences(runs: &[RunView]) -> Result<(Vec<String>, Vec<Vec<String>>)> {
    let (mut tables, mut networks) = (Vec::new(), Vec::new());
    for run in runs {
        let text = run.recipe.to_toml()?;
        let table: toml::Table = text
            .parse()
            .map_err(|e: toml::de::Error| Error::Recipe { recipe: run.name.clone(), message: e.to_string() })?;
        networks.push(layers(&table));
        let mut entries = BTreeMap::new();
        flatten("", &toml::Value::Table(table), &mut entries);
        tables.push(entries);
    }
    let mut keys: Vec<String> = tables.iter().flat_map(|table| table.keys().cloned()).collect();
    keys.sort();
    keys.dedup();
    let values = |key: &String| -> Vec<String> {
        tables.iter().map(|table| table.get(key).cloned().unwrap_or_else(|| "-".into())).collect()
    };
    let or_dash =
        |cells: Vec<Option<String>>| cells.into_iter().map(|cell| cell.unwrap_or_else(|| "-".into())).collect();
    let layers = align(&networks)
        .into_iter()
        .enumerate()
        .map(|(at, cells)| (format!("layers, line {}", at + 1), or_dash(cells)));
    let differing: Vec<(String, Vec<String>)> = keys
        .into_iter()
        .filter(|key| key != "about")
        .map(|key| (key.clone(), values(&key)))
        .chain(layers)
        .filter(|(_, values)| values.iter().any(|value| *value != values[0]))
        .collect();
    Ok(differing.into_iter().unzip())
}

/// The layers of a recipe.
fn layers(recipe: &toml::Table) -> Vec<LayerEntry> {
    let entry = |layer: &toml::Value| LayerEntry {
        kind: layer.get("kind").and_then(toml::Value::as_str).unwrap_or_default().into(),
        text: layer.to_string().replace('\n', " "),
    };
    recipe.get("layers").and_then(toml::Value::as_array).map_or(Vec::new(), |layers| layers.iter().map(entry).collect())
}

/// `a.b = value` for every entry of a table but its layers.
fn flatten(key: &str, value: &toml::Value, entries: &mut BTreeMap<String, String>) {
    match value {
        toml::Value::Table(table) => {
            for (name, value) in table.iter().filter(|(name, _)| !(key.is_empty() && *name == "layers")) {
                let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
                flatten(&key, value, entries);
            }
        }
        value => {
            entries.insert(key.to_string(), value.to_string());
        }
    }
}

fn describe_drives(page: &mut Page, runs: &[RunView]) {
    page.section("On the road");
    if runs.iter().all(|run| run.drives.is_empty()) {
        page.paragraph(
            "No drives lie in these folders (`train` without a recording puts some there). `steersman drive RUN/last.safetensors --track lake --out RUN/drives/lake` puts one there.",
        );
        return;
    }
    let mut all: Vec<(&RunView, &DriveView)> =
        runs.iter().flat_map(|run| run.drives.iter().map(move |drive| (run, drive))).collect();
    all.sort_by(|a, b| (a.1.summary.held_out, &a.1.summary.track).cmp(&(b.1.summary.held_out, &b.1.summary.track)));
    let headers: Vec<&str> = std::iter::once("run").chain(drives::HEADERS).collect();
    let row = |(run, drive): &(&RunView, &DriveView)| std::iter::once(run.name.clone()).chain(drive.row()).collect();
    page.table(&headers, &all.iter().map(row).collect::<Vec<_>>());
    page.paragraph("The maps show the assisted runs: the car is put back when it is more than a metre from the line.");
    for on_track in all.chunk_by(|a, b| a.1.summary.track == b.1.summary.track) {
        page.subsection(&on_track[0].1.summary.track);
        page.drawings(&drives::maps(on_track.iter().map(|(run, drive)| (run.name.clone(), *drive))));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(name: &str, overrides: &[&str]) -> RunView {
        let overrides: Vec<String> = overrides.iter().map(|text| text.to_string()).collect();
        let recipe = Recipe::find("lenet", &overrides).unwrap();
        RunView {
            name: name.into(),
            recipe,
            seed: 1,
            data: Data::default(),
            history: Vec::new(),
            result: None,
            drives: Vec::new(),
        }
    }

    #[test]
    fn only_what_differs_is_listed() {
        let runs = [run("a", &[]), run("b", &["epochs=3", "optimizer.learning_rate=0.01", "name='other'"])];
        let (keys, values) = differences(&runs).unwrap();
        assert_eq!(keys, ["epochs", "name", "optimizer.learning_rate"]);
        assert_eq!(values[0], ["10", "3"]);
        assert!(differences(&runs[..1]).unwrap().0.is_empty());
        let with_dropout = run("c", &[]);
        let mut recipe = with_dropout.recipe.to_toml().unwrap();
        let at = recipe.find("kind = \"flatten\"").unwrap();
        let end = at + recipe[at..].find("[[layers]]").unwrap();
        recipe.insert_str(end, "[[layers]]\nkind = \"dropout\"\ndrop_probability = 0.3\n\n");
        let with_dropout = RunView { recipe: Recipe::parse("c", &recipe, &[]).unwrap(), ..with_dropout };
        let (keys, values) = differences(&[run("a", &[]), with_dropout]).unwrap();
        assert!(keys.len() == 1 && keys[0].starts_with("layers, line") && values[0][0] == "-", "{keys:?} {values:?}");
        assert!(values[0][1].contains("dropout"));
    }

    #[test]
    fn runs_of_the_same_name_are_told_apart_by_their_paths() {
        let paths = |names: &[&str]| names.iter().map(PathBuf::from).collect::<Vec<_>>();
        assert_eq!(names(&paths(&["x/a", "x/b"])), ["a", "b"]);
        assert_eq!(names(&paths(&["x/a", "y/a"])), ["x/a", "y/a"]);
    }

    #[test]
    fn runs_without_epochs_or_drives_have_a_page() {
        let text = page(&[run("a", &[]), run("b", &[])]).unwrap();
        crate::report::pages::html::assert_stands_alone(&text);
        assert!(text.contains("(unfinished)") && text.contains("No drives") && !text.contains("different rows"));
    }

    #[test]
    fn runs_on_different_data_share_no_validation_axis() {
        let on = |name: &str, data: &str| {
            let data = Data { names: data.into(), rows_hash: data.into() };
            RunView { data, ..run(name, &[]) }
        };
        let text = page(&[on("a", "lake"), on("b", "coast")]).unwrap();
        crate::report::pages::html::assert_stands_alone(&text);
        assert!(text.contains("trained on different rows"));
        assert!(text.contains("Validation MSE, a on lake") && text.contains("Validation MSE, b on coast"));
        assert!(
            page(&[on("a", "lake"), on("b", "lake")]).unwrap().matches("Validation MSE").count()
                < text.matches("Validation MSE").count()
        );
    }
}
