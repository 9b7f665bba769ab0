//! Damaged and hostile files: whatever is in them, the answer is an error or a value, never a panic, and memory stays bounded.
//!
//! Valid files of every format are damaged at random, from a seed, and read. Each format is read for some tenths of a second;
//! `STEERSMAN_FUZZ_SECONDS=300 cargo test --release --test hostile_files -- --nocapture` takes 300 s for each, and prints a table.
//! `STEERSMAN_FUZZ_ONLY=keras2` leaves out those whose name in the table is another, `STEERSMAN_FUZZ_SEED=…` begins elsewhere. A failure names its seed, and repeats with it.

mod common;

use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use cap::Cap;
use common::hammer::{Hammer, damage, damage_text, without_digest};
use steersman::engine::tensor::Shape;
use steersman::exchange::keras::{ImportOptions, import};
use steersman::exchange::presets;
use steersman::files::zip_archive::{ZipArchive, ZipEntry};
use steersman::model_file::{Model, TrainingRecord};
use steersman::recipe::Recipe;
use steersman::simulator::Track;
use steersman_kernels::Isa;

/// Counts every allocation, and ends the process at the limit.
#[global_allocator]
static MEMORY: Cap<std::alloc::System> = Cap::new(std::alloc::System, 1 << 30);

/// Memory that a damaged file of about 100 KB may take.
const MAX_BYTES: usize = 64 << 20;

/// The harness.
const HAMMER: Hammer = Hammer { memory: &MEMORY, max_bytes: MAX_BYTES };

/// One test at a time, so that memory belongs to it.
static ALONE: Mutex<()> = Mutex::new(());

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/keras").join(name)
}

/// Writes `bytes` where a command would find them.
fn stored(folder: &Path, bytes: &[u8]) -> PathBuf {
    let path = folder.join("file");
    std::fs::write(&path, bytes).unwrap();
    path
}

fn import_bytes(folder: &Path, bytes: &[u8], options: &ImportOptions) -> Result<(), String> {
    let imported = import(&stored(folder, bytes), options).map_err(|e| e.to_string())?;
    let preprocessing = toml::from_str(&format!("resize = [{}, {}]", imported.input.h, imported.input.w));
    let preprocessing = preprocessing.map_err(|e| e.to_string())?;
    imported.into_model("damaged", preprocessing).map(|_| ()).map_err(|e| e.to_string())
}

/// The entries of a `.keras` archive.
fn entries(name: &str) -> Vec<(String, Vec<u8>)> {
    let mut file = std::fs::File::open(golden(name)).unwrap();
    let archive = ZipArchive::open(&mut file).unwrap();
    let read = |entry: &ZipEntry| (entry.name.clone(), ZipArchive::read(&mut file, entry, 1 << 20).unwrap());
    archive.entries().iter().map(read).collect()
}

/// An archive of deflated `entries`.
fn archive(entries: &[(String, Vec<u8>)]) -> Vec<u8> {
    let (mut bytes, mut directory) = (Vec::new(), Vec::new());
    for (name, content) in entries {
        let mut encoder = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::default());
        encoder.write_all(content).unwrap();
        let packed = encoder.finish().unwrap();
        let mut crc = flate2::Crc::new();
        crc.update(content);
        let mut common = b"\x14\0\0\0\x08\0\0\0\0\0".to_vec();
        for number in [crc.sum(), packed.len() as u32, content.len() as u32, name.len() as u32] {
            common.extend(number.to_le_bytes());
        }
        directory.extend([&b"PK\x01\x02\x14\0"[..], &common, &[0; 10], &(bytes.len() as u32).to_le_bytes()].concat());
        directory.extend(name.as_bytes());
        bytes.extend([&b"PK\x03\x04"[..], &common, name.as_bytes(), &packed].concat());
    }
    let end = [directory.len() as u32, bytes.len() as u32].map(u32::to_le_bytes).concat();
    let count = (entries.len() as u16).to_le_bytes();
    [&bytes[..], &directory, b"PK\x05\x06\0\0\0\0", &count, &count, &end, &[0; 2]].concat()
}

