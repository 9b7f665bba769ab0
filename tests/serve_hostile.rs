//! Hostile input beside one good client.
//!
//! For five seconds; `STEERSMAN_HOSTILE_SECONDS=60 cargo test --release --test serve_hostile -- --nocapture` for longer, with
//! 1,000 instead of 200 connections that say nothing. All traffic stays on loopback, is slowed down by pauses, and ends by
//! itself.
#![cfg(unix)]

mod common;

use std::io::{Read, Write};
use std::net::TcpStream;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use common::hammer::{damage, damage_text};
use common::served::{Served, command, random_model, sample_jpeg, telemetry};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use steersman::engine::random::{Purpose, below, rng};

/// The request of Udacity's simulator.
const REQUEST: &[u8] = b"GET /socket.io/?EIO=4&transport=websocket HTTP/1.1\r\nUser-Agent: websocket-sharp/1.0\r\n\
      Upgrade: websocket\r\nConnection: Upgrade\r\nHost: 127.0.0.1:4567\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\
      Sec-WebSocket-Version: 13\r\n\r\n";

/// A connection of an attacker. Errors are what it is there for: the server may close it at any time.
struct Attack(TcpStream);

impl Attack {
    fn begin(port: u16) -> Option<Attack> {
        let stream = TcpStream::connect(("127.0.0.1", port)).ok()?;
        stream.set_read_timeout(Some(Duration::from_millis(20))).ok()?;
        stream.set_write_timeout(Some(Duration::from_millis(500))).ok()?;
        Some(Attack(stream))
    }

    /// Begins with a complete request.
    fn open(port: u16) -> Option<Attack> {
        let mut attack = Attack::begin(port)?;
        attack.say(REQUEST)?;
        Some(attack)
    }

    fn say(&mut self, bytes: &[u8]) -> Option<()> {
        self.0.write_all(bytes).ok()
    }

    /// Sends a whole text frame with a mask of zeros.
    fn say_text(&mut self, text: &str) -> Option<()> {
        let mut frame = vec![0x81, 0xff];
        frame.extend_from_slice(&(text.len() as u64).to_be_bytes());
        frame.extend_from_slice(&[0; 4]);
        frame.extend_from_slice(text.as_bytes());
        self.say(&frame)
    }

    /// Reads what there is.
    fn listen(&mut self) {
        let _ = self.0.read(&mut [0; 4096]);
    }
}

fn random_bytes(rng: &mut impl Rng, most: usize) -> Vec<u8> {
    let mut bytes = vec![0; 1 + below(rng, most)];
    rng.fill_bytes(&mut bytes);
    bytes
}

