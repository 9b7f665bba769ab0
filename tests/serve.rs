//! `steersman serve` as a black box, driven by the built-in simulator and by clients of other habits.
#![cfg(unix)]

mod common;

use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

use common::command::{error, json, steersman};
use common::served::{Client, SIMULATOR, Served, command, folder_with_model, sample_jpeg, serve, telemetry, turn};
use serde_json::Value;
use steersman::model_file::{Model, TrainingRecord};
use steersman::observer::Unobserved;
use steersman::pilot::Pilot;
use steersman::recipe::Recipe;
use steersman::simulator::run_trial;
use steersman::simulator::{Speed, Track, TrialOptions};
use steersman::simulator_client::{ClientOptions, ClientReport, TimeMode, drive};
use steersman::udacity::{DecimalMark, NumberStyle};
use steersman_kernels::Isa;

/// Long enough for an answer that must not come. (Where the machine stands still, a wrong answer could be missed, not invented.)
const QUIET: Duration = Duration::from_millis(400);

fn lockstep(served: &Served) -> ClientOptions {
    ClientOptions {
        url: format!("ws://127.0.0.1:{}", served.port).parse().unwrap(),
        seed: 2,
        time_mode: TimeMode::Lockstep,
        patience_s: 120.0,
        ..ClientOptions::default()
    }
}

fn drive_lake(options: &ClientOptions) -> ClientReport {
    drive(&Track::load("lake").unwrap(), options, &mut Unobserved).unwrap()
}

fn count(value: &Value, name: &str) -> u64 {
    value[name].as_u64().unwrap_or_else(|| panic!("{name} in {value}"))
}

#[test]
fn in_lockstep_the_way_through_the_server_is_the_way_of_drive_bit_for_bit_in_every_language() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let mut pilot = Pilot::load(&folder.path().join("model")).unwrap();
    let options = TrialOptions { laps: 1, speed: Speed::Fixed(20.0), latency_ms: 0.0, noise: 0.0, assisted: false };
    let expected = run_trial(&Track::load("lake").unwrap(), &mut pilot, &options, 2).unwrap();
    assert!(expected.moments.len() > 30, "{} frames are too few to prove something", expected.moments.len());
    for mark in [DecimalMark::DOT, DecimalMark::COMMA] {
        let report = drive_lake(&ClientOptions { numbers: NumberStyle::Strings(mark), ..lockstep(&served) });
        assert_eq!(report.run, expected, "{mark:?}");
        assert_eq!((report.tokens_lost, report.connections), (0, 1));
    }
    let (summary, said) = served.stop();
    assert_eq!(count(&summary, "frames"), 2 * expected.moments.len() as u64);
    assert!(said.contains("decimal mark"), "{said}");
}

#[test]
fn with_the_throttle_of_the_model_the_way_is_that_of_drive_too() {
    let folder = tempfile::tempdir().unwrap();
    let throttle = "outputs=[{ name = 'steering' }, { name = 'throttle' }]";
    let speed = "outputs=[{ name = 'steering' }, { name = 'speed', top_speed_mph = 24 }]";
    for (name, outputs) in [("throttle", throttle), ("speed", speed)] {
        let recipe = Recipe::find("lenet", &["layers.last.units=2", outputs].map(String::from)).unwrap();
        let network = recipe.network(Isa::best()).unwrap();
        let mut parameters = network.initialize(1);
        // So that the car moves whatever the random weights say.
        parameters.tensor_mut(network.tensor("dense3.bias").unwrap())[1] = 0.6;
        let path = folder.path().join(name);
        Model { recipe, parameters, record: TrainingRecord::default(), training_rows: vec![] }.save(&path).unwrap();
        let served = Served::start(folder.path(), name, &["--speed", "20", "--throttle", "model"]);
        let options =
            TrialOptions { laps: 1, speed: Speed::Driver(20.0), latency_ms: 0.0, noise: 0.0, assisted: false };
        let mut pilot = Pilot::load(&path).unwrap();
        let expected = run_trial(&Track::load("lake").unwrap(), &mut pilot, &options, 2).unwrap();
        assert!(expected.moments.len() > 30, "{} frames are too few to prove something", expected.moments.len());
        let first = expected.moments[0].throttle;
        assert!(expected.moments.iter().any(|moment| moment.throttle != first), "{name}: always {first}");
        let report = drive_lake(&ClientOptions { start_mph: 12.0, ..lockstep(&served) });
        assert_eq!(report.run, expected, "{name}");
        served.stop();
    }
}

