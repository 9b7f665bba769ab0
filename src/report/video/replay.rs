//! The video of a drive that was saved: the simulator's camera goes along the trajectory again.

use std::path::{Path, PathBuf};

use super::film::{Video, ended_early};
use super::lettering::end_of;
use super::onlooker::Onlooker;
use super::painter::{Captions, FilmFrame, FilmScales, Painter};
use super::summary::VideoSummary;
use crate::error::{Error, Result};
use crate::observer::{Observer, Progress};
use crate::picture::RgbImage;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::car::dynamics::{MAX_STEER_DEG, MPS_PER_MPH};
use crate::simulator::car::expert;
use crate::simulator::trial::outcome::DRIVE_HZ;
use crate::simulator::trial::trajectory::{Waypoint, read_summary, read_trajectory, trajectories};
use crate::simulator::{HEIGHT, Simulation, Track, WIDTH};

/// Which run of a drive, and how.
#[derive(Clone, Copy, Debug, Default)]
pub struct RunChoice {
    /// Its seed; the first there is if none is given.
    pub seed: Option<u64>,
    /// The run in which the car was put back, instead of the one in which nobody helped.
    pub assisted: bool,
}

/// Writes the video of a run of the drive in `folder` to the new file `out`. What steered is drawn as it was saved; an
/// `onlooker` steers in its place, without changing the way. `observer` and the result are as in
/// [`recording::film`](super::recording::film).
///
/// # Errors
///
/// [`Error::Usage`] if there is no such run, [`Error::Data`] for files that are not as `drive --out` writes them; as
/// [`Video::create`] and [`Track::load`].
pub fn film(
    folder: &Path,
    choice: RunChoice,
    out: &Path,
    mut onlooker: Option<Onlooker>,
    fps: Option<f64>,
    observer: &mut dyn Observer<Progress>,
) -> Result<(VideoSummary, bool)> {
    let (seed, path) = choose(folder, choice)?;
    let track = Track::load(&read_summary(folder)?.track)?;
    let way = read_trajectory(&path)?;
    let poses: Vec<f64> = way.iter().map_while(|waypoint| waypoint.heading_deg).collect();
    if poses.len() < way.len() {
        let message =
            "there is no column heading_deg, without which the camera has no direction; drive again with --out";
        return Err(Error::data(&path, message));
    }
    let Some(first) = way.first() else {
        return Err(Error::data(&path, "the trajectory has no rows"));
    };
    let speed_mps = |waypoint: &Waypoint| waypoint.speed_mph * MPS_PER_MPH;
    let mut simulation = Simulation::posed(&track, [first.x_m, first.y_m], poses[0], speed_mps(first));
    let kind = if choice.assisted { "assisted" } else { "free" };
    let names = Captions {
        title: format!("{}, {kind}, seed {seed}", track.name()),
        subtitle: end_of(&folder.display().to_string(), 36),
        model: Some(if onlooker.is_some() { "model" } else { "driver" }),
        reference: "expert",
    };
    let mut angles: Vec<f64> = way.iter().map(|waypoint| waypoint.steering * MAX_STEER_DEG).collect();
    for (waypoint, heading_deg) in way.iter().zip(&poses) {
        simulation.pose([waypoint.x_m, waypoint.y_m], *heading_deg, speed_mps(waypoint));
        angles.push(expert::pursuit(&simulation) * MAX_STEER_DEG);
    }
    let scales = FilmScales::covering(angles.into_iter(), way.iter().map(|waypoint| waypoint.cte_m));
    let mut simulation = Simulation::posed(&track, [first.x_m, first.y_m], poses[0], speed_mps(first));
    let saliency = onlooker.as_ref().is_some_and(Onlooker::colours);
    let painter = Painter::new(names, scales, Some(&track), saliency);
    let mut video = Video::create(out, painter, fps.unwrap_or(DRIVE_HZ as f64))?;
    let mut eye = FrontCamera::new(&track, seed);
    let mut frame = FilmFrame { picture: RgbImage::filled(HEIGHT, WIDTH, [0; 3]), ..FilmFrame::default() };
    let (mut stopped, mut put_back) = (false, 0);
    for (k, (waypoint, heading_deg)) in way.iter().zip(&poses).enumerate() {
        simulation.pose([waypoint.x_m, waypoint.y_m], *heading_deg, speed_mps(waypoint));
        frame.picture.pixels.clone_from(&eye.look(&simulation)?.pixels);
        let looked = onlooker.as_mut().map(|onlooker| onlooker.look(&mut frame.picture)).transpose()?;
        frame.time_s = waypoint.time_s;
        frame.model_deg = Some(looked.map_or(waypoint.steering * MAX_STEER_DEG, |(deg, _)| deg));
        frame.answered_in = looked.map(|(_, took)| took);
        frame.reference_deg = Some(expert::pursuit(&simulation) * MAX_STEER_DEG);
        frame.speed_mph = Some(waypoint.speed_mph);
        frame.cte_m = Some(waypoint.cte_m);
        frame.lap = Some(((simulation.progress_m / track.length_m).max(0.0) as usize + 1, None));
        frame.place = Some([waypoint.x_m, waypoint.y_m]);
        frame.put_back = waypoint.intervention > 0;
        put_back += usize::from(frame.put_back);
        video.show(&frame)?;
        if ended_early(observer.observe(Progress((k + 1) as f64 / way.len() as f64)))? {
            stopped = true;
            break;
        }
    }
    let text = match (stopped, put_back) {
        (true, _) => "stopped".into(),
        (false, 0) => format!("end of the run after {:.1} s", frame.time_s),
        (false, times) => format!("{:.1} s, put back {times} times", frame.time_s),
    };
    Ok((video.finish(&text)?, stopped))
}

fn choose(folder: &Path, choice: RunChoice) -> Result<(u64, PathBuf)> {
    let kind = if choice.assisted { "assisted" } else { "free" };
    let found: Vec<_> = trajectories(folder).into_iter().filter(|(of_kind, ..)| of_kind == kind).collect();
    let seeds: Vec<String> = found.iter().map(|(_, seed, _)| seed.to_string()).collect();
    let chosen = found.into_iter().find(|(_, seed, _)| choice.seed.is_none_or(|wanted| wanted == *seed));
    chosen.map(|(_, seed, path)| (seed, path)).ok_or_else(|| {
        let wanted = choice.seed.map_or(String::new(), |seed| format!(" with seed {seed}"));
        let there =
            if seeds.is_empty() { "there are none".into() } else { format!("seeds there: {}", seeds.join(", ")) };
        Error::Usage(format!("{}: no {kind} run{wanted}; {there}", folder.display()))
    })
}
