//! The simulator as a user meets it: `tracks`, `record` and `drive` with good and bad input.

mod common;

use std::fs;
use std::path::Path;
use std::process::Command;

use common::command::{error, json, run};
use sha2::{Digest, Sha256};

/// Name and hash of every file below a folder, sorted.
fn files(folder: &Path) -> Vec<(String, String)> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() {
            found.extend(files(&path).into_iter().map(|(inside, hash)| (format!("{name}/{inside}"), hash)));
        } else {
            let hash = Sha256::digest(fs::read(&path).unwrap());
            found.push((name, hash.iter().map(|byte| format!("{byte:02x}")).collect()));
        }
    }
    found.sort();
    found
}

fn names(folder: &Path) -> Vec<String> {
    files(folder).into_iter().map(|(name, _)| name).collect()
}

#[test]
fn the_same_seed_gives_the_same_log_images_and_trajectories_for_any_number_of_threads() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    let record = |threads: &str, seed: &str, out: &str| {
        let what = ["record", "--track", "mountain", "--laps", "0.03", "--noise", "0.05", "--recovery"];
        run(dir, &[&what[..], &["--threads", threads, "--seed", seed, "--out", out]].concat());
        files(&dir.join(out))
    };
    let first = record("1", "4", "one");
    assert!(first.len() > 60, "{first:?}");
    assert_eq!(first, record("1", "4", "again"));
    assert_eq!(first, record("2", "4", "two"));
    assert_eq!(first, record("5", "4", "five"));
    assert_ne!(first, record("1", "5", "other"));

    let drive = |threads: &str, seed: &str, out: &str| {
        let what = ["drive", "zero", "--track", "random:3", "--runs", "3", "--noise", "0.1"];
        let summary = json(dir, &[&what[..], &["--threads", threads, "--seed", seed, "--out", out, "--json"]].concat());
        let mut files = files(&dir.join(out));
        // The summary tells how fast the machine was.
        files.retain(|(name, _)| name != "summary.json");
        (files, summary["cte_rms_m"].clone(), summary["distance_m"].clone())
    };
    let first = drive("1", "7", "drive-one");
    assert_eq!(first.0.len(), 7, "three free runs, three assisted ones, and the map");
    assert_eq!(first, drive("2", "7", "drive-two"));
    assert_eq!(first, drive("5", "7", "drive-five"));
    assert_ne!(first, drive("1", "8", "drive-other"));
}

#[test]
fn every_option_of_record_makes_a_recording_that_inspect_reads_whole() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    let record = |out: &str, more: &[&str]| {
        let what = ["record", "--track", "lake", "--laps", "0.05", "--out", out, "--json"];
        let made = json(dir, &[&what[..], more].concat());
        let report = json(dir, &["inspect", out, "--json"])[0].clone();
        assert!(made["rows"].as_u64().unwrap() > 20, "{made}");
        assert_eq!((&report["rows"], &report["usable"]), (&made["rows"], &made["rows"]), "{out}");
        let side: toml::Table = fs::read_to_string(dir.join(out).join("recording.toml")).unwrap().parse().unwrap();
        for (key, value) in made.as_object().unwrap() {
            assert_eq!(side[key].to_string().trim_matches('"'), value.to_string().trim_matches('"'), "{key}");
        }
        fs::read_to_string(dir.join(out).join("driving_log.csv")).unwrap()
    };
    let steering = |log: &str| -> Vec<f64> {
        let field = |line: &str| line.split(',').nth(3).and_then(|f| f.trim().parse().ok());
        log.lines().filter_map(field).collect()
    };
    let zeros = |log: &str| steering(log).iter().filter(|s| **s == 0.0).count();

    let plain = record("plain", &[]);
    assert!(
        plain.starts_with("center,left,right,steering,throttle,brake,speed\nIMG/center_2026_01_01_12_00_00_000.jpg, ")
    );
    let reverse = record("reverse", &["--reverse"]);
    assert_ne!(steering(&plain), steering(&reverse));
    let keyboard = record("keyboard", &["--style", "keyboard"]);
    assert!(zeros(&keyboard) > 5 && zeros(&plain) == 0);
    let recovery = record("recovery", &["--recovery"]);
    let mean = |log: &str| steering(log).iter().map(|s| s.abs()).sum::<f64>() / steering(log).len() as f64;
    assert!(mean(&recovery) > mean(&plain), "{} {}", mean(&recovery), mean(&plain));
    let v2 = record("v2", &["--format", "v2"]);
    // The paths are those of the finished folder, not of the one it was made in.
    let image = v2.split(',').next().unwrap();
    assert!(Path::new(image).is_absolute() && Path::new(image).is_file(), "{image}");
    assert_eq!(fs::canonicalize(image).unwrap().parent(), Some(&*fs::canonicalize(dir.join("v2/IMG")).unwrap()));
}