#[test]
fn sim_and_drive_write_the_same_trajectory() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let url = format!("ws://127.0.0.1:{}", served.port);
    let drive = ["drive", "model", "--track", "lake", "--runs", "1", "--seed", "5", "--out", "driven", "--json"];
    let sim = ["sim", "--connect", &url, "--track", "lake", "--seed", "5", "--lockstep", "--out", "sim", "--json"];
    let driven = json(folder.path(), &drive);
    let simulated = json(folder.path(), &sim);
    let read = |dir: &str| std::fs::read_to_string(folder.path().join(dir).join("free_5.csv")).unwrap();
    assert_eq!(read("driven"), read("sim"));
    for name in ["cte_mean_m", "cte_rms_m", "cte_p95_m", "distance_m", "laps_completed", "mean_speed_mph"] {
        assert_eq!(driven[name], simulated[name], "{name}");
    }
    let existing = error(folder.path(), &sim);
    assert!(existing.contains("sim: exists already"), "{existing}");
    served.stop();
}

#[test]
fn a_person_takes_the_wheel_and_gives_it_back() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let report = drive_lake(&ClientOptions { manual_s: Some((0.5, 1.0)), frames: Some(30), ..lockstep(&served) });
    assert_eq!((report.manual_telemetries, report.manuals, report.commands), (10, 10, 20));
    let (summary, said) = served.stop();
    assert_eq!(count(&summary, "frames"), 20);
    assert!(said.contains("release W and S"), "{said}");
}

#[test]
fn a_simulator_of_the_second_term_gets_numbers() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let report = drive_lake(&ClientOptions { numbers: NumberStyle::Json, frames: Some(20), ..lockstep(&served) });
    assert_eq!((report.commands, report.tokens_lost), (20, 0));
    served.stop();
}

#[test]
fn after_a_change_of_scene_the_drive_begins_anew() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let plain = drive_lake(&ClientOptions { frames: Some(10), ..lockstep(&served) });
    let changed = drive_lake(&ClientOptions { scene_change_s: Some(0.5), frames: Some(20), ..lockstep(&served) });
    assert_eq!(changed.connections, 2);
    assert_eq!(changed.run, plain.run, "nothing of the first scene is left in the second");
    served.stop();
}

#[test]
fn in_real_time_it_drives_as_well_and_reports_latencies() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let time_mode = TimeMode::RealTime { fps: 30.0 };
    let report = drive_lake(&ClientOptions { time_mode, frames: Some(40), ..lockstep(&served) });
    assert_eq!((report.commands, report.round_trips_ms.len(), report.tokens_lost), (40, 40, 0));
    let (summary, _) = served.stop();
    let ms = |name: &str| summary[name].as_f64().unwrap();
    assert!(ms("latency_p50_ms") > 0.0 && ms("latency_p50_ms") <= ms("latency_p99_ms"), "{summary}");
    assert!(report.round_trips_ms[20] >= ms("latency_p50_ms") / 2.0, "a round trip holds the server's part");
}

#[test]
fn what_is_recorded_while_driving_can_be_evaluated_and_no_folder_is_overwritten() {
    let folder = folder_with_model();
    let served = serve(&folder, &["--record", "drive"]);
    let report = drive_lake(&ClientOptions { frames: Some(25), ..lockstep(&served) });
    let (summary, _) = served.stop();
    assert_eq!((count(&summary["recorded"], "rows"), count(&summary["recorded"], "dropped")), (25, 0));
    let metrics = json(folder.path(), &["evaluate", "model", "drive", "--json"]);
    assert_eq!(count(&metrics, "rows"), 25);
    // The label of each frame is the command that the car got for it.
    let log = std::fs::read_to_string(folder.path().join("drive/driving_log.csv")).unwrap();
    let labels: Vec<f64> = log.lines().filter_map(|row| row.split(',').nth(3)?.trim().parse().ok()).collect();
    let commands: Vec<f64> = report.run.moments.iter().map(|m| m.steering).collect();
    assert_eq!(labels.len(), 25, "{log}");
    assert!(
        labels.iter().zip(&commands).all(|(label, command)| (label - command).abs() < 1e-6),
        "{labels:?} {commands:?}"
    );
    assert!(commands.iter().any(|steering| *steering != 0.0));
    let refused = error(folder.path(), &["serve", "model", "--port", "0", "--record", "drive"]);
    assert!(refused.contains("drive: exists already"), "{refused}");
}

