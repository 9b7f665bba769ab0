use std::borrow::Cow;

use super::number::Number;
use super::*;

/// The simulator's own telemetry, the image cut short.
const TELEMETRY: &str =
    r#"42["telemetry",{"steering_angle":"0.0000","throttle":"0.0000","speed":"0.4380","image":"/9j/4AAQSkZJRg=="}]"#;

fn telemetry(text: &str) -> Telemetry<'_> {
    match parse(text) {
        Ok(ClientPacket::Telemetry(telemetry, _)) => telemetry,
        other => panic!("{text} is read as {other:?}"),
    }
}

fn steer(steering: f32, throttle: f32, style: NumberStyle) -> String {
    let mut out = String::new();
    print_steer(&mut out, Command { steering, throttle }, style);
    out
}

#[test]
fn telemetry_of_the_simulator_is_read_without_copying_the_image() {
    let read = telemetry(TELEMETRY);
    assert_eq!((read.steering_deg, read.throttle, read.speed_mph), (Some(0.0), Some(0.0), Some(0.438)));
    assert!(matches!(read.image, Some(Cow::Borrowed("/9j/4AAQSkZJRg=="))));
    assert_eq!(read.number_style(), NumberStyle::Strings(DecimalMark::DOT));
    assert_eq!((read.cte_m, read.time_s), (None, None));
}

