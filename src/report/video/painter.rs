//! What a picture of a video looks like: the camera, below it who steers how, beside it the way on the map and the steering of
//! the last seconds.

use std::collections::VecDeque;
use std::time::Duration;

use super::lettering::{Size, draw_text, draw_text_right, end_of};
use crate::dataset::resize::{Interpolation, Resizer};
use crate::picture::RgbImage;
use crate::report::charts::map::{self, Projection};
use crate::report::charts::palette::{self, MODEL_RGB as MODEL, REFERENCE_RGB as REFERENCE};
use crate::report::charts::steering_line::draw_steering;
use crate::simulator::Track;
use crate::simulator::car::dynamics::MAX_STEER_DEG;

/// Height and width of a picture of the video.
const SIZE: [usize; 2] = [480, 960];
/// Height and width that the camera's picture may take, in the upper left corner.
const CAMERA: [usize; 2] = [320, 640];
/// Left and right edge of what stands beside the camera.
const ASIDE: [usize; 2] = [656, 944];
/// Map: left, top, right, bottom.
const MAP: [f64; 4] = [660.0, 66.0, 940.0, 300.0];
/// Steering of the last seconds: top and bottom with a map, and without.
const TRACE: [f64; 2] = [386.0, 456.0];
const LONE_TRACE: [f64; 2] = [110.0, 430.0];
/// Ranges that the curve of steering may have, degrees to either side.
const STEERING_RANGES_DEG: [f64; 3] = [5.0, 10.0, MAX_STEER_DEG];
/// Seconds of steering that are shown.
const TRACE_S: f64 = 10.0;
/// The steering wheel: centre (x, y) and radius.
const WHEEL: ([f64; 2], f64) = ([80.0, 400.0], 60.0);
/// Turns of the wheel for each turn of the front wheels.
const WHEEL_RATIO: f64 = 4.0;
/// Bars of angles: left and right edge.
const BAR: [f64; 2] = [244.0, 544.0];

const GROUND: [u8; 3] = [255; 3];
const INK: [u8; 3] = [0x1a; 3];
const QUIET_INK: [u8; 3] = [0x5a; 3];
const GRID: [u8; 3] = [0xdd; 3];
const ROAD: [u8; 3] = [0xd0; 3];
const ROAD_EDGE: [u8; 3] = [0x90; 3];

/// A moment, as far as it is known.
#[derive(Clone, Debug, Default)]
pub struct FilmFrame {
    /// What the camera shows.
    pub picture: RgbImage,
    /// Time since the beginning, s.
    pub time_s: f64,
    /// Angle of the front wheels that the model wants, degrees, + = right.
    pub model_deg: Option<f64>,
    /// The same of the person or the expert.
    pub reference_deg: Option<f64>,
    /// Speed, mph.
    pub speed_mph: Option<f64>,
    /// Distance from the line, m, + = right as driven.
    pub cte_m: Option<f64>,
    /// How long the model took to answer.
    pub answered_in: Option<Duration>,
    /// Lap, from 1, and laps in all if that is known.
    pub lap: Option<(usize, Option<usize>)>,
    /// Where the car is (x, y), m.
    pub place: Option<[f64; 2]>,
    /// Whether the car was just put somewhere else, so that its way has a gap.
    pub put_back: bool,
}

/// The names that stand in a video.
#[derive(Clone, Debug)]
pub struct Captions {
    /// What is driven on, or what was recorded.
    pub title: String,
    /// What else to know, in one line.
    pub subtitle: String,
    /// Who steers, or would steer, in the colour of models, if anybody; 6 letters fit.
    pub model: Option<&'static str>,
    /// Whose steering it is compared with; 6 letters fit.
    pub reference: &'static str,
}

/// Scales that a film keeps from its first frame to its last.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FilmScales {
    /// Range of the curve of steering, degrees to either side.
    pub steering_deg: f64,
    /// Distance from the line that has the darkest colour on the map, m.
    pub darkest_m: f64,
}

impl FilmScales {
    /// Scales for a film in which the wheels turn by `angles_deg` and the car is `cte_m` from its line. What turns further is
    /// drawn at the border.
    pub fn covering(angles_deg: impl Iterator<Item = f64>, cte_m: impl Iterator<Item = f64>) -> FilmScales {
        let widest = angles_deg.map(f64::abs).fold(0.0, f64::max);
        let range = STEERING_RANGES_DEG.into_iter().find(|range| widest <= *range);
        FilmScales { steering_deg: range.unwrap_or(MAX_STEER_DEG), darkest_m: map::darkest_m(cte_m) }
    }
}

