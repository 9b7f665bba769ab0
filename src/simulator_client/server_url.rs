//! The address of the server.

use std::fmt;
use std::str::FromStr;

use crate::{Error, Result};

/// The address of a server: `ws://HOST:PORT/PATH`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ServerUrl {
    /// Host and port as they stand in the URL.
    authority: String,
    /// Path and query.
    path: String,
}

impl Default for ServerUrl {
    fn default() -> Self {
        ServerUrl::DEFAULT.parse().expect("the built-in address is one")
    }
}

impl ServerUrl {
    /// The address that is built into Udacity's simulator.
    pub const DEFAULT: &str = "ws://127.0.0.1:4567/socket.io/?EIO=4&transport=websocket";

    /// What stands in the `Host` header.
    pub(super) fn host(&self) -> &str {
        self.authority.strip_suffix(":80").unwrap_or(&self.authority)
    }

    /// Path and query.
    pub(super) fn path(&self) -> &str {
        &self.path
    }

    /// `host:port` to connect to.
    pub(super) fn address(&self) -> String {
        let has_port = self.authority.rsplit_once(':').is_some_and(|(_, port)| port.parse::<u16>().is_ok());
        if has_port { self.authority.clone() } else { format!("{}:80", self.authority) }
    }
}

impl FromStr for ServerUrl {
    type Err = Error;

    fn from_str(text: &str) -> Result<ServerUrl> {
        let fail = |what: &str| Err(Error::Usage(format!("{text}: {what}; as in {}", ServerUrl::default())));
        let Some(rest) = text.strip_prefix("ws://") else {
            return fail("an address that begins with ws:// is meant");
        };
        let at = rest.find(['/', '?']).unwrap_or(rest.len());
        let (authority, path) = rest.split_at(at);
        if authority.is_empty() || authority.contains(['@', '#', ' ']) || path.contains(['#', ' ', '\r', '\n']) {
            return fail("no host and port, or something else than path and query behind them");
        }
        let path = match path {
            "" | "/" => ServerUrl::default().path,
            path if path.starts_with('?') => format!("/{path}"),
            path => path.into(),
        };
        Ok(ServerUrl { authority: authority.into(), path })
    }
}

impl fmt::Display for ServerUrl {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "ws://{}{}", self.authority, self.path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses() {
        for (text, address, shown) in [
            ("ws://127.0.0.1:4567", "127.0.0.1:4567", "ws://127.0.0.1:4567/socket.io/?EIO=4&transport=websocket"),
            ("ws://host:9/?EIO=3", "host:9", "ws://host:9/?EIO=3"),
            ("ws://host/x", "host:80", "ws://host/x"),
            ("ws://[::1]:7?y", "[::1]:7", "ws://[::1]:7/?y"),
        ] {
            let url: ServerUrl = text.parse().unwrap();
            assert_eq!((url.address().as_str(), url.to_string().as_str()), (address, shown));
        }
        for bad in ["127.0.0.1:4567", "http://x", "ws://", "ws:///x", "ws://a b", "ws://x/\r\ny"] {
            assert!(bad.parse::<ServerUrl>().unwrap_err().to_string().contains("as in ws://127.0.0.1:4567"), "{bad}");
        }
    }
}