#[test]
fn any_order_unknown_fields_spaces_and_numbers_for_strings_are_read() {
    let read = telemetry(
        r#"42[ "telemetry" , {"gyro":[1,{"x":null}],"image":"AA==","speed":12.5,"lap":"3","throttle":1,"steering_angle":-25} , 7]"#,
    );
    assert_eq!((read.steering_deg, read.throttle, read.speed_mph), (Some(-25.0), Some(1.0), Some(12.5)));
    assert_eq!(read.image.as_deref(), Some("AA=="));
    assert_eq!(telemetry(r#"42["telemetry",{"image":"\/9j\/"}]"#).image.as_deref(), Some("/9j/"));
}

#[test]
fn the_decimal_mark_of_the_client_is_recognised_and_used() {
    for (mark, speed) in [('.', "12.3456"), (',', "12,3456"), ('٫', "12٫3456"), ('/', "12/3456")] {
        let text = format!(r#"42["telemetry",{{"steering_angle":"-1{mark}5000","speed":"{speed}","image":"AA=="}}]"#);
        let read = telemetry(&text);
        assert_eq!((read.steering_deg, read.speed_mph), (Some(-1.5), Some(12.3456)), "{text}");
        let reply = steer(-0.03125, 0.25, read.number_style());
        assert_eq!(reply, format!(r#"42["steer",{{"steering_angle":"-0{mark}03125","throttle":"0{mark}25"}}]"#));
    }
}

#[test]
fn a_client_of_the_second_term_gets_numbers() {
    let read = telemetry(
        r#"42["telemetry",{"cte":"0.7598","speed":"0.4380","steering_angle":"0.0000","throttle":"0.0000","image":"AA=="}]"#,
    );
    assert_eq!(read.number_style(), NumberStyle::Json);
    assert_eq!(steer(-0.5, 1.0, read.number_style()), r#"42["steer",{"steering_angle":-0.5,"throttle":1}]"#);
}

#[test]
fn numbers_in_replies_have_no_exponent_and_read_back_as_the_same() {
    for value in [1e-30, -1e-7, 0.1 + 0.2, 0.1, 1.0, -0.0, f32::MIN_POSITIVE / 4.0] {
        let text = steer(value, 0.0, NumberStyle::default());
        let number = text.split('"').nth(5).unwrap();
        assert!(number.bytes().all(|b| b.is_ascii_digit() || b == b'.' || b == b'-'), "{number}");
        assert_eq!(number.parse::<f32>().unwrap().to_bits(), value.to_bits(), "{number}");
    }
    for value in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        assert_eq!(steer(value, value, NumberStyle::default()), r#"42["steer",{"steering_angle":"0","throttle":"0"}]"#);
    }
}

#[test]
fn what_is_no_number_is_none() {
    for text in ["", "-", "NaN", "Infinity", "-1.#IND", "1.2.3", "1 2", "0x10", "1e999", "٣", "-٫"] {
        assert_eq!(Number::read(text), Number::default(), "{text}");
    }
    assert_eq!(Number::read(&"1".repeat(1000)), Number::default());
    assert_eq!(Number::read(" 7.43E-06 ").value, Some(7.43e-6));
    assert_eq!(Number::read("−2,5").value, Some(-2.5));
    let read = telemetry(r#"42["telemetry",{"speed":"NaN","throttle":null,"image":null}]"#);
    assert_eq!((read.speed_mph, read.throttle, read.image), (None, None, None));
}

#[test]
fn the_other_packets() {
    assert_eq!(parse("1"), Ok(ClientPacket::Close));
    assert_eq!(parse("2"), Ok(ClientPacket::Ping("")));
    assert_eq!(parse("2probe"), Ok(ClientPacket::Ping("probe")));
    assert_eq!(parse("3"), Ok(ClientPacket::Pong));
    assert_eq!(parse("40"), Ok(ClientPacket::Connect { namespace: "/" }));
    assert_eq!(parse(r#"40{"token":"a,b"}"#), Ok(ClientPacket::Connect { namespace: "/" }));
    assert_eq!(parse("40/admin?a=1,"), Ok(ClientPacket::Connect { namespace: "/admin" }));
    assert_eq!(parse("40/admin"), Ok(ClientPacket::Connect { namespace: "/admin" }));
    assert_eq!(parse("41"), Ok(ClientPacket::Disconnect));
    assert_eq!(parse(r#"42["telemetry",null]"#), Ok(ClientPacket::Manual(None)));
    assert_eq!(parse(r#"42["telemetry"]"#), Ok(ClientPacket::Manual(None)));
    assert_eq!(parse(r#"4217["telemetry",null]"#), Ok(ClientPacket::Manual(Some(17))));
    assert_eq!(parse(r#"42/,3["hello","world"]"#), Ok(ClientPacket::OtherEvent { name: "hello".into(), ack: Some(3) }));
    for text in ["430[]", "44{}", "4", "5", "6", "0{}", r#"451-["x",{"_placeholder":true,"num":0}]"#] {
        assert_eq!(parse(text), Ok(ClientPacket::Ignored), "{text}");
    }
}

#[test]
fn only_the_own_name_of_simulated_time_counts_and_nothing_in_it_breaks_telemetry() {
    assert_eq!(telemetry(r#"42["telemetry",{"speed":"1","time":"12.5","image":"AA=="}]"#).time_s, None);
    assert_eq!(telemetry(r#"42["telemetry",{"steersman_lockstep_s":12.5}]"#).time_s, Some(12.5));
    for value in ["null", "true", "[1,[2]]", r#"{"s":{"x":1}}"#, r#""soon""#, r#""\u0041""#, "\"NaN\""] {
        let text = format!(r#"42["telemetry",{{"steersman_lockstep_s":{value},"speed":"1","image":"AA=="}}]"#);
        let read = telemetry(&text);
        assert_eq!((read.time_s, read.speed_mph, read.image.as_deref()), (None, Some(1.0), Some("AA==")), "{text}");
    }
}

#[test]
fn what_is_broken_is_an_error_and_no_panic() {
    assert!(matches!(parse(""), Err(ProtocolError::NotEngineIo(_))));
    assert!(matches!(parse("hello"), Err(ProtocolError::NotEngineIo(_))));
    assert!(matches!(parse("é"), Err(ProtocolError::NotEngineIo(_))));
    assert!(matches!(parse(r#"{"telemetry":{}}"#), Err(ProtocolError::PlainJson(_))));
    let broken = [
        "42",
        "42[",
        "42[]",
        "42{}",
        "42null",
        "42[1]",
        r#"42["telemetry",7]"#,
        r#"42["telemetry",{"speed":[]}]"#,
        r#"42["telemetry",{"image":5}]"#,
        r#"42["telemetry",{"speed":"1"}"#,
        r#"42["telemetry",{}]x"#,
        "4é",
        "49",
        "42/telemetry",
        "4299999999999999999999999",
    ];
    for text in broken {
        assert!(matches!(parse(text), Err(ProtocolError::Event(_))), "{text}");
    }
    let deep = format!("42[\"telemetry\",{}", "[".repeat(100_000));
    assert!(parse(&deep).is_err());
    // Cut off anywhere, telemetry is an error, never half a state.
    for (end, _) in TELEMETRY.char_indices() {
        if let Ok(packet) = parse(&TELEMETRY[..end]) {
            assert!(matches!(packet, ClientPacket::Ignored), "{end}: {packet:?}");
        }
    }
}

#[test]
fn errors_show_only_the_start_of_what_was_sent() {
    let error = parse(&"x".repeat(5000)).unwrap_err().to_string();
    assert!(error.len() < 120 && error.contains('…'), "{error}");
    // The error about an object that is a string quotes the string.
    let error = parse(&format!(r#"42["telemetry","{}"]"#, "x".repeat(500_000))).unwrap_err().to_string();
    assert!(error.len() < 240 && error.contains("xxx") && error.ends_with('…'), "{:.300}", error);
}

#[test]
fn the_handshake_of_ordinary_clients() {
    let mut out = String::new();
    print_open(&mut out, EngineVersion::V3, "0123456789abcdef");
    assert_eq!(out, r#"0{"sid":"0123456789abcdef","upgrades":[],"pingInterval":25000,"pingTimeout":20000}"#);
    out.clear();
    print_open(&mut out, EngineVersion::V4, "ab");
    let open: serde_json::Value = serde_json::from_str(&out[1..]).unwrap();
    assert_eq!((&open["sid"], &open["maxPayload"]), (&"ab".into(), &1_000_000.into()));
    let printed = |print: &dyn Fn(&mut String)| {
        let mut out = String::new();
        print(&mut out);
        out
    };
    assert_eq!(printed(&|out| print_connected(out, EngineVersion::V3, "ab")), "40");
    assert_eq!(printed(&|out| print_connected(out, EngineVersion::V4, "ab")), r#"40{"sid":"ab"}"#);
    assert_eq!(
        printed(&|out| print_namespace_refused(out, EngineVersion::V4, "/admin")),
        r#"44/admin,{"message":"Invalid namespace"}"#
    );
    assert_eq!(printed(&|out| print_manual(out)), r#"42["manual",{}]"#);
    assert_eq!(printed(&|out| print_ack(out, 17)), "4317[]");
}

#[test]
fn telemetry_is_printed_as_the_simulator_does() {
    let mut out = String::new();
    let image = "/9j/4AAQSkZJRg==";
    let mut readings = Readings {
        steering_deg: -0.000_01,
        throttle: 0.0,
        speed_mph: 0.438,
        cte_m: None,
        time_s: None,
        by_user: false,
        image,
    };
    print_telemetry(&mut out, &readings, DecimalMark::DOT);
    assert_eq!(out, TELEMETRY);
    (readings.steering_deg, readings.time_s) = (-12.5, Some(0.1 + 0.2));
    out.clear();
    print_telemetry(&mut out, &readings, DecimalMark::COMMA);
    assert!(out.contains(r#""steering_angle":"-12,5000","throttle":"0,0000","speed":"0,4380""#), "{out}");
    assert!(out.ends_with(r#"","steersman_lockstep_s":"0.30000000000000004"}]"#), "{out}");
    let read = telemetry(&out);
    assert_eq!((read.time_s, read.mark), (Some(0.1 + 0.2), Some(DecimalMark::COMMA)));
}
