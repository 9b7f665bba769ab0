//! A team of threads in the place of processes.

use std::sync::Mutex;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::Duration;

use super::Team;
use crate::engine::network::Ranks;

/// One of several ranks that can send each other messages, and nothing else.
#[derive(Debug)]
pub struct Thread {
    rank: usize,
    to: Vec<Sender<(usize, Vec<u8>)>>,
    messages: Mutex<Receiver<(usize, Vec<u8>)>>,
}

/// The ranks of a team.
pub fn team(ranks: usize) -> Vec<Thread> {
    let (to, messages): (Vec<_>, Vec<_>) = (0..ranks).map(|_| channel()).unzip();
    let rank = |(rank, messages)| Thread { rank, to: to.clone(), messages: Mutex::new(messages) };
    messages.into_iter().enumerate().map(rank).collect()
}

impl Ranks for Thread {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.to.len()
    }

    fn gather_f64(&self, _: &[f64], _: &[usize], _: &mut [f64]) {
        unreachable!("nothing is gathered")
    }

    fn gather_f32(&self, _: &[f32], _: &[usize], _: &mut [f32]) {
        unreachable!("nothing is gathered")
    }

    fn exchange_f32(&self, _: &[f32], _: &[usize], _: &mut [f32], _: &[usize]) {
        unreachable!("nothing is exchanged")
    }
}

impl Team for Thread {
    fn gather_bytes(&self, _: &[u8]) -> Vec<Vec<u8>> {
        unreachable!("nothing is gathered")
    }

    fn send(&self, to: usize, message: &[u8]) {
        self.to[to].send((self.rank, message.to_vec())).expect("the other rank is there");
    }

    fn try_receive(&self) -> Option<(usize, Vec<u8>)> {
        self.messages.lock().unwrap().try_recv().ok()
    }

    fn on_this_machine(&self) -> usize {
        self.size()
    }

    fn sent_bytes(&self) -> u64 {
        0
    }

    fn met(&self) -> Duration {
        Duration::ZERO
    }
}
