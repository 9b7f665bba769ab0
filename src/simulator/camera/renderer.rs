//! Renders a frame: finds the ground behind each pixel, then looks up its colour.
//!
//! A frame takes four passes, none of which calls a function of the mathematical library per pixel:
//!
//! 1. *March*: in every eighth column, from the bottom up, the ray of each pixel is followed over the land until it goes
//!    below it. A ray is never blocked nearer than the ray below it, so each search starts where the last one ended, and a
//!    crest hides what is behind it.
//! 2. *Shade*: along each row, again from the bottom up, the place on the land is interpolated between these columns (eight
//!    pixels at a time) and the road's texture or the land's map is looked up at the resolution that fits. Where the ground
//!    breaks off between two columns, each pixel is marched on its own, from where the ray of the pixel below ended. Pixels
//!    without ground show the sky.
//! 3. *Objects*: walls and billboards are drawn where they are nearer than the ground.
//! 4. *Bonnet*: the car's own bonnet, which is always in the same place; small cars have none.

use crate::simulator::camera::bonnet::Bonnet;
use crate::simulator::camera::objects;
use crate::simulator::camera::pinhole::{Camera, HEIGHT, Mount, RgbFrame, WIDTH};
use crate::simulator::camera::view::{ANCHORS, Column, SPAN, Spot, View};
use crate::simulator::math::{atan2, vec3};
use crate::simulator::scenery::light::Variant;
use crate::simulator::scenery::sky::AROUND;
use crate::simulator::scenery::world::World;

/// Depth and fall of the rays from which the search of the lowest row starts.
const NEAREST: (f32, f32) = (0.9, -1.0);
/// Inverse depths below the lowest row.
const BELOW_PICTURE: [f32; WIDTH] = [1.0 / NEAREST.0; WIDTH];

/// Renders frames; keeps its buffers from one frame to the next.
pub struct Renderer {
    /// Inverse depth (1/m) at each row and marched column; 0 = sky.
    anchors: Vec<f32>,
    /// Inverse depth at each pixel; 0 = sky.
    pub(crate) depths: Vec<f32>,
    bonnet: Bonnet,
}

impl Default for Renderer {
    fn default() -> Self {
        Renderer { anchors: vec![0.0; HEIGHT * ANCHORS], depths: vec![0.0; HEIGHT * WIDTH], bonnet: Bonnet::default() }
    }
}

impl Renderer {
    /// Renders what `camera` sees of `world` in the light of `variant`, 320x160. The bonnet is in the picture as from `mount`, if that is
    /// where the camera is.
    pub fn render(
        &mut self,
        world: &World,
        variant: &Variant,
        camera: &Camera,
        mount: impl Into<Option<Mount>>,
        frame: &mut RgbFrame,
    ) {
        let mount = mount.into();
        let eye = vec3(camera.eye.x - world.terrain.x0, camera.eye.y - world.terrain.y0, camera.eye.z);
        let columns = std::array::from_fn(|k| {
            let column = (k * SPAN) as f32 + 0.5;
            let ray = camera.ray(column, HEIGHT as f32 / 2.0);
            let sky = camera.ray(column, 30.0);
            let turn = atan2(f64::from(sky.y), f64::from(sky.x)) / std::f64::consts::TAU;
            Column {
                middle: ray,
                level: 1.0 / (ray.x * ray.x + ray.y * ray.y).sqrt(),
                turn: turn as f32 * AROUND as f32,
            }
        });
        let limit = (world.terrain.nx as f32 - 1.01, world.terrain.ny as f32 - 1.01);
        let rise = world.terrain.highest_m() - eye.z;
        let view = View { world, variant, camera, eye, rise, limit, columns };
        frame.size = [HEIGHT, WIDTH];
        frame.pixels.resize(WIDTH * HEIGHT * 3, 0);
        self.march(&view, mount);
        self.shade(&view, mount, frame);
        objects::draw(&mut self.depths, &view, frame);
        if let Some(mount) = mount {
            self.bonnet.draw(mount, variant, frame);
        }
    }

    /// Depth along the camera's axis at a pixel of the last picture, m; infinite for the sky.
    pub fn depth_m(&self, column: usize, row: usize) -> f32 {
        1.0 / self.depths[row * WIDTH + column]
    }

    /// Finds the depth at every row of the marched columns. Rows are the outer loop: the searches of a row do not depend
    /// on each other, so the processor works on several at once.
    #[inline(never)]
    fn march(&mut self, view: &View, mount: Option<Mount>) {
        let mut lasts = [Some(NEAREST); ANCHORS];
        for (row, anchors) in self.anchors.chunks_exact_mut(ANCHORS).enumerate().rev() {
            // Shading looks at the row below too, so only what is hidden in both rows is left out.
            let hidden = mount.map_or(0..0, |mount| self.bonnet.hidden_spans(mount, row.saturating_sub(1)));
            for (k, (anchor, last)) in anchors.iter_mut().zip(&mut lasts).enumerate() {
                // Once a ray meets no land, no ray above it does.
                *anchor = 0.0;
                if hidden.start < k && k < hidden.end {
                    continue;
                }
                if let Some((depth, fall)) = *last {
                    let ray = view.ray(k, row);
                    *last = view.march(ray, depth, fall).map(|hit| (hit, ray.z));
                    if let Some((hit, _)) = *last {
                        *anchor = 1.0 / hit;
                    }
                }
            }
        }
    }

    #[inline(never)]
    fn shade(&mut self, view: &View, mount: Option<Mount>, frame: &mut RgbFrame) {
        let mut spots = [Spot::default(); ANCHORS];
        for row in (0..HEIGHT).rev() {
            let inverses = &self.anchors[row * ANCHORS..(row + 1) * ANCHORS];
            let below = &self.anchors[(row + 1).min(HEIGHT - 1) * ANCHORS..][..ANCHORS];
            let hidden = mount.map_or(0..0, |mount| self.bonnet.hidden_spans(mount, row));
            for (k, spot) in spots.iter_mut().enumerate() {
                *spot = view.spot(view.ray(k, row), view.columns[k].level, inverses[k]);
            }
            let (pixels, _) = frame.pixels[row * WIDTH * 3..(row + 1) * WIDTH * 3].as_chunks_mut();
            let (depths, rest) = self.depths[row * WIDTH..].split_at_mut(WIDTH);
            let (depths, _) = depths.as_chunks_mut::<SPAN>();
            let (depths_below, _) = rest.get(..WIDTH).unwrap_or(&BELOW_PICTURE).as_chunks();
            let mut known = spots[0];
            let mut levels = view.levels(row, &known, (below[0] - known.inverse).abs());
            for (k, (out, depth)) in pixels.as_chunks_mut().0.iter_mut().zip(depths).enumerate() {
                let (a, b) = (&spots[k], &spots[k + 1]);
                if hidden.contains(&k) {
                    // Nearer than any object, so that none is drawn there.
                    depth.fill(1.0 / NEAREST.0);
                    continue;
                }
                if a.inverse == 0.0 && b.inverse == 0.0 {
                    depth.fill(0.0);
                    view.shade_sky(row, k, out);
                } else if let Some(lap) = view.join(a, b) {
                    // The resolution changes slowly along a row.
                    if a.look != known.look
                        || a.near_road != known.near_road
                        || (a.depth - known.depth).abs() > 0.08 * a.depth
                    {
                        levels = view.levels(row, a, (below[k] - a.inverse).abs());
                        known = *a;
                    }
                    view.shade_span(a, b, lap, &levels, out, depth);
                } else {
                    view.shade_each(row, k, &depths_below[k], out, depth);
                }
            }
        }
    }
}
