//! Our simulator in the place of DonkeySim, with the messages that the client of `gym_donkeycar` sends: bare JSON, all values strings.

#[path = "common/stand_in.rs"]
mod stand_in;

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

use serde_json::Value;
use steersman::donkeysim::{Reading, Scene};

use stand_in::with_stand_in;

struct Client {
    stream: TcpStream,
    lines: BufReader<TcpStream>,
}

impl Client {
    fn connect(address: SocketAddr) -> Client {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        stream.set_nodelay(true).unwrap();
        Client { lines: BufReader::new(stream.try_clone().unwrap()), stream }
    }

    fn send(&mut self, text: &str) {
        self.stream.write_all(text.as_bytes()).unwrap();
    }

    fn receive(&mut self) -> Value {
        let mut line = String::new();
        self.lines.read_line(&mut line).unwrap();
        assert!(line.ends_with("}\n"), "the client looks for a brace and a line end: {line}");
        serde_json::from_str(&line).unwrap()
    }

    /// The next message of this kind; others are passed over.
    fn wait_for(&mut self, kind: &str) -> Value {
        for _ in 0..200 {
            let message = self.receive();
            if message["msg_type"] == kind {
                return message;
            }
        }
        panic!("no `{kind}` comes");
    }

    fn control(&mut self, steering: f64, throttle: f64) {
        let text = format!(
            "{{\"msg_type\": \"control\", \"steering\": \"{steering}\", \"throttle\": \"{throttle}\", \"brake\": \"0.0\"}}"
        );
        self.send(&text);
    }
}

const RESET: &str = r#"{"msg_type": "reset_car"}"#;
const CAR: &str = r#"{"msg_type": "car_config", "body_style": "donkey", "body_r": "128", "body_g": "128", "body_b": "128", "car_name": "me", "font_size": "100"}"#;

fn number(message: &Value, name: &str) -> f64 {
    message[name].as_f64().unwrap_or_else(|| panic!("{name} must be a number in {message}"))
}

