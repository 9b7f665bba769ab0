//! The live page without a browser: what it serves and to whom, driving by hand, watching.

mod common;

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::time::{Duration, Instant};

use common::command::{error, json};
use common::double::SILENCE;
use common::page::{Page, serve};
use common::served::{Client, Served, command, random_model, sample_jpeg, telemetry};
use serde_json::{Value, json};
use steersman::dataset;
use steersman::picture::{RgbImage, decode::decode_rgb};

/// Starts driving by hand in `folder`, recording into `rec`.
fn by_hand(folder: &Path, args: &[&str]) -> Served {
    serve(folder, &[&["record", "--manual", "--out", "rec", "--json"], args].concat())
}

/// Drives at full throttle, steering as told, until `rows` rows are recorded. On a busy machine the wheel may be lost for a
/// moment, and recording pauses then.
fn record_rows(page: &mut Page, steer: i32, rows: u64) -> Value {
    let began = Instant::now();
    loop {
        page.press(steer, 1);
        let manual = page.next().unwrap().state["manual"].clone();
        if manual["rows"].as_u64().unwrap() >= rows {
            return manual;
        }
        if manual["recording"] == false {
            page.ask(&json!({ "type": "record" }));
            page.next().unwrap();
        }
        assert!(began.elapsed() < common::double::SILENCE, "{manual}");
    }
}

fn entries(folder: &Path) -> Vec<String> {
    fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn keys_steer_the_car_and_what_was_driven_is_on_disk() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    let served = by_hand(dir, &["--track", "coast", "--hz", "25"]);
    let mut page = Page::open(served.port);
    assert_eq!(
        (&page.hello["mode"], &page.hello["track"], &page.hello["held_out"]),
        (&json!("manual"), &json!("coast"), &json!(true))
    );
    assert!(page.hello["edges"][0].as_array().unwrap().len() > 500);
    let standing = page.next().unwrap();
    assert_eq!(standing.number("speed_mph"), 0.0);
    let mut picture = RgbImage::default();
    decode_rgb(&standing.camera, &mut picture).unwrap();
    assert!((picture.width, picture.height) == (320, 160) && standing.saliency.is_empty());

    page.hold_until(0, 1, |frame| frame.number("speed_mph") > 5.0);
    let manual = record_rows(&mut page, 0, 20);
    assert_eq!(manual["driver"], page.hello["id"]);
    // Full lock after 0.4 s; released, the wheel comes back to exactly 0.
    page.hold_until(-1, 0, |frame| frame.number("steering") == -1.0);
    page.hold_until(0, 0, |frame| frame.number("steering") == 0.0);
    page.hold_until(1, 0, |frame| frame.number("steering") > 0.2);
    let wheel = json!({ "type": "controls", "wheel": 0.125, "pedals": -1 });
    page.ask(&wheel);
    let began = Instant::now();
    while page.next().unwrap().number("steering") != 0.125 {
        page.ask(&wheel);
        assert!(began.elapsed() < common::double::SILENCE);
    }

    page.ask(&json!({ "type": "finish" }));
    let words = loop {
        if let Err(words) = page.next() {
            break words;
        }
    };
    let (summary, _) = served.end();
    let rows = summary["rows"].as_u64().unwrap();
    assert!(rows >= 20 && words.contains(&format!("{rows} rows are in rec")), "{words} {summary}");
    assert_eq!((&summary["style"], &summary["held_out"], &summary["hz"]), (&json!("manual"), &json!(true), &json!(25)));
    assert_eq!(entries(dir), ["rec"]);
    let side = fs::read_to_string(dir.join("rec/recording.toml")).unwrap();
    assert!(side.contains("style = \"manual\"") && side.contains("held_out = true"), "{side}");
    assert_eq!(entries(&dir.join("rec/IMG")).len() as u64, 3 * rows);
    let report = &json(dir, &["inspect", "rec", "--json"])[0];
    assert_eq!((report["usable"].as_u64(), report["rows"].as_u64()), (Some(rows), Some(rows)), "{report}");
    let recording = dataset::load(&dir.join("rec")).unwrap();
    assert!(recording.notices.is_empty(), "{:?}", recording.notices);
    assert!(
        recording.rows.iter().any(|row| row.steering < -0.9) && recording.rows.iter().any(|row| row.throttle > 0.9)
    );
    // Training must not see it.
    assert!(error(dir, &["train", "rec", "--out", "run"]).contains("coast"));
    assert!(error(dir, &["record", "--track", "lake", "--manual", "--out", "rec"]).contains("exists already"));
}

