//! What the counterfactuals of a model mean, in sentences. Each sentence follows from the numbers; advice names only what the
//! model's recipe does not do already.

use serde::Serialize;

use super::change::{BONNET, BRIGHTER, Change, DARKER, Effect, HORIZON};
use crate::dataset::Flip;
use crate::recipe::Recipe;
use crate::report::tone::Tone;

/// Angles that differ by less than this on average, in degrees, are those of a model that hardly steers.
const HARDLY_STEERS_DEG: f64 = 0.3;
/// A model whose error is below this share of a straight wheel's has learned something.
const CLEARLY_BETTER: f64 = 0.8;
/// What lies beside the road counts for more than the road itself from this many times its effect on.
const BESIDE: f64 = 1.2;

/// One sentence or two, and what they mean for the reader.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Finding {
    /// Good, neutral or a warning.
    pub tone: Tone,
    /// The sentences.
    pub text: String,
}

/// Errors on the pictures as they are, where they have labels; in degrees of the front wheels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Baseline {
    /// Mean absolute error of the model.
    pub model_mae_deg: f64,
    /// That of a wheel held straight.
    pub straight_mae_deg: f64,
}

/// The findings, the weightiest first. `spread_deg` is the mean distance of the model's angles from their mean.
pub fn findings(effects: &[Effect], spread_deg: f64, baseline: Option<Baseline>, recipe: &Recipe) -> Vec<Finding> {
    let mut found = Vec::new();
    let mut say = |tone: Tone, text: String| found.push(Finding { tone, text });
    let useful = baseline.is_none_or(|errors| errors.model_mae_deg < CLEARLY_BETTER * errors.straight_mae_deg);
    if let Some(Baseline { model_mae_deg: model, straight_mae_deg: straight }) = baseline {
        let compared = format!("a wheel held straight by {straight:.2}°");
        if useful {
            say(Tone::Good, format!("On these pictures the model is off by {model:.2}° on average, {compared}."));
        } else if model < straight {
            say(
                Tone::Warning,
                format!(
                    "On these pictures the model is off by {model:.2}° on average, {compared}: it is hardly better than that. \
                     Train it longer, or on recordings like these."
                ),
            );
        } else {
            say(
                Tone::Warning,
                format!(
                    "On these pictures the model is off by {model:.2}° on average, {compared}: it is of no use here. Train it \
                     longer, or on recordings like these, before you look at what moves its angle."
                ),
            );
        }
    }
    if spread_deg < HARDLY_STEERS_DEG {
        let text = format!(
            "The model hardly steers at all: its angles differ by {spread_deg:.2}° on average. Nothing can be said of what it \
             looks at; give it pictures of bends."
        );
        say(Tone::Warning, text);
        return found;
    }
    let failed = |change: Change| effects.iter().any(|effect| effect.change == change && effect.passed == Some(false));
    let moved = |change: Change| effects.iter().find(|e| e.change == change).map_or(0.0, |e| e.mean_moved_deg);
    let helped = |change: Change| effects.iter().any(|effect| effect.change == change && effect.helped);

    let (road, beside) = (moved(Change::MaskRoad), moved(Change::MaskBeside));
    let both = format!("without the road its angle moves by {road:.1}°, without everything beside it by {beside:.1}°");
    if helped(Change::MaskRoad) {
        say(Tone::Warning, "It steers better without the road than with it: it reads the road wrongly.".into());
    } else if failed(Change::MaskRoad) {
        say(Tone::Warning, format!("It steers by something else than the road: {both}."));
    } else if beside > BESIDE * road {
        say(
            Tone::Warning,
            format!(
                "What lies beside the road moves it more than the road: {both}. Where the surroundings are other ones it may be lost."
            ),
        );
    } else {
        // A model that is of no use steers by the road wrongly; that is no good news.
        say(if useful { Tone::Good } else { Tone::Neutral }, format!("It steers by the road: {both}."));
    }
    if !useful && baseline.is_some_and(|errors| errors.model_mae_deg >= errors.straight_mae_deg) {
        return found; // advice on details would not mend a model that has not learned
    }
    if failed(Change::MaskSky) || failed(Change::MaskBonnet) {
        say(Tone::Warning, about_crop(failed(Change::MaskSky), failed(Change::MaskBonnet), recipe));
    }
    if failed(Change::Darken) || failed(Change::Brighten) {
        say(Tone::Warning, about_light(moved(Change::Darken), moved(Change::Brighten), recipe));
    }
    if failed(Change::ShiftLeft) || failed(Change::ShiftRight) {
        say(Tone::Warning, about_shifts(recipe));
    }
    if failed(Change::Mirror) {
        say(Tone::Warning, about_mirror(recipe));
    }
    let (left, right) = (moved(Change::MaskLeft), moved(Change::MaskRight));
    if left.max(right) > 2.0 * left.min(right) {
        let (side, other) = if left > right { ("left", "right") } else { ("right", "left") };
        let (most, least) = (left.max(right), left.min(right));
        let text = format!(
            "It looks mainly at the {side} side: without it the angle moves by {most:.1}°, without the {other} by {least:.1}°."
        );
        say(Tone::Neutral, text);
    }
    if useful && effects.iter().all(|effect| effect.passed != Some(false)) {
        say(Tone::Good, "It passes every test of the table. Whether it drives, only driving shows.".into());
    }
    found
}

