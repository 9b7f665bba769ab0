//! The messages of the server.

use super::EngineVersion;
use super::number::{NumberStyle, print_number, push};
use super::{PING_INTERVAL_MS, PING_TIMEOUT_MS};

/// A command for the car.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Command {
    /// Steering, [-1, 1], + = right.
    pub steering: f32,
    /// Accelerator from 0 to 1, brake from 0 to -1.
    pub throttle: f32,
}

/// Appends a `steer` event. Each number is the shortest decimal without exponent that reads back as the same `f32`, the type
/// of the simulator. A number that is not finite becomes 0, because the simulator would drop the message and wait for ever.
pub(crate) fn print_steer(out: &mut String, command: Command, style: NumberStyle) {
    out.push_str("42[\"steer\",{\"steering_angle\":");
    print_number(out, command.steering, style);
    out.push_str(",\"throttle\":");
    print_number(out, command.throttle, style);
    out.push_str("}]");
}

/// Appends the `manual` event: the client answers with telemetry, and its command stays the same.
pub(crate) fn print_manual(out: &mut String) {
    out.push_str("42[\"manual\",{}]");
}

/// Appends the acknowledgement with the number `ack`.
pub(crate) fn print_ack(out: &mut String, ack: u64) {
    push(out, format_args!("43{ack}[]"));
}

/// Appends the packet that opens a session.
pub(crate) fn print_open(out: &mut String, version: EngineVersion, sid: &str) {
    push(
        out,
        format_args!(
            "0{{\"sid\":\"{sid}\",\"upgrades\":[],\"pingInterval\":{PING_INTERVAL_MS},\"pingTimeout\":{PING_TIMEOUT_MS}"
        ),
    );
    if version == EngineVersion::V4 {
        out.push_str(",\"maxPayload\":1000000");
    }
    out.push('}');
}

/// Appends the packet that connects a client to `/`.
pub(crate) fn print_connected(out: &mut String, version: EngineVersion, sid: &str) {
    match version {
        EngineVersion::V3 => out.push_str("40"),
        EngineVersion::V4 => push(out, format_args!("40{{\"sid\":\"{sid}\"}}")),
    }
}

/// Appends the refusal of a namespace other than `/`.
pub(crate) fn print_namespace_refused(out: &mut String, version: EngineVersion, namespace: &str) {
    match version {
        EngineVersion::V3 => push(out, format_args!("44{namespace},\"Invalid namespace\"")),
        EngineVersion::V4 => push(out, format_args!("44{namespace},{{\"message\":\"Invalid namespace\"}}")),
    }
}