/// A change to a built-in track file that makes it a bad one, and what the error must say.
const BAD_TRACKS: [(&str, &str, &str, &[&str]); 9] = [
    ("key", "hills_m = 20.0", "hils_m = 20.0", &["bad.toml:", "hils_m", "hills_m"]),
    ("type", "held_out = false", "held_out = 3", &["bad.toml:3: ", "bool"]),
    ("grain", "grain = 0.6", "grain = 7.0", &["bad.toml: look `bridge`: grain is 7; 0 to 1"]),
    ("sun", "sun_elevation_deg = 48.0", "sun_elevation_deg = nan", &["sun_elevation_deg", "5 to 85"]),
    ("flood", "water_level_m = -1.2", "water_level_m = 4.0", &["would flood the road"]),
    ("stretch", "to_m = 935.0", "to_m = 9350.0", &["9350 m is not on the lap"]),
    ("look", "look = \"bridge\"", "look = \"brigde\"", &["no [[look]] is called `brigde`", "bridge"]),
    // One point far inside: the road bends back on itself.
    (
        "tight",
        "[221.4, 75.6, 0.00, 9.06, -1.7]",
        "[150.0, 75.6, 0.00, 9.06, -1.7]",
        &["too tightly", "points[", "at least 25 m"],
    ),
    (
        "twice",
        "[54.0, -4.3, 0.00, 9.29, -0.3],",
        "[54.0, -4.3, 0.00, 9.29, -0.3], [54.0, -4.3, 0.0, 9.0, 0.0],",
        &["same place"],
    ),
];

#[test]
fn bad_track_files_are_refused_with_place_and_remedy() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    let lake = include_str!("../data/tracks/lake.toml");
    let refused = |text: &str| {
        fs::write(dir.join("bad.toml"), text).unwrap();
        error(dir, &["record", "--track", "bad.toml", "--out", "out"])
    };
    for (what, from, to, expected) in BAD_TRACKS {
        assert_eq!(lake.matches(from).count(), 1, "{what}");
        let message = refused(&lake.replace(from, to));
        for part in expected {
            assert!(message.contains(part), "{what}: `{part}` is not in {message}");
        }
    }
    // A figure of eight crosses itself; half a circle is not closed.
    let (head, rest) = lake.split_once("points = [").unwrap();
    let (_, tail) = rest.split_once("],\n]").unwrap();
    let with_points = |point: &dyn Fn(f64) -> (f64, f64)| {
        let points: String = (0..24)
            .map(|i| {
                let (x, y) = point(f64::from(i) / 24.0);
                format!("[{x:.1}, {y:.1}, 3.0, 8.0, 0.0],")
            })
            .collect();
        format!("{head}points = [{points}]{tail}")
    };
    let turn = std::f64::consts::TAU;
    let eight = refused(&with_points(&|t| (170.0 * (t * turn).sin(), 90.0 * (2.0 * t * turn).sin())));
    assert!(eight.contains("crosses or touches itself") && eight.contains("near points["), "{eight}");
    let open = refused(&with_points(&|t| (170.0 * (t * turn / 2.0).cos(), 170.0 * (t * turn / 2.0).sin())));
    assert!(open.contains("not closed") && open.contains("points[23]"), "{open}");
    assert_eq!(names(dir), ["bad.toml"], "nothing is left behind");

    // The file as it is drives, under its name and path.
    fs::write(dir.join("good.toml"), lake).unwrap();
    let made = json(dir, &["record", "--track", "good.toml", "--laps", "0.01", "--out", "out", "--json"]);
    assert_eq!(made["track"], "lake (good.toml)", "not to be taken for the built-in track");
}

