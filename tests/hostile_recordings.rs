//! Damaged and hostile recordings, pictures and run folders: whatever is in them, the answer is an error, a notice or a value, never a
//! panic, and memory stays bounded.
//!
//! As `hostile_files`: valid recordings of every format are damaged at random, from a seed, byte by byte and field by field, and
//! read. Each format is read for some tenths of a second; `STEERSMAN_FUZZ_SECONDS=300 cargo test --release --test
//! hostile_recordings -- --nocapture` takes 300 s for each, and prints a table. `STEERSMAN_FUZZ_SEED=…` begins elsewhere.

mod common;

use std::fs;
use std::path::Path;
use std::sync::Mutex;

use cap::Cap;
use common::archive::{Tree, tar_gz, zip};
use common::hammer::{Hammer, damage, damage_text, without_digest};
use flate2::Compression;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use steersman::dataset::inspect::{Treatment, inspect};
use steersman::dataset::{Description, recordings_below};
use steersman::observer::{StopSignal, Unobserved};
use steersman::picture::RgbImage;
use steersman::picture::decode::{decode_rgb, image_size};
use steersman::recipe::Recipe;
use steersman::training::{TrainRequest, TrainingEvent, resume, train};

/// Counts every allocation, and ends the process at the limit.
#[global_allocator]
static MEMORY: Cap<std::alloc::System> = Cap::new(std::alloc::System, usize::MAX);

/// The harness: recordings of some kilobytes take no more than this.
const HAMMER: Hammer = Hammer { memory: &MEMORY, max_bytes: 256 << 20 };

/// One test at a time, so that memory belongs to it.
static ALONE: Mutex<()> = Mutex::new(());

/// Rows of a recording.
const ROWS: usize = 6;

/// Seconds that each reader is tried.
const SECONDS: f64 = 0.2;

/// A JPEG of 16x8 pixels.
fn jpeg(row: usize, progressive: bool) -> Vec<u8> {
    let pixels: Vec<u8> = (0..16 * 8 * 3).map(|i| (i * 7 + row * 31) as u8).collect();
    let mut bytes = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 80);
    encoder.set_progressive(progressive);
    encoder.encode(&pixels, 16, 8, jpeg_encoder::ColorType::Rgb).unwrap();
    bytes
}

fn label(row: usize) -> f64 {
    (row as f64 * 0.7).sin() * 0.4
}

fn lines(of: impl Fn(usize) -> String) -> Vec<u8> {
    (0..ROWS).map(|row| of(row) + "\n").collect::<String>().into_bytes()
}

/// Pictures of every row, whose names `name` gives.
fn pictures(name: impl Fn(usize) -> String) -> Tree {
    (0..ROWS).map(|row| (name(row), jpeg(row, false))).collect()
}

fn with(mut tree: Tree, name: &str, bytes: Vec<u8>) -> Tree {
    tree.insert(name.into(), bytes);
    tree
}

