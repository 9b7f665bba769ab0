//! Counts of the answers, and the summary at the end.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::Serialize;

use super::journal::Incident;
use super::latency::Latencies;
use super::recording::Recorded;
use crate::udacity::Command;

/// What the server did.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Telemetries that were answered with a command.
    pub frames: u64,
    /// Time between the first and the last of them, s.
    pub seconds: f64,
    /// Frames answered per second.
    pub frames_per_second: Option<f64>,
    /// Latency from the last byte of telemetry to its command: median, ms.
    pub latency_p50_ms: Option<f64>,
    /// Latency: 99th percentile, ms.
    pub latency_p99_ms: Option<f64>,
    /// Latency: longest, ms.
    pub latency_max_ms: Option<f64>,
    /// Telemetries that were not answered because newer ones had arrived.
    pub superseded: u64,
    /// Connections accepted.
    pub connections: u64,
    /// How often each kind of incident happened.
    #[serde(rename = "events")]
    pub incidents: BTreeMap<Incident, u64>,
    /// The recording.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub recorded: Option<Recorded>,
}

/// Counts of the answers so far.
#[derive(Debug, Default)]
pub(crate) struct Statistics {
    pub superseded: u64,
    frames: u64,
    /// Arrival of the first answered telemetry, and of the last.
    first: Option<Instant>,
    last: Option<Instant>,
    all: Latencies,
    /// Latencies since the last status line.
    recent: Latencies,
    command: Command,
    speed_mph: f64,
}

impl Statistics {
    /// Counts an answer: telemetry arrived at `arrived`, its command left at `sent`.
    pub fn answered(&mut self, arrived: Instant, sent: Instant, command: Command, speed_mph: f64) {
        let latency = sent.saturating_duration_since(arrived);
        self.frames += 1;
        self.first.get_or_insert(arrived);
        self.last = Some(arrived);
        self.all.add(latency);
        self.recent.add(latency);
        (self.command, self.speed_mph) = (command, speed_mph);
    }

    /// The status line for the last `seconds`; `None` if nothing was answered in that time.
    pub fn status(&mut self, seconds: f64) -> Option<String> {
        let (p50, p99) = (self.recent.quantile_ms(0.5)?, self.recent.quantile_ms(0.99)?);
        let rate = self.recent.total() as f64 / seconds;
        self.recent.clear();
        let (steering, mph) = (self.command.steering, self.speed_mph);
        Some(format!(
            "{rate:.1} frames/s  latency p50 {p50:.2} p99 {p99:.2} ms  steering {steering:+.3}  speed {mph:.1} mph"
        ))
    }

    /// The summary of a server that had `connections`.
    pub fn summary(self, connections: u64, incidents: BTreeMap<Incident, u64>, recorded: Option<Recorded>) -> Summary {
        let seconds = match (self.first, self.last) {
            (Some(first), Some(last)) => last.duration_since(first).as_secs_f64(),
            _ => 0.0,
        };
        Summary {
            frames: self.frames,
            seconds,
            frames_per_second: (seconds > 0.0).then(|| (self.frames - 1) as f64 / seconds),
            latency_p50_ms: self.all.quantile_ms(0.5),
            latency_p99_ms: self.all.quantile_ms(0.99),
            latency_max_ms: self.all.longest_ms(),
            superseded: self.superseded,
            connections,
            incidents,
            recorded,
        }
    }
}
