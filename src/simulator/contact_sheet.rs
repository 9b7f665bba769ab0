//! Pictures of a whole track on one sheet, to look at.

use image::RgbImage;

use super::camera::{Camera, HEIGHT, Mount, RgbFrame, WIDTH};
use super::car::MPS_PER_MPH;
use super::light::Variant;
use super::renderer::Renderer;
use super::simulation::{Simulation, Start};
use super::track::Track;

/// A sheet of pictures, `rows` of `columns`, taken at even distances along the lap in light `light_seed` (0 = the track's
/// own). With `triples` each row holds left, centre and right of one place, and `columns` counts triples.
pub fn contact_sheet(track: &Track, columns: usize, rows: usize, triples: bool, light_seed: u64) -> RgbImage {
    const GAP: usize = 4;
    let mounts: &[Mount] = if triples { &[Mount::Left, Mount::Center, Mount::Right] } else { &[Mount::Center] };
    let across = columns * mounts.len();
    let mut sheet = RgbImage::new((across * (WIDTH + GAP)) as u32, (rows * (HEIGHT + GAP)) as u32);
    let world = track.world();
    let variant = Variant::new(world, light_seed);
    let (mut renderer, mut frame) = (Renderer::default(), RgbFrame::default());
    for place in 0..columns * rows {
        let s_m = track.length_m * place as f64 / (columns * rows) as f64;
        let start = Start { s_m, reverse: false, offset_m: 0.0, heading_deg: 0.0 };
        let body = Simulation::new(track, start, 20.0 * MPS_PER_MPH).body_pose();
        for (k, mount) in mounts.iter().enumerate() {
            renderer.render(world, &variant, &Camera::new(&body, *mount), *mount, &mut frame);
            let x = (place % columns * mounts.len() + k) * (WIDTH + GAP);
            let y = place / columns * (HEIGHT + GAP);
            for (at, pixel) in frame.pixels.chunks_exact(3).enumerate() {
                let rgb = image::Rgb([pixel[0], pixel[1], pixel[2]]);
                sheet.put_pixel((x + at % WIDTH) as u32, (y + at / WIDTH) as u32, rgb);
            }
        }
    }
    sheet
}
