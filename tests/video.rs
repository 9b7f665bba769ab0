//! Videos as a user makes them: of a drive, of a saved drive, of a recording; and what must not happen on the way.

mod common;

use std::fs;
use std::io::BufReader;
use std::path::Path;
use std::process::{Command, Stdio};

use common::command::{error, json, run, steersman};
use common::{mp4, painted_log};
use steersman::picture::RgbImage;
use steersman::report::video::file::VideoFile;

/// Pictures, seconds, width and height of a video.
fn read(path: &Path) -> (u32, f64, u16, u16) {
    let video = mp4::read(path);
    let (pictures, (width, height)) = (video.samples.len() as u32, video.size);
    assert!(video.samples[0].is_key && video.samples.iter().all(|sample| !sample.bytes.is_empty()));
    check_with_ffprobe(path, pictures);
    (pictures, video.seconds[0], width, height)
}

/// A decoder of other people must find as many pictures, and nothing to complain about.
fn check_with_ffprobe(path: &Path, pictures: u32) {
    let args = ["-v", "warning", "-count_frames", "-show_entries", "stream=nb_read_frames,pix_fmt", "-of", "csv=p=0"];
    match Command::new("ffprobe").args(args).arg(path).output() {
        Ok(output) => {
            let text = String::from_utf8_lossy(&output.stdout).into_owned();
            assert_eq!(text.trim(), format!("yuv420p,{pictures}"));
            assert!(output.stderr.is_empty(), "{}", String::from_utf8_lossy(&output.stderr));
        }
        Err(_) => {
            eprintln!("skipped: ffprobe is not on this machine, so no other decoder looked at {}", path.display())
        }
    }
}

fn seconds(value: &serde_json::Value) -> f64 {
    value["seconds"].as_f64().unwrap()
}

#[test]
fn a_video_can_be_read_again_with_its_pictures_times_and_places_to_jump_to() {
    let scratch = tempfile::tempdir().unwrap();
    let path = scratch.path().join("a.mp4");
    let mut video = VideoFile::create(&path, [96, 128], 10.0).unwrap();
    for k in 0..45 {
        let pixels = (0..96 * 128).flat_map(|at| [(at / 128 + 3 * k) as u8, (at % 128) as u8, 90]).collect();
        video.write(&RgbImage { height: 96, width: 128, pixels }).unwrap();
    }
    assert!(!path.exists());
    let summary = video.finish().unwrap();
    let size = fs::metadata(&path).unwrap().len();
    assert_eq!((summary.frames, summary.fps, summary.seconds, summary.bytes), (45, 10.0, 4.5, size));
    let read = mp4::read(&path);
    assert_eq!((read.seconds, read.size, read.profile, read.samples.len()), ([4.5; 2], (128, 96), 77, 45));
    for (k, sample) in read.samples.iter().enumerate() {
        assert!((sample.start_s - 0.1 * k as f64).abs() < 1e-9 && sample.is_key == (k % 20 == 0), "{k}");
        // Lengths lead from unit to unit to the end; a picture that stands alone has a unit of type 5.
        let (mut rest, mut kinds) = (&sample.bytes[..], vec![]);
        while let Some((length, tail)) = rest.split_first_chunk::<4>() {
            kinds.push(tail[0] & 0x1f);
            rest = &tail[u32::from_be_bytes(*length) as usize..];
        }
        assert!(
            rest.is_empty() && kinds.contains(&5) == sample.is_key && kinds.contains(&1) != sample.is_key,
            "{kinds:?}"
        );
    }
    check_with_ffprobe(&path, 45);
}

#[test]
fn a_drive_has_a_video_as_long_as_it_took_and_the_saved_one_looks_the_same() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    // Who never steers is off the road in a few seconds.
    let drive = ["drive", "zero", "--track", "lake", "--runs", "2", "--seed", "5", "--json"];
    let filmed = json(dir, &[&drive[..], &["--out", "d", "--video", "videos/a.mp4"]].concat());
    let mut plain = json(dir, &drive);
    plain["realtime_factor"] = filmed["realtime_factor"].clone();
    assert_eq!(filmed, plain, "filming changes nothing");
    let (pictures, length_s, width, height) = read(&dir.join("videos/a.mp4"));
    assert_eq!((width, height), (960, 480));
    let rows = fs::read_to_string(dir.join("d/free_5.csv")).unwrap().lines().count() - 1;
    // The last picture stays for 2 s.
    assert!((pictures as usize).abs_diff(rows - 1 + 40) <= 1, "{pictures} pictures, {rows} rows");
    assert!((length_s - f64::from(pictures) / 20.0).abs() < 0.01, "{length_s}");

    let map = fs::read_to_string(dir.join("d/map.svg")).unwrap();
    assert!(roxmltree::Document::parse(&map).is_ok() && map.contains("lake, runs: 2, put back: "), "{map}");

    let again = json(dir, &["video", "d", "b.mp4", "--json"]);
    assert_eq!(read(&dir.join("b.mp4")).0, pictures);
    assert_eq!(again["frames"], pictures);
    let slow = json(dir, &["video", "d", "c.mp4", "--seed", "5", "--fps", "5", "--json"]);
    assert!((seconds(&slow) - length_s).abs() <= 0.2, "the same time at another rate: {slow}");
    assert!((f64::from(read(&dir.join("c.mp4")).0) - 5.0 * length_s).abs() <= 1.0);

    let message = error(dir, &["video", "d", "e.mp4", "--seed", "9"]);
    assert!(message.contains("seed 9") && message.contains("seeds there: 5, 6"), "{message}");
    fs::create_dir(dir.join("run")).unwrap();
    fs::rename(dir.join("d"), dir.join("run/lake")).unwrap();
    assert!(error(dir, &["video", "run", "e.mp4"]).contains("lake"), "drives below are named");
    let old: Vec<String> = fs::read_to_string(dir.join("run/lake/free_6.csv"))
        .unwrap()
        .lines()
        .map(|line| line.rsplit_once(',').unwrap().0.to_string())
        .collect();
    fs::write(dir.join("run/lake/free_6.csv"), old.join("\n")).unwrap();
    assert!(error(dir, &["video", "run/lake", "e.mp4", "--seed", "6"]).contains("heading_deg"));
    assert!(!dir.join("e.mp4").exists());
}

