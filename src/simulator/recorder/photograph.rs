//! Taking the pictures of recordings, which is their work: it is shared out among the ranks.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::cluster::message::{Message, join, split_first, written};
use crate::cluster::tasks::Work;
use crate::simulator::recorder::expert_drive::drive_and_label;
use crate::simulator::recorder::options::RecordOptions;
use crate::simulator::recorder::sample::Sample;
use crate::simulator::recorder::writer::Photographer;
use crate::simulator::road::spec::TrackSpec;
use crate::simulator::scenery::light::Variant;
use crate::simulator::track::Track;
use crate::simulator::trial::wheel::Wheel;
use crate::{Error, Result};

/// What the pictures of all rows have in common.
pub(crate) struct Photographs {
    /// The tracks.
    pub tracks: Vec<TrackSpec>,
    /// For each recording its track, and how it is recorded.
    pub recordings: Vec<(usize, RecordOptions)>,
    /// Who drives where the rows are not known yet, and the share of the seconds in which the expert does it in their place.
    pub driver: Option<(Wheel, f64)>,
    pub recent: Recent,
}

/// Rows to take pictures of.
#[derive(Serialize, Deserialize)]
pub(crate) struct Part {
    /// The recording.
    pub recording: usize,
    /// Number of the first of these rows in it.
    pub first: usize,
    /// Some of its rows; all of them are driven now if there are none.
    pub rows: Option<Vec<Sample>>,
}

/// Rows and their pictures.
pub(crate) struct Taken {
    pub recording: usize,
    pub first: usize,
    pub rows: Vec<Sample>,
    /// JPEG files of the cameras of each row.
    pub pictures: Vec<Vec<Vec<u8>>>,
}

/// The results of a task.
pub(crate) struct Album(pub Vec<Taken>);

impl Work for Photographs {
    const NAME: &'static str = "record";
    type Task = Vec<Part>;
    type Done = Album;

    fn perform(&self, task: Vec<Part>) -> Result<Album> {
        let take = |part: Part| {
            let Part { recording, first, rows } = part;
            let (track, options) = &self.recordings[recording];
            let track = self.recent.track(*track, &self.tracks);
            let rows = match (rows, &self.driver) {
                (Some(rows), _) => rows,
                (None, Some((wheel, expert_share))) => {
                    drive_and_label(&track, options, wheel.driver().as_mut(), *expert_share)?
                }
                (None, None) => return Err(Error::Fault("nobody drives for a recording".into())),
            };
            // Built before the threads of the pool need it.
            let world = track.world();
            let variant = Variant::new(world, options.seed);
            let photographer = || Photographer::new(options.car.as_ref());
            let pictures =
                rows.par_iter().map_init(photographer, |photographer, row| photographer.take(world, &variant, row));
            let pictures = pictures.collect::<Result<_>>()?;
            Ok(Taken { recording, first, rows, pictures })
        };
        task.into_iter().map(take).collect::<Result<_>>().map(Album)
    }
}

/// Tracks with their visible worlds, as many as threads work on, and one more.
#[derive(Default)]
pub(crate) struct Recent(Mutex<VecDeque<(usize, Arc<Track>)>>);

impl Recent {
    /// Track number `number` of `tracks`.
    fn track(&self, number: usize, tracks: &[TrackSpec]) -> Arc<Track> {
        let mut recent = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let known = recent.iter().position(|(known, _)| *known == number).and_then(|place| recent.remove(place));
        let (_, track) = known.unwrap_or_else(|| (number, Arc::new(Track::again(tracks[number].clone()))));
        recent.push_front((number, track.clone()));
        recent.truncate(rayon::current_num_threads() + 1);
        track
    }
}