/// Recordings of each format, by what they are called in the table, and the files of each that are damaged.
fn recordings() -> Vec<(&'static str, Tree, Vec<&'static str>)> {
    let time = |row: usize| format!("2026_01_01_00_00_{:02}_{:03}", row / 10, row % 10 * 100);
    let udacity = |header: &str| {
        let mut log = header.as_bytes().to_vec();
        log.extend(lines(|row| {
            let [c, l, r] = ["center", "left", "right"].map(|camera| format!("IMG/{camera}_{}.jpg", time(row)));
            format!("{c}, {l}, {r}, {}, 0.5, 0, 20.1", label(row))
        }));
        let mut tree = Tree::new();
        for camera in ["center", "left", "right"] {
            tree.extend(pictures(|row| format!("IMG/{camera}_{}.jpg", time(row))));
        }
        with(tree, "driving_log.csv", log)
    };
    let catalog = lines(|row| {
        format!(
            "{{\"_index\": {row}, \"_timestamp_ms\": {}, \"cam/image_array\": \"{row}_cam_image_array_.jpg\", \
             \"user/angle\": {}, \"user/throttle\": 0.5, \"user/mode\": \"user\", \"pilot/angle\": 0.1}}",
            1000 + 50 * row,
            label(row)
        )
    });
    let manifest = "[\"cam/image_array\", \"user/angle\"]\n[\"image_array\", \"float\"]\n{}\n{\"created_at\": 1.0}\n{\"paths\": \
        [\"catalog_0.catalog\"], \"current_index\": 6, \"max_len\": 1000, \"deleted_indexes\": [4]}\n";
    let lengths: Vec<String> = catalog.split(|&byte| byte == b'\n').map(|line| (line.len() + 1).to_string()).collect();
    let catalog_manifest =
        format!("{{\"path\": \"catalog_0.catalog\", \"start_index\": 0, \"line_lengths\": [{}]}}", lengths.join(", "));
    let mut tub = with(pictures(|row| format!("images/{row}_cam_image_array_.jpg")), "catalog_0.catalog", catalog);
    tub.insert("manifest.json".into(), manifest.into());
    tub.insert("catalog_0.catalog_manifest".into(), catalog_manifest.into());
    let mut tub1 = pictures(|row| format!("{row}_cam-image_array_.jpg"));
    for row in 0..ROWS {
        let record = format!(
            "{{\"cam/image_array\": \"{row}_cam-image_array_.jpg\", \"user/angle\": {}, \"user/throttle\": 0.2, \
             \"user/mode\": \"user\", \"milliseconds\": {}}}",
            label(row),
            row * 50
        );
        tub1.insert(format!("record_{row}.json"), record.into());
    }
    tub1.insert("meta.json".into(), b"{\"inputs\": [\"cam/image_array\"]}".to_vec());
    tub1.insert("exclude.json".into(), b"[3]".to_vec());
    let stamp = |row: usize| 1_479_424_215_877_962_784_u64 + row as u64 * 50_000_000;
    let mut challenge = b"index,timestamp,width,height,frame_id,filename,angle,torque,speed,lat,long,alt\n".to_vec();
    challenge.extend(lines(|row| {
        format!("0,{0},16,8,center_camera,center/{0}.jpg,{1},0.1,8.9,37.3,-122.3,42", stamp(row), 0.3 * label(row))
    }));
    let data_txt = lines(|row| format!("{row}.jpg {},2018-07-01 17:09:00:{:03}", 40.0 * label(row), row * 50));
    let described = b"unit = \"lock\"\nfull_lock_deg = 25.0\nhz = 30.0\nlabels = \"user\"\n[columns]\nsteering = 4\ncenter = \"center\"\n";
    let header = "center,left,right,steering,throttle,brake,speed\n";
    let named = |row: usize| format!("frame_{row:05}_ttl_0.25_agl_{:.3}_mil_0.0.jpg", label(row));
    vec![
        ("Udacity log with a header", udacity(header), vec!["driving_log.csv"]),
        ("Udacity log without a header", udacity(""), vec!["driving_log.csv"]),
        ("steersman.toml", with(udacity(header), "steersman.toml", described.to_vec()), vec!["steersman.toml"]),
        ("donkeycar tub, format 2", tub, vec!["manifest.json", "catalog_0.catalog", "catalog_0.catalog_manifest"]),
        ("donkeycar tub, format 1", tub1, vec!["record_0.json", "record_3.json", "meta.json", "exclude.json"]),
        (
            "challenge 2",
            with(pictures(|row| format!("center/{}.jpg", stamp(row))), "interpolated.csv", challenge),
            vec!["interpolated.csv"],
        ),
        ("text lines", with(pictures(|row| format!("data/{row}.jpg")), "data.txt", data_txt), vec!["data.txt"]),
        ("labels in names", pictures(named), vec![]),
    ]
}

