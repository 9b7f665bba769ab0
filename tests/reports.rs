//! The pages and pictures of the program, as a user makes them from a painted log.

mod common;

use std::fs;
use std::path::Path;

use common::command::{error, json, run};
use common::painted_log;
use roxmltree::{Document, ParsingOptions};

/// Largest page.
const MAX_BYTES: u64 = 10_000_000;

fn folder_with_log(rows: usize) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    painted_log::write(&folder.path().join("log"), rows, "");
    folder
}

/// Reads a page; it must be well-formed, load nothing, and stay small. Returns its text, and how many pictures it holds.
fn page(path: &Path) -> (String, usize) {
    assert!(fs::metadata(path).unwrap().len() < MAX_BYTES);
    let text = fs::read_to_string(path).unwrap();
    let document =
        Document::parse_with_options(&text, ParsingOptions { allow_dtd: true, ..Default::default() }).unwrap();
    let (mut pictures, mut shown) = (0, String::new());
    for node in document.descendants() {
        let name = node.tag_name().name();
        assert!(!["link", "iframe", "object", "embed"].contains(&name), "<{name}>");
        for attribute in node.attributes().filter(|a| ["src", "href", "srcset"].contains(&a.name())) {
            assert!(attribute.value().starts_with("data:image/"), "{name} loads {}", attribute.value());
            assert!(attribute.value().len() > 100, "an empty picture in {}", path.display());
            pictures += 1;
        }
        // Not the pictures, whose letters may spell anything.
        shown.extend(node.attributes().map(|a| a.value()).filter(|value| !value.starts_with("data:")));
        shown.extend(node.is_text().then(|| node.text()).flatten());
    }
    assert!(!shown.contains("NaN") && !shown.contains("url("), "{}", path.display());
    (text, pictures)
}

fn is_png(path: &Path) -> bool {
    image::open(path).is_ok_and(|image| image.width() > 1 && image.height() > 1)
}

#[test]
fn inspect_writes_one_page_and_overwrites_none() {
    let folder = folder_with_log(900);
    let dir = folder.path();
    let found = json(dir, &["inspect", "log", "--out", "page", "--recipe", "lenet", "--json"]);
    assert_eq!(found[0]["pictures"]["seen"], 900);
    // 20.5 mph for 89.9 s.
    assert!((found[0]["distance_m"].as_f64().unwrap() - 20.5 * 0.44704 * 89.9).abs() < 0.1, "{found}");
    let (text, pictures) = page(&dir.join("page/report.html"));
    // 5 rows of 3 cameras and a mirror; 2 frames in 8 colour spaces and as they are.
    assert!(pictures >= 5 * 4 + 2 * 9, "{pictures}");
    for part in ["900 of 900", "leak audit: 0.0 %", "saturation, the recipe&#39;s", "Before: labels as recorded"] {
        assert!(text.contains(part), "{part}");
    }
    assert!(error(dir, &["inspect", "log", "--out", "page"]).contains("exists already"));
    assert_eq!(fs::read_to_string(dir.join("page/report.html")).unwrap(), text);
}

#[test]
fn a_log_without_images_and_a_short_one_have_a_page_too() {
    let folder = folder_with_log(30);
    let dir = folder.path();
    fs::create_dir(dir.join("lost")).unwrap();
    fs::copy(dir.join("log/driving_log.csv"), dir.join("lost/driving_log.csv")).unwrap();
    // The page is written for both, and the command fails because of the one.
    assert!(error(dir, &["inspect", "log", "lost", "--out", "page"]).contains("lost: none of 30 rows can be used"));
    let (text, _) = page(&dir.join("page/report.html"));
    assert!(text.contains("no row has its images") && text.contains("cannot be trained on this"));
}

