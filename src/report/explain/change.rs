//! Ways to change a picture, one at a time, and what a model should make of each.

use serde::Serialize;

use crate::picture::RgbImage;

/// Where the horizon of Udacity's camera lies, as a share of the height.
pub(super) const HORIZON: f64 = 0.355;
/// Where the bonnet begins.
pub(super) const BONNET: f64 = 0.85;
/// Half width of the road with its edges at the horizon and at the bonnet, as a share of the width: 5 m on a level road seen
/// from 1.2 m up, and room for bends far away.
const ROAD_HALF: [f64; 2] = [0.08, 1.1];
/// Share of the width that pictures are shifted by.
const SHIFT: f64 = 0.0625;
/// Factors of darker and brighter pictures.
pub(super) const DARKER: f64 = 0.6;
/// See [`DARKER`].
pub(super) const BRIGHTER: f64 = 1.4;
/// Angles below this are straight, in degrees: they have no side.
const STRAIGHT_DEG: f64 = 1.0;

/// One way to change a picture. Masked parts take the mean colour of their row of the picture, so that no new edges lead
/// anywhere.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Change {
    /// Everything above the horizon.
    MaskSky,
    /// The lowest 15 %.
    MaskBonnet,
    /// A trapezium from the horizon to the bonnet that holds the road and its edges.
    MaskRoad,
    /// What is left and right of that trapezium.
    MaskBeside,
    /// The left half.
    MaskLeft,
    /// The right half.
    MaskRight,
    /// Left and right exchanged.
    Mirror,
    /// Grey levels times 0.6.
    Darken,
    /// Grey levels times 1.4.
    Brighten,
    /// By 1/16 of the width to the left.
    ShiftLeft,
    /// By 1/16 of the width to the right.
    ShiftRight,
}

impl Change {
    /// All of them.
    pub const ALL: [Change; 11] = [
        Change::MaskSky,
        Change::MaskBonnet,
        Change::MaskRoad,
        Change::MaskBeside,
        Change::MaskLeft,
        Change::MaskRight,
        Change::Mirror,
        Change::Darken,
        Change::Brighten,
        Change::ShiftLeft,
        Change::ShiftRight,
    ];

    /// Whether the change hides a part of the picture.
    pub(super) fn is_mask(self) -> bool {
        use Change::{MaskBeside, MaskBonnet, MaskLeft, MaskRight, MaskRoad, MaskSky};
        matches!(self, MaskSky | MaskBonnet | MaskRoad | MaskBeside | MaskLeft | MaskRight)
    }

    /// The change in words.
    pub fn text(self) -> &'static str {
        match self {
            Change::MaskSky => "sky masked",
            Change::MaskBonnet => "bonnet masked",
            Change::MaskRoad => "road and its edges masked",
            Change::MaskBeside => "everything beside the road masked",
            Change::MaskLeft => "left half masked",
            Change::MaskRight => "right half masked",
            Change::Mirror => "mirrored",
            Change::Darken => "darker (x 0.6)",
            Change::Brighten => "brighter (x 1.4)",
            Change::ShiftLeft => "shifted left by 1/16",
            Change::ShiftRight => "shifted right by 1/16",
        }
    }

    /// Whether the pixel at the shares `y` and `x` of the picture is masked.
    fn masks(self, y: f64, x: f64) -> bool {
        let on_road = || {
            let along = ((y - HORIZON) / (BONNET - HORIZON)).clamp(0.0, 1.0);
            (x - 0.5).abs() < ROAD_HALF[0] + (ROAD_HALF[1] - ROAD_HALF[0]) * along
        };
        let between = (HORIZON..BONNET).contains(&y);
        match self {
            Change::MaskSky => y < HORIZON,
            Change::MaskBonnet => y >= BONNET,
            Change::MaskRoad => between && on_road(),
            Change::MaskBeside => between && !on_road(),
            Change::MaskLeft => x < 0.5,
            Change::MaskRight => x >= 0.5,
            Change::Mirror | Change::Darken | Change::Brighten | Change::ShiftLeft | Change::ShiftRight => false,
        }
    }

    /// Writes the changed `image` to `out`.
    pub fn apply(self, image: &RgbImage, out: &mut RgbImage) {
        out.clone_from(image);
        let (height, width) = (image.height, image.width);
        let by = (SHIFT * width as f64).round() as usize;
        let factor = if self == Change::Darken { DARKER } else { BRIGHTER };
        match self {
            Change::Mirror => *out = image.mirrored(),
            Change::Darken | Change::Brighten => {
                out.pixels.iter_mut().for_each(|grey| *grey = (f64::from(*grey) * factor).round().min(255.0) as u8);
            }
            // The edge column fills what comes into view.
            Change::ShiftLeft => each_pixel(out, |row, column| image.pixel(row, (column + by).min(width - 1))),
            Change::ShiftRight => each_pixel(out, |row, column| image.pixel(row, column.saturating_sub(by))),
            _ => {
                for row in 0..height {
                    let y = (row as f64 + 0.5) / height as f64;
                    let sums = (0..width).fold([0u32; 3], |sums, column| {
                        let pixel = image.pixel(row, column);
                        std::array::from_fn(|k| sums[k] + u32::from(pixel[k]))
                    });
                    let mean = sums.map(|sum| (sum / width as u32) as u8);
                    for column in 0..width {
                        if self.masks(y, (column as f64 + 0.5) / width as f64) {
                            out.set_pixel(row, column, mean);
                        }
                    }
                }
            }
        }
    }

    /// What the angle should be after the change, in one number: by how much the answer is off, in degrees. A mirrored picture
    /// should give the negated angle; everything else is compared with the unchanged picture.
    pub(super) fn moved_deg(self, before_deg: f64, after_deg: f64) -> f64 {
        if self == Change::Mirror { after_deg + before_deg } else { after_deg - before_deg }
    }

    /// Whether the angle moved the way it should; `None` where no way is right.
    pub(super) fn right_way(self, before_deg: f64, after_deg: f64) -> Option<bool> {
        match self {
            Change::Mirror if before_deg.abs() < STRAIGHT_DEG => None,
            Change::Mirror => Some(before_deg * after_deg < 0.0),
            // A road that lies further right has to be steered to.
            Change::ShiftLeft => Some(after_deg < before_deg),
            Change::ShiftRight => Some(after_deg > before_deg),
            _ => None,
        }
    }
}