#[test]
fn a_recording_has_a_video_at_its_own_rate_with_a_model_beside_the_person() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    painted_log::write(&dir.join("log"), 60, "");
    let plain = json(dir, &["video", "log", "a.mp4", "--json"]);
    let (pictures, length_s, ..) = read(&dir.join("a.mp4"));
    assert_eq!(plain["frames"], pictures);
    assert!((length_s - seconds(&plain)).abs() < 0.01);
    let rate_hz = plain["fps"].as_f64().unwrap();
    // The last picture stays for 2 s.
    assert!((f64::from(pictures) - (59.0 + 2.0 * rate_hz)).abs() <= 1.0, "{plain}");

    let train = ["train", "log", "--recipe", "lenet", "--set", "epochs=1", "--out", "run"];
    painted_log::write(&dir.join("long"), 700, "");
    run(dir, &[&["train", "long"], &train[2..]].concat());
    let options = ["--model", "run/model.safetensors", "--saliency", "--fps", "30", "--json"];
    let beside = json(dir, &[&["video", "log", "b.mp4"], &options[..]].concat());
    assert!((seconds(&beside) - length_s).abs() < 0.2, "{beside}");
    assert!(read(&dir.join("b.mp4")).0 > pictures);
    assert_ne!(fs::read(dir.join("a.mp4")).unwrap(), fs::read(dir.join("b.mp4")).unwrap());
}

#[test]
fn mistakes_are_told_before_anything_is_driven_and_replace_nothing() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    fs::write(dir.join("mine.mp4"), "mine").unwrap();
    let drive =
        |options: &[&str]| error(dir, &[&["drive", "zero", "--track", "lake", "--runs", "1"], options].concat());
    assert!(drive(&["--video", "mine.mp4"]).contains("exists already"));
    assert!(drive(&["--video", "a.webm"]).contains("name it a.mp4"));
    assert!(drive(&["--video", "mine.mp4/a.mp4"]).contains("cannot be created"));
    assert!(drive(&["--video", "a.mp4", "--fps", "1000"]).contains("1 to 60"));
    assert!(drive(&["--video", "a.mp4", "--saliency"]).contains("no saliency"));
    painted_log::write(&dir.join("log"), 60, "");
    assert!(error(dir, &["video", "log", "mine.mp4"]).contains("exists already"));
    assert!(error(dir, &["video", "log", "a.mp4", "--seed", "1"]).contains("--seed"));
    fs::create_dir(dir.join("empty")).unwrap();
    assert!(error(dir, &["video", "empty", "a.mp4"]).contains("no recording"));
    assert_eq!(fs::read_to_string(dir.join("mine.mp4")).unwrap(), "mine");
    let left: Vec<_> = fs::read_dir(dir).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(left.len(), 3, "nothing else is left behind: {left:?}");
}

#[cfg(unix)]
#[test]
fn a_video_that_was_interrupted_plays_as_far_as_it_came() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path();
    let mut child = steersman(dir)
        .args(["drive", "expert", "--track", "lake", "--runs", "1", "--laps", "5", "--video", "a.mp4"])
        .stderr(Stdio::null())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    // The summary is printed before the filming begins.
    let (mut first, mut printed) = (String::new(), BufReader::new(child.stdout.take().unwrap()));
    std::io::BufRead::read_line(&mut printed, &mut first).unwrap();
    assert!(first.contains("expert on lake"), "{first}");
    std::thread::sleep(std::time::Duration::from_secs(3));
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let (pictures, length_s, ..) = read(&dir.join("a.mp4"));
    assert!(pictures > 40 && length_s < 500.0, "{pictures} pictures, {length_s} s");
    assert_eq!(fs::read_dir(dir).unwrap().count(), 1);
}