#[test]
fn a_run_has_its_report_also_after_resume_and_runs_compare() {
    let folder = folder_with_log(1200);
    let dir = folder.path();
    let train = ["train", "log", "--recipe", "lenet", "--json", "--set"];
    run(dir, &[&train[..], &["epochs=2", "--out", "a"]].concat());
    run(dir, &[&train[..], &["epochs=1", "--set", "optimizer.learning_rate=0.01", "--out", "b"]].concat());
    let (text, pictures) = page(&dir.join("a/report.html"));
    assert_eq!(pictures, 24);
    let history = fs::read_to_string(dir.join("a/history.csv")).unwrap();
    let mse: f64 = history.lines().nth(2).unwrap().split(',').nth(2).unwrap().parse().unwrap();
    assert!(text.contains(&format!("{mse:.5}")), "the validation MSE of epoch 2, {mse}");
    for part in ["28,589", "conv 3x3", "keep_zero = 0.4", "Each frame"] {
        assert!(text.contains(part), "{part}");
    }
    fs::remove_file(dir.join("a/report.html")).unwrap();
    run(dir, &["train", "--resume", "a"]);
    assert_eq!(page(&dir.join("a/report.html")).1, 24);

    run(dir, &["drive", "a/last.safetensors", "--track", "lake", "--runs", "1", "--out", "a/drives/lake"]);
    run(dir, &["train", "--resume", "a"]);
    let (text, _) = page(&dir.join("a/report.html"));
    let place = |part: &str| text.find(part).unwrap_or_else(|| panic!("{part}"));
    assert!(place("On the road") < place("lake: autonomy") && place("lake: autonomy") < place("Learning curves"));
    run(dir, &["compare", "a", "b", "--out", "c.html"]);
    let (text, _) = page(&dir.join("c.html"));
    for part in ["optimizer.learning_<wbr/>rate", "autonomy", "from the line", "Validation MSE"] {
        assert!(text.contains(part), "{part}");
    }
    assert!(!text.contains("optimizer.beta1"), "what is the same is not listed");
    assert!(error(dir, &["compare", "a", "--out", "c.html"]).contains("exists already"));
    assert!(error(dir, &["compare", "log"]).contains("is no run folder"));
}

#[test]
fn explain_writes_pictures_and_says_what_the_model_looks_at() {
    let folder = folder_with_log(700);
    let dir = folder.path();
    run(dir, &["train", "log", "--recipe", "lenet", "--set", "epochs=8", "--json", "--out", "a"]);
    let found = json(dir, &["explain", "a/model.safetensors", "log", "--out", "e", "--json"]);
    assert_eq!(found["pictures"], 700);
    let effect = |change: &str| {
        found["effects"].as_array().unwrap().iter().find(|effect| effect["change"] == change).unwrap().clone()
    };
    // The painted stripe is all there is to go by, and it stands on the road.
    assert_eq!(effect("mask-road")["passed"], true, "{found}");
    assert_eq!(effect("shift-right")["passed"], true, "{found}");
    assert!(found["findings"][0]["text"].as_str().unwrap().contains("a wheel held straight"), "{found}");
    assert!(found["mae_deg"].as_f64().unwrap() < found["straight_mae_deg"].as_f64().unwrap(), "{found}");
    let moved = |change: &str| effect(change)["mean_moved_deg"].as_f64().unwrap();
    assert!(moved("mask-road") > 2.0 * moved("mask-bonnet"), "{found}");
    for file in found["pictures_written"].as_array().unwrap() {
        assert!(is_png(&dir.join(file.as_str().unwrap())), "{file}");
    }
    let (text, pictures) = page(&dir.join("e/explain.html"));
    // 12 with saliency, 12 changed ones, filters, feature maps of two convolutions.
    assert_eq!(pictures, 12 + 12 + 1 + 2);
    assert!(text.contains("6 filters of 3x3 on saturation"));
    for (args, expected) in [
        (&["explain", "a/model.safetensors", "log", "--out", "e"][..], "exists already"),
        (&["explain", "a/model.safetensors", "nothing.jpg", "--out", "f"], "nothing.jpg"),
        (&["explain", "a/history.csv", "log", "--out", "f"], "history.csv"),
        (&["explain", "a/model.safetensors", "--track", "lke", "--out", "f"], "did you mean `lake`"),
    ] {
        assert!(error(dir, args).contains(expected), "{args:?}");
    }
    assert!(!dir.join("f").exists(), "what cannot be explained leaves no folder behind");
}

#[test]
fn summary_draws_the_network() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    run(dir, &["summary", "--recipe", "pilotnet", "--svg", "p.svg"]);
    let text = fs::read_to_string(dir.join("p.svg")).unwrap();
    assert!(Document::parse(&text).is_ok() && text.contains("31x98x24") && text.contains("252,219 parameters"));
    assert!(error(dir, &["summary", "--svg", "p.svg"]).contains("exists already"));
}