fn each_pixel(out: &mut RgbImage, rgb: impl Fn(usize, usize) -> [u8; 3]) {
    for row in 0..out.height {
        for column in 0..out.width {
            out.set_pixel(row, column, rgb(row, column));
        }
    }
}

/// What one change did, over all pictures. Angles are degrees of the front wheels.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Effect {
    /// The change.
    pub change: Change,
    /// Mean distance that the angle moves.
    pub mean_moved_deg: f64,
    /// Its 95th percentile.
    pub p95_moved_deg: f64,
    /// Mean movement, + = to the right.
    pub bias_deg: f64,
    /// Share of the pictures in which it moves the right way, where one is right.
    pub right_way_share: Option<f64>,
    /// Mean absolute error after the change, where there are labels (negated for mirrored pictures).
    pub mae_deg: Option<f64>,
    /// Whether the model steers clearly better without what is masked.
    pub helped: bool,
    /// Whether the model passes; `None` where the change is for information.
    pub passed: Option<bool>,
    /// What that means.
    pub verdict: String,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> RgbImage {
        RgbImage::from_fn(160, 320, |row, column| [row as u8, (column / 2) as u8, 90])
    }

    #[test]
    fn changes_do_what_they_say() {
        let (image, mut out) = (picture(), RgbImage::default());
        let mut changed = |change: Change| {
            change.apply(&image, &mut out);
            out.clone()
        };
        let sky = changed(Change::MaskSky);
        assert_eq!(
            (sky.pixel(10, 5), sky.pixel(10, 300), sky.pixel(80, 5)),
            ([10, 79, 90], [10, 79, 90], image.pixel(80, 5))
        );
        let road = changed(Change::MaskRoad);
        assert_eq!(
            (road.pixel(100, 160), road.pixel(60, 20), road.pixel(150, 160)),
            ([100, 79, 90], image.pixel(60, 20), image.pixel(150, 160))
        );
        // The edges of a road 9 m wide, seen from its middle, belong to it: 10 m ahead they are 4.5 / 10 focal lengths aside.
        let (focal, ten_metres_ahead) = (160.0 / 2.0 / 30f64.to_radians().tan(), HORIZON + 1.2 / 10.0 * 0.866);
        for side in [-1.0, 1.0] {
            let edge = 0.5 + side * 0.45 * focal / 320.0;
            assert!(Change::MaskRoad.masks(ten_metres_ahead, edge), "{side}");
        }
        let beside = changed(Change::MaskBeside);
        assert_eq!((beside.pixel(100, 160), beside.pixel(60, 20)), (image.pixel(100, 160), [60, 79, 90]));
        assert_eq!(changed(Change::ShiftRight).pixel(7, 120), image.pixel(7, 100));
        assert_eq!(changed(Change::ShiftLeft).pixel(7, 319), image.pixel(7, 319));
        assert_eq!(changed(Change::Mirror).pixel(7, 0), image.pixel(7, 319));
        assert_eq!(changed(Change::Darken).pixel(100, 0), [60, 0, 54]);
        assert_eq!(changed(Change::Brighten).pixel(100, 0), [140, 0, 126]);
        // Each pixel between horizon and bonnet belongs to the road or to what is beside it.
        for (y, x) in [(0.4, 0.1), (0.5, 0.5), (0.8, 0.9), (0.45, 0.01)] {
            assert!(Change::MaskRoad.masks(y, x) != Change::MaskBeside.masks(y, x), "{y} {x}");
        }
    }
}
