//! Draws what stands upright on the ground: walls, and objects beside the road as billboards.

use crate::simulator::camera::pinhole::{HEIGHT, RgbFrame, WIDTH};
use crate::simulator::camera::view::{FULL, View};
use crate::simulator::math::{Vec3, hash2, lerp};
use crate::simulator::road::spec::Wall;
use crate::simulator::scenery::texel::fixed;
use crate::simulator::scenery::world::{Sprite, WallPiece};

/// Minimum distance at which objects are drawn, m.
const MIN_DISTANCE_M: f32 = 0.35;
/// Maximum distance at which objects are drawn, m.
const MAX_DISTANCE_M: f32 = 330.0;

/// Fraction bits of fixed-point coordinates on a picture.
const FRACTION_BITS: u32 = 14;

/// Draws walls and sprites over the ground of `frame`.
#[inline(never)]
pub(crate) fn draw(depths: &mut [f32], view: &View, frame: &mut RgbFrame) {
    for piece in &view.world.walls {
        draw_wall(depths, view, piece, frame);
    }
    for sprite in &view.world.sprites {
        draw_sprite(depths, view, sprite, frame);
    }
}

fn draw_sprite(depths: &mut [f32], view: &View, sprite: &Sprite, frame: &mut RgbFrame) {
    let foot = view.camera.view(sprite.foot);
    if foot.z < 1.5 || foot.z > MAX_DISTANCE_M || foot.x.abs() > 1.3 * foot.z + 6.0 {
        return;
    }
    let picture = &view.world.pictures[sprite.picture];
    let per_m = view.camera.focal_px / foot.z;
    let (wide, high) = (picture.width_m * sprite.scale * per_m, picture.height_m * sprite.scale * per_m);
    let x = WIDTH as f32 / 2.0 + foot.x * per_m;
    let y = HEIGHT as f32 / 2.0 - foot.y * per_m;
    // Where a point straight above the foot moves in the picture, for each pixel of height.
    let lean = view.camera.right.z / view.camera.up.z.max(0.5);
    let (top, bottom) = ((y - high).max(0.0), y.min(HEIGHT as f32));
    if top >= bottom || high < 0.7 {
        return;
    }
    let level = picture.level(high, wide);
    let (w, h) = (level.width, level.height);
    let light = (sprite.light * 256.0).min(256.0) as u32;
    let (inverse, air) = (1.0 / foot.z, view.air(foot.z));
    let (pixels, _) = frame.pixels.as_chunks_mut();
    let (du, dv) = (w as f32 / wide, h as f32 / high);
    let one = (1 << FRACTION_BITS) as f32;
    let step = fixed(du * one);
    let first_row = (top + 0.5) as usize;
    let last_row = (bottom + 0.5) as usize;
    for row in first_row..last_row.min(HEIGHT) {
        let above = y - (row as f32 + 0.5);
        let v = ((high - above) * dv).clamp(0.0, h as f32 - 1.0) as usize;
        let left = x + above * lean - wide / 2.0;
        let (from, to) = level.solid[v];
        let (from, to) = if sprite.mirrored { (w - to, w - from) } else { (from, to) };
        let first = (left + from as f32 / du + 0.5).max(0.0) as usize;
        let last = ((left + to as f32 / du + 0.5).max(0.0) as usize).min(WIDTH);
        if first >= last {
            continue;
        }
        let texels = &level.texels[v * w..(v + 1) * w];
        let mut u = fixed((first as f32 + 0.5 - left) * du * one);
        let span = row * WIDTH + first..row * WIDTH + last;
        for (depth, out) in depths[span.clone()].iter_mut().zip(&mut pixels[span]) {
            let at = ((u >> FRACTION_BITS) as usize).min(w - 1);
            u += step;
            if *depth > inverse {
                continue;
            }
            let texel = texels[if sprite.mirrored { w - 1 - at } else { at }];
            if texel >> 31 == 1 {
                *depth = inverse;
                view.finish(texel, light, &air, out);
            }
        }
    }
}

/// A wall's extent and colour: lower and upper height, m, and colour at a place along and up.
fn wall_height(wall: Wall) -> (f32, f32) {
    match wall {
        Wall::Parapet => (0.0, 1.05),
        Wall::Rail => (0.0, 0.78),
        Wall::Barrier => (0.0, 0.85),
        Wall::Stone => (0.0, 0.7),
        Wall::Fence => (0.0, 1.15),
    }
}

