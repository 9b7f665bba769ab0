//! A mutation harness without a special toolchain: something valid is damaged at random, from a seed, and read.

use std::alloc::System;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use cap::Cap;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A read that takes longer hangs, seconds.
const HANG_S: u64 = 120;

/// A number in an environment variable.
pub fn number<T: std::str::FromStr>(variable: &str, default: T) -> T {
    std::env::var(variable).ok().map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{variable}={text}")))
}

/// Damages `bytes` in one to eight places.
pub fn damage(random: &mut ChaCha8Rng, bytes: &mut Vec<u8>) {
    let mut below = |bound: usize| (random.next_u64() % bound.max(1) as u64) as usize;
    for _ in 0..=below(8) {
        let at = below(bytes.len());
        let end = (at + 1 + below(16)).min(bytes.len());
        match below(9) {
            0 => bytes[at..end].iter_mut().for_each(|byte| *byte = 0xff),
            1 => bytes[at..end].iter_mut().for_each(|byte| *byte = 0),
            2 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte ^= 1 << below(8);
                }
            }
            3 => {
                if let Some(byte) = bytes.get_mut(at) {
                    *byte = below(256) as u8;
                }
            }
            4 => bytes.truncate(at),
            5 => drop(bytes.drain(at..end)),
            // A part of the file in another place: addresses that lead elsewhere, nested brackets.
            6 => {
                let part = bytes[at..end].to_vec();
                let to = below(bytes.len());
                bytes.splice(to..to, part);
            }
            7 => {
                let part = bytes[at..end].to_vec();
                let to = below(bytes.len().saturating_sub(part.len()));
                for (byte, new) in bytes[to..].iter_mut().zip(part) {
                    *byte = new;
                }
            }
            // Numbers at the edge, as sizes and addresses.
            _ => {
                let edge = [0, 1, 0x7f, 0xffff, 0x7fff_ffff, 0xffff_ffff, 1 << 40, u64::MAX >> 1, bytes.len() as u64];
                let value = edge[below(edge.len())].to_le_bytes();
                for (byte, new) in bytes[at..].iter_mut().zip(value) {
                    *byte = new;
                }
            }
        }
    }
}

/// Damages a number or a word of a text, so that it often stays well-formed.
pub fn damage_text(random: &mut ChaCha8Rng, bytes: &mut Vec<u8>) {
    let below = |random: &mut ChaCha8Rng, bound: usize| (random.next_u64() % bound.max(1) as u64) as usize;
    if below(random, 3) == 0 {
        return damage(random, bytes);
    }
    for _ in 0..=below(random, 4) {
        let digits: Vec<usize> = (0..bytes.len()).filter(|i| bytes[*i].is_ascii_digit()).collect();
        if digits.is_empty() {
            return;
        }
        let at = digits[below(random, digits.len())];
        let words = [
            "0",
            "-1",
            "1e999",
            "99999999999",
            "4294967296",
            "null",
            "\"x\"",
            "[]",
            "{}",
            "[[1,2],3]",
            "0.5",
            "true",
            "65536",
        ];
        let word = words[below(random, words.len())].bytes();
        bytes.splice(at..at + 1, word);
    }
}

/// A model file or checkpoint as earlier versions wrote it.
pub fn without_digest(bytes: &[u8]) -> Vec<u8> {
    let header_len = u64::from_le_bytes(*bytes.first_chunk().unwrap()) as usize;
    let header = std::str::from_utf8(&bytes[8..8 + header_len]).unwrap();
    let seal = header.find(r#",\"sha256\":\""#).unwrap();
    let old = format!("{}{}", &header[..seal], &header[seal + r#",\"sha256\":\"\""#.len() + 64..]);
    [&(old.len() as u64).to_le_bytes()[..], old.as_bytes(), &bytes[8 + header_len..]].concat()
}

/// The harness of a test target.
pub struct Hammer {
    /// The allocator of the target. It counts every allocation, and the process ends at its limit.
    pub memory: &'static Cap<System>,
    /// Memory that one read may take, bytes.
    pub max_bytes: usize,
}

impl Hammer {
    /// Reads damaged versions of `original` for `seconds`, or for `STEERSMAN_FUZZ_SECONDS`, and prints what happened; nothing if `name` does
    /// not contain `STEERSMAN_FUZZ_ONLY`.
    ///
    /// # Panics
    ///
    /// If `read` panics, or `original` is refused, or no damage is. A read that hangs ends the process.
    pub fn strike<T: Clone>(
        &self,
        name: &str,
        original: &T,
        seconds: f64,
        damage: impl Fn(&mut ChaCha8Rng, &mut T),
        read: impl Fn(&T) -> Result<(), String>,
    ) {
        if std::env::var("STEERSMAN_FUZZ_ONLY").is_ok_and(|only| !name.contains(&only)) {
            return;
        }
        let seconds = number("STEERSMAN_FUZZ_SECONDS", seconds);
        let first = number("STEERSMAN_FUZZ_SEED", 1u64);
        let (mut accepted, mut refused, mut slowest) = (0, 0, Duration::ZERO);
        read(original).unwrap_or_else(|e| panic!("{name}: the undamaged one is refused: {e}"));
        let clock = Instant::now();
        let end = clock + Duration::from_secs_f64(seconds);
        // When the read that is under way began, in ms; 0 between two.
        let began_ms = AtomicU64::new(0);
        let done = std::sync::mpsc::channel::<()>();
        let allocated = self.memory.allocated();
        std::thread::scope(|scope| {
            let (stop, stopped) = done;
            scope.spawn({
                let began_ms = &began_ms;
                move || {
                    while stopped.recv_timeout(Duration::from_millis(500))
                        == Err(std::sync::mpsc::RecvTimeoutError::Timeout)
                    {
                        let began = began_ms.load(Ordering::Relaxed);
                        if began > 0 && clock.elapsed().as_millis() as u64 > began + 1000 * HANG_S {
                            println!("{name}: a read takes longer than {HANG_S} s");
                            std::process::exit(3);
                        }
                    }
                }
            });
            for seed in first.. {
                // A hundred at least, however slow the machine is.
                if Instant::now() > end && seed >= first + 100 {
                    break;
                }
                let mut damaged = original.clone();
                damage(&mut ChaCha8Rng::seed_from_u64(seed), &mut damaged);
                let started = Instant::now();
                began_ms.store(clock.elapsed().as_millis() as u64 + 1, Ordering::Relaxed);
                let _ = self.memory.set_limit(self.memory.allocated() + self.max_bytes);
                let result = catch_unwind(AssertUnwindSafe(|| read(&damaged)));
                let _ = self.memory.set_limit(usize::MAX);
                began_ms.store(0, Ordering::Relaxed);
                match result {
                    Ok(Ok(())) => accepted += 1,
                    Ok(Err(message)) => {
                        let fits = !message.is_empty() && message.len() < 100_000;
                        assert!(fits, "{name}, seed {seed}: {} bytes", message.len());
                        refused += 1;
                    }
                    Err(_) => panic!("{name}: panic with seed {seed}"),
                }
                slowest = slowest.max(started.elapsed());
            }
            drop(stop);
        });
        let peak_mb = self.memory.max_allocated() as f64 / (1 << 20) as f64;
        let kept_kb = self.memory.allocated().saturating_sub(allocated) >> 10;
        println!(
            "{name:<44} {:>8} inputs, {refused:>8} noticed, slowest {slowest:>8.1?}, peak so far {peak_mb:>5.1} MB, {kept_kb} KB kept",
            accepted + refused
        );
        assert!(refused > 0, "{name}: damage that is never noticed is no damage");
    }
}
