//! The page on which a person looks through a recording and leaves rows out: what it serves and to whom, and what becomes of the rows.

mod common;

use std::fs;
use std::path::Path;

use common::browser::Browser;
use common::command::{error, json, steersman};
use common::page::serve;
use common::painted_log;
use common::served::{Served, random_model};
use serde_json::{Value, json};

const ROWS: usize = 120;

fn edit(folder: &Path, args: &[&str]) -> Served {
    serve(folder, &[&["inspect", "log", "--edit", "--json"], args].concat())
}

/// The body of the answer to a GET, and its status.
fn get(served: &Served, path: &str) -> (u16, String) {
    split(&served.ask(&format!("GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{}\r\n\r\n", served.port)))
}

fn split(answer: &str) -> (u16, String) {
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    (head.split(' ').nth(1).unwrap().parse().unwrap(), body.to_string())
}

fn post(served: &Served, headers: &str, body: &str) -> (u16, String) {
    let (port, len) = (served.port, body.len());
    split(&served.ask(&format!(
        "POST /left-out HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nContent-Length: {len}\r\n{headers}\r\n{body}"
    )))
}

fn usable(folder: &Path) -> Value {
    json(folder, &["inspect", "log", "--json"])[0]["usable"].clone()
}

#[test]
fn rows_are_left_out_by_the_own_page_only_and_every_command_heeds_it() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    painted_log::write(&dir.join("log"), ROWS, "");
    fs::write(dir.join("log/steersman.toml"), "# seen at dusk\nhz = 10.0\n").unwrap();
    let log_before = fs::read(dir.join("log/driving_log.csv")).unwrap();
    let served = edit(dir, &[]);
    let about: Value = serde_json::from_str(&get(&served, "/about").1).unwrap();
    assert_eq!((&about["rows"], &about["format"]), (&json!(ROWS), &json!("udacity")));
    assert_eq!(about["cameras"], json!(["centre", "left", "right"]));
    let own = format!("Origin: http://127.0.0.1:{}\r\nContent-Type: application/json\r\n", served.port);
    // No number of an earlier start.
    let told: Value = serde_json::from_str(&get(&served, "/left-out").1).unwrap();
    let revision = told["revision"].as_u64().unwrap();
    assert!(revision > 1_700_000_000_000 && told["stretches"] == json!([]), "{told}");
    let stretches =
        |revision: u64, stretches: Value| json!({ "revision": revision, "stretches": stretches }).to_string();
    let wanted = &stretches(revision, json!([[10, 20], [119, 120]]))[..];
    for (headers, body, status) in [
        ("", wanted, 403),
        ("Content-Type: application/json\r\n", wanted, 403),
        ("Origin: http://evil.example\r\nContent-Type: application/json\r\n", wanted, 403),
        (&own.replace("json", "x-www-form-urlencoded"), wanted, 403),
        (&own, "{", 400),
        (&own, &stretches(revision, json!([[10, 121]])), 400),
        (&own, &stretches(revision, json!([[10, 10]])), 400),
        (&own, &stretches(revision + 7, json!([[10, 20]])), 409),
        // A page of another recording, which was served here before.
        (&own, &stretches(0, json!([[10, 20]])), 409),
    ] {
        assert_eq!(post(&served, headers, body).0, status, "{headers} {body}");
    }
    assert_eq!(get(&served, "/left-out").1, stretches(revision, json!([])));
    let (status, told) = post(&served, &own, wanted);
    assert_eq!((status, told.as_str()), (200, &stretches(revision + 1, json!([[10, 20], [119, 120]]))[..]));
    for (request, status) in [
        ("GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 403),
        ("GET /picture?row=0&camera=centre HTTP/1.1\r\nHost: localhost.evil.example\r\n\r\n", 403),
        ("hello\r\n\r\n", 400),
    ] {
        assert_eq!(split(&served.ask(request)).0, status, "{request}");
    }
    for (path, status) in [
        ("/", 200),
        ("/nothing", 404),
        ("/picture?row=120&camera=centre", 404),
        ("/picture?row=1&camera=rear", 400),
        ("/picture?row=../../etc/passwd&camera=left", 400),
    ] {
        assert_eq!(get(&served, path).0, status, "{path}");
    }
    let (end, words) = served.stop();
    assert!(words.contains("11 rows are left out in log/steersman.toml; next: "), "{words}");
    assert_eq!(end["left_out"], 11);
    // The header is line 1.
    let said = fs::read_to_string(dir.join("log/steersman.toml")).unwrap();
    assert_eq!(said, "# seen at dusk\nhz = 10.0\nexclude = [[12, 21], [121, 121]]\n");
    assert_eq!(fs::read(dir.join("log/driving_log.csv")).unwrap(), log_before);
    assert_eq!(usable(dir), ROWS - 11);
    random_model(&dir.join("model.safetensors"), "default");
    let evaluated = steersman(dir).args(["evaluate", "model.safetensors", "log"]).output().unwrap();
    assert!(evaluated.status.success());
    let words = String::from_utf8_lossy(&evaluated.stderr).into_owned() + &String::from_utf8_lossy(&evaluated.stdout);
    assert!(words.contains("11 rows are left out by `exclude` in steersman.toml"), "{words}");
}

#[test]
fn what_cannot_be_edited_is_said_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    painted_log::write(&dir.join("log"), 3, "");
    painted_log::write(&dir.join("other"), 3, "");
    assert!(error(dir, &["inspect", "log", "other", "--edit"]).contains("--edit opens one recording, and 2 are named"));
    assert!(error(dir, &["inspect", "log", "--edit", "--model", "other"]).contains("is a recording, no model"));
    fs::write(dir.join("log/steersman.toml"), "exclude = [[9, 3]]").unwrap();
    assert!(error(dir, &["inspect", "log"]).contains("steersman.toml: exclude: [9, 3] is no range"));
    fs::write(dir.join("log/steersman.toml"), "exclude = [[70, 80]]").unwrap();
    let notices = json(dir, &["inspect", "log", "--json"])[0]["notices"].to_string();
    assert!(notices.contains("names no row of the recording"), "{notices}");
}