#[test]
fn without_a_page_the_car_brakes_and_recording_pauses_and_ctrl_c_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let served = by_hand(folder.path(), &["--track", "lake", "--format", "v2"]);
    let (mut driver, mut guest) = (Page::open(served.port), Page::open(served.port));
    driver.hold_until(0, 1, |frame| frame.number("speed_mph") > 12.0);
    record_rows(&mut driver, 0, 8);
    // Who looks on cannot press anything.
    guest.ask(&json!({ "type": "record" }));
    guest.ask(&json!({ "type": "finish" }));
    drop(driver);
    let stopped = guest.until_it_stands();
    let manual = &stopped.state["manual"];
    assert_eq!((&manual["driver"], &manual["recording"]), (&Value::Null, &json!(false)), "{manual}");
    assert!(manual["notice"].as_str().unwrap().contains("Nobody was at the wheel"), "{manual}");
    assert!(!folder.path().join("rec").exists(), "the recording gets its name when it is whole");

    // The guest takes the wheel, turns round, and drives on.
    let at = stopped.number("laps");
    guest.ask(&json!({ "type": "take" }));
    guest.ask(&json!({ "type": "turn_round" }));
    guest.hold_until(0, 1, |frame| frame.number("put_back") == 1.0 && frame.number("laps") > at + 0.001);
    record_rows(&mut guest, 0, 20);
    let (summary, _) = served.stop();
    assert!(guest.next().is_err(), "the page is told that it is over");
    let recording = dataset::load(&folder.path().join("rec")).unwrap();
    assert_eq!(recording.rows.len() as u64, summary["rows"].as_u64().unwrap());
    assert!(recording.sessions.len() >= 2, "the pause is seen: {:?}", recording.sessions);
    assert!(summary["coverage"]["reverse"].as_f64().unwrap() > 0.1, "{summary}");
}

#[test]
fn a_disk_that_fails_ends_the_drive_and_what_was_recorded_is_kept() {
    let folder = tempfile::tempdir().unwrap();
    let served = by_hand(folder.path(), &["--track", "lake"]);
    let mut page = Page::open(served.port);
    record_rows(&mut page, 0, 5);
    let hidden = folder.path().join(&entries(folder.path())[0]);
    assert!(hidden.file_name().unwrap().to_str().unwrap().starts_with(".rec-unfinished-"));
    // What is driven may be on its way to the disk for a moment.
    let began = Instant::now();
    while fs::read_to_string(hidden.join("driving_log.csv")).unwrap().lines().count() < 6 {
        assert!(began.elapsed() < common::double::SILENCE);
        page.press(0, 1);
        page.next().unwrap();
    }
    // It may have paused meanwhile; the next row must fail.
    fs::rename(hidden.join("IMG"), hidden.join("elsewhere")).unwrap();
    let words = loop {
        page.press(0, 1);
        match page.next() {
            Ok(frame) if frame.state["manual"]["recording"] == false => page.ask(&json!({ "type": "record" })),
            Ok(_) => {}
            Err(words) => break words,
        }
    };
    assert!(words.contains("rec/IMG/") && words.contains("rows are in rec"), "{words}");
    let said = served.wait_until_it_says("error:");
    assert!(said.contains("rec/IMG/") && !said.contains("unfinished"), "{said}");
    assert_eq!(served.code(), Some(1));
    let log = fs::read_to_string(folder.path().join("rec/driving_log.csv")).unwrap();
    assert!(log.lines().count() >= 6 && log.ends_with('\n'), "{log}");
    assert!(folder.path().join("rec/recording.toml").is_file());
}

