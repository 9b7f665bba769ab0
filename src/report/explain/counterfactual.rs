//! What if the picture were different? Each picture is changed in one way at a time, and the model is asked again: how far
//! does its angle move, and does it move the way it should?

use rayon::prelude::*;
use serde::Serialize;

use crate::error::{Error, Result};
use crate::observer::{Observer, Progress, Tally};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::report::explain::footage::{Footage, Projector};

/// Where the horizon of Udacity's camera lies, as a share of the height.
const HORIZON: f64 = 0.355;
/// Where the bonnet begins.
const BONNET: f64 = 0.85;
/// Half width of the road with its edges at the horizon and at the bonnet, as a share of the width: 5 m on a level road seen
/// from 1.2 m up, and room for bends far away.
const ROAD_HALF: [f64; 2] = [0.08, 1.1];
/// Share of the width that pictures are shifted by.
const SHIFT: f64 = 0.0625;
/// Factors of darker and brighter pictures.
const DARKER: f64 = 0.6;
/// See [`DARKER`].
const BRIGHTER: f64 = 1.4;
/// Angles below this are straight, in degrees: they have no side.
const STRAIGHT_DEG: f64 = 1.0;
/// A change moves the angle little below this share of how much the model steers at all.
const LITTLE: f64 = 0.2;
/// A change moves the angle much from here on.
const MUCH: f64 = 0.5;
/// What lies beside the road counts for more than the road itself from this many times its effect on.
const BESIDE: f64 = 1.2;
/// Share of the frames that must move the right way.
const MOSTLY: f64 = 0.8;

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
    fn moved_deg(self, before_deg: f64, after_deg: f64) -> f64 {
        if self == Change::Mirror { after_deg + before_deg } else { after_deg - before_deg }
    }

    /// Whether the angle moved the way it should; `None` where no way is right.
    fn right_way(self, before_deg: f64, after_deg: f64) -> Option<bool> {
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
    /// Whether the model passes; `None` where the change is for information.
    pub passed: Option<bool>,
    /// What that means.
    pub verdict: String,
}

/// The effects of all changes on a model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Counterfactuals {
    /// Pictures that were looked at.
    pub pictures: usize,
    /// Mean distance of the model's angles from their mean: how much it steers at all.
    pub spread_deg: f64,
    /// Mean absolute error on unchanged pictures, where there are labels.
    pub mae_deg: Option<f64>,
    /// One for each of [`Change::ALL`].
    pub effects: Vec<Effect>,
    /// All of it in a few sentences.
    pub verdict: Vec<String>,
}