#[test]
fn damaged_keras_files_are_refused() {
    let _alone = ALONE.lock();
    let folder = tempfile::tempdir().unwrap();
    let options = ImportOptions::default();
    for name in ["keras1.h5", "keras2.h5", "keras3.h5"] {
        let bytes = std::fs::read(golden(name)).unwrap();
        HAMMER.strike(name, &bytes, 0.6, damage, |bytes: &Vec<u8>| import_bytes(folder.path(), bytes, &options));
    }
    let bytes = std::fs::read(golden("keras3.keras")).unwrap();
    HAMMER.strike("keras3.keras", &bytes, 0.2, damage, |bytes: &Vec<u8>| import_bytes(folder.path(), bytes, &options));

    let theano = ImportOptions { input: Some(Shape::new(3, 20, 28)), ..ImportOptions::default() };
    let json = std::fs::read(golden("keras1-theano.json")).unwrap();
    let weights = golden("keras1-theano-weights.h5");
    let path = folder.path().join("architecture.json");
    HAMMER.strike("an architecture in a string", &json, 0.2, damage_text, |bytes: &Vec<u8>| {
        std::fs::write(&path, bytes).unwrap();
        let options = ImportOptions { architecture: Some(path.clone()), ..theano.clone() };
        import(&weights, &options).map(|_| ()).map_err(|e| e.to_string())
    });
    // Damage within an intact archive.
    let original = entries("keras3.keras");
    for (place, (name, bytes)) in original.iter().enumerate().filter(|(_, (name, _))| name != "metadata.json") {
        let damage = if name.ends_with("json") { damage_text } else { damage };
        HAMMER.strike(&format!("{name} in keras3.keras"), bytes, 0.6, damage, |bytes: &Vec<u8>| {
            let mut entries = original.clone();
            entries[place].1 = bytes.to_vec();
            import_bytes(folder.path(), &archive(&entries), &options)
        });
    }
}