#[test]
fn wrong_requests_are_refused_and_leave_everything_as_it_was() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    fs::create_dir(dir.join("mine")).unwrap();
    fs::write(dir.join("mine/notes.txt"), "precious").unwrap();
    fs::write(dir.join("file"), "precious").unwrap();
    let before = files(dir);
    let record = |more: &[&str]| error(dir, &[&["record", "--track"][..], more].concat());
    for (args, expected) in [
        (&["moutain", "--out", "x"][..], "did you mean `mountain`"),
        (&["random:many", "--out", "x"], "write for example random:7"),
        (&["missing.toml", "--out", "x"], "missing.toml: "),
        (&["lake", "--out", "mine"], "mine: exists already and is not overwritten"),
        (&["lake", "--out", "file"], "file: exists already"),
        (&["lake", "--out", "file/x"], "file/x: cannot be created"),
        (&["lake", "--laps", "0", "--out", "x"], "laps 0"),
        (&["lake", "--speed", "90", "--out", "x"], "5 to 30 mph"),
    ] {
        let message = record(args);
        assert!(message.contains(expected), "{args:?}: {message}");
    }
    let message = error(dir, &["drive", "zero", "--track", "lake", "--out", "mine"]);
    assert!(message.contains("mine: exists already"), "{message}");
    let message = error(dir, &["tracks", "lake", "--sheet", "mine"]);
    assert!(message.contains("mine: exists already"), "{message}");
    let message = error(dir, &["tracks", "lake", "--sheet", "new", "--beside", "mine"]);
    assert!(message.contains("mine"), "{message}");
    assert_eq!(files(dir), before);
}

/// `/proc` takes no new folders, whoever asks.
#[cfg(target_os = "linux")]
#[test]
fn a_place_where_nothing_can_be_written_is_named_with_a_remedy() {
    let message = error(Path::new("."), &["record", "--track", "lake", "--laps", "0.01", "--out", "/proc/steersman"]);
    assert!(message.contains("/proc/steersman: cannot be created"), "{message}");
    assert!(message.contains("where you may write"), "{message}");
}

/// On a disk of 200 kB, made in a name space of the test's own.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_an_error_with_a_remedy_and_keeps_nothing_of_the_recording() {
    let scratch = tempfile::tempdir().unwrap();
    let disk = scratch.path().join("disk");
    fs::create_dir(&disk).unwrap();
    let in_name_space = |script: &str| {
        let mut command = Command::new("unshare");
        command.args(["--user", "--map-root-user", "--mount", "sh", "-ec", script, "sh"]);
        command.arg(&disk).arg(env!("CARGO_BIN_EXE_steersman")).output()
    };
    match in_name_space("mount -t tmpfs -o size=200k tmpfs \"$1\"") {
        Ok(output) if output.status.success() => {}
        _ => return eprintln!("skipped: no user name space can be had to mount a small disk in"),
    }
    let script = "mount -t tmpfs -o size=200k tmpfs \"$1\"
        echo precious > \"$1/mine\"
        \"$2\" record --track lake --laps 0.1 --threads 2 --out \"$1/out\" || echo code $?
        ls -A \"$1\"; cat \"$1/mine\"";
    let output = in_name_space(script).unwrap();
    let (stdout, stderr) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(stdout, "code 1\nmine\nprecious\n", "{stderr}");
    assert!(stderr.contains("/out/IMG/") && stderr.contains("make room on that disk"), "{stderr}");
    assert!(!stderr.contains("unfinished"), "{stderr}");
}