#[test]
fn nothing_recorded_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let served = by_hand(folder.path(), &["--track", "lake"]);
    Page::open(served.port).hold_until(0, 1, |frame| frame.number("speed_mph") > 1.0);
    let (summary, _) = served.stop();
    assert_eq!((&summary["rows"], &summary["folder"]), (&json!(0), &Value::Null));
    assert!(entries(folder.path()).is_empty());
}

#[test]
fn strangers_are_refused_and_drive_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let served = by_hand(folder.path(), &["--track", "lake"]);
    let port = served.port;
    let own = format!("127.0.0.1:{port}");
    let ask = |request: &str, host: &str, more: &str| {
        let answer = served.ask(&format!("{request} HTTP/1.1\r\nHost: {host}\r\n{more}\r\n"));
        let status: u16 = answer.split(' ').nth(1).unwrap_or_else(|| panic!("{answer}")).parse().unwrap();
        (status, answer)
    };
    let (status, page) = ask("GET /", &own, "");
    assert!(
        status == 200 && page.contains("Content-Security-Policy: default-src 'none'") && page.ends_with("</html>\n")
    );
    assert_eq!(ask("GET /", &format!("localhost:{port}"), "").0, 200);
    // A name that was made to point here after its page was loaded.
    assert_eq!(ask("GET /", &format!("evil.example:{port}"), "").0, 403);
    assert_eq!(ask("GET /favicon.ico", &own, "").0, 404);
    assert_eq!(ask("GET /../Cargo.toml", &own, "").0, 404);
    assert_eq!(ask("POST /", &own, "Content-Length: 0\r\n").0, 405);
    assert_eq!(ask("GET /live", &own, "").0, 426);
    let upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
        Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n";
    for origin in ["http://evil.example", "null", "http://127.0.0.1:1", "https://localhost"] {
        assert_eq!(ask("GET /live", &own, &format!("{upgrade}Origin: {origin}\r\n")).0, 403, "{origin}");
    }
    assert_eq!(ask("GET /live", &format!("evil.example:{port}"), upgrade).0, 403);
    assert!(served.ask("\u{16}\u{3}\u{1}\r\n\r\n").starts_with("HTTP/1.1 400"));
    assert!(served.ask(&format!("GET / HTTP/1.1\r\nX: {}", "x".repeat(9000))).starts_with("HTTP/1.1 431"));

    let mut page = Page::open(port);
    for nonsense in [json!({ "type": "fly" }), json!("next"), json!({ "type": "controls", "wheel": "left" })] {
        let mut bad = Page::open(port);
        bad.ask(&nonsense);
        assert!(std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| bad.next())).is_err(), "{nonsense}");
    }
    // Connections that say nothing take no place for long, and whoever drives drives on.
    let idle: Vec<_> = (0..8).map(|_| served.connect_tcp()).collect();
    page.hold_until(0, 1, |frame| frame.number("speed_mph") > 3.0);
    drop(idle);
    served.stop();
}

