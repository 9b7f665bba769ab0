//! What several tests share. Not every test uses all of it.
#![allow(dead_code)]

pub mod browser;
pub mod command;
pub mod double;
pub mod formula;
pub mod page;
pub mod painted_log;
pub mod served;