fn about_crop(sky: bool, bonnet: bool, recipe: &Recipe) -> String {
    let what = match (sky, bonnet) {
        (true, true) => "sky and bonnet",
        (true, false) => "the sky",
        _ => "the bonnet",
    };
    // Only where the network sees them they can disturb it, so there is something to cut off.
    let height = recipe.preprocessing.source[0] as f64;
    let [first, end] = recipe.preprocessing.rows;
    let first = if sky { first.max((HORIZON * height).ceil() as usize) } else { first };
    let end = if bonnet { end.min((BONNET * height).floor() as usize) } else { end };
    format!(
        "It also goes by {what}, which tells nothing about the road. Cut it off: train with --set \
         preprocessing.rows=[{first},{end}]."
    )
}

fn about_light(darker_deg: f64, brighter_deg: f64, recipe: &Recipe) -> String {
    let disturbed = format!(
        "Light disturbs it: its angle moves by {darker_deg:.1}° in a darker picture and by {brighter_deg:.1}° in a brighter one"
    );
    match recipe.augmentation.brightness {
        None => format!("{disturbed}. Train with other light: --set augmentation.brightness=[0.5,1.5]."),
        Some([low, high]) if low > DARKER || high < BRIGHTER => format!(
            "{disturbed}. The recipe trains with brightness [{low}, {high}] only; these pictures have {DARKER} and {BRIGHTER}. \
             Widen it: --set augmentation.brightness=[{},{}].",
            low.min(0.5),
            high.max(1.5)
        ),
        Some([low, high]) => format!(
            "{disturbed}, although the recipe trains with brightness [{low}, {high}]. More epochs or recordings in other light \
             may help."
        ),
    }
}

fn about_shifts(recipe: &Recipe) -> String {
    let problem = "It does not steer back when the road lies to one side: it has not learned to recover";
    let augmentation = &recipe.augmentation;
    let shifts = augmentation.shift_px > 0.0 || augmentation.view.is_some();
    let cameras = recipe.samples.side_cameras.is_some();
    let side_cameras = "--set samples.side_cameras=0.2, if the recordings have side cameras";
    let shift = "--set augmentation.shift_px=40 --set augmentation.shift_steering_per_px=0.003";
    match (cameras, shifts) {
        (false, false) => format!("{problem}. Train with {side_cameras}, or with {shift}."),
        (true, false) => format!(
            "{problem}, although the recipe uses side cameras. Train with {shift}, or record ways back to the line."
        ),
        (false, true) => format!(
            "{problem}, although the recipe shifts pictures. Train with {side_cameras}, or record ways back to the line."
        ),
        (true, true) => format!(
            "{problem}, although the recipe uses side cameras and shifts. Record ways back to the line, from both sides."
        ),
    }
}