/// Paints frames. Keeps the way so far.
pub struct Painter {
    names: Captions,
    scales: FilmScales,
    /// Whether the camera's picture shows what excites the model.
    saliency: bool,
    /// Everything that stays, with the way on the map.
    base: RgbImage,
    projection: Option<Projection>,
    last_place: Option<[f64; 2]>,
    camera: Option<Camera>,
    trace: VecDeque<(f64, Option<f64>, Option<f64>)>,
}

/// The camera's picture, enlarged.
struct Camera {
    from: [usize; 2],
    resizer: Resizer,
    picture: RgbImage,
}

impl Painter {
    /// A painter that has seen nothing yet, with a map if the track is known. With `saliency` it explains the colours that
    /// saliency adds.
    pub fn new(names: Captions, scales: FilmScales, track: Option<&Track>, saliency: bool) -> Painter {
        let mut base = RgbImage::filled(SIZE[0], SIZE[1], GROUND);
        let letters = |size: Size, bold| (ASIDE[1] - ASIDE[0]) / size.advance(bold);
        draw_text(
            &mut base,
            [ASIDE[0], 10],
            Size::Medium,
            true,
            INK,
            &end_of(&names.title, letters(Size::Medium, true)),
        );
        let subtitle = end_of(&names.subtitle, letters(Size::Small, false));
        draw_text(&mut base, [ASIDE[0], 36], Size::Small, false, QUIET_INK, &subtitle);
        let projection = track.and_then(|track| draw_track(&mut base, track, scales.darkest_m));
        let mut painter = Painter {
            names,
            scales,
            saliency,
            base,
            projection,
            last_place: None,
            camera: None,
            trace: VecDeque::new(),
        };
        painter.draw_scales();
        painter
    }

    /// Height and width of the pictures.
    pub fn size(&self) -> [usize; 2] {
        SIZE
    }

    /// Adds a frame to the way and to the steering so far.
    pub(super) fn notice(&mut self, frame: &FilmFrame) {
        self.trace.push_back((frame.time_s, frame.model_deg, frame.reference_deg));
        while self.trace.front().is_some_and(|(time_s, ..)| *time_s < frame.time_s - TRACE_S) {
            self.trace.pop_front();
        }
        let (Some(place), Some(projection)) = (frame.place, &self.projection) else { return };
        let to = projection.place(place);
        match self.last_place.filter(|_| !frame.put_back) {
            Some(from) => {
                let colour = palette::heat(map::share(frame.cte_m.unwrap_or_default(), self.scales.darkest_m));
                self.base.draw_line(from, to, 3.0, colour);
            }
            None if frame.put_back => {
                for [dx, dy] in [[4.0, 4.0], [4.0, -4.0]] {
                    self.base.draw_line([to[0] - dx, to[1] - dy], [to[0] + dx, to[1] + dy], 1.6, INK);
                }
            }
            None => {}
        }
        self.last_place = Some(to);
    }

    /// Paints `frame`, the last that was noticed.
    pub(super) fn paint(&mut self, frame: &FilmFrame, out: &mut RgbImage) {
        out.clone_from(&self.base);
        self.paint_camera(frame, out);
        if self.saliency {
            explain_saliency(out);
        }
        self.paint_wheel(frame, out);
        self.paint_angles(frame, out);
        self.paint_figures(frame, out);
        self.paint_trace(frame.time_s, out);
        if let Some(at) = self.last_place {
            out.draw_line(at, at, 13.0, GROUND);
            out.draw_line(at, at, 10.0, INK);
        }
    }

    /// Writes `text` across the camera's picture.
    pub(super) fn farewell(text: &str, out: &mut RgbImage) {
        let width = text.chars().count() * Size::Large.advance(true);
        let left = (CAMERA[1] / 2).saturating_sub(width / 2);
        fill(out, [left as f64 - 12.0, 24.0, (left + width) as f64 + 12.0, 60.0], GROUND);
        draw_text(out, [left, 30], Size::Large, true, INK, text);
    }

