//! A real browser without a window: Chromium, told what to do in its DevTools protocol.

use std::net::TcpStream;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};
use tempfile::TempDir;
use tungstenite::{Message, WebSocket};

use super::double::SILENCE;

/// Names under which Chromium is found.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "chrome"];

/// A browser with one page.
pub struct Browser {
    child: Child,
    socket: WebSocket<TcpStream>,
    session: String,
    sent: u64,
    /// What the page said to its console, and the errors in it.
    pub complaints: Vec<String>,
    _profile: TempDir,
}

fn found() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    std::env::split_paths(&path).flat_map(|folder| NAMES.map(|name| folder.join(name))).find(|path| path.is_file())
}

impl Browser {
    /// Opens `url` in a window of `size` (width, height) pixels. `None`, with the reason printed, where there is no Chromium.
    pub fn open(url: &str, size: [u32; 2]) -> Option<Browser> {
        let Some(program) = found() else {
            eprintln!("skipped: there is no Chromium on the PATH");
            return None;
        };
        let profile = tempfile::tempdir().unwrap();
        let flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking \
            --disable-component-update --disable-sync --remote-debugging-port=0";
        let child = Command::new(program)
            .args(flags.split_whitespace())
            .arg(format!("--user-data-dir={}", profile.path().display()))
            .arg(format!("--window-size={},{}", size[0], size[1]))
            .arg("about:blank")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // The file has two lines: the port, and the path of the browser's WebSocket.
        let began = Instant::now();
        let address = loop {
            let text = std::fs::read_to_string(profile.path().join("DevToolsActivePort")).unwrap_or_default();
            if let Some((port, path)) = text.split_once('\n').filter(|(_, path)| path.starts_with("/devtools/")) {
                break format!("127.0.0.1:{port}{}", path.trim());
            }
            assert!(began.elapsed() < SILENCE, "Chromium did not start");
            std::thread::sleep(Duration::from_millis(50));
        };
        let stream = TcpStream::connect(address.split('/').next().unwrap()).unwrap();
        stream.set_read_timeout(Some(SILENCE)).unwrap();
        let socket = tungstenite::client(format!("ws://{address}"), stream).unwrap().0;
        let mut browser =
            Browser { child, socket, session: String::new(), sent: 0, complaints: Vec::new(), _profile: profile };
        let target = browser.tell("Target.createTarget", json!({ "url": "about:blank" }));
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        browser.session = browser.tell("Target.attachToTarget", attach)["sessionId"].as_str().unwrap().into();
        for domain in ["Runtime.enable", "Log.enable", "Page.enable", "Page.bringToFront"] {
            browser.tell(domain, json!({}));
        }
        browser.resize(size);
        browser.tell("Page.navigate", json!({ "url": url }));
        Some(browser)
    }

    /// Makes the page as large as this (width, height).
    pub fn resize(&mut self, size: [u32; 2]) {
        let metrics = json!({ "width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": false });
        self.tell("Emulation.setDeviceMetricsOverride", metrics);
    }

    /// Sends a command, and waits for its result.
    pub fn tell(&mut self, method: &str, params: Value) -> Value {
        let answer = self.ask(method, params);
        assert!(answer["error"].is_null(), "{method}: {answer}");
        answer["result"].clone()
    }

    /// Sends a command, and waits for the answer: its `result` or its `error`.
    fn ask(&mut self, method: &str, params: Value) -> Value {
        self.sent += 1;
        let mut command = json!({ "id": self.sent, "method": method, "params": params });
        if !self.session.is_empty() {
            command["sessionId"] = json!(self.session);
        }
        self.socket.send(Message::text(command.to_string())).unwrap();
        loop {
            let Message::Text(text) = self.socket.read().unwrap() else { continue };
            let answer: Value = serde_json::from_str(&text).unwrap();
            if answer["id"] == self.sent {
                return answer;
            }
            if ["Runtime.exceptionThrown", "Log.entryAdded"].contains(&answer["method"].as_str().unwrap_or_default()) {
                self.complaints.push(text.to_string());
            }
        }
    }

    /// The value of a JavaScript expression.
    pub fn value(&mut self, expression: &str) -> Value {
        let result = self.tell("Runtime.evaluate", evaluation(expression));
        assert!(result["exceptionDetails"].is_null(), "{expression}: {result}");
        result["result"]["value"].clone()
    }

