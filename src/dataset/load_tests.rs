//! Recordings written into scratch folders, and the real ones where they are at hand.

use super::*;
use crate::dataset::recording::View;
use crate::dataset::testing::{jpeg, recordings_folder, write_image};
use crate::dataset::unusable::Reason;
use std::fs;

fn log(folder: &Path, text: &str) {
    fs::write(folder.join("driving_log.csv"), text).unwrap();
}

/// Reads a log whose images are elsewhere.
fn believed(path: &Path) -> Result<Recording> {
    load_with(path, &Description::default(), ImageCheck::Skip)
}

/// A log of `rows` rows 100 ms apart with their images in `IMG`.
fn drive(folder: &Path, rows: usize) -> String {
    fs::create_dir_all(folder.join("IMG")).unwrap();
    let mut text = String::new();
    for i in 0..rows {
        let time = format!("2020_01_01_10_00_{:02}_{:03}", i / 10, i % 10 * 100);
        for (grey, camera) in ["center", "left", "right"].iter().enumerate() {
            let picture = jpeg(8, 8, [90 + i as u8, 80, 70 + 40 * grey as u8]);
            fs::write(folder.join("IMG").join(format!("{camera}_{time}.jpg")), picture).unwrap();
        }
        text += &format!("center_{time}.jpg,left_{time}.jpg,right_{time}.jpg,0.1,1,0,9\n");
    }
    text
}

#[test]
fn images_are_found_wherever_they_were_recorded() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join("IMG")).unwrap();
    fs::create_dir_all(folder.path().join("sub/pictures")).unwrap();
    let elsewhere = tempfile::tempdir().unwrap();
    for place in ["IMG/a.jpg", "b.jpg", "sub/pictures/c.jpg"] {
        write_image(&folder.path().join(place));
    }
    write_image(&elsewhere.path().join("d.jpg"));
    let written = [
        r"C:\Users\me\IMG\a.jpg".to_owned(),
        "/home/some one/else/IMG/a.jpg".to_owned(),
        "data/IMG/a.jpg".to_owned(),
        "a.jpg".to_owned(),
        "b.jpg".to_owned(),
        r"sub\pictures\c.jpg".to_owned(),
        elsewhere.path().join("d.jpg").display().to_string(),
    ];
    let text: String = written.iter().map(|path| format!("{path},{path},,0,0,0,1\n")).collect();
    log(folder.path(), &text);
    let recording = load(folder.path()).unwrap();
    // What lies outside the recording is not followed.
    assert_eq!(recording.rows.len(), written.len() - 1, "{:?}", recording.unusable);
    assert_eq!(recording.unusable.0[&Reason::ImageMissing].rows, 1);
    assert_eq!(recording.image_path(0, View::Centre), Some(folder.path().join("IMG").join("a.jpg")));
    assert!(!recording.has(View::Left), "the left image is the centre image");
    assert_eq!(recording.image_size, Some([8, 8]));
}

#[test]
fn unusable_rows_are_counted_by_reason_with_examples() {
    let folder = tempfile::tempdir().unwrap();
    let mut text = drive(folder.path(), 30);
    let image = |i: usize, camera: &str| {
        folder.path().join("IMG").join(format!("{camera}_2020_01_01_10_00_{:02}_{:03}.jpg", i / 10, i % 10 * 100))
    };
    fs::remove_file(image(3, "center")).unwrap();
    fs::remove_file(image(4, "left")).unwrap();
    fs::write(image(5, "center"), &jpeg(8, 8, [1, 2, 3])[..60]).unwrap();
    fs::write(image(6, "right"), b"").unwrap();
    fs::write(image(8, "center"), b"").unwrap();
    fs::write(image(7, "center"), b"<html>not found</html>").unwrap();
    text += "x.jpg,y.jpg,z.jpg,nan,0,0,1\nx.jpg,y.jpg,z.jpg,0\n";
    log(folder.path(), &text);
    let recording = load(&folder.path().join("driving_log.csv")).unwrap();
    assert_eq!((recording.total_rows(), recording.rows.len()), (32, 26));
    let count = |reason| recording.unusable.0.get(&reason).map_or(0, |tally| tally.rows);
    assert_eq!(count(Reason::ImageMissing), 1);
    assert_eq!(count(Reason::ImageTruncated), 2);
    assert_eq!(count(Reason::NotAnImage), 1);
    assert_eq!(count(Reason::LabelOutOfRange), 1);
    assert_eq!(count(Reason::TooFewFields), 1);
    let example = &recording.unusable.0[&Reason::LabelOutOfRange].examples[0];
    assert_eq!(example, "driving_log.csv:31: steering NaN is no number");
    assert!(recording.unusable.0[&Reason::ImageMissing].examples[0].starts_with("driving_log.csv:4: "));
    // A missing side image costs that side sample, not its row.
    assert!(recording.rows.iter().any(|row| row.line == 5) && recording.rows.iter().any(|row| row.line == 7));
    let notices = recording.notices.join("\n");
    assert!(
        notices.contains("1 pictures of the left camera cannot be used") && notices.contains("driving_log.csv:5: "),
        "{notices}"
    );
    assert!(notices.contains("1 pictures of the right camera cannot be used"), "{notices}");
    assert!(recording.require_usable().is_ok());
    log(folder.path(), &format!("{text}{}", "x.jpg,y.jpg,z.jpg,0\n".repeat(4)));
    let message = load(folder.path()).unwrap().require_usable().unwrap_err().to_string();
    assert!(message.contains("10 of 36 rows"), "{message}");
}

