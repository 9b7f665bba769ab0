//! The live page in a real browser, where there is one: `apt-get install chromium`, or another Chromium on the PATH.

mod common;

use std::time::{Duration, Instant};

use common::browser::Browser;
use common::command::json;
use common::page::serve;
use common::served::{Served, command, random_model, sample_jpeg, telemetry};
use serde_json::json;

/// Fails if something does not fit into the window, or is cut off.
fn assert_fits(browser: &mut Browser, size: [u32; 2]) {
    browser.resize(size);
    browser.wait_for(&format!("innerWidth === {} && innerHeight === {}", size[0], size[1]));
    let beyond = browser.value(
        "[...document.querySelectorAll('header, figure, canvas, button, p, li, #words, #shares, .gauge')]
           .filter(e => e.offsetParent && (r => r.bottom > innerHeight + 1 || r.right > innerWidth + 1 || r.x < -1)
             (e.getBoundingClientRect()) || e.id === 'words' && e.scrollHeight > e.clientHeight + 1
             || e.className === 'gauge' && e.scrollWidth > e.clientWidth + 1)
           .map(e => e.outerHTML.slice(0, 80))
           .concat(document.documentElement.scrollHeight > innerHeight ? ['the page scrolls'] : [])",
    );
    assert_eq!(beyond, json!([]), "at {size:?}");
}

#[test]
fn a_person_drives_with_keys_and_mouse_and_gamepad_and_the_recording_is_on_disk() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path();
    let served = serve(dir, &["record", "--track", "lake", "--manual", "--out", "rec", "--json"]);
    let Some(mut browser) = Browser::open(&format!("http://127.0.0.1:{}/", served.port), [1024, 768]) else { return };
    browser.wait_for("document.getElementById('link')?.textContent === 'you drive'");
    browser.wait_for("document.getElementById('angle').textContent === '0.0°'");
    assert!(browser.colours("camera") > 500, "a picture of the road");
    assert!(browser.colours("map") > 4 && browser.colours("chart") > 4 && browser.colours("wheel") > 4);
    assert_fits(&mut browser, [1600, 900]);
    assert_fits(&mut browser, [1024, 768]);

    browser.key("KeyW", true);
    browser.wait_for("parseFloat(document.getElementById('speed').textContent) > 5");
    browser.key("KeyR", true);
    browser.key("KeyR", false);
    browser.wait_for("document.getElementById('state').textContent.includes('● recording')");
    let before = browser.value("document.getElementById('camera').toDataURL()");
    browser.key("ArrowLeft", true);
    browser.wait_for("document.getElementById('angle').textContent === '−25.0°'");
    browser.key("ArrowLeft", false);
    browser.wait_for("document.getElementById('angle').textContent === '0.0°'");
    browser.key("KeyW", false);
    assert_ne!(browser.value("document.getElementById('camera').toDataURL()"), before, "the picture moves");

    // A sixth of the window's width is full lock.
    let [x, y] = browser.middle("camera");
    browser.mouse("mousePressed", x, y);
    browser.mouse("mouseMoved", x + 1024.0 / 12.0, y);
    browser.wait_for("Math.abs(parseFloat(document.getElementById('angle').textContent) - 12.5) < 0.6");
    browser.mouse("mouseReleased", x + 1024.0 / 12.0, y);
    browser.wait_for("document.getElementById('angle').textContent === '0.0°'");

    browser.value(
        "navigator.getGamepads = () => [{ connected: true, axes: [-0.54, 0],
           buttons: Array.from({ length: 17 }, (_, k) => ({ value: k === 6 ? 1 : 0, pressed: k === 6 })) }]; true",
    );
    browser.wait_for("document.getElementById('angle').textContent === '−12.5°'");
    browser.wait_for("document.getElementById('throttle').textContent === 'brake 100 %'");
    browser.value("navigator.getGamepads = () => []; true");

    // On a busy machine the wheel may have been lost for a moment, and recording paused.
    let began = Instant::now();
    while browser.value("state.manual.rows > 5") != true {
        assert!(began.elapsed() < common::double::SILENCE, "no rows");
        if browser.value("state.manual.recording") == false {
            browser.key("KeyR", true);
            browser.key("KeyR", false);
        }
        std::thread::sleep(Duration::from_millis(500));
    }
    assert_fits(&mut browser, [1024, 768]);
    let [x, y] = browser.middle("finish");
    browser.mouse("mousePressed", x, y);
    browser.mouse("mouseReleased", x, y);
    browser.wait_for("!document.getElementById('over').hidden");
    let words = browser.value("document.getElementById('over').textContent");
    let (summary, _) = served.end();
    let rows = summary["rows"].as_u64().unwrap();
    assert!(words.as_str().unwrap().contains(&format!("{rows} rows are in rec")), "{words} {summary}");
    assert_eq!(json(dir, &["inspect", "rec", "--json"])[0]["usable"], rows);
    let log = std::fs::read_to_string(dir.join("rec/driving_log.csv")).unwrap();
    assert!(log.lines().skip(1).all(|line| line.split(", ").count() == 7), "{log}");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
}