impl Message for Photographs {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let share = self.driver.as_ref().map(|(_, share)| share);
        let common = written(&(&self.tracks, &self.recordings, share))?;
        let wheel = self.driver.as_ref().map(|(wheel, _)| wheel.to_bytes()).transpose()?;
        Ok(join([common].into_iter().chain(wheel)))
    }

    fn of_bytes(bytes: &[u8]) -> Result<Photographs> {
        let ([common], wheel) = split_first::<1>(bytes)?;
        let (tracks, recordings, share): (_, _, Option<f64>) = Message::of_bytes(common)?;
        let wheel = wheel.first().map(|wheel| Wheel::of_bytes(wheel)).transpose()?;
        Ok(Photographs { tracks, recordings, driver: wheel.zip(share), recent: Recent::default() })
    }
}

impl Message for Album {
    fn to_bytes(&self) -> Result<Vec<u8>> {
        let taken = self.0.iter().map(|Taken { recording, first, rows, pictures }| {
            let head = (recording, first, rows, pictures.iter().map(Vec::len).collect::<Vec<usize>>());
            Ok(join([&written(&head)?].into_iter().chain(pictures.iter().flatten())))
        });
        Ok(join(taken.collect::<Result<Vec<_>>>()?))
    }

    fn of_bytes(bytes: &[u8]) -> Result<Album> {
        let taken = crate::cluster::message::split(bytes)?.into_iter().map(|taken| {
            let ([head], files) = split_first::<1>(taken)?;
            let (recording, first, rows, cameras): (_, _, Vec<Sample>, Vec<usize>) = Message::of_bytes(head)?;
            if cameras.len() != rows.len() || cameras.iter().sum::<usize>() != files.len() {
                return Err(Error::Fault("another rank sent other pictures than those of its rows".into()));
            }
            let mut files = files.into_iter().map(<[u8]>::to_vec);
            let pictures = cameras.into_iter().map(|cameras| files.by_ref().take(cameras).collect()).collect();
            Ok(Taken { recording, first, rows, pictures })
        });
        taken.collect::<Result<_>>().map(Album)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::recorder::expert_drive::drive_expert;

    #[test]
    fn pictures_and_rows_come_back_as_they_were_sent_and_are_those_of_another_rank() {
        let track = Track::load("random:2").unwrap();
        let options = RecordOptions { laps: 0.01, seed: 4, ..RecordOptions::default() };
        let rows = drive_expert(&track, &options);
        assert!(rows.len() > 3);
        let work = Photographs {
            tracks: vec![track.spec.clone()],
            recordings: vec![(0, options)],
            driver: Some((Wheel::Zero, 0.5)),
            recent: Recent::default(),
        };
        let sent = Photographs::of_bytes(&work.to_bytes().unwrap()).unwrap();
        for rows in [Some(rows[1..4].to_vec()), None] {
            let task = || vec![Part { recording: 0, first: 1, rows: rows.clone() }];
            let task_sent = Vec::<Part>::of_bytes(&task().to_bytes().unwrap()).unwrap();
            let [here, there] = [work.perform(task()), sent.perform(task_sent)].map(|album| album.unwrap());
            let there = Album::of_bytes(&there.to_bytes().unwrap()).unwrap();
            let [here, there] = [&here.0[0], &there.0[0]];
            assert_eq!((here.recording, here.first, &here.rows), (there.recording, there.first, &there.rows));
            assert!(here.pictures == there.pictures && here.pictures.len() == here.rows.len());
            assert!(here.pictures.iter().all(|cameras| cameras.len() == 3));
        }
    }

    #[test]
    fn few_tracks_are_kept() {
        let tracks: Vec<TrackSpec> =
            (1..7).map(|seed| Track::load(&format!("random:{seed}")).unwrap().spec.clone()).collect();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(2).build().unwrap();
        let recent = Recent::default();
        pool.install(|| {
            let first = recent.track(0, &tracks);
            assert!(Arc::ptr_eq(&first, &recent.track(0, &tracks)));
            (1..6).for_each(|number| drop(recent.track(number, &tracks)));
            assert!(recent.0.lock().unwrap().len() == 3 && !Arc::ptr_eq(&first, &recent.track(0, &tracks)));
        });
    }
}