#[test]
fn a_client_that_dies_in_mid_frame_makes_room_at_once() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let jpeg = sample_jpeg();
    for _ in 0..3 {
        let mut client = served.connect_simulator();
        turn(&mut client, 10.0, &jpeg);
        // The first half of a piece: text, not the last, masked, 1016 bytes announced and 500 sent.
        let mut stream = client.0.get_ref();
        stream.write_all(&[0x01, 0xfe, 0x03, 0xf8, 1, 2, 3, 4]).unwrap();
        stream.write_all(&[0x55; 500]).unwrap();
    }
    let report = drive_lake(&ClientOptions { frames: Some(5), ..lockstep(&served) });
    assert_eq!((report.commands, report.connections), (5, 1));
    served.stop();
}

#[test]
fn of_five_telemetries_at_once_the_newest_is_answered_and_one_goes_round() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let jpeg = sample_jpeg();
    let mut client = served.connect_simulator();
    let throttle = turn(&mut client, 19.0, &jpeg).1;
    for speed in [1.0, 2.0, 3.0, 4.0] {
        client.0.write(tungstenite::Message::text(telemetry(speed, &jpeg))).unwrap();
    }
    client.send(&telemetry(29.0, &jpeg));
    let mut answers = vec![command(&client.next())];
    while let Some(text) = client.next_within(QUIET) {
        answers.push(command(&text));
    }
    assert!(answers.last().unwrap().1 < throttle, "the newest, at 29 mph, is answered last: {answers:?}");
    let (summary, _) = served.stop();
    let (frames, superseded) = (count(&summary, "frames"), count(&summary, "superseded"));
    // Usually one answer; the pieces of five messages need not arrive in one go.
    assert!(frames + superseded == 6 && frames <= 4, "{summary}");
    assert_eq!(answers.len() as u64, frames - 1);
}

#[test]
fn another_client_drives_only_when_the_first_is_silent_or_gone() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let jpeg = sample_jpeg();
    let mut first = served.connect_simulator();
    turn(&mut first, 10.0, &jpeg);
    let mut second = served.connect_simulator();
    second.send(&telemetry(10.0, &jpeg));
    served.wait_until_it_says("another client drives");
    // An open connection without telemetry takes nothing away either.
    let idle = served.connect_simulator();
    turn(&mut first, 10.0, &jpeg);
    // Now the first falls silent, and the telemetry that waits is answered.
    let answer = second.next();
    assert!(answer.contains("steer"), "{answer}");
    // It waited; it was not silent.
    assert_eq!(second.next_within(Duration::from_millis(100)), None);
    first.next_within(QUIET);
    assert!(first.next_within(Duration::from_secs(60)).is_none(), "the silent one is closed");
    drop(idle);
    // One that leaves makes room at once.
    second.0.close(None).unwrap();
    drop(second);
    let mut third = served.connect_simulator();
    turn(&mut third, 10.0, &jpeg);
    served.stop();
}

#[test]
fn bad_telemetry_is_answered_so_that_the_car_does_not_wait_for_ever() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let jpeg = sample_jpeg();
    let mut client = served.connect_simulator();
    let (steering, throttle) = turn(&mut client, 10.0, &jpeg);
    assert!(throttle > 0.0);
    let good = telemetry(10.0, &jpeg);
    // The same trouble is not reported again within seconds.
    for (bad, words) in [
        (good.replace("/9j/", "?9j/"), "not base64"),
        (telemetry(10.0, &jpeg[..jpeg.len() / 2]), ""),
        (telemetry(10.0, b"no picture at all"), ""),
        (good.replace("\"speed\"", "\"velocity\""), "without a speed"),
        (good.replace("\"image\"", "\"picture\""), "without an image"),
        (good[..good.len() - 3].to_string(), "event that cannot be read"),
    ] {
        client.send(&bad);
        let (held, throttle) = command(&client.next());
        // On a slow machine the time of holding may be over, and the car brakes.
        assert!(held == steering && (throttle == 0.0 || throttle == -1.0), "the wheel stays: {words}: {throttle}");
        served.wait_until_it_says(words);
        client.send(&good);
        // On a slow machine the throttle is cut once more in between.
        let mut again =
            (0..10).map(|_| client.next()).filter(|text| text.starts_with("42[\"steer\"")).map(|text| command(&text));
        let last = again.find(|(_, throttle)| *throttle > 0.0);
        assert_eq!(last.map(|(steering, _)| steering), Some(steering), "{words}");
    }
    served.stop();
}

