//! A track from above, with the way a car took, coloured by its distance from the line. The colours cover the range of
//! `RANGES_M` that most of the way lies in.

use super::chart::NARROW;
use super::palette::{INK, QUIET_INK, ROAD, ROAD_EDGE, heat_hex};
use crate::error::{Error, Result};
use crate::files::new_folder::NewFolder;
use crate::geometry::{DrivenPath, Offset, Pose};
use crate::replay::MAX_OFFSET_M;
use crate::report::charts::svg::{Anchor, Svg};
use crate::simulator::trial::outcome::Moment;
use crate::simulator::{DriveResult, DriveSummary, Track};

/// Distances from the line that may have the darkest colour, m.
pub(crate) const RANGES_M: [f64; 5] = [0.25, 0.5, 1.0, 2.0, 5.0];
/// Share of the way that lies below the darkest colour.
const COVERED: f64 = 0.98;
/// Steps of colour.
pub(crate) const COLOURS: usize = 8;

/// A moment of a drive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapPoint {
    /// East, m.
    pub x: f64,
    /// North, m.
    pub y: f64,
    /// Distance from the line, m, + = right as driven.
    pub cte_m: f64,
    /// Whether the car was just put back.
    pub put_back: bool,
}

/// Size of a map on its own, pixels.
const PAGE: [f64; 2] = [760.0, 620.0];

/// Writes the map of a drive on `track`, `map.svg`, into `folder`: its assisted runs, which are the free ones where nobody had to
/// help.
///
/// # Errors
///
/// If it cannot be written.
pub fn write(track: &Track, result: &DriveResult, folder: &NewFolder) -> Result<()> {
    let place = |m: &Moment| MapPoint { x: m.x, y: m.y, cte_m: m.cte_m, put_back: m.intervention };
    let drives: Vec<Vec<MapPoint>> =
        result.trials.iter().map(|pair| pair.assisted.moments.iter().map(place).collect()).collect();
    let DriveSummary { runs, interventions, .. } = result.summary;
    let title = format!("{}, runs: {runs}, put back: {interventions}", track.name());
    let path = folder.unfinished().join("map.svg");
    let written = std::fs::write(&path, draw(&title, Some(track), &drives, PAGE));
    written.map_err(|source| folder.explain(Error::Io { path, source }))
}

/// The distance from the line, m, that has the darkest colour where a car was as far from it as `cte_m`: of `RANGES_M` the
/// smallest that covers nearly all of them.
pub(crate) fn darkest_m(cte_m: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = cte_m.map(f64::abs).filter(|m| m.is_finite()).collect();
    sorted.sort_by(f64::total_cmp);
    let covered = sorted.get((COVERED * sorted.len() as f64) as usize).or(sorted.last()).copied().unwrap_or(0.0);
    RANGES_M.into_iter().find(|range| covered <= *range).unwrap_or(RANGES_M[RANGES_M.len() - 1])
}

/// As [`draw`], for a page: on wide ground and on a phone. Maps that are to be compared are given the same `darkest_m`.
pub(crate) fn figure(title: &str, track: Option<&Track>, drives: &[Vec<MapPoint>], darkest_m: f64) -> String {
    let [wide, narrow] = [[552.0, 430.0], [NARROW, 340.0]].map(|size| draw_at(title, track, drives, size, darkest_m));
    format!("<figure><div class=\"wide\">{wide}</div><div class=\"narrow\">{narrow}</div></figure>\n")
}

/// Draws `drives` on `track`, if it is known, within `size` (width, height) pixels.
pub fn draw(title: &str, track: Option<&Track>, drives: &[Vec<MapPoint>], size: [f64; 2]) -> String {
    draw_at(title, track, drives, size, darkest_m(drives.iter().flatten().map(|point| point.cte_m)))
}

/// Draws `drive` along the `path` of a recording, within `size` (width, height) pixels: on the ground where the car is not put back.
pub fn draw_on_path(title: &str, path: &DrivenPath, drive: &[MapPoint], size: [f64; 2]) -> String {
    let edge = |right_m: f64| -> Vec<[f64; 2]> {
        let beside = |pose: &Pose| pose.displaced(Offset { right_m, ..Offset::default() });
        path.poses().iter().map(beside).map(|pose| [pose.x_m, pose.y_m]).collect()
    };
    let (edges, drives) = (vec![edge(MAX_OFFSET_M), edge(-MAX_OFFSET_M)], [drive.to_vec()]);
    draw_between(title, &edges, &drives, size, darkest_m(drive.iter().map(|point| point.cte_m)))
}

