//! Lists the TOML files of `data/` that are built into the program: to add a recipe, a preset or a track is to add its file.

use std::env;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    let root = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").expect("cargo sets it"));
    let out = PathBuf::from(env::var_os("OUT_DIR").expect("cargo sets it"));
    for folder in ["recipes", "preprocessing", "tracks"] {
        println!("cargo::rerun-if-changed=data/{folder}");
        let list = list(&root.join("data").join(folder));
        fs::write(out.join(format!("{folder}.rs")), list).expect("the output folder can be written");
    }
}

/// An expression: name and text of each TOML file in `folder`, sorted by name.
fn list(folder: &Path) -> String {
    let entries = fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display()));
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.expect("a readable folder").path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "toml"));
    files.sort_by_key(|path| path.file_stem().map(|name| name.to_owned()));
    let mut text = String::from("&[\n");
    for path in files {
        let name = path.file_stem().and_then(|name| name.to_str()).expect("names are UTF-8");
        let path = path.to_str().expect("the path of the source is UTF-8");
        // Writing to a String cannot fail.
        let _ = writeln!(text, "    ({name:?}, include_str!({path:?})),");
    }
    text + "]"
}
