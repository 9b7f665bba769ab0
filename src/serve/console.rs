//! Where the server writes for the user.

/// Takes the lines for the user.
pub trait Console: Sync {
    /// A line that stays.
    fn line(&self, text: &str);
    /// The status line, which replaces the one before. The server sends one about each second while it drives a client.
    fn status(&self, text: &str);
}
