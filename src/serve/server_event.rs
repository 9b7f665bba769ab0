//! What a server tells its observer.

/// A message for the user.
#[derive(Clone, Debug, PartialEq)]
pub enum ServeEvent {
    /// A line of the log.
    Line(String),
    /// The status line, which replaces the one before. The server sends one about each second while it drives a client.
    Status(String),
}