#[test]
fn a_camera_without_any_image_falls_away() {
    let folder = tempfile::tempdir().unwrap();
    log(folder.path(), &drive(folder.path(), 12));
    for entry in fs::read_dir(folder.path().join("IMG")).unwrap() {
        let path = entry.unwrap().path();
        if file_name(&path).starts_with("left") {
            fs::remove_file(path).unwrap();
        }
    }
    let recording = load(folder.path()).unwrap();
    assert_eq!((recording.rows.len(), recording.unusable.rows()), (12, 0));
    assert!(recording.has(View::Right) && !recording.has(View::Left));
    assert!(recording.notices[0].contains("left camera"), "{:?}", recording.notices);
    assert!(recording.require_usable().is_ok());
}

#[test]
fn sessions_end_at_gaps_at_steps_back_and_where_the_folder_changes() {
    let folder = tempfile::tempdir().unwrap();
    let row = |folder: &str, time: &str| format!("{folder}c_2020_01_01_10_{time}.jpg,l.jpg,r.jpg,0,0,0,1\n");
    let text = [
        row("", "00_00_000"),
        row("", "00_00_100"),
        row("", "00_00_900"), // 0..3
        row("", "00_02_000"),
        row("", "00_02_100"), // 3..5: 1.1 s later
        row("", "00_01_000"),
        row("", "00_01_100"), // 5..7: back in time
        row("/other/IMG/", "00_01_200"),
        row("/other/IMG/", "00_01_300"), // 7..9: another folder
    ];
    log(folder.path(), &text.concat());
    let recording = believed(folder.path()).unwrap();
    assert_eq!(recording.sessions, [0..3, 3..5, 5..7, 7..9]);
    assert!(recording.times_plausible);
    assert_eq!(recording.rate_hz(), Some(10.0));
}

#[test]
fn rows_without_plausible_times_count_as_20_hz() {
    let folder = tempfile::tempdir().unwrap();
    log(folder.path(), &"a.jpg,b.jpg,c.jpg,0,0,0,1\n".repeat(100));
    let recording = believed(folder.path()).unwrap();
    assert!(!recording.times_plausible && recording.notices[0].contains("20 Hz"));
    assert_eq!((recording.rate_hz(), recording.sessions.len()), (Some(20.0), 1));
    fs::write(folder.path().join("steersman.toml"), "hz = 40.0").unwrap();
    let said = believed(folder.path()).unwrap();
    assert!(said.times_plausible && said.notices[0].contains("40 Hz"), "{:?}", said.notices);
    assert_eq!((said.rate_hz(), said.driven_s()), (Some(40.0), 99.0 * 0.025));
    assert!((recording.driven_s() - 99.0 * 0.05).abs() < 1e-9);
}

#[test]
fn a_tub_loads_without_deleted_records() {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir_all(folder.path().join("images")).unwrap();
    fs::write(
        folder.path().join("manifest.json"),
        "[\"cam/image_array\"]\n[\"image_array\"]\n{}\n{\"created_at\": 1.0}\n\
         {\"paths\": [\"._catalog_0.catalog\", \"catalog_0.catalog\"], \"current_index\": 6, \"deleted_indexes\": [2]}\n",
    )
    .unwrap();
    let mut text = String::new();
    for i in 0..6 {
        let name = format!("{i}_cam_image_array_.jpg");
        write_image(&folder.path().join("images").join(&name));
        let angle = if i == 4 { "1.0000001" } else { "-0.25" };
        let session = if i < 3 { "a" } else { "b" };
        text += &format!(
            "{{\"_index\": {i}, \"_timestamp_ms\": {}, \"_session_id\": \"{session}\", \"cam/image_array\": \"{name}\", \
             \"user/angle\": {angle}, \"user/mode\": \"user\", \"user/throttle\": 0.5}}\n",
            1000 + 50 * i
        );
    }
    fs::write(folder.path().join("catalog_0.catalog"), text + "{\"_index\": 6, \"cam").unwrap();
    for path in [folder.path().to_path_buf(), folder.path().join("manifest.json")] {
        let recording = load(&path).unwrap();
        assert_eq!((recording.kind(), recording.rows.len(), recording.unusable.rows()), ("tub", 5, 1));
        assert_eq!(recording.sessions, [0..2, 2..5]);
        assert_eq!((recording.rows[0].steering, recording.rows[3].steering), (-0.25, 1.0));
        assert!(recording.notices.iter().any(|notice| notice.contains("1 records marked as deleted")));
        assert!(recording.notices.iter().any(|notice| notice.contains("side cameras")));
    }
}