fn about_mirror(recipe: &Recipe) -> String {
    let problem = "In a mirrored world it steers differently: it has learned this track, or one side of the road";
    let askew = "a camera that is mounted askew (Udacity's is rolled by 1.2°) does the same, for mirrored pictures then show the \
                 car beside its place";
    match recipe.samples.flip {
        Flip::None => format!(
            "{problem}. Train with --set samples.flip=random; {askew}. --set samples.mirror=geometry helps then."
        ),
        Flip::Both | Flip::Random => {
            format!("{problem}, although the recipe mirrors its pictures. It may need more epochs; {askew}.")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::counterfactual::judge;
    use super::*;

    /// Findings on ten bends from −9 to 9 degrees, labelled so, of a model that answers `answer(change, label in degrees)`.
    fn found(recipe: &Recipe, answer: impl Fn(Option<Change>, f64) -> f64) -> Vec<Finding> {
        let labels: Vec<f64> = (0..10).map(|i| 2.0 * f64::from(i) - 9.0).collect();
        let steering = |deg: f64| (deg / recipe.full_lock_deg) as f32;
        let answers: Vec<_> = labels
            .iter()
            .map(|label| {
                let mut of = [0.0; Change::ALL.len() + 1];
                of[0] = steering(answer(None, *label));
                for (k, change) in Change::ALL.into_iter().enumerate() {
                    of[k + 1] = steering(answer(Some(change), *label));
                }
                of
            })
            .collect();
        let labels: Vec<Option<f32>> = labels.into_iter().map(|label| Some(steering(label))).collect();
        judge(&answers, &labels, recipe).findings
    }

    /// A model that sees the road and nothing else.
    fn good(change: Option<Change>, label: f64) -> f64 {
        match change {
            Some(Change::Mirror) => -label,
            Some(Change::MaskRoad) => 0.0,
            Some(Change::ShiftLeft) => label - 2.0,
            Some(Change::ShiftRight) => label + 2.0,
            _ => label,
        }
    }

    fn recipe(overrides: &[&str]) -> Recipe {
        let overrides: Vec<String> = overrides.iter().map(|text| text.to_string()).collect();
        Recipe::find("lenet", &overrides).unwrap()
    }

    fn warnings(found: &[Finding]) -> Vec<&str> {
        found.iter().filter(|finding| finding.tone == Tone::Warning).map(|finding| finding.text.as_str()).collect()
    }

    #[test]
    fn a_good_model_gets_good_news_only() {
        let found = found(&recipe(&[]), good);
        assert!(found.iter().all(|finding| finding.tone == Tone::Good), "{found:?}");
        assert_eq!(
            found.iter().map(|finding| finding.text.as_str()).collect::<Vec<_>>(),
            [
                "On these pictures the model is off by 0.00° on average, a wheel held straight by 5.00°.",
                "It steers by the road: without the road its angle moves by 5.0°, without everything beside it by 0.0°.",
                "It passes every test of the table. Whether it drives, only driving shows.",
            ]
        );
    }

    #[test]
    fn a_poor_model_is_compared_with_a_straight_wheel_and_gets_no_good_news() {
        // It steers to the wrong side of every bend, so that hiding the road lowers its error.
        let found = found(&recipe(&[]), |change, label| good(change, -label));
        assert!(found.iter().all(|finding| finding.tone != Tone::Good), "{found:?}");
        assert!(
            found[0].text.starts_with("On these pictures the model is off by 10.00° on average, a wheel held straight by 5.00°: it is of no use here."),
            "{found:?}"
        );
        assert!(found[1].text.contains("better without the road"), "{found:?}");
    }

    #[test]
    fn a_spoilt_model_is_told_what_its_recipe_lacks_and_never_what_it_has() {
        // The sky, light and mirror move it; it does not follow shifts.
        let spoilt = |change: Option<Change>, label: f64| match change {
            Some(Change::MaskSky | Change::Brighten) => label + 4.0,
            Some(Change::Darken | Change::Mirror) => label - 4.0,
            Some(Change::ShiftLeft | Change::ShiftRight) => label,
            _ => good(change, label),
        };
        let bare = recipe(&["preprocessing.rows=[20,136]", "samples.flip=none", "augmentation.brightness=[0.9,1.1]"]);
        let text = warnings(&found(&bare, spoilt)).join("\n");
        for part in [
            "goes by the sky, which tells nothing about the road. Cut it off: train with --set preprocessing.rows=[57,136]",
            "its angle moves by 4.0° in a darker picture and by 4.0° in a brighter one. The recipe trains with brightness [0.9, 1.1] only",
            "--set augmentation.brightness=[0.5,1.5]",
            "--set samples.flip=random",
            "although the recipe uses side cameras. Train with --set augmentation.shift_px=40",
        ] {
            assert!(text.contains(part), "{part}\n{text}");
        }
        let rich = recipe(&[
            "preprocessing.rows=[60,136]",
            "samples.flip=random",
            "augmentation.brightness=[0.5,1.5]",
            "augmentation.shift_px=40",
            "augmentation.shift_steering_per_px=0.003",
        ]);
        let text = warnings(&found(&rich, spoilt)).join("\n");
        assert!(!text.contains("--set"), "nothing is advised that the recipe has: {text}");
        assert_eq!(text.matches("although the recipe").count(), 3, "{text}");
        assert!(!text.contains("sky"), "what is cut off cannot disturb: {text}");
    }

    #[test]
    fn a_mask_that_lowers_the_error_is_not_good() {
        // The bonnet pulls the wheel to one side.
        let pulled = |change: Option<Change>, label: f64| match change {
            Some(Change::MaskBonnet) => label,
            Some(Change::Mirror) => -label,
            _ => good(change, label) + 1.0,
        };
        let whole = recipe(&["preprocessing.rows=[20,160]"]);
        let found = found(&whole, pulled);
        let text = warnings(&found).join("\n");
        assert!(text.contains("goes by the bonnet") && text.contains("preprocessing.rows=[20,136]"), "{text}");
    }

    #[test]
    fn a_model_that_does_not_steer_is_told_so() {
        let found = found(&recipe(&[]), |_, _| 0.1);
        assert!(
            found.last().unwrap().text.contains("hardly steers") && found[0].text.contains("of no use"),
            "{found:?}"
        );
    }
}