fn draw_at(title: &str, track: Option<&Track>, drives: &[Vec<MapPoint>], size: [f64; 2], darkest_m: f64) -> String {
    draw_between(title, &track.map(edges).unwrap_or_default(), drives, size, darkest_m)
}

/// Draws `drives` and the road between `edges`, two or none.
fn draw_between(
    title: &str,
    edges: &[Vec<[f64; 2]>],
    drives: &[Vec<MapPoint>],
    size: [f64; 2],
    darkest_m: f64,
) -> String {
    let mut svg = Svg::new(size[0], size[1]);
    svg.text([14.0, 22.0], 15.0, Anchor::Start, "font-weight=\"600\"", title);
    let driven = drives.iter().flatten().map(|place| [place.x, place.y]);
    let corners = edges.iter().flatten().copied().chain(driven);
    let within = [16.0, 36.0, size[0] - 16.0, size[1] - 58.0];
    let Some(projection) = Projection::fitting(corners, within) else {
        svg.text([14.0, 50.0], 13.0, Anchor::Start, "", "nothing was driven");
        return svg.finish();
    };
    let place = |point| projection.place(point);

    if let [outer, inner] = edges {
        let around: Vec<[f64; 2]> = outer.iter().chain(inner.iter().rev()).map(|p| place(*p)).collect();
        svg.polygon(&around, &format!("fill=\"{ROAD}\""));
        for edge in [outer, inner] {
            svg.polyline(
                &edge.iter().map(|p| place(*p)).collect::<Vec<_>>(),
                &format!("stroke=\"{ROAD_EDGE}\" stroke-width=\"0.8\""),
            );
        }
    }
    for drive in drives {
        way(&mut svg, drive, darkest_m, &place);
    }
    legend(&mut svg, size, darkest_m, &projection);
    svg.finish()
}

/// How a map lies in a picture: north is up, and both directions have one scale.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Projection {
    /// Pixels for each metre.
    pub scale: f64,
    shift: [f64; 2],
}

impl Projection {
    /// The largest map that shows `points`, m, `within` (left, top, right, bottom) pixels. `None` without a point.
    pub fn fitting(points: impl Iterator<Item = [f64; 2]>, within: [f64; 4]) -> Option<Projection> {
        let points = points.filter(|p| p.iter().all(|v| v.is_finite()));
        let (low, high) = points.fold(([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]), |(low, high), [x, y]| {
            ([low[0].min(x), low[1].min(y)], [high[0].max(x), high[1].max(y)])
        });
        let [left, top, right, bottom] = within;
        let scale = ((right - left) / (high[0] - low[0]).max(1.0)).min((bottom - top) / (high[1] - low[1]).max(1.0));
        let shift =
            [(right + left - scale * (low[0] + high[0])) / 2.0, (bottom + top + scale * (low[1] + high[1])) / 2.0];
        (low[0] <= high[0]).then_some(Projection { scale, shift })
    }

    /// Where a point of the world (x, y), m, is in the picture (x, y), pixels.
    pub fn place(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [self.shift[0] + self.scale * x, self.shift[1] - self.scale * y]
    }

    /// The longest round length, m, of at most `most_px` pixels, for a scale bar.
    pub fn bar_m(&self, most_px: f64) -> f64 {
        [10.0, 20.0, 50.0, 100.0, 200.0].into_iter().rfind(|m| m * self.scale <= most_px).unwrap_or(10.0)
    }
}

/// Which of the [`COLOURS`] steps of colour a distance from the line has.
fn step(cte_m: f64, darkest_m: f64) -> usize {
    ((cte_m.abs() / darkest_m * COLOURS as f64) as usize).min(COLOURS - 1)
}

/// The place in [`heat`](crate::report::charts::palette::heat) of a step of colour; the lightest would not show on the road.
pub(crate) fn step_share(step: usize) -> f64 {
    0.25 + 0.75 * step as f64 / (COLOURS - 1) as f64
}

/// The place in [`heat`](crate::report::charts::palette::heat) of a distance from the line, m.
pub(crate) fn share(cte_m: f64, darkest_m: f64) -> f64 {
    step_share(step(cte_m, darkest_m))
}