    /// What stands around the numbers and curves.
    fn draw_scales(&mut self) {
        let [_, bottom] = self.trace_edges();
        let base = &mut self.base;
        let middle = f64::midpoint(BAR[0], BAR[1]);
        for (row, name, colour) in [(0, self.names.model, MODEL), (1, Some(self.names.reference), REFERENCE)] {
            let Some(name) = name else { continue };
            let top = 330 + 36 * row;
            draw_text(base, [164, top + 2], Size::Medium, true, INK, name);
            fill(base, [164.0, top as f64 + 24.0, 226.0, top as f64 + 27.0], colour);
            fill(base, [BAR[0], top as f64 + 2.0, BAR[1], top as f64 + 26.0], [0xf2; 3]);
        }
        for deg in [-20.0, -10.0, 0.0, 10.0, 20.0] {
            let x = middle + deg / MAX_STEER_DEG * (BAR[1] - BAR[0]) / 2.0;
            fill(base, [x - 0.5, 328.0, x + 0.5, 396.0], if deg == 0.0 { INK } else { [0xb8; 3] });
            let text = format!("{deg:.0}°");
            let half = text.chars().count() * Size::Small.advance(false) / 2;
            draw_text(base, [x as usize - half, 398], Size::Small, false, QUIET_INK, &text);
        }
        draw_text(base, [BAR[0] as usize - 40, 398], Size::Small, false, QUIET_INK, "left");
        draw_text(base, [BAR[1] as usize, 398], Size::Small, false, QUIET_INK, "right");
        draw_text(base, [ASIDE[0], bottom as usize + 4], Size::Small, false, QUIET_INK, "steering, last 10 s");
    }

    fn trace_edges(&self) -> [f64; 2] {
        if self.projection.is_some() { TRACE } else { LONE_TRACE }
    }

    fn paint_camera(&mut self, frame: &FilmFrame, out: &mut RgbImage) {
        let from = [frame.picture.height, frame.picture.width];
        if from.contains(&0) {
            return;
        }
        let camera = match &mut self.camera {
            Some(camera) if camera.from == from => camera,
            other => other.insert(Camera::new(from)),
        };
        camera.resizer.apply(&frame.picture.pixels, &mut camera.picture.pixels);
        for (deg, colour) in [(frame.reference_deg, REFERENCE), (frame.model_deg, MODEL)] {
            if let Some(deg) = deg {
                draw_steering(&mut camera.picture, deg, colour);
            }
        }
        let (top, left) = ((CAMERA[0] - camera.picture.height) / 2, (CAMERA[1] - camera.picture.width) / 2);
        out.paste(&camera.picture, top, left);
    }

    /// The wheel stands as who drives holds it; a mark on its rim shows where the other would.
    fn paint_wheel(&self, frame: &FilmFrame, out: &mut RgbImage) {
        let ([x, y], radius) = WHEEL;
        let Some(deg) = frame.model_deg.or(frame.reference_deg) else { return };
        let at = |angle_deg: f64, r: f64| {
            let (sin, cos) = angle_deg.to_radians().sin_cos();
            [x + r * sin, y - r * cos]
        };
        let turn = WHEEL_RATIO * deg;
        for k in 0..72 {
            let angle = f64::from(k) * 5.0;
            out.draw_line(at(angle, radius), at(angle + 5.0, radius), 9.0, [0x3a; 3]);
        }
        for spoke in [90.0, 180.0, 270.0] {
            out.draw_line([x, y], at(turn + spoke, radius), 8.0, [0x3a; 3]);
        }
        out.draw_line([x, y], [x, y], 26.0, [0x3a; 3]);
        // The top of the wheel, in the colour of who holds it.
        let holds = if frame.model_deg.is_some() { MODEL } else { REFERENCE };
        out.draw_line(at(turn - 9.0, radius), at(turn + 9.0, radius), 9.0, holds);
        if let (Some(_), Some(reference)) = (frame.model_deg, frame.reference_deg) {
            let turn = WHEEL_RATIO * reference;
            out.draw_line(at(turn, radius - 14.0), at(turn, radius + 8.0), 6.0, GROUND);
            out.draw_line(at(turn, radius - 13.0), at(turn, radius + 7.0), 3.0, REFERENCE);
        }
    }

