//! Pictures of a whole track on one sheet, to look at.

use image::{Rgb, RgbImage};

use crate::simulator::camera::pinhole::{Camera, HEIGHT, Mount, RgbFrame, WIDTH};
use crate::simulator::camera::renderer::Renderer;
use crate::simulator::car::dynamics::MPS_PER_MPH;
use crate::simulator::car::simulation::{Simulation, Start};
use crate::simulator::scenery::light::Variant;
use crate::simulator::track::Track;

/// Pixels between pictures.
const GAP: usize = 4;

/// Pictures of 320x160 pixels in rows and columns.
struct Sheet {
    image: RgbImage,
    columns: usize,
}

impl Sheet {
    fn new(columns: usize, rows: usize) -> Sheet {
        Sheet { image: RgbImage::new((columns * (WIDTH + GAP)) as u32, (rows * (HEIGHT + GAP)) as u32), columns }
    }

    /// Puts a picture, `[HEIGHT][WIDTH][3]`, at the place `at`, counted row by row.
    fn put(&mut self, at: usize, pixels: &[u8]) {
        let (x, y) = (at % self.columns * (WIDTH + GAP), at / self.columns * (HEIGHT + GAP));
        for (k, rgb) in pixels.as_chunks::<3>().0.iter().enumerate() {
            self.image.put_pixel((x + k % WIDTH) as u32, (y + k / WIDTH) as u32, Rgb(*rgb));
        }
    }
}

/// Takes pictures of a track from the reference line.
struct Photographer<'a> {
    track: &'a Track,
    variant: Variant,
    renderer: Renderer,
    frame: RgbFrame,
}

impl Photographer<'_> {
    fn new(track: &Track, light_seed: u64) -> Photographer<'_> {
        let variant = Variant::new(track.world(), light_seed);
        Photographer { track, variant, renderer: Renderer::default(), frame: RgbFrame::default() }
    }

    /// The picture at a share of the lap, 0 to 1.
    fn take(&mut self, lap: f64, mount: Mount) -> &[u8] {
        let start = Start { s_m: self.track.length_m * lap, reverse: false, offset_m: 0.0, heading_deg: 0.0 };
        let camera = Camera::new(&Simulation::new(self.track, start, 20.0 * MPS_PER_MPH).body_pose(), mount);
        self.renderer.render(self.track.world(), &self.variant, &camera, mount, &mut self.frame);
        &self.frame.pixels
    }
}

/// A sheet of pictures, `rows` of `columns`, taken at even distances along the lap in light `light_seed` (0 = the track's
/// own). With `triples` each row holds left, centre and right of one place, and `columns` counts triples.
pub fn contact_sheet(track: &Track, columns: usize, rows: usize, triples: bool, light_seed: u64) -> RgbImage {
    let mounts: &[Mount] = if triples { &[Mount::Left, Mount::Center, Mount::Right] } else { &[Mount::Center] };
    let mut sheet = Sheet::new(columns * mounts.len(), rows);
    let mut photographer = Photographer::new(track, light_seed);
    let places = columns * rows;
    for at in 0..places * mounts.len() {
        let lap = (at / mounts.len()) as f64 / places as f64;
        sheet.put(at, photographer.take(lap, mounts[at % mounts.len()]));
    }
    sheet.image
}

/// A sheet with given pictures in its odd columns, each with a picture of the track to its right; `columns` counts pairs.
/// Pictures of another size are resized.
pub fn side_by_side(track: &Track, columns: usize, given: &[RgbImage], light_seed: u64) -> RgbImage {
    let mut sheet = Sheet::new(2 * columns, given.len().div_ceil(columns));
    let mut photographer = Photographer::new(track, light_seed);
    for (k, picture) in given.iter().enumerate() {
        let filter = image::imageops::FilterType::Triangle;
        let fitting = image::imageops::resize(picture, WIDTH as u32, HEIGHT as u32, filter);
        sheet.put(2 * k, fitting.as_raw());
        sheet.put(2 * k + 1, photographer.take(k as f64 / given.len() as f64, Mount::Center));
    }
    sheet.image
}
