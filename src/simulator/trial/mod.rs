//! A measured drive: one run, several runs, their statistics and their trajectories.

pub mod closed_loop;
pub mod drive;
pub mod observer;
mod pilot;
pub mod run;
pub mod statistics;
pub mod trajectory;
