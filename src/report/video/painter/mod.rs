//! Paints the frames of a video: the camera's picture, the angles below it, and beside it the trail on the map and the
//! steering of the last seconds.

mod frame;
mod legend;
mod panels;

use std::collections::VecDeque;

pub use frame::{Captions, FilmFrame, FilmScales};

use super::lettering::{Size, draw_text, end_of};
use crate::dataset::resize::{Interpolation, Resizer};
use crate::picture::RgbImage;
use crate::report::charts::map::{self, Projection};
use crate::report::charts::palette;
use crate::simulator::Track;
use legend::{draw_track, explain_saliency};

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
/// Seconds of steering that are shown.
const TRACE_S: f64 = 10.0;
/// Bars of angles: left and right edge.
const BAR: [f64; 2] = [244.0, 544.0];

const GROUND: [u8; 3] = [255; 3];
const INK: [u8; 3] = [0x1a; 3];
const QUIET_INK: [u8; 3] = [0x5a; 3];

/// Paints frames. Keeps the way so far.
pub struct Painter {
    names: Captions,
    scales: FilmScales,
    /// Whether the camera's picture shows what excites the model.
    saliency: bool,
    /// Everything that stays from frame to frame, with the trail on the map.
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
    pub(in crate::report::video) fn notice(&mut self, frame: &FilmFrame) {
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
    pub(in crate::report::video) fn paint(&mut self, frame: &FilmFrame, out: &mut RgbImage) {
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
    pub(in crate::report::video) fn farewell(text: &str, out: &mut RgbImage) {
        let width = text.chars().count() * Size::Large.advance(true);
        let left = (CAMERA[1] / 2).saturating_sub(width / 2);
        fill(out, [left as f64 - 12.0, 24.0, (left + width) as f64 + 12.0, 60.0], GROUND);
        draw_text(out, [left, 30], Size::Large, true, INK, text);
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
    use super::panels::signed;
    use super::*;
    use crate::report::charts::palette::{MODEL_RGB as MODEL, REFERENCE_RGB as REFERENCE};

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
            let apart = |y: &usize| -> u32 {
                out.pixel(*y, ASIDE[1] - 3).iter().zip(MODEL).map(|(a, b)| u32::from(a.abs_diff(b))).sum()
            };
            let newest = (LONE_TRACE[0] as usize..LONE_TRACE[1] as usize).min_by_key(apart).unwrap();
            assert!(k == 0 || apart(&newest) < 200, "the curve is drawn up to now");
            heights.extend((k == 1 || k == 4).then_some(newest));
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