/// Everything that is found out about the recording at `path`: an error unless it is `expected`.
fn read(path: &Path, expected: Option<&str>) -> Result<String, String> {
    let inspection =
        inspect(path, &Description::default(), &Treatment::default(), &mut Unobserved).map_err(|e| e.to_string())?;
    inspection.recording.require_usable().map_err(|e| e.to_string())?;
    let mut recording = inspection.recording;
    recording.hash_pictures();
    let ids: Vec<u64> = (0..recording.rows.len()).map(|row| recording.row_id(row)).collect();
    let found = format!("{}\n{}\n{ids:?}", inspection.report, serde_json::to_string(&inspection.report).unwrap());
    match expected {
        Some(expected) if found != expected => Err("something else is found".into()),
        _ => Ok(found),
    }
}

fn write(tree: &Tree, folder: &Path) {
    for (name, bytes) in tree {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
}

fn below(random: &mut ChaCha8Rng, bound: usize) -> usize {
    (random.next_u64() % bound.max(1) as u64) as usize
}

/// Damages one field of a log, or one line, or some bytes.
fn damage_fields(random: &mut ChaCha8Rng, bytes: &mut Vec<u8>) {
    const VALUES: [&str; 24] = [
        "",
        " ",
        "nan",
        "inf",
        "-inf",
        "1e400",
        "-1",
        "0",
        "1",
        "2.5",
        "90",
        "18446744073709551616",
        "-9223372036854775808",
        "null",
        "\"",
        "'",
        "\\",
        "/dev/zero",
        "../../etc/passwd",
        "a/../b",
        "\u{feff}",
        "\u{1b}[2J",
        "1,5",
        "true",
    ];
    for _ in 0..=below(random, 3) {
        let separators: Vec<usize> = (0..bytes.len()).filter(|&i| b",;:{}[] \n\t".contains(&bytes[i])).collect();
        let lines: Vec<usize> = (0..bytes.len()).filter(|&i| bytes[i] == b'\n').collect();
        match below(random, 8) {
            // A field becomes another value.
            0..=3 if separators.len() > 1 => {
                let at = below(random, separators.len() - 1);
                let value = VALUES[below(random, VALUES.len())];
                bytes.splice(separators[at] + 1..separators[at + 1], value.bytes());
            }
            // A separator goes, or becomes another one.
            4 if !separators.is_empty() => {
                let at = separators[below(random, separators.len())];
                let new = [&b""[..], b",", b";", b"\n", b"\r", b"\t", b"\0"][below(random, 7)];
                bytes.splice(at..at + 1, new.iter().copied());
            }
            // Lines are doubled, swapped with others, or go.
            5 if lines.len() > 1 => {
                let at = below(random, lines.len() - 1);
                let line = bytes[lines[at] + 1..=lines[at + 1]].to_vec();
                let to = lines[below(random, lines.len())] + 1;
                bytes.splice(to..to, line);
            }
            6 if lines.len() > 1 => {
                let at = below(random, lines.len() - 1);
                bytes.drain(lines[at] + 1..=lines[at + 1]);
            }
            _ => damage_text(random, bytes),
        }
    }
}

#[test]
fn damaged_recordings_of_every_format_are_read_or_refused() {
    let _alone = ALONE.lock();
    for (name, tree, targets) in recordings() {
        let folder = tempfile::tempdir().unwrap();
        write(&tree, folder.path());
        let expected = read(folder.path(), None).unwrap_or_else(|e| panic!("{name}: {e}"));
        let strike = |random: &mut ChaCha8Rng, damaged: &mut Tree| {
            if targets.is_empty() {
                let names: Vec<String> = damaged.keys().cloned().collect();
                let old = &names[below(random, names.len())];
                let mut new = old.clone().into_bytes();
                damage_fields(random, &mut new);
                let new = String::from_utf8_lossy(&new).replace(['\0', '/'], "_");
                let new: String = new.chars().take(60).collect();
                if !matches!(new.as_str(), "" | "." | "..") {
                    let bytes = damaged.remove(old).unwrap();
                    damaged.insert(new, bytes);
                }
                return;
            }
            // Now and then a picture: they lie beside the log.
            let pictures: Vec<String> = damaged.keys().filter(|name| name.ends_with(".jpg")).cloned().collect();
            let target = match below(random, 8) {
                0 => pictures[below(random, pictures.len())].clone(),
                _ => targets[below(random, targets.len())].to_string(),
            };
            let bytes = damaged.get_mut(&target).unwrap();
            if target.ends_with(".jpg") { damage(random, bytes) } else { damage_fields(random, bytes) }
        };
        let read_damaged = |damaged: &Tree| {
            let differ = |name: &&String| damaged.get(*name) != tree.get(*name);
            let changed: Vec<&String> = damaged.keys().chain(tree.keys()).filter(differ).collect();
            for name in &changed {
                match damaged.get(*name) {
                    Some(bytes) => fs::write(folder.path().join(name), bytes).unwrap(),
                    None => fs::remove_file(folder.path().join(name)).unwrap_or_default(),
                }
            }
            let result = read(folder.path(), Some(&expected)).map(drop);
            for name in &changed {
                match tree.get(*name) {
                    Some(bytes) => fs::write(folder.path().join(name), bytes).unwrap(),
                    None => fs::remove_file(folder.path().join(name)).unwrap_or_default(),
                }
            }
            result
        };
        HAMMER.strike(name, &tree, SECONDS, strike, read_damaged);
    }
}

#[test]
fn damaged_archives_are_read_or_refused() {
    let _alone = ALONE.lock();
    let (_, tree, _) = recordings().remove(0);
    let folder = tempfile::tempdir().unwrap();
    for (name, file, bytes) in [
        (".zip archive", "drive.zip", zip(&tree, "drive/")),
        (".tar.gz archive", "drive.tar.gz", tar_gz(&tree)),
        (".tar in a .tar.gz archive", "inner.tar.gz", unpacked(&tar_gz(&tree))),
    ] {
        let path = folder.path().join(file);
        let packs = file == "inner.tar.gz";
        let written = |bytes: &[u8]| {
            fs::write(&path, if packs { packed(bytes) } else { bytes.to_vec() }).unwrap();
        };
        written(&bytes);
        let expected = read(&path, None).unwrap();
        HAMMER.strike(name, &bytes, SECONDS, damage, |bytes: &Vec<u8>| {
            written(bytes);
            let _ = recordings_below(&path);
            read(&path, Some(&expected)).map(drop)
        });
    }
}

fn unpacked(bytes: &[u8]) -> Vec<u8> {
    let mut content = Vec::new();
    std::io::Read::read_to_end(&mut flate2::read::GzDecoder::new(bytes), &mut content).unwrap();
    content
}

fn packed(bytes: &[u8]) -> Vec<u8> {
    let mut packer = flate2::write::GzEncoder::new(Vec::new(), Compression::fast());
    std::io::Write::write_all(&mut packer, bytes).unwrap();
    packer.finish().unwrap()
}

#[test]
fn damaged_pictures_are_decoded_or_refused() {
    let _alone = ALONE.lock();
    // 16 megapixels in three passes are allowed; they take 400 MB while they are decoded.
    let hammer = Hammer { max_bytes: 700 << 20, ..HAMMER };
    let pixels: Vec<u8> = (0..48 * 40 * 3).map(|i| (i * i / 7) as u8).collect();
    let encoded = |progressive: bool, restart: u16, colour: jpeg_encoder::ColorType| {
        let mut bytes = Vec::new();
        let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, 85);
        encoder.set_progressive(progressive);
        if restart > 0 {
            encoder.set_restart_interval(restart);
        }
        let channels = if matches!(colour, jpeg_encoder::ColorType::Luma) { 1 } else { 3 };
        encoder.encode(&pixels[..48 * 40 * channels], 48, 40, colour).unwrap();
        bytes
    };
    let mut png = Vec::new();
    let encoder = image::codecs::png::PngEncoder::new(&mut png);
    image::ImageEncoder::write_image(encoder, &pixels, 48, 40, image::ExtendedColorType::Rgb8).unwrap();
    for (name, bytes) in [
        ("JPEG picture", encoded(false, 0, jpeg_encoder::ColorType::Rgb)),
        ("JPEG picture with restarts", encoded(false, 3, jpeg_encoder::ColorType::Rgb)),
        ("grey JPEG picture", encoded(false, 0, jpeg_encoder::ColorType::Luma)),
        ("progressive JPEG picture", encoded(true, 0, jpeg_encoder::ColorType::Rgb)),
        ("PNG picture", png),
    ] {
        hammer.strike(name, &bytes, SECONDS, damage, |bytes: &Vec<u8>| {
            let mut image = RgbImage::default();
            let size = image_size(bytes);
            decode_rgb(bytes, &mut image)?;
            let pixels = image.height * image.width * 3;
            if image.pixels.len() != pixels {
                return Err(format!("{} bytes of {pixels}", image.pixels.len()));
            }
            size.map(drop)
        });
    }
}