    fn paint_angles(&self, frame: &FilmFrame, out: &mut RgbImage) {
        let middle = f64::midpoint(BAR[0], BAR[1]);
        for (row, deg, colour) in [(0, frame.model_deg, MODEL), (1, frame.reference_deg, REFERENCE)] {
            let Some(deg) = deg else { continue };
            let top = 330 + 36 * row;
            draw_text_right(out, [632, top + 1], Size::Large, true, INK, &(signed(deg, 1) + "°"));
            let end = middle + (deg / MAX_STEER_DEG).clamp(-1.0, 1.0) * (BAR[1] - BAR[0]) / 2.0;
            let (left, right) = (middle.min(end), middle.max(end));
            fill(out, [left - 1.0, top as f64 + 5.0, right + 1.0, top as f64 + 23.0], colour);
        }
    }

    fn paint_figures(&self, frame: &FilmFrame, out: &mut RgbImage) {
        let tenths = (10.0 * frame.time_s).round() as u64;
        let apart = frame.model_deg.zip(frame.reference_deg).map(|(a, b)| format!("{:.1}°", (a - b).abs()));
        let beside = match self.projection {
            Some(_) => ("from line", frame.cte_m.map(|m| signed(m, 2) + " m")),
            None => ("apart", apart),
        };
        let lap = frame.lap.map(|(lap, laps)| match laps {
            Some(laps) => format!("{lap}/{laps}"),
            None => lap.to_string(),
        });
        let figures = [
            ("speed", frame.speed_mph.map(|mph| format!("{mph:.1} mph"))),
            beside,
            ("answer in", frame.answered_in.map(|took| format!("{:.1} ms", 1000.0 * took.as_secs_f64()))),
            ("lap", lap),
            ("time", Some(format!("{}:{:02}.{}", tenths / 600, tenths / 10 % 60, tenths % 10))),
        ];
        // What is not known has no place; what is known keeps it.
        for ((caption, text), left) in figures.iter().zip([164, 272, 372, 472, 544]) {
            if let Some(text) = text {
                draw_text(out, [left, 426], Size::Medium, true, INK, text);
                draw_text(out, [left, 450], Size::Small, false, QUIET_INK, caption);
            }
        }
    }

    fn paint_trace(&self, now_s: f64, out: &mut RgbImage) {
        let [top, bottom] = self.trace_edges();
        let [left, right] = ASIDE.map(|x| x as f64);
        let range_deg = self.scales.steering_deg;
        let y = |deg: f64| f64::midpoint(top, bottom) - (deg / range_deg).clamp(-1.0, 1.0) * (bottom - top) / 2.0;
        for (deg, grey) in [(-range_deg, GRID), (0.0, [0xa0; 3]), (range_deg, GRID)] {
            out.draw_line([left, y(deg)], [right, y(deg)], 1.0, grey);
        }
        let range = format!("±{range_deg:.0}°");
        draw_text_right(out, [ASIDE[1], bottom as usize + 4], Size::Small, false, QUIET_INK, &range);
        let x = |time_s: f64| right - (now_s - time_s) / TRACE_S * (right - left);
        type TracePoint = (f64, Option<f64>, Option<f64>);
        let mut curve = |of: fn(&TracePoint) -> Option<f64>, colour| {
            for (a, b) in self.trace.iter().zip(self.trace.iter().skip(1)) {
                if let (Some(from), Some(to)) = (of(a), of(b)) {
                    out.draw_line([x(a.0), y(from)], [x(b.0), y(to)], 2.0, colour);
                }
            }
        };
        curve(|moment| moment.1, MODEL);
        curve(|moment| moment.2, REFERENCE);
    }
}

impl Camera {
    fn new(from: [usize; 2]) -> Camera {
        let scale = (CAMERA[0] as f64 / from[0] as f64).min(CAMERA[1] as f64 / from[1] as f64);
        let to = [0, 1].map(|k| ((from[k] as f64 * scale).round() as usize).clamp(1, CAMERA[k]));
        let interpolation = if scale < 1.0 { Interpolation::Area } else { Interpolation::Linear };
        Camera {
            from,
            resizer: Resizer::new(from, to, 3, interpolation),
            picture: RgbImage::filled(to[0], to[1], GROUND),
        }
    }
}

/// A number with its sign, which zero has not.
fn signed(value: f64, decimals: usize) -> String {
    let text = format!("{value:+.decimals$}");
    if text.chars().any(|c| ('1'..='9').contains(&c)) { text } else { text[1..].into() }
}