#[test]
fn without_telemetry_the_throttle_is_cut_and_the_simulator_is_asked() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let mut client = served.connect_simulator();
    let (steering, throttle) = turn(&mut client, 10.0, &sample_jpeg());
    assert!(throttle > 0.0);
    assert_eq!(command(&client.next()), (steering, 0.0));
    assert_eq!(client.next(), r#"42["manual",{}]"#);
    served.wait_until_it_says("no telemetry for");
    turn(&mut client, 10.0, &sample_jpeg());
    served.stop();
}

#[test]
fn a_silent_car_that_is_not_driven_is_asked_and_nobody_claims_its_throttle_was_cut() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let ask = r#"42["manual",{}]"#;
    let mut by_hand = served.connect_simulator();
    by_hand.send(r#"42["telemetry",null]"#);
    assert_eq!((by_hand.next(), by_hand.next()), (ask.into(), ask.into()), "the answer, and the question");
    drop(by_hand);
    let mut taken_over = served.connect_simulator();
    turn(&mut taken_over, 10.0, &sample_jpeg());
    taken_over.send(r#"42["telemetry",null]"#);
    // On a slow machine the throttle is cut once before the person is noticed.
    while taken_over.next() != ask {}
    assert_eq!(taken_over.next(), ask);
    let (summary, said) = served.stop();
    assert!(count(&summary["events"], "silent") >= 2, "{summary}");
    assert!(said.contains("it is asked for"), "{said}");
}

#[test]
fn control_characters_of_a_client_are_not_shown() {
    let folder = folder_with_model();
    let served = serve(&folder, &["--check"]);
    let mut client = served.connect_simulator();
    client.send("2\u{1b}[2J\u{9b}\rend");
    assert_eq!(client.next(), "3\u{1b}[2J\u{9b}\rend");
    let said = served.wait_until_it_says("< 3");
    assert!(said.contains(r"> 2\u{1b}[2J\u{9b}\rend"), "{said:?}");
    let (_, said) = served.stop();
    assert!(!said.contains(['\u{1b}', '\u{9b}', '\r']), "{said:?}");
}

#[test]
fn the_car_is_driven_on_and_told_to_roll_when_nobody_reads_the_log() {
    let folder = folder_with_model();
    let mut command_line = steersman(folder.path());
    command_line.args(["serve", "model", "--port", "0", "--speed", "20", "--check", "--json"]);
    let mut child = command_line.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut line = String::new();
    // As `head -1` does, it leaves after the first line.
    BufReader::new(child.stderr.take().unwrap()).read_line(&mut line).unwrap();
    let port = line.split("127.0.0.1:").nth(1).and_then(|rest| rest.split('/').next()).unwrap().parse().unwrap();
    let mut client = Client::connect(port, SIMULATOR, 4);
    let steering = turn(&mut client, 10.0, &sample_jpeg()).0;
    assert!(std::process::Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    let mut last = client.next();
    while let Some(text) = client.next_within(Duration::from_secs(60)) {
        last = text;
    }
    assert_eq!(command(&last), (steering, 0.0));
    assert!(child.wait_with_output().unwrap().status.success());
}

#[test]
fn at_the_end_the_car_is_told_to_roll() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let mut client = served.connect_simulator();
    let (steering, _) = turn(&mut client, 10.0, &sample_jpeg());
    let reader = std::thread::spawn(move || {
        let last = client.next();
        (last, client.next_within(Duration::from_secs(60)))
    });
    served.stop();
    let (last, end) = reader.join().unwrap();
    assert_eq!((command(&last), end), ((steering, 0.0), None));
}

#[test]
fn wrong_ports_are_named_on_both_sides() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let port = served.port.to_string();
    let taken = error(folder.path(), &["serve", "model", "--port", &port]);
    assert!(taken.contains(&port) && taken.contains("--port"), "{taken}");
    served.stop();
    let url = format!("ws://127.0.0.1:{port}");
    let nobody = error(folder.path(), &["sim", "--connect", &url, "--track", "lake", "--patience", "0.5"]);
    assert!(nobody.contains(&url) && nobody.contains("steersman serve"), "{nobody}");
}