/// The files of a run that `--resume` reads, without the digests that later versions write beside them: damage comes as far as
/// what is in them.
#[test]
fn damaged_runs_go_on_or_are_refused() {
    let _alone = ALONE.lock();
    let folder = tempfile::tempdir().unwrap();
    let (log, run) = (folder.path().join("log"), folder.path().join("run"));
    common::painted_log::write(&log, 60, "");
    let layers = "layers=[{kind='scale', factor=0.004, offset=-0.5}, {kind='flatten'}, {kind='dense', units=1}]";
    let settings = [layers, "preprocessing.resize=[8, 8]", "batch=8", "epochs=3", "split.validation_share=0"];
    let recipe = Recipe::find("lenet", &settings.map(String::from)).unwrap();
    let request = TrainRequest { seed: 5, cache_mib: 1, ..TrainRequest::new(vec![log], recipe, run.clone()) };
    // It stops after its first epoch.
    let stop = StopSignal::default();
    let mut observer = |event: TrainingEvent| {
        if let TrainingEvent::Epoch { .. } = event {
            stop.request();
        }
        Ok(())
    };
    assert!(train(request, &mut observer, &stop).is_err());
    let mut files = Tree::new();
    for entry in fs::read_dir(&run).unwrap().map(|entry| entry.unwrap().path()).filter(|path| path.is_file()) {
        files.insert(entry.file_name().unwrap().to_str().unwrap().into(), fs::read(entry).unwrap());
    }
    assert!(files.remove("checksums.txt").is_some());
    files.remove("result.json");
    let checkpoint = without_digest(&files["checkpoint.safetensors"]);
    files.insert("checkpoint.safetensors".into(), checkpoint);
    let written = |files: &Tree| {
        fs::remove_dir_all(&run).unwrap();
        write(files, &run);
    };
    for (name, target) in
        [("checkpoint", "checkpoint.safetensors"), ("run.json", "run.json"), ("recipe.toml of a run", "recipe.toml")]
    {
        let strike = |random: &mut ChaCha8Rng, files: &mut Tree| {
            let bytes = files.get_mut(target).unwrap();
            if target.ends_with("tensors") && below(random, 2) == 0 {
                let tensors = bytes.split_off(8 + u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize);
                let mut header = bytes.split_off(8);
                damage_text(random, &mut header);
                *bytes = [&(header.len() as u64).to_le_bytes()[..], &header, &tensors].concat();
            } else if target.ends_with("tensors") {
                damage(random, bytes);
            } else {
                damage_fields(random, bytes);
            }
        };
        HAMMER.strike(name, &files, SECONDS, strike, |files: &Tree| {
            written(files);
            // It stops again after its next step.
            let stop = StopSignal::default();
            let mut observer = |event: TrainingEvent| {
                if let TrainingEvent::Batch { .. } = event {
                    stop.request();
                }
                Ok(())
            };
            match resume(&run, false, &mut observer, &stop) {
                Err(steersman::Error::Interrupted) | Ok(_) => Ok(()),
                Err(error) => Err(error.to_string()),
            }
        });
    }
}
