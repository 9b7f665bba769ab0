//! The preprocessings that are tried.

use crate::dataset::colour::Colour;
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::resize::Interpolation;
use crate::engine::layers::Family;
use crate::engine::network::{LayerSpec, Network};
use crate::engine::tensor::Shape;

/// Height of Udacity's picture, which [`CROPS`] refers to.
const UDACITY_HEIGHT: usize = 160;

/// Rows that well-known projects keep: first and end.
const CROPS: [[usize; 2]; 22] = [
    [0, 160],
    [0, 135],
    [20, 140],
    [25, 135],
    [30, 135],
    [32, 135],
    [40, 135],
    [40, 138],
    [40, 160],
    [50, 135],
    [50, 140],
    [50, 160],
    [52, 135],
    [55, 135],
    [56, 144],
    [60, 135],
    [60, 140],
    [60, 160],
    [63, 136],
    [70, 135],
    [70, 140],
    [80, 160],
];

/// Factor and offset that turn a grey level into an input value.
const SCALINGS: [(f64, f64); 4] = [(1.0, 0.0), (1.0 / 255.0, 0.0), (1.0 / 255.0, -0.5), (1.0 / 127.5, -1.0)];

const COLOURS: [Colour; 7] =
    [Colour::Rgb, Colour::Bgr, Colour::Yuv, Colour::YuvOld, Colour::Hsv, Colour::Hls, Colour::Lab];

const SINGLE_PLANES: [Colour; 2] = [Colour::Gray, Colour::Saturation];

/// The combinations for a network and pictures of `source` size: every colour space of its input's number of planes, every crop and
/// every scaling, resized to its input by the linear method without a blur.
pub fn combinations(network: &Network, source: [usize; 2]) -> Vec<Preprocessing> {
    let Shape { c, h, w } = network.input();
    let colours: &[Colour] = match c {
        3 => &COLOURS,
        1 => &SINGLE_PLANES,
        _ => &[],
    };
    // A network that scales by itself, perhaps after it has cropped or resized, wants grey levels.
    let keeps_grey_levels = |spec: &LayerSpec| spec.family() == Family::Rearrangement || spec.base_name() == "resize";
    let first = network.layers().iter().find(|layer| !keeps_grey_levels(&layer.spec));
    let scales_itself = first.is_some_and(|layer| layer.spec.family() == Family::Normalization);
    let scalings = if scales_itself { &SCALINGS[..1] } else { &SCALINGS[..] };
    let mut crops: Vec<[usize; 2]> = Vec::new();
    for rows in CROPS.map(|rows| rows.map(|row| (row * source[0] + UDACITY_HEIGHT / 2) / UDACITY_HEIGHT)) {
        if rows[0] < rows[1] && !crops.contains(&rows) {
            crops.push(rows);
        }
    }
    let mut all = Vec::new();
    for &colour in colours {
        for &rows in &crops {
            for &(scale, offset) in scalings {
                let resize = [h, w];
                all.push(Preprocessing { source, rows, resize, colour, scale, offset, ..Preprocessing::default() });
            }
        }
    }
    all
}

/// `best` by other ways of resizing: by the area method, with the colours first, and each of these after a blur.
pub fn variants(best: &Preprocessing) -> Vec<Preprocessing> {
    let area = Preprocessing { interpolation: Interpolation::Area, ..best.clone() };
    let mut all = vec![Preprocessing { blur: true, ..best.clone() }, area.clone()];
    if !matches!(best.colour, Colour::Rgb | Colour::Bgr) {
        all.push(Preprocessing { colour_first: true, ..area.clone() });
    }
    all.push(Preprocessing { blur: true, ..area });
    all
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::layers::{DenseSpec, ResizeMethod, ResizeSpec, ScaleSpec};
    use steersman_kernels::Isa;

    fn network(scales_itself: bool) -> Network {
        let scale = ScaleSpec { factor: 1.0 / 255.0, offset: 0.0 }.into();
        let dense = DenseSpec { units: 1, init: Default::default() }.into();
        let layers = if scales_itself { vec![scale, dense] } else { vec![dense] };
        Network::new(Shape::new(3, 4, 8), &layers, Isa::PORTABLE).unwrap()
    }

    #[test]
    fn every_colour_crop_and_scaling_is_tried_once() {
        let all = combinations(&network(true), [160, 320]);
        assert_eq!(all.len(), COLOURS.len() * CROPS.len());
        for rows in [[0, 135], [52, 135]] {
            assert_eq!(all.iter().filter(|p| p.rows == rows).count(), COLOURS.len());
        }
        let all = combinations(&network(false), [160, 320]);
        assert_eq!(all.len(), COLOURS.len() * CROPS.len() * SCALINGS.len());
        let resize = ResizeSpec { to: [2, 4], method: ResizeMethod::default() }.into();
        let scale = ScaleSpec { factor: 1.0 / 255.0, offset: 0.0 }.into();
        let dense = DenseSpec { units: 1, init: Default::default() }.into();
        let resizes = Network::new(Shape::new(3, 4, 8), &[resize, scale, dense], Isa::PORTABLE).unwrap();
        assert_eq!(combinations(&resizes, [160, 320]).len(), COLOURS.len() * CROPS.len(), "it scales after it resizes");
        let twice = all.iter().enumerate().any(|(i, p)| all[..i].contains(p));
        assert!(!twice && all.iter().all(|p| p.validate().is_ok()));
    }

    #[test]
    fn crops_are_those_of_the_pictures_height() {
        let all = combinations(&network(true), [120, 160]);
        assert!(all.iter().all(|p| p.source == [120, 160] && p.validate().is_ok()));
        // 60 to 140 of 160.
        assert!(all.iter().any(|p| p.rows == [45, 105]));
        assert!(!combinations(&network(true), [1, 7]).is_empty(), "the whole picture at least");
    }

    #[test]
    fn variants_blur_and_resize_otherwise() {
        let of = |colour| variants(&Preprocessing { colour, ..Preprocessing::default() });
        let yuv = of(Colour::Yuv);
        let ways: Vec<_> =
            yuv.iter().map(|p| (p.blur, p.interpolation == Interpolation::Area, p.colour_first)).collect();
        assert_eq!(ways, [(true, false, false), (false, true, false), (false, true, true), (true, true, false)]);
        assert_eq!(of(Colour::Bgr).len(), 3, "the order of planes and resize makes no difference");
    }
}
