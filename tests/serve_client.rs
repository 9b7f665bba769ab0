//! The built-in simulator as a client, before servers that say what each test tells them to say.

mod common;

use std::io::{Read, Write};
use std::net::{Shutdown, TcpStream};

use common::double::{Peer, start};
use data_encoding::BASE64;
use serde_json::Value;
use steersman::Error;
use steersman::observer::Unobserved;
use steersman::picture::{RgbImage, decode::decode_rgb};
use steersman::simulator::SpeedController;
use steersman::simulator::run_trial;
use steersman::simulator::{DriveState, Driver, RgbFrame, Speed, Track, TrialOptions};
use steersman::simulator_client::{ClientOptions, ClientReport, TimeMode, drive};
use steersman::udacity::{DecimalMark, NumberStyle};

/// In lockstep with a server on `port`, for `frames` replies.
fn lockstep(port: u16, frames: u64) -> ClientOptions {
    ClientOptions {
        url: format!("ws://127.0.0.1:{port}").parse().unwrap(),
        seed: 3,
        time_mode: TimeMode::Lockstep,
        frames: Some(frames),
        ..ClientOptions::default()
    }
}

fn drive_lake(options: &ClientOptions) -> ClientReport {
    drive(&Track::load("lake").unwrap(), options, &mut Unobserved).unwrap()
}

/// The fields of a telemetry.
fn fields(text: &str) -> Value {
    let event: Value = serde_json::from_str(text.strip_prefix("42").unwrap_or_else(|| panic!("{text}"))).unwrap();
    assert_eq!(event[0], "telemetry");
    event[1].clone()
}

fn number(fields: &Value, name: &str) -> f64 {
    fields[name].as_str().unwrap_or_else(|| panic!("{name} in {fields}")).parse().unwrap()
}

const STRAIGHT: &str = r#"42["steer",{"steering_angle":"0","throttle":"0.1"}]"#;

/// Steers away from the brighter half of the picture: the wrong way often enough, but by every pixel.
fn away_from_light(pixels: &[u8]) -> f32 {
    let balance: i64 = pixels
        .chunks_exact(3)
        .enumerate()
        .map(|(at, rgb)| rgb.iter().map(|byte| i64::from(*byte)).sum::<i64>() * if at % 320 < 160 { 1 } else { -1 })
        .sum();
    balance as f32 / 4e7
}

struct AwayFromLight;

impl Driver for AwayFromLight {
    fn steer(&mut self, frame: &RgbFrame, _: &DriveState) -> f32 {
        away_from_light(&frame.pixels)
    }
}

#[test]
fn in_lockstep_a_drive_over_the_wire_is_the_drive_in_this_process_bit_for_bit() {
    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        let (mut controller, mut image, mut telemetries) = (SpeedController::default(), RgbImage::default(), 0);
        while let Some(text) = peer.next() {
            if text == "41" {
                break;
            }
            let fields = fields(&text);
            decode_rgb(&BASE64.decode(fields["image"].as_str().unwrap().as_bytes()).unwrap(), &mut image).unwrap();
            let throttle =
                controller.throttle_at(number(&fields, "steersman_lockstep_s"), 20.0, number(&fields, "speed"));
            let steering = away_from_light(&image.pixels);
            peer.send(&format!(r#"42["steer",{{"steering_angle":"{steering}","throttle":"{throttle}"}}]"#));
            telemetries += 1;
        }
        telemetries
    });
    let options = ClientOptions { frames: None, ..lockstep(port, 0) };
    let report = drive_lake(&options);
    let here = TrialOptions { laps: 1, speed: Speed::Fixed(20.0), latency_ms: 0.0, noise: 0.0, assisted: false };
    let expected = run_trial(&Track::load("lake").unwrap(), &mut AwayFromLight, &here, 3).unwrap();
    assert!(expected.moments.len() > 40, "{} frames are too few to prove something", expected.moments.len());
    assert_eq!(report.run, expected);
    assert_eq!(report.telemetries as usize, expected.moments.len());
    assert_eq!(server.join().unwrap(), expected.moments.len());
}

/// Reads the header of a request.
fn read_request(stream: &mut TcpStream) -> String {
    let mut request = Vec::new();
    while !request.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        stream.read_exact(&mut byte).unwrap();
        request.push(byte[0]);
    }
    String::from_utf8(request).unwrap()
}

