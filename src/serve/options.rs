//! How to serve.

use std::net::SocketAddr;
use std::path::PathBuf;

use super::helm::HelmOptions;
use crate::udacity::DEFAULT_PORT;

/// How to serve.
#[derive(Clone, Debug)]
pub struct ServerOptions {
    /// Address to listen at; with port 0 the system chooses one.
    pub address: SocketAddr,
    /// How commands are made.
    pub helm: HelmOptions,
    /// Folder to record into, which must not exist.
    pub record: Option<PathBuf>,
    /// Origins of web pages that may connect; `*` is any.
    pub allowed_origins: Vec<String>,
    /// Whether to show every step and message.
    pub check: bool,
}

impl Default for ServerOptions {
    fn default() -> Self {
        ServerOptions {
            address: SocketAddr::from(([127, 0, 0, 1], DEFAULT_PORT)),
            helm: HelmOptions::default(),
            record: None,
            allowed_origins: Vec::new(),
            check: false,
        }
    }
}
