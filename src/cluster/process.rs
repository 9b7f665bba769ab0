//! What this process has of its machine.

use std::fs::read_to_string;
use std::thread::available_parallelism;

/// Cores of the machine, whether or not this process may use them.
pub(super) fn cores() -> usize {
    let listed = read_to_string("/proc/cpuinfo").map_or(0, |text| text.matches("\nprocessor\t").count() + 1);
    listed.max(available_parallelism().map_or(1, usize::from))
}

/// Largest resident memory of this process so far, in millions of bytes, where the system tells (Linux).
pub fn peak_memory_mb() -> Option<f64> {
    let status = read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    let kibibytes: f64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
    Some(kibibytes * 1024.0 / 1e6)
}