/// Answers a request with 101 and `more` headers.
fn upgrade(stream: &mut TcpStream, more: &str) {
    let request = read_request(stream);
    let key = request.split("Sec-WebSocket-Key: ").nth(1).unwrap().split("\r\n").next().unwrap();
    let accept = tungstenite::handshake::derive_accept_key(key.as_bytes());
    let response = format!(
        "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept}\r\n{more}\r\n"
    );
    stream.write_all(response.as_bytes()).unwrap();
}

/// The next frame: first byte and unmasked payload; the end of the stream is `None`.
fn read_frame(stream: &mut TcpStream) -> Option<(u8, Vec<u8>)> {
    let mut head = [0; 2];
    stream.read_exact(&mut head).ok()?;
    assert!(head[1] & 0x80 != 0, "a client masks every frame");
    let mut len = usize::from(head[1] & 0x7f);
    if len == 126 {
        let mut long = [0; 2];
        stream.read_exact(&mut long).unwrap();
        len = usize::from(u16::from_be_bytes(long));
    }
    let (mut mask, mut payload) = ([0; 4], vec![0; len]);
    stream.read_exact(&mut mask).unwrap();
    stream.read_exact(&mut payload).unwrap();
    payload.iter_mut().zip(mask.iter().cycle()).for_each(|(byte, mask)| *byte ^= mask);
    Some((head[0], payload))
}