/// Colour of a wall, `None` where one sees through it.
fn wall_colour(wall: Wall, along_m: f32, up_m: f32) -> Option<[f32; 3]> {
    match wall {
        Wall::Parapet => Some(if up_m > 0.93 { [92.0, 88.0, 84.0] } else { [34.0, 33.0, 33.0] }),
        Wall::Rail => {
            let post = along_m.rem_euclid(4.0) < 0.12;
            if up_m > 0.46 {
                let fold = if (0.58..0.66).contains(&up_m) { 130.0 } else { 182.0 };
                Some([fold, fold, fold + 4.0])
            } else {
                post.then_some([120.0, 118.0, 114.0])
            }
        }
        Wall::Barrier => {
            let gap = along_m.rem_euclid(4.0) < 0.08;
            let grey = if gap { 92.0 } else { 168.0 + 26.0 * up_m };
            Some([grey, grey, 0.97 * grey])
        }
        Wall::Stone => {
            let course = (up_m / 0.24) as i32;
            let stone = ((along_m + 0.3 * (course % 2) as f32) / 0.6) as i32;
            let k = 0.8 + 0.35 * hash2(stone, course, 5);
            Some([202.0 * k, 190.0 * k, 166.0 * k])
        }
        Wall::Fence => {
            let post = along_m.rem_euclid(2.5) < 0.14;
            let plank = (0.35..0.55).contains(&up_m) || (0.8..1.0).contains(&up_m);
            (post || plank).then_some([112.0, 88.0, 62.0])
        }
    }
}

fn draw_wall(depths: &mut [f32], view: &View, piece: &WallPiece, frame: &mut RgbFrame) {
    let (mut a, mut b) = (view.camera.view(piece.from), view.camera.view(piece.to));
    if a.z.max(b.z) < MIN_DISTANCE_M || a.z.min(b.z) > MAX_DISTANCE_M / 2.0 {
        return;
    }
    let length = (b - a).dot(b - a).sqrt();
    let (mut along_a, mut along_b) = (0.0, length);
    // Clips the part behind the camera.
    if a.z < MIN_DISTANCE_M {
        let t = (MIN_DISTANCE_M - a.z) / (b.z - a.z);
        (a, along_a) = (a + (b - a) * t, length * t);
    } else if b.z < MIN_DISTANCE_M {
        let t = (MIN_DISTANCE_M - b.z) / (a.z - b.z);
        (b, along_b) = (b + (a - b) * t, length * (1.0 - t));
    }
    let screen = |p: Vec3| {
        (
            WIDTH as f32 / 2.0 + p.x / p.z * view.camera.focal_px,
            HEIGHT as f32 / 2.0 - p.y / p.z * view.camera.focal_px,
            1.0 / p.z,
        )
    };
    let (mut from, mut to) = ((screen(a), along_a), (screen(b), along_b));
    if from.0.0 > to.0.0 {
        std::mem::swap(&mut from, &mut to);
    }
    let (((x0, y0, i0), u0), ((x1, y1, i1), u1)) = (from, to);
    let up = view.camera.up.z;
    let first = (x0 + 0.5).max(0.0) as usize;
    let last = ((x1 + 0.5).max(0.0) as usize).min(WIDTH);
    let (low_m, high_m) = wall_height(piece.wall);
    let (pixels, _) = frame.pixels.as_chunks_mut();
    for column in first..last {
        let t = (column as f32 + 0.5 - x0) / (x1 - x0).max(1e-3);
        let inverse = lerp(i0, i1, t);
        let foot = lerp(y0, y1, t);
        let along_m = piece.along_m + lerp(u0 * i0, u1 * i1, t) / inverse;
        let per_m = view.camera.focal_px * inverse * up;
        let (top, bottom) = (foot - high_m * per_m, foot - low_m * per_m);
        let air = view.air(1.0 / inverse);
        let rows = (top + 0.5).clamp(0.0, HEIGHT as f32) as usize..(bottom + 1.0).clamp(0.0, HEIGHT as f32) as usize;
        for row in rows {
            let at = row * WIDTH + column;
            // A wall stands on the ground: leave some room for the ground's own unevenness.
            if depths[at] > inverse * 1.03 {
                continue;
            }
            if let Some(rgb) = wall_colour(piece.wall, along_m, (foot - row as f32 - 0.5) / per_m) {
                depths[at] = inverse;
                let rgb = rgb.map(|c| (c * piece.light.min(1.1)) as u32);
                view.finish(rgb[0] | rgb[1] << 8 | rgb[2] << 16, FULL, &air, &mut pixels[at]);
            }
        }
    }
}
