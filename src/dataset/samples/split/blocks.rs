//! The split by blocks of time, and copies of pictures, which never stand on both sides.

use super::{GUARD_MS, LONG_SESSION_S, Split, rows_of};
use crate::dataset::recording::Recording;
use crate::dataset::samples::Item;
use crate::engine::random::{Purpose, rng, shuffle, unit};
use std::collections::{HashMap, HashSet};
use std::ops::Range;

/// Shortest session, in seconds, that is cut where no validation rows could be had otherwise.
const SHORTEST_CUT_S: f64 = 10.0;

impl Split {
    pub(super) fn by_blocks(&mut self, recordings: &[Recording], seed: u64) {
        let share = self.spec.validation_share;
        let copies = Copies::of(recordings);
        let mut runs_of_copies = Vec::new();
        let mut short = Vec::new();
        let mut number = 0;
        for (i, recording) in recordings.iter().enumerate() {
            if !recording.times_plausible {
                let path = recording.path.display();
                let hz = recording.rate_hz().unwrap_or(0.0);
                self.notices
                    .push(format!("{path}: blocks of time are counted at {hz:.0} Hz, time stamps are implausible"));
            }
            for session in &recording.sessions {
                number += 1;
                let (own, runs) = copies.pieces(recording, i as u16, session);
                runs_of_copies.extend(runs.into_iter().map(|run| (i as u16, run)));
                for session in own {
                    if recording.session_s(&session) >= LONG_SESSION_S {
                        self.cut(recording, i as u16, &session, seed, number);
                    } else {
                        short.push((i as u16, session, number));
                    }
                }
            }
        }
        // Short sessions go whole to one side, in random order, as long as validation keeps to its share of them.
        let rows: usize = short.iter().map(|(_, session, _)| session.len()).sum();
        let mut room = (share * rows as f64).round() as usize;
        shuffle(&mut rng(seed, Purpose::Split, 0, 0), &mut short);
        let mut kept = Vec::new();
        for (i, session, number) in short {
            if session.len() <= room {
                room -= session.len();
                self.validation.extend(rows_of(i, session));
            } else {
                kept.push((i, session, number));
            }
        }
        let nothing_held_out = self.validation.is_empty() && share > 0.0;
        if nothing_held_out {
            self.notices.push(
                "no session is 60 s long and none is short enough to be held out whole: \
                 those of at least 10 s are cut, with a guard"
                    .into(),
            );
        }
        for (i, session, number) in kept {
            let recording = &recordings[usize::from(i)];
            if nothing_held_out && recording.session_s(&session) >= SHORTEST_CUT_S {
                self.cut(recording, i, &session, seed, number);
            } else {
                self.training.extend(rows_of(i, session));
            }
        }
        self.training.sort_unstable();
        self.validation.sort_unstable();
        self.settle_copies(&copies, &runs_of_copies);
    }

    /// Cuts validation blocks out of a session.
    fn cut(&mut self, recording: &Recording, i: u16, session: &Range<usize>, seed: u64, number: u64) {
        let share = self.spec.validation_share;
        let start_ms = recording.rows[session.start].time_ms;
        let periods = (recording.session_s(session) / LONG_SESSION_S).floor().max(1.0);
        let period_ms = recording.session_s(session) * 1000.0 / periods;
        let mut rng = rng(seed, Purpose::Split, 0, number);
        let blocks: Vec<Range<i64>> = (0..periods as usize)
            .filter(|_| share > 0.0)
            .map(|period| {
                let begin = (period as f64 + unit(&mut rng) * (1.0 - share)) * period_ms;
                start_ms + begin as i64..start_ms + (begin + share * period_ms) as i64
            })
            .collect();
        for row in session.clone() {
            let time_ms = recording.rows[row].time_ms;
            let item = rows_of(i, row..row + 1);
            if blocks.iter().any(|block| block.contains(&time_ms)) {
                self.validation.extend(item);
            } else if blocks.iter().any(|b| (b.start - GUARD_MS..b.end + GUARD_MS).contains(&time_ms)) {
                self.guard_rows += 1;
            } else {
                self.training.extend(item);
            }
        }
    }

    /// Puts rows that show the picture of an earlier row on its side. Those of long runs of copies stand on no side yet; single
    /// ones that stand on another side than their picture are used on neither: it never stands on both.
    fn settle_copies(&mut self, copies: &Copies, runs: &[(u16, Range<usize>)]) {
        if copies.0.is_empty() {
            return;
        }
        let places = |side: &[Item]| -> HashSet<Place> { side.iter().map(|item| (item.recording, item.row)).collect() };
        let sides = [places(&self.training), places(&self.validation)];
        let mut dropped = 0;
        for (side, places) in [&mut self.training, &mut self.validation].into_iter().zip(&sides) {
            let before = side.len();
            side.retain(|item| copies.first(item.recording, item.row).is_none_or(|first| places.contains(&first)));
            dropped += before - side.len();
            let followers = runs.iter().flat_map(|(i, run)| rows_of(*i, run.clone()));
            side.extend(
                followers
                    .filter(|item| copies.first(item.recording, item.row).is_some_and(|first| places.contains(&first))),
            );
            side.sort_unstable();
        }
        self.notices.push(format!(
            "{} rows show the same picture as an earlier row (the log, or a recording, is there twice, or the car stands): they \
             stand on its side, {dropped} of them on neither",
            copies.0.len()
        ));
    }
}

/// A row: number of its recording, and its own.
type Place = (u16, u32);

/// Rows that show the picture of an earlier row, byte for byte, each with the first such row.
struct Copies(HashMap<Place, Place>);

impl Copies {
    /// Finds copies among the rows whose pictures were hashed.
    fn of(recordings: &[Recording]) -> Copies {
        let (mut first, mut copies) = (HashMap::new(), HashMap::new());
        for (i, recording) in recordings.iter().enumerate() {
            for row in 0..recording.rows.len() {
                let Some(hash) = recording.picture_hash(row) else { break };
                let here = (i as u16, row as u32);
                let earlier = *first.entry(hash).or_insert(here);
                if earlier != here {
                    copies.insert(here, earlier);
                }
            }
        }
        Copies(copies)
    }

    /// The first row with the picture of a row, unless that is the first one itself.
    fn first(&self, recording: u16, row: u32) -> Option<Place> {
        self.0.get(&(recording, row)).copied()
    }

    /// Takes the runs of copies out of a session that last as long as a guard: what remains of it, and the runs.
    fn pieces(&self, recording: &Recording, i: u16, session: &Range<usize>) -> (Vec<Range<usize>>, Vec<Range<usize>>) {
        if self.0.is_empty() {
            return (vec![session.clone()], Vec::new());
        }
        let (mut own, mut runs, mut begin) = (Vec::new(), Vec::new(), session.start);
        let is_copy = |row: &usize| self.first(i, *row as u32).is_some();
        let mut row = session.start;
        while row < session.end {
            let end = (row..session.end).find(|row| !is_copy(row)).unwrap_or(session.end);
            let run = row..end;
            let lasts_ms =
                if run.is_empty() { 0 } else { recording.rows[end - 1].time_ms - recording.rows[row].time_ms };
            if !run.is_empty() && (lasts_ms >= GUARD_MS || run == *session) {
                own.extend((begin < row).then_some(begin..row));
                runs.push(run);
                begin = end;
            }
            row = end.max(row + 1);
        }
        own.extend((begin < session.end).then_some(begin..session.end));
        (own, runs)
    }
}
