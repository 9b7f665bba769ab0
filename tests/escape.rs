//! Bytes of others never reach a terminal raw: every command is fed with hostile texts, and nothing that a terminal would obey
//! comes out of it.

mod common;

use std::fs;
use std::net::TcpListener;
use std::path::Path;
use std::process::Output;

use common::archive::{Tree, zip};
use common::command::steersman;
use common::painted_log;
use common::served::{SIMULATOR, Served, random_model};
use steersman::model_file::{Model, TrainingRecord};
use steersman::recipe::SHIPPED;

/// Clears the screen, rings, begins a C1 sequence, turns the direction around.
const HOSTILE: &str = "x\u{1b}[2J\u{7}\u{9b}31m\u{202e}\u{200b}\u{7f}y";

/// The first thing in `bytes` that a terminal would obey, with what stands around it.
fn obeyed(bytes: &[u8]) -> Option<String> {
    let Ok(text) = std::str::from_utf8(bytes) else { return Some("bytes that are no UTF-8".into()) };
    let bad = |c: char| {
        c.is_control() && c != '\n' && c != '\t'
            || matches!(c, '\u{200b}'..='\u{200f}' | '\u{202a}'..='\u{202e}' | '\u{feff}')
    };
    let at = text.find(bad)?;
    let begin = (at.saturating_sub(60)..=at).find(|&i| text.is_char_boundary(i)).unwrap_or(at);
    Some(format!("{:?}", text[begin..].chars().take(120).collect::<String>()))
}

fn checked(args: &[String], output: &Output, failures: &mut Vec<String>) {
    for (name, bytes) in [("standard output", &output.stdout), ("standard error", &output.stderr)] {
        failures.extend(obeyed(bytes).map(|found| format!("{args:?}: {name}: {found}")));
    }
    // The hostile text must have come as far as the output, or the case shows nothing. Of wrong
    // arguments ESC is taken away before.
    let said = [&output.stdout[..], &output.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    let shown = [r"\u{1b}[2J", r"\u001b[2J", r"\u{9b}31m"];
    if !shown.iter().any(|shown| said.contains(shown)) {
        failures.push(format!("{args:?}: the hostile text is not shown: {said}"));
    }
    assert!(!said.contains("panicked"), "{args:?}: {said}");
}

fn log(folder: &Path) -> String {
    painted_log::write(folder, 60, "");
    fs::read_to_string(folder.join("driving_log.csv")).unwrap()
}

/// Recordings, models and other files whose texts are hostile; names of recordings.
fn recordings(dir: &Path) -> Vec<&'static str> {
    let text = log(&dir.join("cells"));
    let cells = text.replace("0.8, 0, 20.5", "0.8, 0, fast");
    // A cell that is no number, a picture that is not there, a header that names a column twice.
    fs::write(dir.join("cells/driving_log.csv"), cells.replacen(", 0.8", &format!(", 0.8{HOSTILE}"), 3)).unwrap();
    let text = log(&dir.join("pictures"));
    let missing = format!("IMG/{HOSTILE}.jpg,,,0.1,0.8,0,20\n");
    fs::write(dir.join("pictures/driving_log.csv"), text + &missing).unwrap();
    let text = log(&dir.join("header"));
    let header = format!("center,left,right,{HOSTILE} angle,angle of y,throttle,brake,speed\n");
    let rest: String = text.lines().skip(1).map(|line| format!("{line},1\n")).collect();
    fs::write(dir.join("header/driving_log.csv"), header + &rest).unwrap();
    log(&dir.join("described"));
    fs::write(dir.join("described/steersman.toml"), format!("unit = 'lock'\n\"{}\" = 3", toml_escaped())).unwrap();
    log(&dir.join("described2"));
    fs::write(dir.join("described2/steersman.toml"), format!("unit = '{HOSTILE}'")).unwrap();
    let tub = dir.join("tub");
    fs::create_dir_all(tub.join("images")).unwrap();
    let json = serde_json::to_string(HOSTILE).unwrap();
    let records = format!(
        "{{\"_index\": 0, \"cam/image_array\": {json}, \"user/angle\": 0.1}}\n{{\"_index\": {json}\n{HOSTILE}\n"
    );
    fs::write(tub.join("catalog_0.catalog"), records).unwrap();
    fs::write(
        tub.join("manifest.json"),
        format!("[{json}]\n[]\n{{}}\n{{}}\n{{\"paths\": [{json}, \"catalog_0.catalog\"]}}\n"),
    )
    .unwrap();
    fs::create_dir_all(dir.join("lines")).unwrap();
    fs::write(dir.join("lines/data.txt"), format!("0.jpg 1.0\n{HOSTILE}.jpg 2.0\n").repeat(4)).unwrap();
    let tree: Tree = [
        (format!("{HOSTILE}.csv"), b"center,left\n".to_vec()),
        (format!("{HOSTILE}/driving_log.csv"), b"a,b\n".to_vec()),
    ]
    .into();
    fs::write(dir.join("names.zip"), zip(&tree, "")).unwrap();
    vec!["cells", "pictures", "header", "described", "described2", "tub", "lines", "names.zip"]
}