#[test]
fn damaged_files_of_our_own_are_refused() {
    let _alone = ALONE.lock();
    let folder = tempfile::tempdir().unwrap();
    let recipe = Recipe::find("lenet", &["layers=[{kind='conv2d', filters=2, kernel=[9, 9], stride=[4, 4]}, {kind='batch_norm'}, \
        {kind='prelu'}, {kind='leaky_relu', slope=0.1}, {kind='zero_pad', rows=[1, 1]}, {kind='max_pool', window=[4, 4]}, \
        {kind='dense', units=1}]".to_string()])
    .unwrap();
    let parameters = recipe.network(Isa::PORTABLE).unwrap().initialize(1);
    let path = folder.path().join("model.safetensors");
    let model = Model { recipe, parameters, record: TrainingRecord::default(), training_rows: vec![1, 2, 3] };
    model.save(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let load = |bytes: &Vec<u8>| Model::load(&stored(folder.path(), bytes)).map(|_| ()).map_err(|e| e.to_string());
    HAMMER.strike("a model file", &bytes, 0.4, damage, load);
    // Files of earlier versions have no digest: damage comes as far as the tensors and the recipe.
    let bytes = without_digest(&bytes);
    HAMMER.strike("a model file without a digest", &bytes, 0.4, damage, load);
    HAMMER.strike(
        "the header of a model file",
        &bytes,
        0.4,
        |random, bytes: &mut Vec<u8>| {
            let tensors = bytes.split_off(8 + u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize);
            let mut header = bytes.split_off(8);
            damage_text(random, &mut header);
            *bytes = [&(header.len() as u64).to_le_bytes()[..], &header, &tensors].concat();
        },
        load,
    );

    let text = model.recipe.to_toml().unwrap();
    HAMMER.strike("a recipe", &text.into_bytes(), 0.4, damage_text, |bytes: &Vec<u8>| {
        let text = std::str::from_utf8(bytes).map_err(|e| e.to_string())?;
        Recipe::parse("damaged", text, &[]).map(|_| ()).map_err(|e| e.to_string())
    });
    let track = include_str!("../data/tracks/coast.toml").as_bytes().to_vec();
    HAMMER.strike("a track file", &track, 0.4, damage_text, |bytes: &Vec<u8>| {
        let text = std::str::from_utf8(bytes).map_err(|e| e.to_string())?;
        Track::from_toml(text, "damaged").map(|_| ()).map_err(|e| e.to_string())
    });
    let toml = folder.path().join("p.toml");
    let name = toml.to_str().unwrap().to_string();
    let table = "source = [160, 320]\nrows = [40, 138]\nresize = [64, 64]\ninterpolation = 'area'\ncolour = 'hsv'\nscale = 0.5\n";
    HAMMER.strike("a preprocessing", &table.as_bytes().to_vec(), 0.2, damage_text, |bytes: &Vec<u8>| {
        std::fs::write(&toml, bytes).unwrap();
        presets::find(&name).map(|_| ()).map_err(|e| e.to_string())
    });
}

#[test]
fn valid_files_that_mean_harm_are_refused() {
    let _alone = ALONE.lock();
    let folder = tempfile::tempdir().unwrap();
    let refused = |bytes: &[u8]| {
        let before = MEMORY.allocated();
        MEMORY.set_limit(before + MAX_BYTES).unwrap();
        let message = import_bytes(folder.path(), bytes, &ImportOptions::default()).unwrap_err();
        MEMORY.set_limit(1 << 30).unwrap();
        message
    };
    let file = |name: &str| std::fs::read(golden(name)).unwrap();
    // A group that contains itself, tensors larger than the file, tensors in another file.
    assert!(refused(&file("hostile-cycle.h5")).contains("of `dense`"));
    assert!(refused(&file("hostile-huge.h5")).contains("kernel"));
    assert!(refused(&file("hostile-elsewhere.h5")).contains("kernel"));

    // An archive of kilobytes that unpacks to hundreds of megabytes.
    let mut entries = entries("keras3.keras");
    let place = entries.iter().position(|(name, _)| name == "config.json").unwrap();
    entries[place].1 = vec![b' '; 300 << 20];
    let bomb = archive(&entries);
    assert!(bomb.len() < 1 << 20);
    let message = refused(&bomb);
    assert!(message.contains("unpacks to more than"), "{message}");
    // Brackets without end.
    entries[place].1 = b"[".repeat(100_000);
    assert!(refused(&archive(&entries)).contains("no JSON"));
    // An archive of nothing, and one without weights.
    assert!(!refused(&archive(&[])).is_empty());
    assert!(!refused(&archive(&entries[..1])).is_empty());

    // JSON that is much larger when it is parsed: refused by its length, or within the bound.
    for len in [3 << 20, 1 << 20] {
        entries[place].1 = b"[".iter().chain(b"0,".repeat(len / 2 - 2).iter()).chain(b"0]").copied().collect();
        let message = refused(&archive(&entries));
        let expected = if len > 1 << 20 { "unpacks to more than" } else { "has 524287 layers" };
        assert!(message.contains(expected), "{message}");
        let path = folder.path().join("long.json");
        std::fs::write(&path, &entries[place].1).unwrap();
        let options = ImportOptions { architecture: Some(path), ..ImportOptions::default() };
        assert!(import(&golden("keras1-theano-weights.h5"), &options).is_err());
    }
}

/// Sizes whose products do not fit into a machine's word, or into its memory.
#[test]
fn maps_beyond_all_measure_are_refused() {
    let _alone = ALONE.lock();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("architecture.json");
    let refused = |layers: &str| {
        std::fs::write(&path, format!(r#"{{"class_name": "Sequential", "config": [{layers}]}}"#)).unwrap();
        let options = ImportOptions { architecture: Some(path.clone()), ..ImportOptions::default() };
        let before = MEMORY.allocated();
        MEMORY.set_limit(before + MAX_BYTES).unwrap();
        let message = import(&golden("keras1-theano-weights.h5"), &options).unwrap_err().to_string();
        MEMORY.set_limit(1 << 30).unwrap();
        message
    };
    let input = |shape: &str| {
        format!(r#"{{"class_name": "InputLayer", "config": {{"name": "in", "batch_input_shape": [null, {shape}]}}}}"#)
    };
    for shape in ["1e9, 1e9, 1e9", "8193, 1, 1", "1, 8193, 1", "1, 1, 1e9", "8192, 8192, 2"] {
        let message = refused(&input(shape));
        assert!(message.contains("is too large"), "{shape}: {message}");
    }
    let padding = r#"{"class_name": "ZeroPadding2D", "config": {"name": "pad", "padding": [1e9, 1e9]}}"#;
    let message = refused(&format!("{}, {padding}", input("20, 28, 3")));
    assert!(message.contains("pad (ZeroPadding2D): the padded map would have more than"), "{message}");
    let conv = r#"{"class_name": "Conv2D", "config": {"name": "conv", "filters": 1e9, "kernel_size": [1e9, 1e9], "padding": "same"}}"#;
    let message = refused(&format!("{}, {conv}", input("20, 28, 3")));
    assert!(message.contains("conv"), "{message}");
}
