//! Making a sample: decoding its picture, warping it to where a car is shown to stand, changing it, and the label that belongs to it.

use super::{Loader, cached_len, keeps_rgb, lock};
use crate::Result;
use crate::dataset::pictures::preprocess::{Preprocessing, Preprocessor};
use crate::dataset::recording::View;
use crate::dataset::samples::labels::{chained, turn_of_camera};
use crate::dataset::samples::pairs::Wanted;
use crate::dataset::samples::{Correction, Item, Mirror};
use crate::engine::random::{Purpose, rng};
use crate::geometry::{CarGeometry, Offset, PixelGrid, ViewWarp};
use crate::picture::{RgbImage, decode::decode_rgb};

/// Buffers of one thread.
#[derive(Debug)]
pub(super) struct Scratch {
    file: Vec<u8>,
    image: RgbImage,
    preprocessor: Preprocessor,
    cached: Vec<u8>,
    rgb: Vec<u8>,
    planes: Vec<u8>,
}

impl Loader {
    /// Writes a sample's network input to `x` and its labels to `labels`; `false` if the image cannot be decoded.
    pub(super) fn make_sample(
        &self,
        wanted: &Wanted,
        x: &mut [f32],
        labels: &mut [f32],
        scratch: &mut Scratch,
    ) -> Result<bool> {
        let own = wanted.sample / self.variants() as u32;
        let (number, camera) = self.images[own as usize];
        let item = self.items[number as usize];
        let mirrored = self.is_mirrored(wanted.draws);
        // The second augmentation of a sample has numbers that no first one has.
        let samples = self.images.len() * self.variants();
        let stream = u64::from(wanted.draws) + if wanted.again { samples as u64 } else { 0 };
        let in_mirrored_world = mirrored && self.spec.samples.mirror == Mirror::Geometry;
        let view = self.view(stream);
        let image = view.map_or(own, |offset| self.nearest_image(number, offset));
        let Scratch { file, image: decoded, preprocessor, cached, rgb, planes } = scratch;
        let picture = self.pictures[image as usize];
        let made = self.cache.get(picture as usize, cached, |out| {
            self.decode(image, file, decoded, preprocessor, out)
                .map_err(|message| self.report(picture, message))
                .is_ok()
        })?;
        let Some(made) = made else { return Ok(false) };
        let preprocessing = &self.spec.preprocessing;
        let mut moved_px = 0.0;
        let keeps_rgb = keeps_rgb(&self.spec, self.training, self.flip);
        if keeps_rgb {
            moved_px = self.times.augment.time(|| {
                match self.warp(item, self.images[image as usize].1, view, in_mirrored_world) {
                    Some(warp) => warp.apply(made, rgb),
                    None => rgb.copy_from_slice(made),
                }
                if !self.training || !self.spec.augmentation.is_active() {
                    return 0.0;
                }
                let mut rng = rng(self.spec.seed, Purpose::Augment, self.epoch, stream);
                self.spec.augmentation.apply(preprocessing, rgb, &mut rng)
            });
        }
        // A picture that moved to the right in the mirrored world moved to the left in the world of the label.
        let label = self.label(item, camera, view, if in_mirrored_world { -moved_px } else { moved_px });
        self.times.preprocess.time(|| {
            if keeps_rgb {
                preprocessor.finish(rgb, planes);
            } else {
                planes.copy_from_slice(made);
            }
            if mirrored && !in_mirrored_world {
                planes.chunks_exact_mut(preprocessing.resize[1]).for_each(<[u8]>::reverse);
            }
            preprocessing.to_input(planes, x);
        });
        labels[0] = if mirrored { -label } else { label };
        labels[1..].copy_from_slice(self.targets.labels_beside_steering(item));
        Ok(true)
    }

    /// Where beside the driven path a sample with the random numbers `stream` is shown from; `None` as it was taken.
    fn view(&self, stream: u64) -> Option<Offset> {
        let spec = self.spec.augmentation.view.filter(|_| self.training)?;
        spec.draw(&mut rng(self.spec.seed, Purpose::View, self.epoch, stream))
    }

    /// The image of item `number` whose camera was nearest to a car at `offset`.
    fn nearest_image(&self, number: u32, offset: Offset) -> u32 {
        let item = self.items[number as usize];
        let distance_m = |image: &u32| {
            let camera = self.images[*image as usize].1;
            (self.targets.camera_right_m(item, camera) - offset.right_m).abs()
        };
        let images = self.first_images[number as usize]..self.first_images[number as usize + 1];
        images.min_by(|a, b| distance_m(a).total_cmp(&distance_m(b))).expect("an item has an image")
    }

