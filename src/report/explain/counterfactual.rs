//! What if the picture were different? Each picture is changed in one way at a time, and the model is asked again: how far
//! does its angle move, and does it move the way it should?

use rayon::prelude::*;
use serde::Serialize;

use super::change::{BONNET, Change, Effect, HORIZON};
use super::findings::{Baseline, Finding, findings};
use super::footage::{Footage, FootageBuffers};
use crate::error::{Error, Result};
use crate::observer::{Observer, Progress, Tally};
use crate::picture::RgbImage;
use crate::pilot::Pilot;
use crate::recipe::Recipe;

/// A change moves the angle little below this share of how much the model steers at all.
const LITTLE: f64 = 0.2;
/// A change moves the angle much from this share on.
const MUCH: f64 = 0.5;
/// Share of the frames that must move the right way.
const MOSTLY: f64 = 0.8;
/// A mask helps a model whose error falls below this share of the error without the mask.
const HELPED: f64 = 0.9;

/// The effects of all changes on a model.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Counterfactuals {
    /// Pictures that were looked at.
    pub pictures: usize,
    /// Mean distance of the model's angles from their mean: how much it steers at all.
    pub spread_deg: f64,
    /// Mean absolute error on unchanged pictures, where there are labels.
    pub mae_deg: Option<f64>,
    /// That of a wheel held straight.
    pub straight_mae_deg: Option<f64>,
    /// One for each of [`Change::ALL`].
    pub effects: Vec<Effect>,
    /// All of it in a few sentences.
    pub findings: Vec<Finding>,
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
    let fresh = || (pilot.clone(), FootageBuffers::default(), RgbImage::default(), RgbImage::default());
    let look = |(pilot, buffers, image, changed): &mut (Pilot, FootageBuffers, RgbImage, RgbImage), i: usize| {
        footage.picture(i, buffers, image)?;
        let mut answers = [0.0f32; Change::ALL.len() + 1];
        answers[0] = pilot.steer(image.view())?;
        for (change, answer) in Change::ALL.into_iter().zip(&mut answers[1..]) {
            change.apply(image, changed);
            *answer = pilot.steer(changed.view())?;
        }
        tally.add(1)?;
        Ok(answers)
    };
    let answers: Vec<[f32; Change::ALL.len() + 1]> =
        (0..footage.len()).into_par_iter().map_init(fresh, look).collect::<Result<_>>()?;
    let labels: Vec<Option<f32>> = (0..footage.len()).map(|i| footage.label(i)).collect();
    let found = judge(&answers, &labels, pilot.recipe());
    Ok((found, answers.iter().map(|answer| answer[0]).collect()))
}

/// Turns answers into effects and words.
pub(super) fn judge(
    answers: &[[f32; Change::ALL.len() + 1]],
    labels: &[Option<f32>],
    recipe: &Recipe,
) -> Counterfactuals {
    let deg = |steering: f32| f64::from(steering) * recipe.full_lock_deg;
    let kept = recipe.preprocessing.rows.map(|row| row as f64 / recipe.preprocessing.source[0] as f64);
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
    let mae_deg = mae(0, 1.0);
    let straight: Vec<f64> = labels.iter().flatten().map(|label| deg(*label).abs()).collect();
    let straight_mae_deg = (!straight.is_empty()).then(|| mean(&straight));
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
            let share = mean_moved_deg / spread_deg.max(1e-9);
            let mae_after_deg = mae(k + 1, if change == Change::Mirror { -1.0 } else { 1.0 });
            let errors = mae_deg.zip(mae_after_deg);
            let helped = change.is_mask() && share > LITTLE / 2.0 && errors.is_some_and(|(a, b)| b < HELPED * a);
            let (passed, verdict) = match errors.filter(|_| helped) {
                Some((before, after)) => {
                    (Some(false), format!("disturbs: without it the error falls from {before:.2}° to {after:.2}°"))
                }
                None => verdict(change, share, right_way_share, kept),
            };
            Effect {
                change,
                mean_moved_deg,
                p95_moved_deg: crate::statistics::quantile(&distances, 0.95),
                bias_deg: mean(&moved),
                right_way_share,
                mae_deg: mae_after_deg,
                helped,
                passed,
                verdict,
            }
        })
        .collect();
    let baseline = mae_deg
        .zip(straight_mae_deg)
        .map(|(model_mae_deg, straight_mae_deg)| Baseline { model_mae_deg, straight_mae_deg });
    let findings = findings(&effects, spread_deg, baseline, recipe);
    Counterfactuals { pictures: answers.len(), spread_deg, mae_deg, straight_mae_deg, effects, findings }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_those_of_a_case_computed_by_hand() {
        // Angles 10 and −10 degrees. The sky moves them by 1 and −3; the mirror gives −10 and 6; shifts are right, then wrong.
        let mut answers = [[0.4f32; 12], [-0.4; 12]];
        let at = |change: Change| 1 + Change::ALL.iter().position(|c| *c == change).unwrap();
        (answers[0][at(Change::MaskSky)], answers[1][at(Change::MaskSky)]) = (0.44, -0.52);
        (answers[0][at(Change::Mirror)], answers[1][at(Change::Mirror)]) = (-0.4, 0.24);
        (answers[0][at(Change::ShiftRight)], answers[1][at(Change::ShiftRight)]) = (0.5, -0.5);
        let recipe = Recipe::find("lenet", &["preprocessing.rows=[40,136]".into()]).unwrap();
        let found = judge(&answers, &[Some(0.4), Some(-0.48)], &recipe);
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
        let text = &found.findings[1].text;
        assert!(text.contains("something else than the road"), "{text}");
        assert!(near(found.straight_mae_deg.unwrap(), 11.0));
    }
}