#[test]
fn a_person_marks_undoes_reloads_and_training_obeys() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    painted_log::write(&dir.join("log"), ROWS, "");
    random_model(&dir.join("model.safetensors"), "default");
    let served = edit(dir, &["--model", "model.safetensors"]);
    let Some(mut browser) = Browser::open(&format!("http://127.0.0.1:{}/", served.port), [1300, 900]) else { return };
    let opened =
        "typeof about !== 'undefined' && about !== null && document.getElementById('status').textContent === ''";
    browser.wait_for(opened);
    browser.wait_for("document.getElementById('picture').getContext('2d') && load(0).naturalWidth === 320");
    let press = |browser: &mut Browser, keys: &[&str]| {
        for key in keys {
            browser.key(key, true);
            browser.key(key, false);
        }
    };
    // Rows 2 to 5, by keys.
    press(&mut browser, &["ArrowRight", "ArrowRight", "[", "ArrowRight", "ArrowRight", "ArrowRight", "]"]);
    assert_eq!(browser.value("document.getElementById('chosen').textContent"), "chosen: lines 4–7, 4 rows");
    let said = || fs::read_to_string(dir.join("log/steersman.toml")).unwrap_or_default();
    let wait_for_file = |expected: &str| {
        let began = std::time::Instant::now();
        while said() != expected {
            assert!(began.elapsed() < common::double::SILENCE, "{}", said());
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
    };
    press(&mut browser, &["x"]);
    wait_for_file("exclude = [[4, 7]]\n");
    assert!(browser.colours("picture") > 50 && browser.colours("near") > 4 && browser.colours("whole") > 4);
    press(&mut browser, &["End", "x"]);
    wait_for_file("exclude = [[4, 7], [121, 121]]\n");
    press(&mut browser, &["u"]);
    wait_for_file("exclude = [[4, 7]]\n");
    press(&mut browser, &["y"]);
    wait_for_file("exclude = [[4, 7], [121, 121]]\n");
    // The model is asked, its worst rows are listed, and a click leads there.
    browser.wait_for("document.querySelectorAll('#worst button').length > 3");
    browser.value("document.querySelector('#worst button').click()");
    assert_eq!(browser.value("row === worst[0] && row > 0"), true);
    browser.wait_for("document.querySelectorAll('#suspicious li').length > 0");
    // A list puts rows back; a reloaded page knows what is left.
    browser.value("[...document.querySelectorAll('#out button')].find(b => b.textContent === 'put back').click()");
    wait_for_file("exclude = [[121, 121]]\n");
    browser.reload();
    browser.wait_for(opened);
    browser.wait_for("document.getElementById('counts').textContent === '120 rows, 1 row left out (0.8 %)'");
    // Nothing lies beside a phone's screen, in the dark as in the light.
    for scheme in ["light", "dark"] {
        browser.prefer(scheme);
        for size in [[390, 844], [1300, 900]] {
            browser.resize(size);
            browser.wait_for(&format!("innerWidth === {}", size[0]));
            browser.assert_no_sideways_scrolling(&format!("{scheme}, {size:?}"));
            let small = "[...document.querySelectorAll('button, select')].filter(e => e.offsetParent \
                && e.getBoundingClientRect().height < 24).map(e => e.outerHTML)";
            assert_eq!(browser.value(small), json!([]), "{scheme}");
            browser.assert_contrast("h1, h2, span, figcaption, .help, #values b, .none", scheme);
        }
    }
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    assert_eq!(served.stop().0["left_out"], 1);
    let trained = json(dir, &["train", "log", "--recipe", "lenet", "--set", "epochs=1", "--out", "run", "--json"]);
    assert!(!trained.is_null());
    let rows = fs::read_to_string(dir.join("run/split.csv")).unwrap();
    assert!(!rows.contains(",121,") && rows.lines().count() > ROWS / 2, "{rows}");
}

#[test]
fn a_hundred_thousand_rows_open_soon() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    painted_log::write(&dir.join("log"), 4, "");
    let log = fs::read_to_string(dir.join("log/driving_log.csv")).unwrap();
    let (header, rows) = log.split_once('\n').unwrap();
    let many = rows.repeat(25_000);
    fs::write(dir.join("log/driving_log.csv"), format!("{header}\n{many}")).unwrap();
    let began = std::time::Instant::now();
    let served = edit(dir, &[]);
    let columns = get_bytes(&served, "/columns");
    let took = began.elapsed();
    assert_eq!(columns, 100_000 * 20);
    println!("100,000 rows opened in {took:.2?}");
    // On a quiet machine it is one.
    assert!(took.as_secs() < 20, "{took:?}");
    assert_eq!(served.stop().0["left_out"], 0);
}

/// Length of the body of the answer to a GET.
fn get_bytes(served: &Served, path: &str) -> usize {
    use std::io::{Read, Write};
    let mut stream = served.connect_tcp();
    write!(stream, "GET {path} HTTP/1.1\r\nHost: localhost:{}\r\n\r\n", served.port).unwrap();
    let mut bytes = Vec::new();
    stream.read_to_end(&mut bytes).unwrap();
    let head = bytes.windows(4).position(|window| window == b"\r\n\r\n").unwrap();
    bytes.len() - head - 4
}