    /// The warp of the picture of `camera` to what a car beside the path sees, or to a mirrored world; `None` where it stays as it
    /// is.
    fn warp(&self, item: Item, camera: View, view: Option<Offset>, in_mirrored_world: bool) -> Option<ViewWarp> {
        if view.is_none() && !in_mirrored_world {
            return None;
        }
        let Preprocessing { rows, source, .. } = self.spec.preprocessing;
        let car = self.car(item);
        let grid =
            PixelGrid::part(car, rows.map(|row| row as f64 / source[0] as f64), self.spec.preprocessing.rgb_size());
        let taken_m = self.targets.camera_right_m(item, camera);
        // Without a view from elsewhere the car is taken to stand where its camera is: nothing shifts.
        let offset = view.unwrap_or(Offset { right_m: taken_m, ..Offset::default() });
        Some(match in_mirrored_world {
            true => ViewWarp::mirrored(car, grid, taken_m, offset),
            false => ViewWarp::new(car, grid, taken_m, offset),
        })
    }

    /// The label of a sample before it is mirrored: its picture was taken by `camera`, or warped to `view`, and then moved to the right
    /// by `moved_px` source pixels.
    fn label(&self, item: Item, camera: View, view: Option<Offset>, moved_px: f64) -> f32 {
        let samples = &self.spec.samples;
        let mut offset = view.unwrap_or_else(|| samples.offset(&self.targets, item, camera));
        let added = if view.is_some() { 0.0 } else { samples.added(camera) };
        let mut shifted = 0.0;
        match self.spec.augmentation.shift_steering_per_px {
            Some(Correction::Fixed(per_px)) => shifted = (moved_px * per_px) as f32,
            Some(Correction::Geometry) if moved_px != 0.0 => {
                let car = self.car(item);
                let camera_px = moved_px * car.image[1] as f64 / self.spec.preprocessing.source[1] as f64;
                offset = chained(offset, turn_of_camera(car, libm::atan(camera_px / car.focal_px)));
            }
            _ => {}
        }
        self.targets.beside(item, offset) + added + shifted
    }

    fn car(&self, item: Item) -> &CarGeometry {
        self.targets.geometry(item).expect("the labels were made for these samples")
    }

    /// Reads, decodes and preprocesses an image, up to the stage that is cached.
    fn decode(
        &self,
        image: u32,
        file: &mut Vec<u8>,
        decoded: &mut RgbImage,
        preprocessor: &mut Preprocessor,
        out: &mut [u8],
    ) -> std::result::Result<(), String> {
        let (_, camera) = self.images[image as usize];
        self.times.decode.time(|| self.read(image, file, decoded))?;
        let failed = |message: String| {
            let Item { recording, row, .. } = self.items[self.images[image as usize].0 as usize];
            let path = self.recordings[usize::from(recording)].image_path(row as usize, camera);
            format!("{}: {message}", path.unwrap_or_default().display())
        };
        if preprocessor.image_size() != [decoded.height, decoded.width] {
            let planned = self.spec.preprocessing.plan(decoded.height, decoded.width);
            *preprocessor = planned.map_err(|error| failed(error.to_string()))?;
        }
        self.thumbnails[self.pictures[image as usize] as usize]
            .get_or_init(|| (camera == View::Centre && self.is_compared(image)).then(|| self.thumbnail(decoded)));
        self.times.preprocess.time(|| {
            if keeps_rgb(&self.spec, self.training, self.flip) {
                preprocessor.to_rgb_stage(&decoded.pixels, out);
            } else {
                preprocessor.apply(&decoded.pixels, out);
            }
        });
        Ok(())
    }

    /// Reads and decodes an image.
    pub(super) fn read(
        &self,
        image: u32,
        file: &mut Vec<u8>,
        decoded: &mut RgbImage,
    ) -> std::result::Result<(), String> {
        let (item, camera) = self.images[image as usize];
        let Item { recording, row, .. } = self.items[item as usize];
        let recording = &self.recordings[usize::from(recording)];
        let path = recording.image_path(row as usize, camera).ok_or("no such image")?;
        recording.read_picture(row as usize, camera, file).map_err(|error| error.to_string())?;
        decode_rgb(file, decoded).map_err(|message| format!("{}: {message}", path.display()))
    }

    fn report(&self, image: u32, message: String) {
        lock(&self.undecodable).insert(image, message);
    }

    /// Runs `work` with buffers that no other thread uses.
    pub(super) fn with_scratch<T>(&self, work: impl FnOnce(&mut Scratch) -> T) -> Result<T> {
        let held = lock(&self.scratch).pop();
        let mut scratch = match held {
            Some(scratch) => scratch,
            None => {
                let spec = &self.spec.preprocessing;
                Scratch {
                    file: Vec::new(),
                    image: RgbImage::default(),
                    preprocessor: spec.plan(spec.source[0], spec.source[1])?,
                    cached: vec![0; cached_len(&self.spec, self.training, self.flip)],
                    rgb: vec![0; spec.rgb_len()],
                    planes: vec![0; spec.output_len()],
                }
            }
        };
        let result = work(&mut scratch);
        lock(&self.scratch).push(scratch);
        Ok(result)
    }
}