/// Draws the road and what the colours of the way mean.
fn draw_track(base: &mut RgbImage, track: &Track, darkest_m: f64) -> Option<Projection> {
    let edges = map::edges(track);
    let projection = Projection::fitting(edges.iter().flatten().copied(), MAP)?;
    for (beside_px, colour) in [(1.6, ROAD_EDGE), (0.0, ROAD)] {
        for (i, station) in track.stations.iter().enumerate() {
            let next = &track.stations[(i + 1) % track.stations.len()];
            let thickness = (station.width_m * projection.scale).max(4.0) + beside_px;
            base.draw_line(
                projection.place([station.x, station.y]),
                projection.place([next.x, next.y]),
                thickness,
                colour,
            );
        }
    }
    let [left, top] = [ASIDE[0], 314];
    for k in 0..map::COLOURS {
        let x = (left + 14 * k) as f64;
        fill(base, [x, top as f64, x + 14.0, top as f64 + 10.0], palette::heat(map::step_share(k)));
    }
    let bar_m = projection.bar_m(110.0);
    let bar_px = bar_m * projection.scale;
    let right = ASIDE[1] as f64;
    fill(base, [right - bar_px, top as f64 + 4.0, right, top as f64 + 7.0], INK);
    let range = format!("0 to {darkest_m} m+ from line");
    draw_text(base, [left, top + 14], Size::Small, false, QUIET_INK, &range);
    draw_text_right(base, [ASIDE[1], top + 14], Size::Small, false, QUIET_INK, &format!("{bar_m:.0} m"));
    draw_text(base, [left, top + 32], Size::Small, false, QUIET_INK, "× put back");
    Some(projection)
}

/// Explains, in the lower left corner of the camera's picture, what the colours of saliency mean.
fn explain_saliency(out: &mut RgbImage) {
    let (bottom, words, bar) = (CAMERA[0] as f64 - 8.0, ["excites it: little", "much"], 96.0);
    let width = |text: &str| (text.len() * Size::Small.advance(false)) as f64;
    let from = 14.0 + width(words[0]) + 8.0;
    fill(out, [8.0, bottom - 22.0, from + bar + 8.0 + width(words[1]) + 6.0, bottom], [0x18; 3]);
    draw_text(out, [14, bottom as usize - 19], Size::Small, false, [0xff; 3], words[0]);
    for k in 0..16 {
        let left = from + bar * f64::from(k) / 16.0;
        let colour = palette::saliency(f64::from(k) / 15.0);
        fill(out, [left, bottom - 17.0, left + bar / 16.0, bottom - 6.0], colour);
    }
    draw_text(out, [(from + bar + 8.0) as usize, bottom as usize - 19], Size::Small, false, [0xff; 3], words[1]);
}