#[test]
fn a_drive_is_watched_in_real_time_by_several_and_ends_with_ctrl_c() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    random_model(&dir.join("model.safetensors"), "lenet");
    let served = serve(dir, &["drive", "model.safetensors", "--track", "lake", "--watch", "--runs", "2"]);
    let mut page = Page::open(served.port);
    assert_eq!(page.hello["mode"], "watch");
    let (first, began) = (page.next().unwrap(), Instant::now());
    let mut pictures = [RgbImage::default(), RgbImage::default()];
    decode_rgb(&first.camera, &mut pictures[0]).unwrap();
    decode_rgb(&first.saliency, &mut pictures[1]).unwrap();
    assert!((pictures[1].width, pictures[1].height) == (320, 160) && pictures[0] != pictures[1]);

    // A slow page skips frames, and slows nothing down.
    let mut slow = Page::open(served.port);
    slow.next().unwrap();
    let mut frames = 1;
    let last = loop {
        let frame = page.next().unwrap();
        frames += 1;
        if frame.state["trail_id"] != first.state["trail_id"] || frame.number("time_s") > first.number("time_s") + 2.0 {
            break frame;
        }
    };
    let (driven_s, waited_s) = (last.number("time_s") - first.number("time_s"), began.elapsed().as_secs_f64());
    assert!(frames > 5 && driven_s < waited_s + 0.4, "{frames} frames, {driven_s} s driven in {waited_s} s");
    let skipped = slow.next().unwrap();
    assert!(
        skipped.number("trail_id") > last.number("trail_id") || skipped.number("time_s") >= last.number("time_s") - 0.2
    );

    // Whoever watches can let time stand still, and see that.
    page.ask(&json!({ "type": "pause" }));
    let paused = loop {
        let frame = page.next().unwrap();
        if frame.state["playback"]["paused"] == true {
            break frame;
        }
    };
    std::thread::sleep(Duration::from_millis(300));
    page.ask(&json!({ "type": "rate", "rate": 4 }));
    let still = page.next().unwrap();
    assert_eq!((&still.state["time_s"], &still.state["playback"]["rate"]), (&paused.state["time_s"], &json!(4.0)));
    page.ask(&json!({ "type": "pause" }));
    // To the end of the run, whose result stands on the page.
    page.ask(&json!({ "type": "next_run" }));
    let after = loop {
        let frame = page.next().unwrap();
        if frame.state["trail_id"] != paused.state["trail_id"] {
            break frame;
        }
    };
    let result = &after.state["results"][0];
    assert!(paused.state["title"].as_str().unwrap().ends_with(result["run"].as_str().unwrap()), "{result}");
    assert!(result["time_s"].as_f64() > paused.state["time_s"].as_f64());
    // Commands of a driver mean nothing from a watching page.
    page.ask(&json!({ "type": "finish" }));
    page.press(1, 1);
    std::thread::sleep(Duration::from_secs(1));
    let late = Page::open(served.port);
    assert!(!late.hello["trail"].as_array().unwrap().is_empty(), "who comes late sees the trail so far");
    assert!(late.hello["recent"].as_array().unwrap().len() > 3, "and the charts");
    drop((late, slow));
    served.interrupt();
    let words = loop {
        if let Err(words) = page.next() {
            break words;
        }
    };
    assert!(words.contains("ended"), "{words}");
    assert_eq!(served.code(), Some(130));
}

#[test]
fn a_port_that_is_taken_is_told_with_the_remedy_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let watch = ["drive", "expert", "--track", "lake", "--watch", "--port", &port];
    let manual = ["record", "--track", "lake", "--manual", "--out", "rec", "--port", &port];
    for args in [&watch[..], &manual[..]] {
        let message = error(folder.path(), args);
        assert!(message.contains(&port) && message.contains("another program has this port"), "{message}");
        assert!(message.contains("--port; 0 takes any free one"), "{message}");
    }
    assert!(entries(folder.path()).is_empty());
}

#[test]
fn idle_connections_make_room_and_a_page_in_use_keeps_its_seat() {
    let folder = tempfile::tempdir().unwrap();
    random_model(&folder.path().join("model"), "lenet");
    let served = serve(folder.path(), &["drive", "model", "--track", "lake", "--runs", "1", "--laps", "9", "--watch"]);
    let mut page = Page::open(served.port);
    page.next().unwrap();
    let mut idle = Vec::new();
    for _ in 0..45 {
        idle.push(Page::open(served.port));
        page.next().unwrap();
    }
    let mut late = Page::open(served.port);
    late.next().unwrap();
    page.next().unwrap();
    assert!(
        served.ask(&format!("GET / HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", served.port)).starts_with("HTTP/1.1 200")
    );
    served.interrupt();
    assert_eq!(served.code(), Some(130));
}

