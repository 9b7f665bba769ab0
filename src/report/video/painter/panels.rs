//! The parts of a frame, each in its place: camera, steering wheel, angles, figures, the steering of the last seconds.

use super::{ASIDE, BAR, CAMERA, Camera, FilmFrame, GROUND, INK, LONE_TRACE, Painter, QUIET_INK, TRACE, TRACE_S, fill};
use crate::picture::RgbImage;
use crate::report::charts::palette::{MODEL_RGB as MODEL, REFERENCE_RGB as REFERENCE};
use crate::report::charts::steering_line::draw_steering;
use crate::report::video::lettering::{Size, draw_text, draw_text_right};
use crate::simulator::car::dynamics::MAX_STEER_DEG;

/// The steering wheel: centre (x, y) and radius.
const WHEEL: ([f64; 2], f64) = ([80.0, 400.0], 60.0);
/// Turns of the wheel for each turn of the front wheels.
const WHEEL_RATIO: f64 = 4.0;
const GRID: [u8; 3] = [0xdd; 3];

impl Painter {
    /// What stands around the numbers and curves.
    pub(super) fn draw_scales(&mut self) {
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

    pub(super) fn trace_edges(&self) -> [f64; 2] {
        if self.projection.is_some() { TRACE } else { LONE_TRACE }
    }

    pub(super) fn paint_camera(&mut self, frame: &FilmFrame, out: &mut RgbImage) {
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
    pub(super) fn paint_wheel(&self, frame: &FilmFrame, out: &mut RgbImage) {
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

    pub(super) fn paint_angles(&self, frame: &FilmFrame, out: &mut RgbImage) {
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

    pub(super) fn paint_figures(&self, frame: &FilmFrame, out: &mut RgbImage) {
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

    pub(super) fn paint_trace(&self, now_s: f64, out: &mut RgbImage) {
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

/// A number with its sign, which zero has not.
pub(super) fn signed(value: f64, decimals: usize) -> String {
    let text = format!("{value:+.decimals$}");
    if text.chars().any(|c| ('1'..='9').contains(&c)) { text } else { text[1..].into() }
}
