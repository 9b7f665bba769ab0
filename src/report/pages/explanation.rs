//! The page of `explain`: what a model looks at.

use super::html::{Figure, Page};
use crate::pilot::Pilot;
use crate::report::charts::palette::saliency_hex;
use crate::report::charts::steering_line::STEERING_SCALE;
use crate::report::explain::counterfactual::Counterfactuals;
use crate::report::explain::exhibits::{Exhibit, Exhibits};
use crate::report::explain::findings::Finding;

/// The table of counterfactuals: a row for each change.
pub fn table(found: &Counterfactuals) -> (Vec<&'static str>, Vec<Vec<String>>) {
    let headers = vec!["change", "moves by", "95 % below", "to the right", "right way", "error", "", "what that means"];
    let optional = |value: Option<f64>, text: fn(f64) -> String| value.map_or("-".into(), text);
    let degrees = |value: f64| format!("{value:.2}°");
    let mut rows = vec![vec![
        "none".to_string(),
        "-".into(),
        "-".into(),
        "-".into(),
        "-".into(),
        optional(found.mae_deg, degrees),
        String::new(),
        format!("it steers by {:.2}° on average", found.spread_deg),
    ]];
    let straight = optional(found.straight_mae_deg, degrees);
    if found.straight_mae_deg.is_some() {
        let dash = || "-".to_string();
        let what = "for comparison: never steering".to_string();
        rows.push(vec!["a wheel held straight".into(), dash(), dash(), dash(), dash(), straight, String::new(), what]);
    }
    rows.extend(found.effects.iter().map(|effect| {
        vec![
            effect.change.text().to_string(),
            degrees(effect.mean_moved_deg),
            degrees(effect.p95_moved_deg),
            format!("{:+.2}°", effect.bias_deg),
            optional(effect.right_way_share, |share| format!("{:.0} %", 100.0 * share)),
            optional(effect.mae_deg, degrees),
            effect.passed.map_or("", |passed| if passed { "good" } else { "bad" }).into(),
            effect.verdict.clone(),
        ]
    }));
    (headers, rows)
}

/// The page.
pub fn page(title: &str, pilot: &Pilot, found: &Counterfactuals, exhibits: &Exhibits) -> String {
    let recipe = pilot.recipe();
    let lead = format!("Recipe {}; {} pictures. Angles are those of the front wheels.", recipe.name, found.pictures);
    let mut page = Page::new(title, &lead);
    page.section("What does it look at?");
    for Finding { tone, text } in &found.findings {
        page.advice(text, *tone);
    }
    page.paragraph(
        "Each picture was changed in one way at a time. \"Moves by\" is the mean distance between the angles before and after; a \
         mirrored picture should give the negated angle. Masked parts take the mean colour of their row. Where the road lies is \
         taken from Udacity's camera: from the horizon at 35 % of the height down to the bonnet at 85 %.",
    );
    let (headers, rows) = table(found);
    page.table(&headers, &rows);
    page.subsection("One picture in all its changes");
    page.figures(4, &figures(&exhibits.changes, true));
    page.section("What excites it");
    page.paragraph(&format!(
        "VisualBackProp, from the hardest left to the hardest right: what the network sees is grey, and coloured where it excites \
         the convolutions. The lines show the label (blue) and the model (orange), at {STEERING_SCALE} times the angle of the \
         wheels."
    ));
    page.scale("excites a little", "much", &(0..=8).map(|k| saliency_hex(f64::from(k) / 8.0)).collect::<Vec<_>>());
    page.figures(3, &figures(&exhibits.saliency, true));
    page.section("Filters and feature maps");
    page.figures(1, &exhibits.filters.iter().map(|exhibit| figure(exhibit, false)).collect::<Vec<_>>());
    page.figures(1, &figures(&exhibits.features, false));
    page.finish()
}

fn figures(exhibits: &[Exhibit], photograph: bool) -> Vec<Figure> {
    exhibits.iter().map(|exhibit| figure(exhibit, photograph)).collect()
}

fn figure(exhibit: &Exhibit, photograph: bool) -> Figure {
    let source = if photograph { exhibit.picture.jpeg_address() } else { exhibit.picture.png_address() };
    Figure { source, caption: exhibit.caption.clone(), pixelated: !photograph }
}