#[test]
fn a_hidden_page_lets_go_of_the_wheel() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), &["record", "--track", "lake", "--manual", "--out", "rec", "--json"]);
    let Some(mut browser) = Browser::open(&format!("http://127.0.0.1:{}/", served.port), [1024, 768]) else { return };
    browser.wait_for("document.getElementById('link')?.textContent === 'you drive'");
    browser.key("KeyW", true);
    browser.wait_for("parseFloat(document.getElementById('speed').textContent) > 5");
    browser.value(
        "Object.defineProperty(document, 'hidden', { configurable: true, get: () => true });
         document.dispatchEvent(new Event('visibilitychange')); true",
    );
    let mut guest = common::page::Page::open(served.port);
    let stopped = guest.until_it_stands();
    assert!(stopped.state["manual"]["driver"].is_null(), "{}", stopped.state);
    browser.value("delete document.hidden; document.dispatchEvent(new Event('visibilitychange')); true");
    browser.wait_for("document.getElementById('link').textContent === 'you drive'");
    served.stop();
}

#[test]
fn a_drive_is_watched_with_its_saliency() {
    let folder = tempfile::tempdir().unwrap();
    random_model(&folder.path().join("model.safetensors"), "default");
    let served = serve(folder.path(), &["drive", "model.safetensors", "--track", "mountain", "--watch"]);
    let Some(mut browser) = Browser::open(&format!("http://127.0.0.1:{}/", served.port), [1024, 768]) else { return };
    browser.wait_for("document.body?.classList.contains('two') && document.getElementById('title').textContent !== ''");
    assert!(browser.colours("camera") > 500 && browser.colours("saliency") > 500);
    let same = "document.getElementById('camera').toDataURL() === document.getElementById('saliency').toDataURL()";
    assert_eq!(browser.value(same), false);
    for size in [[1600, 900], [1024, 768]] {
        assert_fits(&mut browser, size);
    }
    let time = browser.value("state.time_s + 100 * state.trail_id").as_f64().unwrap();
    browser.wait_for(&format!("state.time_s + 100 * state.trail_id > {time} + 0.5"));
    browser.key("Space", true);
    browser.key("Space", false);
    browser.wait_for("document.getElementById('rate').textContent === 'paused'");
    let [x, y] = browser.middle("next");
    browser.mouse("mousePressed", x, y);
    browser.mouse("mouseReleased", x, y);
    browser.wait_for(
        "!document.getElementById('finished').hidden && document.querySelector('#results td').textContent !== ''",
    );
    browser.key("NumpadAdd", true);
    browser.wait_for("document.getElementById('rate').textContent === '2 times real time'");
    browser.key("NumpadAdd", false);
    for size in [[1600, 900], [1024, 768]] {
        assert_fits(&mut browser, size);
    }
    browser.wait_for("history.length > 20");
    browser.reload();
    browser.wait_for("typeof history !== 'undefined' && state !== null && history.length > 10");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    // The browser stays; the page says that the drive is over.
    served.interrupt();
    browser.wait_for("!document.getElementById('over').hidden");
    assert_eq!(served.code(), Some(130));
}

#[test]
fn a_phone_in_the_dark_drives_with_a_finger_on_each_pedal() {
    let folder = tempfile::tempdir().unwrap();
    let served = serve(folder.path(), &["record", "--track", "lake", "--manual", "--out", "rec", "--json"]);
    let Some(mut browser) = Browser::open(&format!("http://127.0.0.1:{}/", served.port), [390, 844]) else { return };
    browser.wait_for("document.getElementById('link')?.textContent === 'you drive'");
    for scheme in ["light", "dark"] {
        browser.prefer(scheme);
        browser.assert_no_sideways_scrolling(scheme);
        browser.assert_contrast("h1, p, figcaption, .gauge, #subject, #link", scheme);
    }
    assert!(browser.colours("map") > 4 && browser.colours("chart") > 4);
    let [x, y] = browser.middle("accelerate");
    assert!(y < 844.0, "the pedals are always in sight: {y}");
    browser.mouse("mousePressed", x, y);
    browser.wait_for("parseFloat(document.getElementById('speed').textContent) > 8");
    browser.mouse("mouseReleased", x, y);
    let [x, y] = browser.middle("brake");
    browser.mouse("mousePressed", x, y);
    browser.wait_for("document.getElementById('speed').textContent === '0.0 mph'");
    browser.mouse("mouseReleased", x, y);
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    served.stop();
}

