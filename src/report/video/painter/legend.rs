//! What stays from frame to frame: the track on its map, and what the colours mean.

use super::{ASIDE, CAMERA, INK, MAP, QUIET_INK, fill};
use crate::picture::RgbImage;
use crate::report::charts::map::{self, Projection};
use crate::report::charts::palette;
use crate::report::video::lettering::{Size, draw_text, draw_text_right};
use crate::simulator::Track;

const ROAD: [u8; 3] = [0xd0; 3];
const ROAD_EDGE: [u8; 3] = [0x90; 3];

/// Draws the road and what the colours of the way mean.
pub(super) fn draw_track(base: &mut RgbImage, track: &Track, darkest_m: f64) -> Option<Projection> {
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
pub(super) fn explain_saliency(out: &mut RgbImage) {
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