/// Attacks, one after the other, each once in a while. `None` when the server did not want to hear the rest.
type Kind = (&'static str, fn(u16, u64) -> Option<()>);

const KINDS: [Kind; 10] = [
    ("random bytes", |port, turn| {
        let mut rng = rng(1, Purpose::Test, 0, turn);
        let mut attack = Attack::begin(port)?;
        attack.say(&random_bytes(&mut rng, 8192))?;
        attack.listen();
        Some(())
    }),
    ("random bytes behind a good handshake", |port, turn| {
        let mut rng = rng(1, Purpose::Test, 1, turn);
        let mut attack = Attack::open(port)?;
        attack.listen();
        attack.say(&random_bytes(&mut rng, 65_536))?;
        attack.listen();
        Some(())
    }),
    ("broken frames", |port, turn| {
        const FRAMES: [&[u8]; 8] = [
            b"\xf1\x80\0\0\0\0",                   // reserved bits
            b"\x81\x05hello",                      // no mask
            b"\x80\x81\0\0\0\0a",                  // continuation of nothing
            b"\x01\x81\0\0\0\0a\x81\x81\0\0\0\0b", // a text within a text
            b"\x09\x80\0\0\0\0",                   // a ping in pieces
            b"\x89\xfe\x00\x80\0\0\0\0",           // a ping that is too long
            b"\x81\x84\0\0\0\0\xff\xfe\xfd\xfc",   // no UTF-8
            b"\x83\x80\0\0\0\0",                   // unknown opcode
        ];
        let mut attack = Attack::open(port)?;
        attack.say(FRAMES[turn as usize % FRAMES.len()])?;
        attack.listen();
        attack.listen();
        Some(())
    }),
    ("frames that are too large", |port, turn| {
        let mut attack = Attack::open(port)?;
        if turn.is_multiple_of(2) {
            attack.say(b"\x81\xff\x00\x00\x00\xff\xff\xff\xff\xff\0\0\0\0")?;
            attack.say(&[b'4'; 65_536])?;
        } else {
            // Three megabytes in pieces that are small enough.
            let mut piece = vec![0x01, 0xff, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0];
            piece.extend_from_slice(&[b'4'; 65_536]);
            for _ in 0..48 {
                attack.say(&piece)?;
                piece[0] = 0x00;
            }
        }
        attack.listen();
        Some(())
    }),
    ("malformed messages", |port, turn| {
        let deep = format!("42{}", "[".repeat(100_000));
        let texts = [
            "",
            "x",
            "4",
            "42",
            "42[",
            "42{}",
            "42[\"telemetry\"",
            "42[\"telemetry\",[]]",
            "42[\"telemetry\",{\"image\":1}]",
            "42[null,null]",
            "42[\"telemetry\",{\"speed\":\"1e999\",\"image\":\"\"}]",
            "{\"telemetry\":{}}",
            "9",
            "451-[]",
            "42/admin,[\"x\"]",
            &deep,
        ];
        let mut attack = Attack::open(port)?;
        for k in 0..6 {
            attack.say_text(texts[(turn as usize + k) % texts.len()])?;
            attack.listen();
        }
        Some(())
    }),
    ("pictures that are none", |port, turn| {
        let good = sample_jpeg();
        let mut attack = Attack::open(port)?;
        let jpeg = match turn % 5 {
            0 => good[..good.len() / 3].to_vec(),
            // The largest size that a JPEG can announce.
            1 => {
                let mut huge = good;
                let at = huge.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
                huge[at + 5..at + 9].fill(0xff);
                huge
            }
            2 => good
                .iter()
                .enumerate()
                .map(|(at, byte)| if at > 700 && at.is_multiple_of(7) { !byte } else { *byte })
                .collect(),
            3 => {
                let mut plain = Vec::new();
                let encoder = jpeg_encoder::Encoder::new(&mut plain, 60);
                encoder.encode(&vec![128; 1900 * 1900], 1900, 1900, jpeg_encoder::ColorType::Luma).unwrap();
                plain
            }
            _ => b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\x7f\xff\xff\xff\x7f\xff\xff\xff\x08\x02\0\0\0".to_vec(),
        };
        attack.say_text(&telemetry(10.0, &jpeg))?;
        attack.listen();
        attack.say_text(&telemetry(10.0, b"").replace("\"image\":\"", "\"image\":\"!!!"))?;
        attack.listen();
        Some(())
    }),
    ("messages damaged field by field", |port, turn| {
        let mut attack = Attack::open(port)?;
        let valid = [
            telemetry(10.0, &sample_jpeg()),
            "42[\"telemetry\",null]".to_string(),
            "0{\"sid\":\"x\",\"pingInterval\":25000}".to_string(),
            "40/,{\"a\":[1,2,{}]}".to_string(),
            "2probe".to_string(),
        ];
        for k in 0..6 {
            let mut bytes = valid[(turn as usize + k) % valid.len()].clone().into_bytes();
            damage_text(&mut ChaCha8Rng::seed_from_u64(6 * turn + k as u64), &mut bytes);
            attack.say_text(&String::from_utf8_lossy(&bytes))?;
            attack.listen();
        }
        Some(())
    }),
    ("frames damaged bit by bit", |port, turn| {
        let mut attack = Attack::open(port)?;
        let text = telemetry(10.0, &sample_jpeg()[..2000]);
        let mut frame = [&[0x81, 0xfe], &(text.len() as u16).to_be_bytes()[..], &[0; 4], text.as_bytes()].concat();
        damage(&mut ChaCha8Rng::seed_from_u64(turn), &mut frame);
        attack.say(&frame)?;
        attack.listen();
        attack.listen();
        Some(())
    }),
    ("slow requests and slow frames", |port, turn| {
        let mut attack = if turn.is_multiple_of(2) { Attack::begin(port)? } else { Attack::open(port)? };
        let bytes = if turn.is_multiple_of(2) { REQUEST } else { b"\x81\xfe\x10\x00\x00\x00\x00\x0042[\"telemetry\"" };
        for byte in bytes.iter().take(20) {
            attack.say(&[*byte])?;
            std::thread::sleep(Duration::from_millis(50));
        }
        Some(())
    }),
    ("requests that never end or want something else", |port, turn| {
        let mut attack = Attack::begin(port)?;
        match turn % 4 {
            0 => {
                attack.say(b"GET / HTTP/1.1\r\n")?;
                for _ in 0..200 {
                    attack
                        .say(b"X-Header: 0123456789012345678901234567890123456789012345678901234567890123456789\r\n")?;
                }
            }
            1 => {
                attack.say(b"POST /socket.io/?EIO=4&transport=polling HTTP/1.1\r\nContent-Length: 999999999\r\n\r\n")?
            }
            2 => attack.say(b"GET http://[ HTTP/9.9\r\n\r\n")?,
            _ => attack.say(&[b'\n'; 20_000])?,
        }
        attack.listen();
        Some(())
    }),
];

#[test]
fn a_good_client_drives_on_amid_hostile_input() {
    let seconds = std::env::var("STEERSMAN_HOSTILE_SECONDS").ok().and_then(|text| text.parse().ok());
    let (seconds, silent) = seconds.map_or((5, 200), |seconds: u64| (seconds, 1000));
    let folder = tempfile::tempdir().unwrap();
    random_model(&folder.path().join("model"), "lenet");
    let served = Served::start(folder.path(), "model", &[]);
    let mut good = served.connect_simulator();
    let message = telemetry(10.0, &sample_jpeg());
    let mut drive_once = move || {
        // Where the machine stands still, the throttle is cut and telemetry asked for: neither answers this telemetry.
        while good.next_within(Duration::from_millis(1)).is_some() {}
        let began = Instant::now();
        good.send(&message);
        loop {
            let text = good.next();
            if text.starts_with("42[\"steer\"") && command(&text).1 > 0.0 {
                break;
            }
        }
        began.elapsed().as_secs_f64() * 1000.0
    };
    drive_once();
    let calm_kib = served.status("VmHWM");

    let port = served.port;
    let deadline = Instant::now() + Duration::from_secs(seconds);
    let attacks: [AtomicU64; KINDS.len()] = Default::default();
    let opened = AtomicU64::new(0);
    let (mut latencies_ms, mut most_threads) = (Vec::new(), 0);
    std::thread::scope(|scope| {
        for ((_, attack), count) in KINDS.iter().zip(&attacks) {
            scope.spawn(move || {
                for turn in 0.. {
                    if Instant::now() >= deadline {
                        break;
                    }
                    attack(port, turn);
                    count.fetch_add(1, Ordering::Relaxed);
                    std::thread::sleep(Duration::from_millis(3));
                }
            });
        }
        scope.spawn(|| {
            let mut held = Vec::new();
            while held.len() < silent && Instant::now() < deadline {
                held.extend(Attack::begin(port));
                opened.store(held.len() as u64, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(2));
            }
            std::thread::sleep(deadline.saturating_duration_since(Instant::now()));
        });
        while Instant::now() < deadline {
            latencies_ms.push(drive_once());
            most_threads = most_threads.max(served.status("Threads").unwrap_or(0));
            std::thread::sleep(Duration::from_millis(25));
        }
    });
    // The good client is still the one that drives.
    latencies_ms.push(drive_once());
    let peak_kib = served.status("VmHWM");
    let (summary, said) = served.stop();

    latencies_ms.sort_by(f64::total_cmp);
    let quantile = |q: f64| latencies_ms[((latencies_ms.len() - 1) as f64 * q) as usize];
    println!("{seconds} s, {} round trips of the good client", latencies_ms.len());
    let [median, p90, p99, worst] = [0.5, 0.9, 0.99, 1.0].map(quantile);
    println!("round trip p50/p90/p99/worst  {median:.2} / {p90:.2} / {p99:.2} / {worst:.2} ms");
    println!("peak memory  {calm_kib:?} KiB before, {peak_kib:?} KiB after; at most {most_threads} threads");
    for ((name, _), count) in KINDS.iter().zip(&attacks) {
        println!("{:>7}  {name}", count.load(Ordering::Relaxed));
    }
    println!("{:>7}  connections that say nothing", opened.load(Ordering::Relaxed));
    println!("{summary}");

    assert!(attacks.iter().all(|count| count.load(Ordering::Relaxed) > 0), "every kind was tried");
    assert_eq!(opened.load(Ordering::Relaxed), silent as u64);
    // A machine that stands still for a while may spoil some round trips, not most.
    assert!(p90 < 1000.0, "{p90} ms");
    if let (Some(calm), Some(peak)) = (calm_kib, peak_kib) {
        assert!(peak < calm + 100 * 1024, "{calm} KiB grew to {peak} KiB");
        assert!(most_threads < 100, "{most_threads} threads");
    }
    assert!(said.lines().count() < 200 + 20 * seconds as usize, "the log is limited: {} lines", said.lines().count());
}