/// The hostile text as TOML writes it between quotes.
fn toml_escaped() -> String {
    HOSTILE.chars().map(|c| if c.is_ascii_graphic() { c.to_string() } else { format!("\\u{:04x}", c as u32) }).collect()
}

/// A model with hostile texts in its metadata.
fn hostile_model(path: &Path) {
    random_model(path, "lenet");
    let mut model = Model::load(path).unwrap();
    model.recipe.about = format!("{HOSTILE}\r");
    let hostile = || vec![HOSTILE.to_string()];
    model.record = TrainingRecord {
        recordings: hostile(),
        trained_on_held_out: hostile(),
        isa: HOSTILE.into(),
        ..Default::default()
    };
    model.save(path).unwrap();
}

#[test]
fn no_command_passes_on_what_a_terminal_obeys() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    let recordings = recordings(dir);
    hostile_model(&dir.join("hostile.safetensors"));
    random_model(&dir.join("plain.safetensors"), "lenet");
    log(&dir.join("plain"));
    let lenet = SHIPPED.iter().find(|(name, _)| *name == "lenet").unwrap().1;
    fs::write(dir.join("recipe.toml"), lenet.replace("\"lenet\"", &format!("\"{}\"", toml_escaped()))).unwrap();
    fs::write(dir.join("syntax.toml"), format!("name = {HOSTILE}\n")).unwrap();
    fs::write(dir.join("key.toml"), format!("name = \"a\"\n\"{}\" = 1\n", toml_escaped())).unwrap();
    fs::write(dir.join("track.toml"), format!("name = \"a\"\n\"{}\" = []\n", toml_escaped())).unwrap();
    let hostile_json = serde_json::to_string(HOSTILE).unwrap();
    let layer = format!("{{\"class_name\": {hostile_json}, \"config\": {{\"name\": {hostile_json}}}}}");
    let architecture = format!("{{\"class_name\": \"Sequential\", \"config\": [{layer}]}}");
    fs::write(dir.join("layers.json"), architecture).unwrap();
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/keras");
    let [weights, keras] =
        ["keras1-theano-weights.h5", "keras3.keras"].map(|name| golden.join(name).display().to_string());
    fs::create_dir(dir.join("run")).unwrap();
    fs::write(dir.join("run/run.json"), format!("{{\"version\": {}", serde_json::to_string(HOSTILE).unwrap())).unwrap();
    let named = dir.join(HOSTILE);
    log(&named);

    let mut cases: Vec<Vec<String>> = Vec::new();
    let mut case = |args: &[&str]| cases.push(args.iter().map(|arg| arg.to_string()).collect());
    for recording in &recordings {
        case(&["inspect", recording]);
        case(&["inspect", recording, "--json"]);
    }
    for recording in ["header", "described", "described2", "tub", "names.zip"] {
        case(&["train", recording, "--recipe", "lenet", "--set", "epochs=1", "--out", "trained"]);
        case(&["evaluate", "plain.safetensors", recording]);
        case(&["video", recording, "out.mp4"]);
        case(&["explain", "plain.safetensors", recording, "--out", "explained"]);
        case(&["drive", "plain.safetensors", "--on", recording]);
        // Of a tub without pictures these say no more than that.
        if recording != "tub" {
            case(&["tracks", "lake", "--sheet", "sheet", "--beside", recording]);
            case(&["import", &keras, "--fit", recording]);
        }
    }
    case(&["inspect", HOSTILE]);
    case(&["inspect", HOSTILE, "--json"]);
    let all = ["--set", "split.validation_share=0", "--set", "epochs=1"];
    case(&[&["train", HOSTILE, "--recipe", "lenet", "--out", HOSTILE][..], &all].concat());
    case(&["evaluate", "hostile.safetensors", "plain"]);
    case(&["summary", "hostile.safetensors"]);
    case(&["summary", "hostile.safetensors", "--set", HOSTILE]);
    case(&["export", "hostile.safetensors", HOSTILE, "--to", HOSTILE]);
    case(&["predict", "plain.safetensors", HOSTILE, "recipe.toml"]);
    case(&["predict", "plain.safetensors", HOSTILE, "--json"]);
    case(&["compare", HOSTILE, "--out", "compared.html"]);
    case(&["compare", HOSTILE, "run"]);
    case(&["train", "--resume", HOSTILE]);
    for recipe in ["recipe.toml", "syntax.toml", "key.toml", HOSTILE] {
        case(&["train", "plain", "--recipe", recipe]);
        case(&["summary", "--recipe", recipe]);
        case(&["bench", "--recipe", recipe]);
    }
    case(&["train", "plain", "--set", &format!("{HOSTILE}=1")]);
    for command in ["train", "drive", "serve", "sim", "record", "experiment", HOSTILE] {
        case(&[command, &format!("--{HOSTILE}")]);
    }
    for track in ["track.toml", HOSTILE] {
        case(&["tracks", track]);
        case(&["drive", "plain.safetensors", "--track", track]);
        case(&["record", "--track", track, "--out", "recorded"]);
        case(&["sim", "--track", track]);
    }
    case(&["drive", HOSTILE, "--track", "lake"]);
    case(&["serve", HOSTILE]);
    case(&["sim", "--track", "lake", "--connect", HOSTILE]);
    case(&["import", &weights, "--architecture", "layers.json", "--out", "imported"]);
    case(&["import", HOSTILE, "--out", "imported"]);
    case(&["experiment", "split", "--recording", HOSTILE, "--track", HOSTILE]);

    let mut failures = Vec::new();
    for args in &cases {
        let output = steersman(dir).args(args).output().unwrap();
        checked(args, &output, &mut failures);
    }
    assert!(failures.is_empty(), "{} of {} cases: {}", failures.len(), cases.len(), failures.join("\n"));
}

