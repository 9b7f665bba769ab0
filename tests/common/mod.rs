//! What several tests share.
#![allow(dead_code)] // Each test is a crate of its own and would warn of what only others use.

pub mod archive;
pub mod browser;
pub mod command;
pub mod double;
pub mod formula;
pub mod hammer;
pub mod mp4;
pub mod page;
pub mod painted_log;
pub mod served;