#[test]
fn on_the_wire_it_is_websocket_sharp_to_the_byte() {
    let (port, server) = start(|listener| {
        let mut stream = listener.accept().unwrap().0;
        let mut peeked = [0; 4096];
        let read = stream.peek(&mut peeked).unwrap();
        let request = String::from_utf8_lossy(&peeked[..read]).into_owned();
        upgrade(&mut stream, "");
        let mut frames = Vec::new();
        while let Some((first, payload)) = read_frame(&mut stream) {
            // A server's frame: a text of less than 126 bytes.
            if first & 0x80 != 0 && (payload.len() > 10 || first & 0xf == 0) {
                stream.write_all(&[0x81, STRAIGHT.len() as u8]).unwrap();
                stream.write_all(STRAIGHT.as_bytes()).unwrap();
            }
            frames.push((first, payload));
            if first == 0x88 {
                break;
            }
        }
        (request, frames)
    });
    drive_lake(&lockstep(port, 2));
    let (request, frames) = server.join().unwrap();
    let key = request.split("Sec-WebSocket-Key: ").nth(1).unwrap().split("\r\n").next().unwrap();
    assert_eq!(BASE64.decode(key.as_bytes()).unwrap().len(), 16);
    assert_eq!(
        request,
        format!(
            "GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\nUpgrade: websocket\r\n\
             Connection: Upgrade\r\nHost: 127.0.0.1:{port}\r\nSec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n"
        )
    );
    let (mut texts, mut text) = (Vec::new(), Vec::new());
    for (first, payload) in &frames {
        let begins = text.is_empty();
        match first {
            0x01 | 0x00 => assert!(payload.len() == 1016 && begins == (*first == 1), "pieces are 1016 bytes long"),
            0x81 => assert!(begins && payload.len() <= 1016),
            0x80 => assert!(!begins && payload.len() <= 1016),
            0x88 => assert!(payload.is_empty(), "the application closes without a code"),
            other => panic!("{other:x}"),
        }
        text.extend_from_slice(payload);
        if first & 0x80 != 0 {
            texts.push(String::from_utf8(std::mem::take(&mut text)).unwrap());
        }
    }
    texts.retain(|text| text != "2");
    let [first, second, disconnect, close, close_frame] = &texts[..] else { panic!("{} texts", texts.len()) };
    assert!(
        first.starts_with(
            r#"42["telemetry",{"steering_angle":"0.0000","throttle":"0.0000","speed":"20.0000","image":"/9j/"#
        ),
        "{first:.120}"
    );
    assert!(
        first.ends_with(r#"","steersman_lockstep_s":"0"}]"#)
            && second.ends_with(r#"","steersman_lockstep_s":"0.06"}]"#)
    );
    assert!(second.contains(r#""throttle":"0.1000""#), "{second:.120}");
    assert!(first.len() > 10_000 && frames.iter().any(|f| f.0 == 0), "a telemetry goes out in many pieces");
    assert_eq!((disconnect.as_str(), close.as_str(), close_frame.as_str()), ("41", "1", ""));
}

#[test]
fn each_event_brings_one_telemetry_and_whatever_cannot_be_read_none() {
    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        let is_telemetry = |text: Option<String>| text.unwrap().starts_with(r#"42["telemetry""#);
        assert!(is_telemetry(peer.next()), "on opening");
        peer.send(r#"0{"sid":"a1","upgrades":[],"pingTimeout":60000,"pingInterval":25000}"#);
        assert!(is_telemetry(peer.next()), "on an open packet");
        peer.send(r#"42["manual",{}]"#);
        assert!(is_telemetry(peer.next()), "on manual");
        for lost in [
            r#"42["steer",{"steering_angle":0.5,"throttle":0.5}]"#,
            r#"42["steer",{"steering_angle":"nan","throttle":"0"}]"#,
            r#"42["steer",{"throttle":"0"}]"#,
            r#"42["steer"]"#,
        ] {
            peer.send(lost);
        }
        for nothing in ["1", "3", "40", "41", "43[]", "44", "5", "6", r#"42["reset",{}]"#] {
            peer.send(nothing);
        }
        peer.send("2");
        assert_eq!(peer.next(), Some("3".into()), "no telemetry for what cannot be read, and a pong for a ping");
        peer.send(STRAIGHT);
        assert!(is_telemetry(peer.next()), "on a command");
        peer.send(STRAIGHT);
        while peer.next().is_some_and(|text| text != "41") {}
    });
    let report = drive_lake(&lockstep(port, 2));
    server.join().unwrap();
    assert_eq!((report.tokens_lost, report.commands, report.manuals, report.questions), (4, 2, 0, 1));
    assert_eq!((report.telemetries, report.connections), (4, 1));
}

#[test]
fn a_message_that_throws_closes_the_socket_without_a_close_frame_and_it_comes_back_at_once() {
    let (port, server) = start(|listener| {
        for bad in [r#"42["steer",null]"#, "", "hello", r#"0{"upgrades":[]}"#] {
            let mut stream = listener.accept().unwrap().0;
            upgrade(&mut stream, "");
            stream.write_all(&[0x81, bad.len() as u8]).unwrap();
            stream.write_all(bad.as_bytes()).unwrap();
            let mut last = 0;
            while let Some((first, _)) = read_frame(&mut stream) {
                last = first;
            }
            assert_ne!(last, 0x88, "no close frame after {bad:?}");
        }
        let mut peer = Peer::accept(&listener);
        assert!(peer.next().unwrap().starts_with(r#"42["telemetry""#));
        peer.send(STRAIGHT);
        while peer.next().is_some_and(|text| text != "41") {}
    });
    let report = drive_lake(&lockstep(port, 1));
    server.join().unwrap();
    assert_eq!((report.connections, report.commands), (5, 1));
}

#[test]
fn responses_with_something_that_was_not_offered_are_refused() {
    let (port, server) = start(|listener| {
        for more in ["Sec-WebSocket-Extensions: permessage-deflate\r\n", "Sec-WebSocket-Protocol: chat\r\n"] {
            let mut stream = listener.accept().unwrap().0;
            upgrade(&mut stream, more);
            assert_eq!(read_frame(&mut stream), None, "{more}");
        }
        let mut peer = Peer::accept(&listener);
        peer.next().unwrap();
        peer.send(STRAIGHT);
        while peer.next().is_some_and(|text| text != "41") {}
    });
    assert_eq!(drive_lake(&lockstep(port, 1)).connections, 1);
    server.join().unwrap();
}

#[test]
fn a_hand_on_the_wheel_sends_null_and_wants_manual() {
    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        let mut kinds = String::new();
        while let Some(text) = peer.next().filter(|text| text != "41") {
            let manual = text == r#"42["telemetry",null]"#;
            kinds.push(if manual { 'm' } else { 't' });
            peer.send(if manual { r#"42["manual",{}]"# } else { STRAIGHT });
        }
        kinds
    });
    let report = drive_lake(&ClientOptions { manual_s: Some((0.2, 0.5)), ..lockstep(port, 15) });
    assert_eq!(server.join().unwrap(), "ttttmmmmmmttttt");
    assert_eq!((report.manual_telemetries, report.manuals, report.commands), (6, 6, 9));
    assert_eq!(report.run.moments[5].throttle, 1.0, "W is the accelerator");
    assert_ne!(report.run.moments[5].steering, 0.0, "the hand steers");
}

#[test]
fn a_machine_with_decimal_comma_writes_commas_and_misreads_dots() {
    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        let first = peer.next().unwrap();
        peer.send(r#"42["steer",{"steering_angle":"0,125","throttle":"-0,5"}]"#);
        let second = peer.next().unwrap();
        peer.send(r#"42["steer",{"steering_angle":"0.125","throttle":"0"}]"#);
        while peer.next().is_some_and(|text| text != "41") {}
        (first, second)
    });
    let comma = NumberStyle::Strings(DecimalMark::COMMA);
    let report = drive_lake(&ClientOptions { numbers: comma, ..lockstep(port, 2) });
    let (first, second) = server.join().unwrap();
    assert!(first.contains(r#""speed":"20,0000""#) && second.contains(r#""steering_angle":"3,1250""#), "{second:.120}");
    let steering: Vec<f64> = report.run.moments.iter().map(|m| m.steering).collect();
    assert_eq!(steering, [0.125, 1.0], "0.125 is 125 there, and full lock");
    assert_eq!(report.run.moments[0].throttle, -0.5);
}

#[test]
fn a_change_of_scene_ends_the_connection_without_a_word_and_starts_anew() {
    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        let mut before = 0;
        while let Some(text) = peer.next() {
            assert!(text.starts_with(r#"42["telemetry""#), "{text:.40}");
            before += 1;
            peer.send(STRAIGHT);
        }
        let mut peer = Peer::accept(&listener);
        let first = peer.next().unwrap();
        peer.send(STRAIGHT);
        while peer.next().is_some_and(|text| text != "41") {}
        (before, first)
    });
    let report = drive_lake(&ClientOptions { scene_change_s: Some(0.5), ..lockstep(port, 11) });
    let (before, first) = server.join().unwrap();
    assert_eq!((before, report.connections, report.run.moments.len()), (10, 2, 1));
    assert!(first.ends_with(r#""steersman_lockstep_s":"0"}]"#));
}

#[test]
fn in_real_time_the_clock_goes_on_without_replies_and_the_car_keeps_its_last_command() {
    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        peer.next().unwrap();
        peer.send(r#"42["steer",{"steering_angle":"1","throttle":"0.2"}]"#);
        let mut telemetries = 0;
        while peer.next().is_some_and(|text| text != "41") {
            telemetries += 1;
        }
        telemetries
    });
    let options = ClientOptions { time_mode: TimeMode::RealTime { fps: 50.0 }, frames: None, ..lockstep(port, 0) };
    let report = drive_lake(&options);
    assert_eq!(server.join().unwrap(), 1, "one for the command, then the token is gone");
    assert!(report.run.failure.is_some(), "{:?}", report.run.failure);
    let last = report.run.moments.last().unwrap();
    assert_eq!((last.steering, report.commands), (1.0, 1));
    assert!(report.frames > 10 && report.wall_s >= 0.9 * report.run.time_s);
}

#[test]
fn no_server_and_a_server_without_a_word_are_errors_with_a_remedy() {
    let track = Track::load("lake").unwrap();
    // The port was free a moment ago.
    let (port, server) = start(drop);
    server.join().unwrap();
    let impatient = |port| ClientOptions { patience_s: 0.3, ..lockstep(port, 1) };
    let message = |result: steersman::Result<ClientReport>| match result {
        Err(Error::Connection(message)) => message,
        other => panic!("{other:?}"),
    };
    let nobody = message(drive(&track, &impatient(port), &mut Unobserved));
    assert!(nobody.contains(&format!("127.0.0.1:{port}")) && nobody.contains("steersman serve"), "{nobody}");

    let (port, server) = start(|listener| {
        let mut peer = Peer::accept(&listener);
        while peer.next().is_some_and(|text| text != "41") {}
        peer.stream().shutdown(Shutdown::Both)
    });
    let silent = message(drive(&track, &impatient(port), &mut Unobserved));
    assert!(silent.contains("no reply to telemetry"), "{silent}");
    let _ = server.join().unwrap();

    // Closes every connection at once; its thread ends with the test.
    let (port, _) = start(|listener| listener.incoming().for_each(drop));
    let closing = message(drive(&track, &impatient(port), &mut Unobserved));
    assert!(closing.contains("steersman serve"), "{closing}");
}

#[test]
fn impossible_options_are_refused_before_anything_is_connected() {
    let track = Track::load("lake").unwrap();
    for options in [
        ClientOptions { laps: 0, ..ClientOptions::default() },
        ClientOptions { start_mph: 99.0, ..ClientOptions::default() },
        ClientOptions { time_mode: TimeMode::RealTime { fps: 0.0 }, ..ClientOptions::default() },
        ClientOptions { manual_s: Some((5.0, 2.0)), ..ClientOptions::default() },
        ClientOptions { scene_change_s: Some(f64::NAN), ..ClientOptions::default() },
        ClientOptions { patience_s: 0.0, ..ClientOptions::default() },
    ] {
        assert!(matches!(drive(&track, &options, &mut Unobserved), Err(Error::Usage(_))), "{options:?}");
    }
}