#[test]
fn peers_on_the_network_are_shown_and_not_obeyed() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    random_model(&dir.join("model.safetensors"), "lenet");
    let served = Served::start(dir, "model.safetensors", &["--check"]);
    for text in [
        HOSTILE.to_string(),
        format!("4{HOSTILE}"),
        format!("42[\"{HOSTILE}\",{{}}]"),
        format!("42[{}, {{}}]", serde_json::to_string(HOSTILE).unwrap()),
        format!("42[\"telemetry\",{{\"speed\":{}}}]", serde_json::to_string(HOSTILE).unwrap()),
        format!(
            "42[\"telemetry\",{{\"steering_angle\":\"0\",\"throttle\":\"0\",\"speed\":\"0\",\"image\":\"{HOSTILE}\"}}]"
        ),
    ] {
        let mut client = served.connect(SIMULATOR, 4);
        client.send(&text);
        while client.next_within(std::time::Duration::from_millis(300)).is_some() {}
    }
    served.interrupt();
    let (printed, said) = served.end();
    assert_eq!(obeyed(said.as_bytes()), None);
    assert_eq!(obeyed(printed.to_string().as_bytes()), None);
    assert!(said.contains(r"\u{1b}[2J"), "{said}");

    // A server that answers the simulator's request with hostile words.
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("ws://{}", listener.local_addr().unwrap());
    let answers = [
        format!("HTTP/1.1 403 {HOSTILE}\r\nServer: {HOSTILE}\r\nContent-Length: 3\r\n\r\nno!"),
        format!("{HOSTILE}\r\n\r\n"),
    ];
    let server = std::thread::spawn(move || {
        use std::io::{Read, Write};
        for answer in answers {
            let (mut stream, _) = listener.accept().unwrap();
            let _ = stream.read(&mut [0; 4096]);
            let _ = stream.write_all(answer.as_bytes());
        }
    });
    for _ in 0..2 {
        let output =
            steersman(dir).args(["sim", "--track", "lake", "--connect", &url, "--patience", "1"]).output().unwrap();
        assert_eq!(output.status.code(), Some(1));
        let said = [&output.stdout[..], &output.stderr].concat();
        assert_eq!(obeyed(&said), None);
    }
    server.join().unwrap();
}

#[test]
fn the_check_itself_sees_what_a_terminal_obeys() {
    for c in HOSTILE.chars().filter(|c| !c.is_ascii_graphic()) {
        assert!(obeyed(format!("a{c}b").as_bytes()).is_some(), "{c:?}");
    }
    assert_eq!(obeyed("ä\n\t\\u{1b}".as_bytes()), None);
    assert!(obeyed(b"\xff").is_some());
}