/// Fills a rectangle: left, top, right, bottom, pixels.
fn fill(picture: &mut RgbImage, [left, top, right, bottom]: [f64; 4], rgb: [u8; 3]) {
    let [rows, columns] = [(top, bottom, picture.height), (left, right, picture.width)]
        .map(|(from, to, end)| (from.round().max(0.0) as usize).min(end)..(to.round().max(0.0) as usize).min(end));
    for row in rows {
        for column in columns.clone() {
            picture.set_pixel(row, column, rgb);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SCALES: FilmScales = FilmScales { steering_deg: 10.0, darkest_m: 2.0 };

    fn names() -> Captions {
        Captions { title: "lake".into(), subtitle: "a model".into(), model: Some("model"), reference: "expert" }
    }

    /// Pixels of a part of the picture that have the colour.
    fn count(picture: &RgbImage, [left, top, right, bottom]: [usize; 4], rgb: [u8; 3]) -> usize {
        (top..bottom)
            .flat_map(|y| (left..right).map(move |x| (y, x)))
            .filter(|(y, x)| picture.pixel(*y, *x) == rgb)
            .count()
    }

    fn frame(model_deg: f64, reference_deg: f64) -> FilmFrame {
        let picture = RgbImage::filled(160, 320, [90, 120, 150]);
        FilmFrame { picture, model_deg: Some(model_deg), reference_deg: Some(reference_deg), ..FilmFrame::default() }
    }

    #[test]
    fn bars_and_wheel_show_who_steers_where_and_how_far() {
        let mut painter = Painter::new(names(), SCALES, None, false);
        let mut out = RgbImage::default();
        let mut bars = |model_deg, reference_deg| {
            let frame = frame(model_deg, reference_deg);
            painter.notice(&frame);
            painter.paint(&frame, &mut out);
            let middle = f64::midpoint(BAR[0], BAR[1]) as usize;
            let (left, right) = ([BAR[0] as usize, 324, middle - 2, 396], [middle + 2, 324, BAR[1] as usize, 396]);
            [(left, MODEL), (right, MODEL), (left, REFERENCE), (right, REFERENCE)]
                .map(|(part, colour)| count(&out, part, colour))
        };
        let [model_left, model_right, reference_left, reference_right] = bars(12.5, -6.25);
        assert!(
            model_left == 0 && reference_right == 0 && model_right > 18 * 70 && model_right < 18 * 80,
            "{model_right}"
        );
        assert!((2 * reference_left).abs_diff(model_right) < 18 * 4, "{reference_left} {model_right}");
        let [far, ..] = bars(-90.0, 0.0);
        assert!(far <= 18 * 151, "a bar ends where the scale ends: {far}");
    }

    #[test]
    fn the_way_grows_on_the_map_in_the_colour_of_its_error_and_is_not_drawn_where_the_car_was_lifted() {
        let track = Track::load("lake").unwrap();
        let mut painter = Painter::new(names(), SCALES, Some(&track), false);
        let way = |painter: &mut Painter, s_m: f64, cte_m: f64, put_back| {
            let station = track.at(s_m);
            let place = Some([station.x, station.y]);
            painter.notice(&FilmFrame { place, put_back, cte_m: Some(cte_m), ..frame(0.0, 0.0) });
        };
        let map = MAP.map(|edge| edge as usize);
        let [near, far] = [0.1, 1.9].map(|cte_m| palette::heat(map::share(cte_m, 2.0)));
        let before = count(&painter.base, map, far);
        for k in 0..50 {
            way(&mut painter, f64::from(k), 0.1, false);
        }
        let first = count(&painter.base, map, near);
        assert!(first > 20 && count(&painter.base, map, far) == before);
        for k in 0..50 {
            way(&mut painter, 200.0 + f64::from(k), 1.9, k == 0);
        }
        let second = count(&painter.base, map, far) - before;
        assert!(second > 20 && count(&painter.base, map, near) <= first);
        assert!(second < 3 * first, "no line leads from one stretch to the other: {second}");
    }

    #[test]
    fn a_film_keeps_its_scale_of_steering() {
        let mut painter = Painter::new(names(), SCALES, None, false);
        let mut heights = Vec::new();
        for (k, model_deg) in [2.0, 2.0, 24.0, 2.0, 2.0].into_iter().enumerate() {
            let shown = FilmFrame { time_s: k as f64, ..frame(model_deg, 0.0) };
            let mut out = RgbImage::default();
            painter.notice(&shown);
            painter.paint(&shown, &mut out);
            let newest =
                (LONE_TRACE[0] as usize..LONE_TRACE[1] as usize).find(|y| out.pixel(*y, ASIDE[1] - 3) == MODEL);
            heights.extend((k == 1 || k == 4).then_some(newest.unwrap()));
        }
        assert_eq!(heights[0], heights[1], "2 degrees stand where they stood before");
        let scales = FilmScales::covering([3.0, -7.0].into_iter(), [0.1, 0.3].into_iter());
        assert_eq!(scales, FilmScales { steering_deg: 10.0, darkest_m: 0.5 });
    }

    #[test]
    fn numbers_have_their_sign_and_zero_has_none() {
        assert_eq!([1.25, -0.04, 0.0, -0.05].map(|v| signed(v, 1)), ["+1.2", "0.0", "0.0", "-0.1"]);
    }

    #[test]
    fn pictures_of_any_size_lie_within_the_camera_and_text_is_not_cut_off() {
        let mut painter = Painter::new(Captions { title: "x".repeat(200), ..names() }, SCALES, None, true);
        let mut out = RgbImage::default();
        for size in [[120, 160], [160, 320], [1, 1], [40, 900], [2000, 30]] {
            let frame =
                FilmFrame { picture: RgbImage::filled(size[0], size[1], [200, 10, 10]), ..FilmFrame::default() };
            painter.notice(&frame);
            painter.paint(&frame, &mut out);
            let inside = count(&out, [0, 0, CAMERA[1], CAMERA[0]], [200, 10, 10]);
            assert!(inside > 0 && count(&out, [0, 0, 960, 480], [200, 10, 10]) == inside, "{size:?}");
        }
        assert_eq!(count(&out, [950, 0, 960, 480], GROUND), 10 * 480, "nothing touches the right edge");
    }
}