#[test]
fn check_shows_the_handshake_and_both_sides() {
    let folder = folder_with_model();
    let served = serve(&folder, &["--check"]);
    drive_lake(&ClientOptions { frames: Some(3), ..lockstep(&served) });
    let (_, said) = served.stop();
    for words in [
        "GET /socket.io/?EIO=4&transport=websocket HTTP/1.1",
        "User-Agent: websocket-sharp/1.0",
        "101 Switching Protocols",
        r#"> 42["telemetry",{"steering_angle":"0.0000""#,
        r#"< 42["steer",{"steering_angle":""#,
    ] {
        assert!(said.contains(words), "{words} in {said}");
    }
}

#[test]
fn bad_arguments_of_sim_are_errors_with_a_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let sim = |args: &[&str]| error(folder.path(), &[&["sim", "--track", "lake"], args].concat());
    assert!(sim(&["--fps", "0"]).contains("1 to 1000"));
    assert!(sim(&["--manual", "5:2"]).contains("the end must come after"));
    assert!(error(folder.path(), &["sim", "--track", "lakke"]).contains("lake"));
    for args in [&["--connect", "http://127.0.0.1"][..], &["--manual", "5"], &["--lockstep", "--fps", "10"]] {
        let output =
            common::command::steersman(folder.path()).args(["sim", "--track", "lake"]).args(args).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}");
    }
    assert!(!Path::new(&folder.path().join("sim")).exists());
}

#[test]
fn damaged_frames_hold_the_wheel_for_half_a_second_and_then_the_car_brakes() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let jpeg = sample_jpeg();
    let mut client = served.connect_simulator();
    let (steering, _) = turn(&mut client, 12.0, &jpeg);
    let answered = Instant::now();
    // A whole start, and an end marker behind half of the picture.
    let damaged = [&jpeg[..jpeg.len() / 2], &[0xff, 0xd9]].concat();
    let mut braked = None;
    while braked.is_none() {
        client.send(&telemetry(12.0, &damaged));
        let (held, throttle) = command(&client.next());
        assert_eq!(held, steering, "a damaged frame steers nothing");
        assert!(throttle == 0.0 || throttle == -1.0, "{throttle}");
        braked = (throttle < 0.0).then(|| answered.elapsed());
        assert!(answered.elapsed() < Duration::from_secs(60), "it never brakes");
    }
    assert!(braked >= Some(Duration::from_millis(450)), "{braked:?}");
    // The simulator would drive backwards if it braked a slow car.
    client.send(&telemetry(3.0, &damaged));
    assert_eq!(command(&client.next()), (steering, 0.0));
    assert!(turn(&mut client, 12.0, &jpeg).1 > 0.0, "a good frame drives again");
    served.stop();
}

#[test]
fn a_damaged_model_is_refused_by_name_and_an_old_one_is_driven_with_a_notice() {
    let folder = folder_with_model();
    let path = folder.path().join("model");
    let whole = std::fs::read(&path).unwrap();
    let mut damaged = whole.clone();
    // The lowest bit of a weight.
    let at = damaged.len() - 1001;
    damaged[at - at % 4] ^= 1;
    std::fs::write(&path, damaged).unwrap();
    for args in [&["serve", "model", "--port", "0"][..], &["drive", "model", "--track", "lake", "--runs", "1"]] {
        let said = error(folder.path(), args);
        assert!(said.contains("model: is damaged"), "{said}");
    }
    let header_len = u64::from_le_bytes(*whole.first_chunk().unwrap()) as usize;
    let header = std::str::from_utf8(&whole[8..8 + header_len]).unwrap();
    let seal = header.find(r#",\"sha256\":\""#).unwrap();
    let end = seal + r#",\"sha256\":\"\""#.len() + 64;
    let old = format!("{}{}", &header[..seal], &header[end..]);
    let bytes = [&(old.len() as u64).to_le_bytes(), old.as_bytes(), &whole[8 + header_len..]].concat();
    std::fs::write(&path, bytes).unwrap();
    let served = serve(&folder, &[]);
    assert!(served.said().contains("note: model: an earlier version wrote this file"), "{}", served.said());
    served.stop();
}