#[test]
fn tracks_are_listed_and_drawn() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    let list = json(dir, &["tracks", "--json"]);
    let named: Vec<(&str, bool)> =
        list.as_array().unwrap().iter().map(|t| (t["track"].as_str().unwrap(), t["held_out"] == true)).collect();
    assert_eq!(named, [("lake", false), ("mountain", false), ("coast", true), ("forest", true)]);
    let text = String::from_utf8(run(dir, &["tracks", "random:1000001"]).stdout).unwrap();
    assert!(text.contains("random:1000001") && text.contains("held out"), "{text}");

    run(dir, &["record", "--track", "forest", "--laps", "0.03", "--out", "drive"]);
    run(dir, &["tracks", "random:2", "--sheet", "sheets", "--beside", "drive"]);
    let sizes: Vec<(String, u32, u32)> = names(&dir.join("sheets"))
        .into_iter()
        .map(|name| {
            let picture = image::open(dir.join("sheets").join(&name)).unwrap();
            (name, picture.width(), picture.height())
        })
        .collect();
    let expected = [("random-2-beside.png", 4, 7), ("random-2-cameras.png", 3, 8), ("random-2.png", 4, 7)];
    assert_eq!(sizes, expected.map(|(name, columns, rows)| (name.to_string(), columns * 324, rows * 164)));
}

/// Real frames beside ours, to be looked at: `STEERSMAN_RECORDINGS=… cargo test --release --test simulator -- --ignored`
/// writes sheets below `target/looks`.
#[test]
#[ignore = "draws pictures for people"]
fn real_frames_beside_ours() {
    let Some(recordings) = std::env::var_os("STEERSMAN_RECORDINGS") else {
        return eprintln!("skipped: STEERSMAN_RECORDINGS is not set");
    };
    let out = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/looks");
    let _ = fs::remove_dir_all(&out);
    for (track, recording) in [("lake", "lake-sample"), ("mountain", "mountain-keyboard")] {
        let (sheet, beside) = (out.join(track), Path::new(&recordings).join(recording));
        let paths = [sheet.to_str().unwrap(), beside.to_str().unwrap()];
        run(Path::new("."), &["tracks", track, "--sheet", paths[0], "--beside", paths[1]]);
        eprintln!("{}", sheet.display());
    }
}

/// The story goes with the model, not with the recordings: they may be gone.
#[test]
fn every_report_on_a_model_says_what_held_out_tracks_it_was_trained_on() {
    let folder = tempfile::tempdir().unwrap();
    let go = |args: &str| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_steersman"));
        let output = command.args(args.split(' ')).current_dir(&folder).output().unwrap();
        let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
        (output.status.success(), text(&output.stdout), text(&output.stderr))
    };
    for (track, out) in [("coast", "kept"), ("lake", "free")] {
        assert!(go(&format!("record --track {track} --laps 0.1 --out {out}")).0);
    }
    let (done, _, message) = go("experiment split --quick --recording kept");
    assert!(!done && message.contains("--force-held-out") && !folder.path().join("runs").exists(), "{message}");
    let short = "--recipe lenet --set epochs=1 --cache 64";
    for kept in ["kept", "kept/driving_log.csv", "free kept"] {
        let (done, _, message) = go(&format!("train {kept} {short} --out refused"));
        assert!(!done && message.contains("show coast,") && message.contains("--force-held-out"), "{kept}: {message}");
        assert!(!folder.path().join("refused").exists(), "{kept}: nothing is trained");
    }
    let (done, text, message) = go(&format!("train kept --force-held-out {short} --out a"));
    assert!(done && text.contains("the model was trained on coast, held-out"), "{text}{message}");
    // What began with such a model was trained there too.
    let (done, text, message) = go(&format!("train free --from a/model.safetensors {short} --out b --json"));
    assert!(done && text.contains(r#""trained_on_held_out":["coast"]"#), "{text}{message}");
    assert!(
        std::fs::read_to_string(folder.path().join("b/report.html")).unwrap().contains("trained on coast, held-out")
    );
    std::fs::rename(folder.path().join("kept"), folder.path().join("moved")).unwrap();
    let (_, text, message) = go("drive b/model.safetensors --track lake --runs 1 --out drives --json");
    assert!(text.contains(r#""trained_on_held_out":["coast"]"#), "{text}{message}");
    let summary = std::fs::read_to_string(folder.path().join("drives/summary.json")).unwrap();
    assert!(summary.contains("trained_on_held_out"), "{summary}");
    let (_, text, message) = go("evaluate a/model.safetensors free");
    assert!(text.contains("the model was trained on coast, held-out"), "{text}{message}");
    let (_, text, _) = go("evaluate a/model.safetensors free --json");
    assert!(text.contains(r#""trained_on_held_out":["coast"]"#), "{text}");
}