/// Steering of each picture, unchanged and after each change; pictures that cannot be read are an error.
///
/// # Errors
///
/// As [`Footage::picture`]; [`Error::Input`] if there is no picture; the observer's own.
pub fn examine(
    pilot: &Pilot,
    footage: &Footage,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<(Counterfactuals, Vec<f32>)> {
    if footage.is_empty() {
        return Err(Error::Input("there is no picture to look at".into()));
    }
    let tally = Tally::new(footage.len(), observer);
    let fresh = || (pilot.clone(), Projector::default(), RgbImage::default(), RgbImage::default());
    let look = |(pilot, projector, image, changed): &mut (Pilot, Projector, RgbImage, RgbImage), i: usize| {
        footage.picture(i, projector, image)?;
        let mut answers = [0.0f32; Change::ALL.len() + 1];
        answers[0] = pilot.steer(image.height, image.width, &image.pixels)?;
        for (change, answer) in Change::ALL.into_iter().zip(&mut answers[1..]) {
            change.apply(image, changed);
            *answer = pilot.steer(changed.height, changed.width, &changed.pixels)?;
        }
        tally.add(1)?;
        Ok(answers)
    };
    let answers: Vec<[f32; Change::ALL.len() + 1]> =
        (0..footage.len()).into_par_iter().map_init(fresh, look).collect::<Result<_>>()?;
    let labels: Vec<Option<f32>> = (0..footage.len()).map(|i| footage.label(i)).collect();
    let kept = pilot.recipe().preprocessing.rows.map(|row| row as f64 / pilot.recipe().preprocessing.source[0] as f64);
    let found = judge(&answers, &labels, pilot.recipe().full_lock_deg, kept);
    Ok((found, answers.iter().map(|answer| answer[0]).collect()))
}

/// Turns answers into effects and words. `kept` is the range of the height that preprocessing keeps.
fn judge(
    answers: &[[f32; Change::ALL.len() + 1]],
    labels: &[Option<f32>],
    full_lock_deg: f64,
    kept: [f64; 2],
) -> Counterfactuals {
    let deg = |steering: f32| f64::from(steering) * full_lock_deg;
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let angles: Vec<f64> = answers.iter().map(|answer| deg(answer[0])).collect();
    let middle = mean(&angles);
    let spread_deg = mean(&angles.iter().map(|angle| (angle - middle).abs()).collect::<Vec<_>>());
    let mae = |k: usize, sign: f64| {
        let errors = answers
            .iter()
            .zip(labels)
            .filter_map(|(answer, label)| Some((deg(answer[k]) - sign * deg((*label)?)).abs()));
        let errors: Vec<f64> = errors.collect();
        (!errors.is_empty()).then(|| mean(&errors))
    };
    let effects: Vec<Effect> = Change::ALL
        .into_iter()
        .enumerate()
        .map(|(k, change)| {
            let after: Vec<f64> = answers.iter().map(|answer| deg(answer[k + 1])).collect();
            let moved: Vec<f64> = angles.iter().zip(&after).map(|(a, b)| change.moved_deg(*a, *b)).collect();
            let mut distances: Vec<f64> = moved.iter().map(|moved| moved.abs()).collect();
            let ways: Vec<f64> =
                angles.iter().zip(&after).filter_map(|(a, b)| change.right_way(*a, *b)).map(f64::from).collect();
            let mean_moved_deg = mean(&distances);
            distances.sort_by(f64::total_cmp);
            let right_way_share = (!ways.is_empty()).then(|| mean(&ways));
            let (passed, verdict) = verdict(change, mean_moved_deg / spread_deg.max(1e-9), right_way_share, kept);
            Effect {
                change,
                mean_moved_deg,
                p95_moved_deg: crate::statistics::quantile(&distances, 0.95),
                bias_deg: mean(&moved),
                right_way_share,
                mae_deg: mae(k + 1, if change == Change::Mirror { -1.0 } else { 1.0 }),
                passed,
                verdict,
            }
        })
        .collect();
    let verdict = conclusion(&effects, spread_deg);
    Counterfactuals { pictures: answers.len(), spread_deg, mae_deg: mae(0, 1.0), effects, verdict }
}

/// Whether a model passes a change that moves its angle by `share` of how much it steers at all, and what that means.
fn verdict(change: Change, share: f64, right_way: Option<f64>, kept: [f64; 2]) -> (Option<bool>, String) {
    let cut_off = match change {
        Change::MaskSky => kept[0] >= HORIZON,
        Change::MaskBonnet => kept[1] <= BONNET,
        _ => false,
    };
    let percent = 100.0 * share;
    match change {
        _ if cut_off => (Some(true), "cut off before the network sees it".into()),
        Change::MaskSky | Change::MaskBonnet | Change::Darken | Change::Brighten => {
            let said = format!("{percent:.0} % of how much it steers");
            match share {
                share if share <= LITTLE => (Some(true), format!("hardly matters, as it should ({said})")),
                share if share <= MUCH => (Some(false), format!("matters somewhat, and should not ({said})")),
                _ => (Some(false), format!("matters a lot, and should not ({said})")),
            }
        }
        Change::MaskRoad => match share {
            share if share >= MUCH => {
                (Some(true), format!("matters, as it should ({percent:.0} % of how much it steers)"))
            }
            _ => (Some(false), format!("hardly matters: it does not look at the road ({percent:.0} %)")),
        },
        Change::MaskBeside | Change::MaskLeft | Change::MaskRight => {
            (None, format!("{percent:.0} % of how much it steers"))
        }
        Change::Mirror => {
            let passed = share <= MUCH && right_way.is_none_or(|share| share >= MOSTLY);
            let share = right_way.map_or("-".into(), |share| format!("{:.0} %", 100.0 * share));
            let words = match passed {
                true => format!("steers to the other side, as it should, in {share} of the bends"),
                false => {
                    format!("the angle is not simply negated; it steers to the other side in {share} of the bends")
                }
            };
            (Some(passed), words)
        }
        Change::ShiftLeft | Change::ShiftRight => {
            let right = right_way.unwrap_or(0.0);
            let words = if right >= MOSTLY { "follows the road, as it should" } else { "does not follow the road" };
            (Some(right >= MOSTLY), format!("{words} ({:.0} % move the right way)", 100.0 * right))
        }
    }
}

/// The effects in a few sentences.
fn conclusion(effects: &[Effect], spread_deg: f64) -> Vec<String> {
    if spread_deg < 0.3 {
        return vec![format!(
            "The model hardly steers at all: its angles differ by {spread_deg:.2}° on average. Nothing can be said of what it looks at."
        )];
    }
    let of = |change: Change| effects.iter().find(|effect| effect.change == change);
    let moved = |change: Change| of(change).map_or(0.0, |effect| effect.mean_moved_deg);
    let passed = |change: Change| of(change).and_then(|effect| effect.passed) != Some(false);
    let mut sentences = Vec::new();
    let (road, beside) = (moved(Change::MaskRoad), moved(Change::MaskBeside));
    sentences.push(if !passed(Change::MaskRoad) {
        "It steers by something else than the road: without the road it steers nearly as before.".to_string()
    } else if beside > BESIDE * road {
        format!("It looks more at what lies beside the road ({beside:.1}° without it) than at the road itself ({road:.1}°): on roads with other surroundings it may be lost.")
    } else {
        format!("It steers by the road: without it the angle moves by {road:.1}°, without everything beside it by {beside:.1}°.")
    });
    if !(passed(Change::MaskSky) && passed(Change::MaskBonnet)) {
        sentences.push(
            "It also goes by sky or bonnet, which tell nothing about the road: crop them, or show it more roads."
                .into(),
        );
    }
    if !(passed(Change::Darken) && passed(Change::Brighten)) {
        sentences.push("Light disturbs it: train with augmentation.brightness, as in [0.5, 1.5].".into());
    }
    if !(passed(Change::ShiftLeft) && passed(Change::ShiftRight)) {
        sentences.push("It does not steer back when the road lies to one side: it has not learned to recover. Use side cameras, shifts or recordings of recovery.".into());
    }
    if !passed(Change::Mirror) {
        sentences.push("In a mirrored world it steers differently: it has learned this track, or one side. Train with samples.flip=random, \
             unless the camera is mounted askew (Udacity's is rolled by 1.2°): mirrored pictures then show the car beside its place.".into());
    }
    let (left, right) = (moved(Change::MaskLeft), moved(Change::MaskRight));
    if left.max(right) > 2.0 * left.min(right) {
        let side = if left > right { "left" } else { "right" };
        sentences.push(format!("It looks mainly at the {side} side of the road."));
    }
    if sentences.len() == 1 && passed(Change::MaskRoad) {
        sentences.push("It passes every test here. Whether it drives, only driving shows.".into());
    }
    sentences
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

    #[test]
    fn figures_are_those_of_a_case_computed_by_hand() {
        // Angles 10 and −10 degrees. The sky moves them by 1 and −3; the mirror gives −10 and 6; shifts are right, then wrong.
        let mut answers = [[0.4f32; 12], [-0.4; 12]];
        let at = |change: Change| 1 + Change::ALL.iter().position(|c| *c == change).unwrap();
        (answers[0][at(Change::MaskSky)], answers[1][at(Change::MaskSky)]) = (0.44, -0.52);
        (answers[0][at(Change::Mirror)], answers[1][at(Change::Mirror)]) = (-0.4, 0.24);
        (answers[0][at(Change::ShiftRight)], answers[1][at(Change::ShiftRight)]) = (0.5, -0.5);
        let found = judge(&answers, &[Some(0.4), Some(-0.48)], 25.0, [0.25, 0.85]);
        let effect = |change: Change| &found.effects[at(change) - 1];
        let near = |a: f64, b: f64| (a - b).abs() < 1e-5;
        assert!(near(found.spread_deg, 10.0) && near(found.mae_deg.unwrap(), 1.0), "{found:?}");
        let sky = effect(Change::MaskSky);
        assert!(near(sky.mean_moved_deg, 2.0) && near(sky.bias_deg, -1.0) && sky.passed == Some(true), "{sky:?}");
        let mirror = effect(Change::Mirror);
        assert!(near(mirror.mean_moved_deg, 2.0) && mirror.right_way_share == Some(1.0) && mirror.passed == Some(true));
        // Against the negated labels: 0 and 6 degrees off.
        assert!(near(mirror.mae_deg.unwrap(), 3.0), "{mirror:?}");
        assert_eq!(
            (effect(Change::ShiftRight).right_way_share, effect(Change::ShiftRight).passed),
            (Some(0.5), Some(false))
        );
        assert_eq!(effect(Change::MaskRoad).passed, Some(false));
        assert!(effect(Change::MaskBonnet).verdict.contains("cut off"));
        assert!(found.verdict[0].contains("something else than the road"), "{:?}", found.verdict);
    }

    #[test]
    fn a_model_that_does_not_steer_is_told_so() {
        let found = judge(&[[0.01; 12], [0.011; 12]], &[None, None], 25.0, [0.0, 1.0]);
        assert!(found.verdict[0].contains("hardly steers") && found.mae_deg.is_none());
    }
}