#[test]
fn a_client_goes_from_the_menu_onto_the_track_and_drives() {
    with_stand_in(Scene::Menu, Reading::Lenient, |address| {
        let mut client = Client::connect(address);
        assert_eq!(client.receive()["msg_type"], "scene_selection_ready");
        client.send(r#"{"msg_type": "get_scene_names"}"#);
        let names = client.receive();
        assert!(names["scene_names"].as_array().unwrap().iter().any(|name| name == "generated_track"), "{names}");
        client.send(r#"{"msg_type": "load_scene", "scene_name": "generated_track"}"#);
        assert_eq!(client.receive()["msg_type"], "car_loaded");
        // Two messages in one write, and one in two.
        client.send(&format!("{CAR}{RESET}"));
        client.send("{\"msg_type\": \"cam_config\", \"img_w\": \"64\", ");
        client.send("\"img_h\": \"48\", \"img_enc\": \"JPG\"}");
        let standing = client.wait_for("telemetry");
        assert_eq!(number(&standing, "speed"), 0.0);
        // A picture comes whether something is sent or not, and the last control holds.
        client.control(0.0, 1.0);
        let mut last = standing;
        for _ in 0..40 {
            last = client.wait_for("telemetry");
        }
        assert!(number(&last, "speed") > 0.2 && number(&last, "throttle") == 1.0, "{last}");
        assert!(number(&last, "cte").abs() < 8.0 && last["hit"] == "none");
        let image = data_encoding::BASE64.decode(last["image"].as_str().unwrap().as_bytes()).unwrap();
        let picture = image::load_from_memory_with_format(&image, image::ImageFormat::Jpeg).unwrap();
        assert_eq!((picture.width(), picture.height()), (64, 48));
        // + steers to the right, which is clockwise seen from above.
        let yaw = number(&last, "yaw");
        client.control(1.0, 0.2);
        (0..10).for_each(|_| last = client.wait_for("telemetry"));
        let turned = (number(&last, "yaw") - yaw).rem_euclid(360.0);
        assert!((1.0..180.0).contains(&turned), "{turned}");
        assert!(number(&last, "gyro_y") > 0.0);
        client.send(RESET);
        (0..4).for_each(|_| last = client.wait_for("telemetry"));
        assert!(number(&last, "speed") < 0.01 && number(&last, "cte").abs() < 0.01, "{last}");
        client.send(r#"{"msg_type": "node_position", "index": "3"}"#);
        assert_eq!(client.wait_for("node_position")["index"], 3);
        client.send(r#"{"msg_type": "exit_scene"}"#);
        client.wait_for("scene_selection_ready");
    });
}

#[test]
fn a_race_scene_sends_pictures_to_whoever_connects() {
    with_stand_in(Scene::Race, Reading::Lenient, |address| {
        let mut clients = [Client::connect(address), Client::connect(address)];
        for client in &mut clients {
            assert_eq!(client.receive()["msg_type"], "car_loaded");
        }
        clients[0].control(0.0, 1.0);
        (0..20).for_each(|_| drop(clients[0].wait_for("telemetry")));
        let [first, second] = clients.each_mut().map(|client| client.wait_for("telemetry"));
        assert!(number(&first, "speed") > 0.0 && number(&second, "speed") == 0.0, "each has its own car");
        clients[0].send(r#"{"msg_type": "get_protocol_version"}"#);
        assert_eq!(clients[0].wait_for("protocol_version")["version"], "2");
    });
}

#[test]
fn the_strict_mode_wants_strings_and_one_message_a_write() {
    let said = with_stand_in(Scene::Race, Reading::Strict, |address| {
        let mut client = Client::connect(address);
        client.wait_for("telemetry");
        client.send(r#"{"msg_type": "control", "steering": 0.5, "throttle": 1.0}"#);
        (0..3).for_each(|_| drop(client.wait_for("telemetry")));
        client.send(&RESET.repeat(2));
        (0..3).for_each(|_| drop(client.wait_for("telemetry")));
        client.control(0.5, 1.0);
        let mut last = Value::Null;
        (0..5).for_each(|_| last = client.wait_for("telemetry"));
        assert_eq!(number(&last, "steering_angle"), 0.5);
    });
    assert!(said.iter().any(|text| text.contains("`steering` must be a number in a string")), "{said:?}");
    assert!(said.iter().any(|text| text.contains("no message")), "{said:?}");
}

#[test]
fn hostile_clients_harm_neither_the_server_nor_others() {
    let said = with_stand_in(Scene::Race, Reading::Lenient, |address| {
        let mut honest = Client::connect(address);
        honest.wait_for("telemetry");
        let attacks: [Vec<u8>; 7] = [
            b"GET / HTTP/1.1\r\nHost: a\r\n\r\n".to_vec(),
            vec![b'{'; 1 << 20],
            [b"{\"a\":".repeat(20_000), b"1".to_vec(), b"}".repeat(20_000)].concat(),
            b"\x1b[2J\x1b]0;owned\x07".to_vec(),
            b"{\"msg_type\":\"load_scene\",\"scene_name\":\"\\u001b[31mred\"}".to_vec(),
            b"{\"msg_type\":\"control\",\"steering\":\"1e400\",\"throttle\":\"nan\"}".repeat(1000),
            b"{\"msg_type\":\"cam_config\",\"img_w\":\"1e9\",\"img_h\":\"-1\"}".to_vec(),
        ];
        for attack in attacks {
            let mut stream = TcpStream::connect(address).unwrap();
            // It may be cut off while it still sends.
            let _ = stream.write_all(&attack);
            std::thread::sleep(Duration::from_millis(60));
            let _ = stream.set_read_timeout(Some(Duration::from_millis(50)));
            let _ = stream.read(&mut [0; 1000]);
        }
        honest.control(0.0, 1.0);
        let mut last = Value::Null;
        (0..20).for_each(|_| last = honest.wait_for("telemetry"));
        assert!(number(&last, "speed") > 0.0, "{last}");
    });
    assert!(said.iter().all(|text| text.chars().all(|c| !c.is_control())), "{said:?}");
    assert!(said.len() < 100, "{} notices", said.len());
}
