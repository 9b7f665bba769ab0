//! The client of DonkeySim: against our stand-in as strict as the real one, against a simulator that a test plays, and against hostile ones.

mod common;
#[path = "common/stand_in.rs"]
mod stand_in;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use steersman::Error;
use steersman::donkeysim::client::{DonkeyDrive, DonkeyDriveOptions, DonkeyDriveSummary, DonkeyFrame, drive};
use steersman::donkeysim::{Reading, Scene};
use steersman::observer::StopSignal;
use steersman::pilot::Pilot;
use steersman::simulator::{DriverAnswer, Failure, Pace, Speed};
use steersman::simulator_client::ClientEvent;

use common::command::{error, json as run_json, steersman};
use common::served::random_model;
use stand_in::with_stand_in;

/// A picture of 160x120 pixels in one grey.
fn jpeg() -> Vec<u8> {
    let mut bytes = Vec::new();
    let picture = image::RgbImage::from_pixel(160, 120, image::Rgb([90; 3]));
    picture.write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg).unwrap();
    bytes
}

/// Drives; what was said is the second result.
fn go(
    options: &DonkeyDriveOptions,
    mut driver: impl FnMut(DonkeyFrame) -> Result<DriverAnswer, String>,
) -> (steersman::Result<DonkeyDrive>, Vec<String>) {
    let mut said = Vec::new();
    let mut observer = |event| {
        if let ClientEvent::Notice(text) = event {
            said.push(text);
        }
        Ok(())
    };
    let driven = drive(options, &mut driver, &mut observer);
    (driven, said)
}

fn straight(_: DonkeyFrame) -> Result<DriverAnswer, String> {
    Ok(DriverAnswer { steering: 0.0, pace: None })
}

#[test]
fn it_drives_our_stand_in_from_the_menu_in_its_strict_mode() {
    let said_there = with_stand_in(Scene::Menu, Reading::Strict, |address| {
        let options = DonkeyDriveOptions {
            server: address.to_string(),
            picture: [48, 64],
            time_limit_s: 5.0,
            ..DonkeyDriveOptions::default()
        };
        let mut sizes = Vec::new();
        // Who knows the line steers along it.
        let driver = |frame: DonkeyFrame| {
            let picture = image::load_from_memory(frame.picture).map_err(|e| e.to_string())?;
            sizes.push((picture.width(), picture.height()));
            let steering = -0.1 * frame.telemetry.cte.ok_or("no cte")? as f32;
            Ok(DriverAnswer { steering, pace: None })
        };
        let (driven, said) = go(&options, driver);
        let driven = driven.unwrap();
        assert!(driven.ended.is_none() && driven.runs.len() == 1, "{:?} {said:?}", driven.ended);
        assert_eq!(driven.scene.as_deref(), Some("generated_track"));
        assert!(said.iter().any(|text| text.contains("scenes of the simulator: generated_road")), "{said:?}");
        assert!(said.iter().any(|text| text.contains("time limit of 5 s")), "{said:?}");
        assert!(!sizes.is_empty() && sizes.iter().all(|size| *size == (64, 48)), "{sizes:?}");
        let run = &driven.runs[0];
        assert!(run.failure.is_none() && run.laps_completed == 0, "{:?}", run.failure);
        let (first, last) = (&run.moments[0], run.moments.last().unwrap());
        // It accelerates from the start, and the distance is that between the places.
        assert!(first.speed_mph < 1.0 && last.speed_mph > 3.0, "{last:?}");
        let way_m = (last.x - first.x).hypot(last.y - first.y);
        assert!((way_m / run.distance_m - 1.0).abs() < 0.1, "{way_m} {}", run.distance_m);
        assert!(last.cte_m.abs() < 8.0 && (-180.0..=180.0).contains(&last.heading_deg));
        let summary = DonkeyDriveSummary::new(&options, &driven);
        assert_eq!((summary.autonomy_percent, summary.laps_total), (100.0, 1));
        assert!(summary.cte_mean_m.unwrap() < 8.0 && summary.answer_ms_p50.unwrap() < 1000.0);
    });
    assert!(!said_there.iter().any(|text| text.contains("must be a number in a string")), "{said_there:?}");
    assert!(
        !said_there.iter().any(|text| text.contains("no effect") && !text.contains("car_config")),
        "{said_there:?}"
    );
    // On a machine that stands still for a while two controls may arrive at once.
    let at_once = said_there.iter().filter(|text| text.contains("no message")).count();
    assert!(at_once <= 2, "{said_there:?}");
}