/// Right and left edge of the road, closed.
pub(crate) fn edges(track: &Track) -> Vec<Vec<[f64; 2]>> {
    let around = || track.stations.iter().chain(track.stations.first());
    let edge = |side: f64| {
        around().map(move |s| {
            let aside = side * s.width_m / 2.0;
            [s.x + aside * s.ty, s.y - aside * s.tx]
        })
    };
    vec![edge(1.0).collect(), edge(-1.0).collect()]
}

/// Draws a way in stretches of one colour.
fn way(svg: &mut Svg, drive: &[MapPoint], darkest_m: f64, place: &impl Fn([f64; 2]) -> [f64; 2]) {
    let mut from = 0;
    for i in 1..=drive.len() {
        let ends = i == drive.len()
            || drive[i].put_back
            || step(drive[i].cte_m, darkest_m) != step(drive[from].cte_m, darkest_m);
        if ends {
            // The first point of the next stretch joins them, unless the car was lifted there.
            let joined = usize::from(i < drive.len() && !drive[i].put_back);
            let points: Vec<_> = drive[from..i + joined].iter().map(|p| place([p.x, p.y])).collect();
            let colour = heat_hex(share(drive[from].cte_m, darkest_m));
            svg.polyline(&points, &format!("stroke=\"{colour}\" stroke-width=\"2.6\""));
            from = i;
        }
    }
    for moment in drive.iter().filter(|moment| moment.put_back) {
        let [x, y] = place([moment.x, moment.y]);
        let style = format!("stroke=\"{INK}\" stroke-width=\"1.6\"");
        svg.line([x - 4.0, y - 4.0], [x + 4.0, y + 4.0], &style);
        svg.line([x - 4.0, y + 4.0], [x + 4.0, y - 4.0], &style);
    }
    if let Some(end) = drive.last() {
        svg.dots([place([end.x, end.y])], 8.0, INK, "");
    }
}

fn legend(svg: &mut Svg, [width, height]: [f64; 2], darkest_m: f64, projection: &Projection) {
    let y = height - 34.0;
    for i in 0..COLOURS {
        let fill = format!("fill=\"{}\"", heat_hex(step_share(i)));
        svg.rect([16.0 + 16.0 * i as f64, y - 10.0], [16.0, 10.0], &fill);
    }
    let quiet = format!("fill=\"{QUIET_INK}\"");
    let bar_m = projection.bar_m(110.0);
    let from = width - 16.0 - bar_m * projection.scale;
    svg.line([from, y - 3.0], [width - 16.0, y - 3.0], &format!("stroke=\"{INK}\" stroke-width=\"2\""));
    svg.text([width - 16.0, y + 14.0], 12.0, Anchor::End, &quiet, &format!("{bar_m:.0} m"));
    svg.text([16.0, y + 14.0], 12.0, Anchor::Start, &quiet, &format!("0 to {darkest_m} m and more from the line"));
    svg.text([16.0, y + 29.0], 12.0, Anchor::Start, &quiet, "× put back   ● end of the run");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drive_is_drawn_on_its_track_in_stretches_of_one_colour() {
        let track = Track::load("lake").unwrap();
        let place = |s_m: f64, cte_m: f64, put_back: bool| {
            let station = track.at(s_m);
            MapPoint { x: station.x + cte_m * station.ty, y: station.y - cte_m * station.tx, cte_m, put_back }
        };
        let drive: Vec<MapPoint> =
            (0..40).map(|i| place(f64::from(i), if i < 20 { 0.1 } else { 1.9 }, i == 30)).collect();
        let text = draw("lake", Some(&track), &[drive], [552.0, 420.0]);
        assert!(roxmltree::Document::parse(&text).is_ok());
        // Two edges, and three stretches: near the line, far from it, after the car was put back.
        assert_eq!(text.matches("<path").count() - 1, 2 + 3, "one more is the dot at the end");
        assert!(text.contains(&heat_hex(0.25)) && text.contains(&heat_hex(1.0)));
        assert!(draw("none", None, &[], [552.0, 420.0]).contains("nothing was driven"));
    }

    #[test]
    fn colours_cover_the_distances_that_there_are() {
        let good = (0..100).map(|i| f64::from(i) / 500.0);
        assert_eq!((darkest_m(good.clone()), darkest_m(good.map(|m| -8.0 * m))), (0.25, 2.0));
        // One glitch among a thousand does not make the rest pale.
        assert_eq!(darkest_m((0..1000).map(|i| if i == 7 { 3.0 } else { 0.1 })), 0.25);
        assert_eq!((darkest_m([].into_iter()), darkest_m([99.0].into_iter())), (0.25, 5.0));
    }
}