    /// Loads the page again, and waits until the new one is complete.
    pub fn reload(&mut self) {
        self.value("window.isOld = true");
        self.tell("Page.reload", json!({}));
        self.wait_for("!window.isOld && document.readyState === 'complete'");
    }

    /// Waits until a JavaScript expression is true. While a page replaces another, Chromium answers with an error.
    pub fn wait_for(&mut self, expression: &str) {
        let began = Instant::now();
        loop {
            let answer = self.ask("Runtime.evaluate", evaluation(expression));
            let result = &answer["result"];
            assert!(result["exceptionDetails"].is_null(), "{expression}: {result}");
            if result["result"]["value"] == true {
                return;
            }
            assert!(began.elapsed() < SILENCE, "never: {expression}; {answer}; {:?}", self.complaints);
            std::thread::sleep(Duration::from_millis(30));
        }
    }

    /// Presses a key, or lets it go; `code` as in `KeyboardEvent.code`.
    pub fn key(&mut self, code: &str, down: bool) {
        let kind = if down { "rawKeyDown" } else { "keyUp" };
        self.tell("Input.dispatchKeyEvent", json!({ "type": kind, "code": code, "key": code }));
    }

    /// Moves the mouse or its left button: `mousePressed`, `mouseMoved`, `mouseReleased`.
    pub fn mouse(&mut self, kind: &str, x: f64, y: f64) {
        let event = json!({ "type": kind, "x": x, "y": y, "button": "left", "buttons": 1, "clickCount": 1 });
        self.tell("Input.dispatchMouseEvent", event);
    }

    /// The middle of an element.
    pub fn middle(&mut self, id: &str) -> [f64; 2] {
        let place = self.value(&format!(
            "(r => [r.x + r.width / 2, r.y + r.height / 2])(document.getElementById('{id}').getBoundingClientRect())"
        ));
        [0, 1].map(|k| place[k].as_f64().unwrap())
    }

    /// Sets what `prefers-color-scheme` asks for: `light` or `dark`.
    pub fn prefer(&mut self, scheme: &str) {
        let features = json!({ "features": [{ "name": "prefers-color-scheme", "value": scheme }] });
        self.tell("Emulation.setEmulatedMedia", features);
    }

    /// Fails if the page scrolls sideways.
    pub fn assert_no_sideways_scrolling(&mut self, when: &str) {
        let fits = "document.documentElement.scrollWidth <= document.documentElement.clientWidth";
        assert_eq!(self.value(fits), true, "{when}");
    }

    /// Fails if the words of an element that `selector` finds have less contrast to the page than WCAG AA asks for: 4.5.
    pub fn assert_contrast(&mut self, selector: &str, when: &str) {
        let pale = format!(
            "(() => {{ const light = text => {{ const [r, g, b] = text.match(/[0-9.]+/g).map(v => v / 255)
               .map(v => v <= .04045 ? v / 12.92 : ((v + .055) / 1.055) ** 2.4); return .2126 * r + .7152 * g + .0722 * b; }};
               const paper = light(getComputedStyle(document.body).backgroundColor);
               return [...document.querySelectorAll('{selector}')]
               .filter(e => e.offsetParent && e.textContent.trim()).map(e => [light(getComputedStyle(e).color), e.outerHTML])
               .filter(([ink]) => (Math.max(ink, paper) + .05) / (Math.min(ink, paper) + .05) < 4.5).map(([, html]) => html); }})()"
        );
        assert_eq!(self.value(&pale), json!([]), "contrast, {when}");
    }

    /// How many different colours a canvas shows.
    pub fn colours(&mut self, canvas: &str) -> u64 {
        let value = self.value(&format!(
            "(c => new Set(new Uint32Array(c.getContext('2d').getImageData(0, 0, c.width, c.height).data.buffer)).size)\
             (document.getElementById('{canvas}'))"
        ));
        value.as_u64().unwrap()
    }
}

/// Parameters of `Runtime.evaluate`.
fn evaluation(expression: &str) -> Value {
    json!({ "expression": expression, "returnByValue": true })
}

impl Drop for Browser {
    fn drop(&mut self) {
        // Asked kindly, it ends its own children, too.
        let close = json!({ "id": self.sent + 1, "method": "Browser.close" });
        let _ = self.socket.send(Message::text(close.to_string()));
        let began = Instant::now();
        while began.elapsed() < Duration::from_secs(20) && matches!(self.child.try_wait(), Ok(None)) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