#[test]
fn a_scene_that_is_not_there_is_refused_with_those_that_are() {
    with_stand_in(Scene::Menu, Reading::Strict, |address| {
        let scene = Some("moon\u{1b}[2J".to_string());
        let options = DonkeyDriveOptions { server: address.to_string(), scene, ..DonkeyDriveOptions::default() };
        let message = go(&options, straight).0.unwrap_err().to_string();
        assert!(message.contains("it has generated_road") && message.contains("moon\\u{1b}"), "{message}");
    });
    with_stand_in(Scene::Race, Reading::Strict, |address| {
        let options = DonkeyDriveOptions {
            server: address.to_string(),
            scene: Some("warehouse".into()),
            time_limit_s: 1.0,
            ..DonkeyDriveOptions::default()
        };
        let (driven, said) = go(&options, straight);
        assert!(driven.unwrap().ended.is_none() && said[0].contains("in a scene already"), "{said:?}");
    });
}

/// A simulator that `play` plays for one client; options that lead to it.
fn played<T: Send + 'static>(
    play: impl FnOnce(TcpStream) -> T + Send + 'static,
) -> (DonkeyDriveOptions, std::thread::JoinHandle<T>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let server = listener.local_addr().unwrap().to_string();
    let playing = std::thread::spawn(move || {
        let (stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        play(stream)
    });
    (DonkeyDriveOptions { server, patience_s: 3.0, ..DonkeyDriveOptions::default() }, playing)
}

/// The next message of the client: one object of strings in one read.
fn heard(stream: &mut TcpStream) -> Option<Value> {
    let mut bytes = [0; 4096];
    let len = stream.read(&mut bytes).unwrap_or(0);
    if len == 0 {
        return None;
    }
    let message: Value = serde_json::from_slice(&bytes[..len])
        .unwrap_or_else(|e| panic!("{e} in {}", String::from_utf8_lossy(&bytes[..len])));
    assert!(message.as_object().unwrap().values().all(Value::is_string), "{message}");
    Some(message)
}

fn tell(stream: &mut TcpStream, message: &Value) {
    // The client may have left.
    let _ = stream.write_all(format!("{message}\n").as_bytes());
}

fn telemetry(time_s: f64, fields: &Value) -> Value {
    let image = data_encoding::BASE64.encode(&jpeg());
    let mut message = json!({"msg_type": "telemetry", "image": image, "speed": 1.0, "time": time_s, "hit": "none"});
    message.as_object_mut().unwrap().extend(fields.as_object().unwrap().clone());
    message
}

/// Plays a simulator in a scene: after each reset, telemetries as `fields` says of the n-th, one for each control, until the client leaves.
fn play_scene(mut stream: TcpStream, mut fields: impl FnMut(usize, usize) -> Vec<Value>) -> Vec<Value> {
    tell(&mut stream, &json!({"msg_type": "need_car_config"}));
    let (mut heard_all, mut resets, mut n, mut time_s) = (Vec::new(), 0, 0, 100.0);
    while let Some(message) = heard(&mut stream) {
        let kind = message["msg_type"].as_str().unwrap().to_string();
        resets += usize::from(kind == "reset_car");
        n = if kind == "reset_car" { 0 } else { n };
        heard_all.push(message);
        if kind == "control" && resets > 0 {
            // The client stands for a second after a reset and heeds nothing.
            if n == 0 {
                std::thread::sleep(Duration::from_millis(1100));
            }
            for message in fields(resets, n) {
                time_s += 0.5;
                match message.get("msg_type") {
                    Some(_) => tell(&mut stream, &message),
                    None => tell(&mut stream, &telemetry(time_s, &message)),
                }
            }
            n += 1;
        }
    }
    heard_all
}

#[test]
fn laps_failures_and_measures_are_those_of_what_the_simulator_says() {
    let line = || json!({"msg_type": "collision_with_starting_line", "starting_line_index": 0, "timeStamp": 1.0});
    let (options, playing) = played(move |stream| {
        play_scene(stream, |run, n| match (run, n) {
            (1, 1 | 9 | 17) => vec![line(), json!({"cte": -2.0})],
            (2, 5) => vec![json!({"cte": 0.5, "hit": "cone"})],
            (3, 6) => vec![json!({"cte": 9.0})],
            _ => vec![json!({"cte": 1.0})],
        })
    });
    let options = DonkeyDriveOptions { laps: 2, runs: 3, ..options };
    let (driven, said) = go(&options, |_| Ok(DriverAnswer { steering: 7.0, pace: None }));
    let driven = driven.unwrap();
    assert!(driven.ended.is_none(), "{:?}", driven.ended);
    let heard = playing.join().unwrap();
    let of = |kind: &str| heard.iter().filter(|message| message["msg_type"] == kind).count();
    assert_eq!((of("car_config"), of("cam_config"), of("reset_car"), of("exit_scene")), (1, 1, 3, 0));
    let camera = heard.iter().find(|message| message["msg_type"] == "cam_config").unwrap();
    assert_eq!((&camera["img_w"], &camera["img_h"], &camera["fov"]), (&json!("160"), &json!("120"), &json!("0")));
    assert!(heard.iter().any(|message| message["steering"] == "1.00000"), "beyond full lock is full lock");
    assert_eq!(heard.last().unwrap()["brake"], "1.00000", "the car must not go on alone");
    let failures: Vec<_> = driven.runs.iter().map(|run| run.failure).collect();
    assert_eq!(failures, [None, Some(Failure::Crash), Some(Failure::LeftRoad)], "{said:?}");
    let summary = DonkeyDriveSummary::new(&options, &driven);
    assert_eq!((summary.laps_completed, summary.laps_total, summary.crashes, summary.interventions), (2, 6, 1, 2));
    assert_eq!(summary.cte_max_m, Some(9.0));
    // Eight units of the scene in each unit of the telemetry's speed, for half a second each.
    assert!((summary.distance_m - 8.0 * summary.time_s).abs() < 1e-6 && summary.time_s > 10.0, "{summary:?}");
    assert_eq!(summary.calm, None, "the simulator tells no direction");
}

#[test]
fn a_model_drives_with_its_own_throttle_up_to_the_limit() {
    let (options, playing) = played(|stream| play_scene(stream, |_, _| vec![json!({"cte": 0.0, "speed": 0.1})]));
    let options = DonkeyDriveOptions { speed: Speed::Driver(30.0), time_limit_s: 1.0, ..options };
    let pace = Some(Pace::Throttle(0.375));
    let (driven, _) = go(&options, |_| Ok(DriverAnswer { steering: -0.5, pace }));
    assert!(driven.unwrap().answered > 0);
    let heard = playing.join().unwrap();
    let driving = heard.iter().find(|message| message["steering"] == "-0.50000").unwrap();
    assert_eq!((&driving["throttle"], &driving["brake"]), (&json!("0.37500"), &json!("0.00000")));
}

#[test]
fn what_was_driven_is_kept_when_the_simulator_leaves_or_somebody_stops_it() {
    // The simulator is gone after 20 telemetries.
    let (options, playing) = played(|stream| {
        let closing = stream.try_clone().unwrap();
        play_scene(stream, move |_, n| {
            if n == 20 {
                closing.shutdown(std::net::Shutdown::Both).unwrap();
            }
            vec![json!({"cte": 1.0})]
        })
    });
    let driven = go(&options, straight).0.unwrap();
    let ended = driven.ended.unwrap().to_string();
    assert!(ended.contains("closed the connection") && ended.starts_with("127.0.0.1:"), "{ended}");
    assert!(driven.runs.len() == 1 && driven.runs[0].moments.len() >= 15, "{}", driven.runs[0].moments.len());
    playing.join().unwrap();
    // Somebody stops it.
    let (options, playing) = played(|stream| play_scene(stream, |_, _| vec![json!({"cte": 1.0})]));
    let mut answered = 0;
    let stop = StopSignal::default();
    let mut driver = |_: DonkeyFrame| {
        answered += 1;
        if answered == 10 {
            stop.request();
        }
        Ok(DriverAnswer { steering: 0.0, pace: None })
    };
    let mut observer = |_: ClientEvent| stop.check();
    let driven = drive(&options, &mut driver, &mut observer).unwrap();
    assert!(matches!(driven.ended, Some(Error::Interrupted)) && driven.runs[0].moments.len() == 10);
    assert_eq!(playing.join().unwrap().last().unwrap()["brake"], "1.00000");
}

#[test]
fn a_drive_that_ends_before_its_first_run_is_no_drive() {
    // Somebody stops it while the car is put back, for the first run and for the second.
    for stopped_at in [1, 2] {
        let stop = StopSignal::default();
        let (signal, mut resets) = (stop.clone(), 0);
        let (options, playing) = played(move |mut stream| {
            tell(&mut stream, &json!({"msg_type": "need_car_config"}));
            while let Some(message) = heard(&mut stream) {
                resets += usize::from(message["msg_type"] == "reset_car");
                if resets == stopped_at {
                    signal.request();
                }
                if resets > 0 {
                    tell(&mut stream, &telemetry(1.0, &json!({"hit": "wall"})));
                }
            }
        });
        let options = DonkeyDriveOptions { runs: 3, ..options };
        let mut observer = |_: ClientEvent| stop.check();
        let driven = drive(&options, &mut straight, &mut observer);
        if stopped_at == 1 {
            assert!(matches!(driven, Err(Error::Interrupted)), "{driven:?}");
        } else {
            let driven = driven.unwrap();
            assert!(matches!(driven.ended, Some(Error::Interrupted)), "{:?}", driven.ended);
            assert_eq!((driven.runs.len(), driven.last_run), (1, 2));
        }
        playing.join().unwrap();
    }
    // The simulator leaves.
    let (options, playing) = played(|mut stream| {
        tell(&mut stream, &json!({"msg_type": "need_car_config"}));
        while heard(&mut stream).is_some_and(|message| message["msg_type"] != "reset_car") {}
    });
    let message = go(&options, straight).0.unwrap_err().to_string();
    assert!(message.contains("closed the connection"), "{message}");
    playing.join().unwrap();
}

#[test]
fn every_message_of_a_flood_counts_and_a_disqualified_car_has_not_left_the_road() {
    // More than is read before one is answered, in one write.
    const FLOOD: usize = 700;
    let (options, playing) = played(|stream| {
        let mut flooding = stream.try_clone().unwrap();
        play_scene(stream, move |_, n| {
            if n == 1 {
                let telemetry = "{\"msg_type\":\"telemetry\",\"speed\":1,\"time\":100}\n".repeat(FLOOD);
                flooding.write_all((telemetry + "{\"msg_type\":\"DQ\"}\n").as_bytes()).unwrap();
            }
            if n == 0 { vec![json!({"cte": 1.0})] } else { vec![] }
        })
    });
    let (driven, said) = go(&options, straight);
    let driven = driven.unwrap();
    assert!(
        driven.ended.is_none() && driven.runs[0].failure == Some(Failure::Disqualified),
        "{:?} {said:?}",
        driven.ended
    );
    // The first has a picture; the newest of the last batch is not answered, as the run is over.
    assert_eq!((driven.answered, driven.superseded + driven.unreadable), (1, FLOOD as u64 - 1), "{said:?}");
    let summary = DonkeyDriveSummary::new(&options, &driven);
    assert_eq!((summary.interventions, summary.disqualified, summary.crashes), (1, 1, 0));
    assert!(said.iter().any(|text| text.contains("is disqualified")), "{said:?}");
    playing.join().unwrap();
}

#[test]
fn hostile_simulators_end_the_drive_with_place_and_remedy_and_soon() {
    let hello = b"{\"msg_type\":\"car_loaded\"}\n".to_vec();
    let menu = b"{\"msg_type\":\"scene_selection_ready\",\"loaded\":\"1\"}\n".to_vec();
    let with = |fields: &str| {
        [&hello[..], format!("{{\"msg_type\":\"telemetry\",{fields}}}\n").repeat(40).as_bytes()].concat()
    };
    let huge = data_encoding::BASE64.encode(&{
        // A JPEG of 60000x60000 pixels, as its header says.
        let mut bytes = jpeg();
        let at = bytes.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
        bytes[at + 5..at + 9].copy_from_slice(&[0xea, 0x60, 0xea, 0x60]);
        bytes
    });
    let cases: Vec<(&str, Vec<u8>, &str)> = vec![
        ("nothing", vec![], "says nothing"),
        ("another protocol", b"HTTP/1.1 400 Bad Request\r\n\r\n".to_vec(), "is this DonkeySim?"),
        ("control characters", b"\x1b[2J\x1b]0;owned\x07\n".to_vec(), "is this DonkeySim?"),
        ("no end of a line", vec![b'{'; 5 << 20], "more than 4 MiB"),
        ("deep", [b"[".repeat(100_000), b"\n".to_vec()].concat(), "is this DonkeySim?"),
        ("half a message", b"{\"msg_type\":\"car_lo\n".to_vec(), "message 1"),
        ("no scenes", [&menu[..], b"{\"msg_type\":\"scene_names\",\"scene_names\":[]}\n"].concat(), "no scenes"),
        ("no names", menu.clone(), "does not name its scenes"),
        ("no telemetry", hello.clone(), "no telemetry for 0.8 s"),
        ("rubbish in a scene", [&hello[..], b"{\"msg_type\":\"telemetry\"\n"].concat(), "no message"),
        ("no picture", with("\"speed\":1"), "it has no `image`"),
        ("a picture of a number", with("\"speed\":1,\"image\":5"), "it has no `image`"),
        ("no Base64", with("\"speed\":1,\"image\":\"\\u001b[2J\""), "no Base64"),
        ("no JPEG", with("\"speed\":1,\"image\":\"QUJD\""), "neither a JPEG nor a PNG"),
        ("a huge picture", with(&format!("\"speed\":1,\"image\":\"{huge}\"")), "60000"),
        ("no speed", with("\"image\":\"QUJD\",\"speed\":\"NaN\""), "no `speed`"),
    ];
    let folder = tempfile::tempdir().unwrap();
    let model = folder.path().join("model");
    random_model(&model, "donkey");
    let pilot = steersman::pilot::Pilot::load(&model).unwrap();
    std::thread::scope(|scope| {
        for (name, bytes, named) in cases {
            let pilot = pilot.clone();
            scope.spawn(move || end_of_drive(name, bytes, named, pilot));
        }
    });
}

/// Drives against a simulator that sends `bytes`, which must end with an error in which `named` stands.
fn end_of_drive(name: &str, bytes: Vec<u8>, named: &str, mut pilot: Pilot) {
    let (options, playing) = played(move |mut stream| {
        let began = Instant::now();
        // Telemetry goes on until the car is to drive; the client may leave.
        let goes_on = bytes.windows(11).any(|part| part == b"\"telemetry\"");
        let mut sent = stream.write_all(&bytes).is_ok();
        stream.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        while sent && began.elapsed() < Duration::from_secs(30) {
            sent = !matches!(stream.read(&mut [0; 4096]), Ok(0));
            if goes_on && began.elapsed() > Duration::from_secs(1) {
                sent &= stream.write_all(&bytes).is_ok();
            }
        }
    });
    let options = DonkeyDriveOptions { patience_s: 0.8, ..options };
    let began = Instant::now();
    let driver = |frame: DonkeyFrame| {
        let answer = pilot.answer_encoded_within(frame.picture, 1920).map_err(|error| error.to_string())?;
        Ok(DriverAnswer { steering: answer.steering, pace: None })
    };
    let (driven, said) = go(&options, driver);
    let message = match driven {
        Err(error) => error.to_string(),
        Ok(driven) => driven.ended.unwrap_or_else(|| panic!("{name} must not drive")).to_string(),
    };
    assert!(message.contains(named), "{name}: {message}");
    assert!(message.contains("127.0.0.1:"), "{name}: {message}");
    assert!(message.chars().all(|c| !c.is_control()), "{name}: {message}");
    assert!(said.iter().all(|text| text.chars().all(|c| !c.is_control())) && said.len() <= 20, "{name}: {said:?}");
    assert!(began.elapsed() < Duration::from_secs(60), "{name}");
    playing.join().unwrap();
}

#[test]
fn as_a_command_it_saves_and_tells_and_an_error_has_its_remedy() {
    let folder = tempfile::tempdir().unwrap();
    random_model(&folder.path().join("model"), "donkey");
    let nobody = {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        listener.local_addr().unwrap().to_string()
    };
    let message = error(folder.path(), &["drive", "model", "--donkeysim", &nobody]);
    assert!(message.contains(&nobody) && message.contains("start DonkeySim first"), "{message}");
    let message = error(folder.path(), &["drive", "expert", "--donkeysim", &nobody]);
    assert!(message.contains("name a model file"), "{message}");
    let message = error(folder.path(), &["drive", "model", "--donkeysim", &nobody, "--cam", "zoom=2"]);
    assert!(message.contains("fish_eye_x"), "{message}");
    for wrong in [["--track", "lake"], ["--noise", "0.1"]] {
        let output =
            steersman(folder.path()).args(["drive", "model", "--donkeysim", &nobody]).args(wrong).output().unwrap();
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
    }
    with_stand_in(Scene::Race, Reading::Strict, |address| {
        let address = address.to_string();
        let args = ["drive", "model", "--donkeysim", &address, "--time-limit", "3", "--out", "drive", "--json"];
        let told = run_json(folder.path(), &args);
        assert!(told["answered"].as_u64().unwrap() > 5 && told["laps_total"] == 1, "{told}");
        let kept = std::fs::read_to_string(folder.path().join("drive/donkeysim.json")).unwrap();
        let kept: Value = serde_json::from_str(&kept).unwrap();
        assert_eq!(kept["distance_m"], told["distance_m"]);
        let way = std::fs::read_to_string(folder.path().join("drive/run_1.csv")).unwrap();
        assert!(way.starts_with("time_s,x_m,y_m,") && way.lines().count() > 6, "{way}");
    });
}