#[test]
fn beside_a_server_keys_take_the_wheel_from_the_model_and_the_rows_are_marked() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    random_model(&dir.join("model"), "lenet");
    let served = Served::start(dir, "model", &["--page=0", "--record", "corrections"]);
    let said = served.wait_until_it_says("in a browser to take the wheel");
    let port = said.split("open http://127.0.0.1:").nth(1).unwrap().split('/').next().unwrap().parse().unwrap();
    let mut car = served.connect_simulator();
    let jpeg = sample_jpeg();
    let turn = |car: &mut Client| {
        car.send(&telemetry(10.0, &jpeg));
        command(&car.next())
    };
    let (of_model, throttle) = turn(&mut car);
    assert!(throttle > 0.0 && of_model < 0.9, "{of_model} {throttle}");
    let mut page = Page::open(port);
    assert_eq!(turn(&mut car).0, of_model, "a page that is only open does not drive");
    let frame = page.next().unwrap();
    assert_eq!(frame.camera, jpeg);
    assert_eq!(frame.state["takeover"]["by_user"], false);
    // A held key turns the wheel to full lock, while the server holds the speed.
    let began = Instant::now();
    let mut driven = (of_model, 0.0);
    while driven.0 < 1.0 {
        assert!(began.elapsed() < SILENCE, "{driven:?}");
        page.press(1, 0);
        std::thread::sleep(Duration::from_millis(20));
        driven = turn(&mut car);
    }
    assert!(driven.1 > 0.0, "{driven:?}");
    let state = loop {
        let state = page.next().unwrap().state;
        if state["steering"] == 1.0 {
            break state;
        }
    };
    assert_eq!(state["takeover"]["by_user"], true);
    assert!((state["expert"].as_f64().unwrap() - of_model).abs() < 1e-6, "the model is asked all the time: {state}");
    assert!(state["takeover"]["rows"].as_u64().unwrap() > 0, "{state}");
    // Whoever lets go gives the wheel back, and a page that leaves does so at once.
    while turn(&mut car).0 != of_model {
        assert!(began.elapsed() < SILENCE);
        page.press(0, 0);
        std::thread::sleep(Duration::from_millis(20));
    }
    page.press(1, 0);
    while turn(&mut car).0 == of_model {
        assert!(began.elapsed() < SILENCE);
    }
    page.ask(&json!({ "type": "leave" }));
    while turn(&mut car).0 != of_model {
        assert!(began.elapsed() < SILENCE);
    }
    served.interrupt();
    let words = loop {
        if let Err(words) = page.next() {
            break words;
        }
    };
    assert!(words.contains("of them by you"), "{words}");
    let (summary, said) = served.end();
    assert!(said.contains("driven from the page"), "{said}");
    let by_user = summary["recorded"]["by_user"].as_u64().unwrap();
    let log = std::fs::read_to_string(dir.join("corrections/driving_log.csv")).unwrap();
    assert_eq!(log.lines().filter(|line| line.ends_with(", user")).count() as u64, by_user);
    assert!(by_user > 0 && log.contains(", pilot"), "{log}");
}

#[test]
fn a_training_is_watched_and_its_page_ends_with_the_report_that_is_on_disk() {
    let folder = tempfile::tempdir().unwrap();
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample");
    let args = ["train", sample.to_str().unwrap(), "--recipe", "lenet", "--set", "epochs=4", "--out", "run", "--watch"];
    let served = serve(folder.path(), &[&args[..], &["--json"]].concat());
    let get = |path: &str, host: &str| served.ask(&format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n"));
    let own = format!("127.0.0.1:{}", served.port);
    for (path, host, status) in [("/", "evil.example", "403"), ("/x", &own[..], "404"), ("/", &own, "200")] {
        assert!(get(path, host).starts_with(&format!("HTTP/1.1 {status}")), "{path} {host}");
    }
    let state = || -> Value { serde_json::from_str(get("/state", &own).split("\r\n\r\n").nth(1).unwrap()).unwrap() };
    let (began, mut reports) = (Instant::now(), Vec::new());
    let last = loop {
        let state = state();
        let number = state["report"].as_u64().unwrap();
        if number > 0 && reports.last().is_none_or(|(last, _)| *last < number) {
            let page = get("/report", &own).split_once("\r\n\r\n").unwrap().1.to_string();
            reports.push((number, page));
        }
        if !state["over"].is_null() {
            break state;
        }
        assert!(began.elapsed() < SILENCE, "{state}");
        std::thread::sleep(Duration::from_millis(20));
    };
    let (result, _) = served.end();
    assert!(last["over"].as_str().unwrap().contains(result["model"].as_str().unwrap()), "{last}");
    assert_eq!((&last["run"], &last["epoch"], &last["epochs"]), (&json!("run"), &json!(4), &json!(4)));
    let (_, page) = reports.last().unwrap();
    assert_eq!(*page, fs::read_to_string(folder.path().join("run/report.html")).unwrap());
}
