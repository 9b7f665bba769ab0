//! What `steersman serve` understands and says: handshakes, pings, and telemetry in other spellings than the simulator's.
#![cfg(unix)]

mod common;

use std::io::Write;
use std::time::Duration;

use common::served::{Client, command, folder_with_model, sample_jpeg, serve, telemetry, turn};
use serde_json::Value;

/// Long enough for an answer that must not come. (Where the machine stands still, a wrong answer could be missed, not invented.)
const QUIET: Duration = Duration::from_millis(400);

#[test]
fn fields_in_any_order_and_numbers_instead_of_strings_are_understood() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let image = data_encoding::BASE64.encode(&sample_jpeg());
    let mut client = served.connect_simulator();
    let (steering, _) = turn(&mut client, 10.0, &sample_jpeg());
    client.send(&format!(
        r#"42["telemetry", {{"fps": [1, {{}}], "image":"{image}", "speed":10, "throttle":0.1, "steering_angle":-3.5}}]"#
    ));
    assert_eq!(command(&client.next()).0, steering);
    served.stop();
}

#[test]
fn pings_are_answered_in_whatever_order() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let mut client = served.connect_simulator();
    client.send("2");
    assert_eq!(client.next(), "3");
    client.send(&telemetry(10.0, &sample_jpeg()));
    client.send("2");
    let mut answers = [client.next(), client.next()];
    answers.sort();
    assert!(answers[0] == "3" && answers[1].starts_with(r#"42["steer""#), "{answers:?}");
    served.stop();
}

#[test]
fn ordinary_clients_of_socket_io_are_greeted_as_they_expect() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let jpeg = sample_jpeg();
    let open = |client: &mut Client| -> Value {
        let open = client.next();
        serde_json::from_str(open.strip_prefix('0').unwrap_or_else(|| panic!("{open}"))).unwrap()
    };

    let mut old = served.connect("node-XMLHttpRequest", 3);
    let opened = open(&mut old);
    assert!(opened["sid"].as_str().is_some_and(|sid| sid.len() >= 16) && opened["pingInterval"].is_u64(), "{opened}");
    assert_eq!(old.next(), "40");
    turn(&mut old, 10.0, &jpeg);
    old.send("2");
    assert_eq!(old.next_within(Duration::from_secs(60)).unwrap(), "3");
    drop(old);

    let mut new = served.connect("", 4);
    let opened = open(&mut new);
    assert!(opened["maxPayload"].is_u64(), "{opened}");
    assert_eq!(new.next_within(QUIET), None, "it has to ask for the namespace");
    new.send("40");
    let connected = new.next();
    assert!(connected.starts_with(r#"40{"sid":"#), "{connected}");
    turn(&mut new, 10.0, &jpeg);
    served.stop();
}

/// The headers of a handshake, without the empty line.
const HANDSHAKE: &str = "GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\n\
     Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n";

#[test]
fn requests_that_are_refused_get_a_sentence_with_the_remedy() {
    let folder = folder_with_model();
    let served = serve(&folder, &["--allow-origin", "http://localhost:8000"]);
    let polling = served.ask("GET /socket.io/?EIO=4&transport=polling HTTP/1.1\r\nHost: x\r\n\r\n");
    assert!(polling.starts_with("HTTP/1.1 400") && polling.contains("transports=['websocket']"), "{polling}");
    let page = served.ask(&format!("{HANDSHAKE}Origin: http://evil.example\r\n\r\n"));
    assert!(page.starts_with("HTTP/1.1 403") && page.contains("--allow-origin"), "{page}");
    let nonsense = served.ask("HELO there\r\n\r\n");
    assert!(nonsense.starts_with("HTTP/1.1 400"), "{nonsense}");

    let mut allowed = served.connect_tcp();
    allowed.write_all(format!("{HANDSHAKE}Origin: http://localhost:8000\r\n\r\n").as_bytes()).unwrap();
    let mut answer = [0; 12];
    std::io::Read::read_exact(&mut allowed, &mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 101");
    served.stop();
}

#[test]
fn nothing_is_negotiated_that_the_simulator_would_refuse() {
    let folder = folder_with_model();
    let served = serve(&folder, &[]);
    let offer = "Sec-WebSocket-Extensions: permessage-deflate\r\nSec-WebSocket-Protocol: chat\r\n";
    let mut client = served.connect_tcp();
    client.write_all(format!("{HANDSHAKE}{offer}\r\n").as_bytes()).unwrap();
    let mut answer = Vec::new();
    while !answer.ends_with(b"\r\n\r\n") {
        let mut byte = [0];
        std::io::Read::read_exact(&mut client, &mut byte).unwrap();
        answer.push(byte[0]);
    }
    let answer = String::from_utf8(answer).unwrap();
    assert!(answer.contains("Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo="), "{answer}");
    assert!(!answer.contains("Extensions") && !answer.contains("WebSocket-Protocol"), "{answer}");
    served.stop();
}