#[test]
fn beside_a_server_the_arrow_keys_take_the_wheel() {
    let folder = tempfile::tempdir().unwrap();
    random_model(&folder.path().join("model"), "lenet");
    let served = Served::start(folder.path(), "model", &["--page=0", "--record", "corrections"]);
    let said = served.wait_until_it_says("in a browser to take the wheel");
    let url = said.lines().find_map(|line| line.strip_prefix("open ")?.split(' ').next()).unwrap().to_string();
    let Some(mut browser) = Browser::open(&url, [1024, 768]) else { return };
    browser.wait_for("document.getElementById('link')?.textContent === 'connected'");
    let mut car = served.connect_simulator();
    let jpeg = sample_jpeg();
    let mut turn = || {
        car.send(&telemetry(10.0, &jpeg));
        command(&car.next()).0
    };
    let of_model = turn();
    browser.wait_for("document.getElementById('who').textContent === 'the model drives' && history.length > 0");
    assert!(browser.colours("camera") > 50);
    for (size, scheme) in [([1600, 900], "light"), ([1024, 768], "dark"), ([390, 844], "dark")] {
        browser.prefer(scheme);
        browser.resize(size);
        browser.wait_for(&format!("innerWidth === {}", size[0]));
        browser.assert_no_sideways_scrolling(&format!("{scheme}, {size:?}"));
        browser.assert_contrast("h1, p, figcaption, .gauge, #subject, #link, #who", scheme);
        turn();
    }
    browser.key("ArrowRight", true);
    let began = Instant::now();
    while turn() < 1.0 {
        assert!(began.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(20));
    }
    browser.wait_for("document.getElementById('who').textContent === 'you drive'");
    browser.key("ArrowRight", false);
    while turn() != of_model {
        assert!(began.elapsed() < Duration::from_secs(60));
        std::thread::sleep(Duration::from_millis(20));
    }
    browser.wait_for("document.getElementById('who').textContent === 'the model drives'");
    browser.wait_for("/Recorded with your steering: [1-9]/.test(document.getElementById('corrected').textContent)");
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    served.stop();
    browser.wait_for("document.getElementById('over').textContent.includes('of them by you')");
}

#[test]
fn a_training_shows_its_report_while_it_runs_and_says_at_the_end_how_to_go_on() {
    let folder = tempfile::tempdir().unwrap();
    let sample = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample");
    let args =
        ["train", sample.to_str().unwrap(), "--recipe", "lenet", "--set", "epochs=10000", "--out", "run", "--watch"];
    let served = serve(folder.path(), &args);
    let Some(mut browser) = Browser::open(&format!("http://127.0.0.1:{}/", served.port), [1280, 900]) else { return };
    let inside = "document.getElementById('report').contentDocument";
    browser.wait_for(&format!(
        "typeof shown !== 'undefined' && shown > 1 && {inside}?.body?.textContent.includes('The worst frames')"
    ));
    browser.wait_for("/epoch \\d+\\/10000, .* images\\/s, .* left/.test(document.getElementById('doing').textContent)");
    let errors = browser.value(&format!("{inside}.querySelectorAll('svg').length > 2"));
    assert_eq!(errors, true, "the curves are drawn");
    for (size, scheme) in [([1280, 900], "light"), ([1280, 900], "dark"), ([390, 844], "dark")] {
        browser.prefer(scheme);
        browser.resize(size);
        browser.wait_for(&format!("innerWidth === {}", size[0]));
        browser.assert_no_sideways_scrolling(&format!("{scheme}, {size:?}"));
        let fits = format!("{inside}.documentElement.scrollWidth <= {inside}.documentElement.clientWidth");
        browser.wait_for(&format!("{inside}?.readyState === 'complete' && {fits}"));
        browser.assert_contrast("h1, #doing, #link, summary", scheme);
    }
    served.interrupt();
    browser.wait_for("document.getElementById('over').textContent.includes('--resume run')");
    browser.wait_for(&format!("{inside}?.body?.textContent.includes('This run was stopped after')"));
    assert!(browser.complaints.is_empty(), "{:?}", browser.complaints);
    assert_eq!(served.code(), Some(130));
}