#[test]
fn places_without_a_recording_say_so() {
    let folder = tempfile::tempdir().unwrap();
    assert!(load(folder.path()).unwrap_err().to_string().contains("driving_log.csv"));
    assert!(load(&folder.path().join("nothing")).is_err());
    fs::write(folder.path().join("notes.csv"), "a,b\n1,2\n").unwrap();
    assert!(load(folder.path()).is_err());
    fs::write(folder.path().join("mine.csv"), "c.jpg,l.jpg,r.jpg,0,0,0,1\n").unwrap();
    assert_eq!(believed(folder.path()).unwrap().rows.len(), 1);
    fs::write(folder.path().join("other.csv"), "c.jpg,l.jpg,r.jpg,0,0,0,1\n").unwrap();
    assert!(load(folder.path()).unwrap_err().to_string().contains("mine.csv, other.csv"));
    log(folder.path(), "");
    assert!(load(folder.path()).unwrap().require_usable().is_err());
}

#[test]
fn the_real_recordings_have_the_counts_of_their_readme() {
    let Some(root) = recordings_folder() else { return };
    for (name, total, usable, sessions) in [
        ("lake-sample", 3000, 3000, Some(6)),
        ("lake-windows-paths", 500, 500, Some(2)),
        ("mountain-keyboard", 701, 700, Some(1)),
        ("donkey-tub", 1000, 1000, Some(1)),
    ] {
        let recording = load(&root.join(name)).unwrap();
        assert_eq!((recording.total_rows(), recording.rows.len()), (total, usable), "{name}");
        assert_eq!(Some(recording.sessions.len()), sessions, "{name} {:?}", recording.sessions);
        assert!(recording.require_usable().is_ok());
        let cameras = View::ALL.into_iter().filter(|&camera| recording.has(camera)).count();
        assert_eq!(cameras, if name == "donkey-tub" { 1 } else { 3 });
        assert_eq!(recording.times_plausible, name != "donkey-tub");
    }
    let lake = load(&root.join("lake-sample")).unwrap();
    let starts: Vec<usize> = lake.sessions.iter().map(|session| session.start).collect();
    assert_eq!(starts, [0, 2, 28, 29, 31, 1500]);
    let mountain = load(&root.join("mountain-keyboard")).unwrap();
    assert_eq!(mountain.unusable.0[&Reason::ImageMissing].rows, 1);
}

#[test]
fn the_log_variants_parse_without_their_images() {
    let Some(root) = recordings_folder() else { return };
    let mut counts = Vec::new();
    for entry in fs::read_dir(root.join("csv-variants")).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "csv") {
            let parsed = believed(&path).unwrap();
            assert_eq!(parsed.unusable.rows(), 0, "{path:?} {:?}", parsed.unusable);
            assert!(parsed.times_plausible, "{path:?}");
            counts.push(parsed.rows.len());
            let checked = load(&path).unwrap();
            assert_eq!(checked.unusable.0[&Reason::ImageMissing].rows, parsed.rows.len(), "{path:?}");
        }
    }
    counts.sort_unstable();
    assert_eq!(counts, [149, 149, 150, 150, 150, 150, 150, 150]);
}

#[test]
fn a_person_takes_over_only_where_a_model_drove_too() {
    let folder = tempfile::tempdir().unwrap();
    let taken_over = |modes: [&str; 4]| -> Vec<bool> {
        let rows = modes.map(|mode| format!("a.jpg,,,0.1,1,0,9,{mode}\n")).concat();
        log(folder.path(), &format!("center,left,right,steering,throttle,brake,speed,mode\n{rows}"));
        believed(folder.path()).unwrap().rows.iter().map(|row| row.taken_over).collect()
    };
    assert_eq!(taken_over(["pilot", "user", "user", "pilot"]), [false, true, true, false]);
    assert_eq!(taken_over(["user"; 4]), [false; 4]);
    assert_eq!(taken_over(["pilot"; 4]), [false; 4]);
}
