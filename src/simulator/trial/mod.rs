//! A measured drive: one trial, many trials, their statistics and their trajectories.

pub mod closed_loop;
pub mod drive;
pub mod driver;
pub mod event;
pub mod outcome;
mod pilot;
pub mod run;
pub mod statistics;
pub mod summary;
pub mod trajectory;
pub mod wheel;
