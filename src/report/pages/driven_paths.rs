//! The paths that the sessions of a recording were driven along, from above.

use crate::dataset::{DrivenSession, DrivenSessions, Recording};
use crate::geometry::CarGeometry;
use crate::report::charts::chart::NARROW;
use crate::report::charts::map::Projection;
use crate::report::charts::palette::{INK, QUIET_INK, series};
use crate::report::charts::svg::{Anchor, Svg};
use crate::report::pages::html::Page;

/// Sessions that are drawn, the longest.
const MAX_DRAWN: usize = 6;
/// Shorter paths are not drawn, m.
const MIN_DRAWN_M: f64 = 5.0;
/// Points of a drawn path.
const MAX_POINTS: usize = 600;

/// A section with the path of each session.
pub(super) fn driven_paths(page: &mut Page, recording: &Recording) {
    let DrivenSessions { sessions, assumed_speed_mps, .. } = DrivenSessions::of(recording, recording.geometry.clone());
    let mut drawn: Vec<(usize, &DrivenSession)> =
        sessions.iter().enumerate().filter(|(_, session)| session.path.length_m() >= MIN_DRAWN_M).collect();
    if drawn.is_empty() {
        return;
    }
    page.section("The driven path");
    let CarGeometry { wheelbase_m, full_lock_deg, .. } = recording.geometry;
    page.paragraph(&format!(
        "Dead reckoning from steering, speed and time, for a car with a wheelbase of {wheelbase_m} m whose wheels turn by \
         {full_lock_deg} degrees at steering 1. Every session begins at the dot and goes to the right; the errors of a long drive add \
         up, so a closed track need not close."
    ));
    if let Some(notice) = recording.camera_notice() {
        page.paragraph(&format!("Note: {notice}."));
    }
    if let Some(mps) = assumed_speed_mps {
        page.paragraph(&format!("Note: no speed was recorded; {mps:.1} m/s is assumed, so the scale is a guess."));
    }
    let count = drawn.len();
    drawn.sort_by(|a, b| b.1.path.length_m().total_cmp(&a.1.path.length_m()));
    drawn.truncate(MAX_DRAWN);
    drawn.sort_by_key(|(number, _)| *number);
    if count > drawn.len() {
        page.paragraph(&format!("The longest {} of {count} sessions are shown.", drawn.len()));
    }
    let figures: Vec<String> = drawn
        .iter()
        .map(|(number, session)| {
            let line = recording.rows[session.rows.start].line;
            let title = format!("Session {}, from line {line}: {:.0} m", number + 1, session.path.length_m());
            let [wide, narrow] = [[552.0, 320.0], [NARROW, 300.0]].map(|size| drawing(&title, session, size));
            format!("<figure><div class=\"wide\">{wide}</div><div class=\"narrow\">{narrow}</div></figure>\n")
        })
        .collect();
    page.drawings(&figures);
}

fn drawing(title: &str, session: &DrivenSession, [width, height]: [f64; 2]) -> String {
    let mut svg = Svg::new(width, height);
    svg.text([14.0, 22.0], 15.0, Anchor::Start, "font-weight=\"600\"", title);
    let poses = session.path.poses();
    let mut places = poses.iter().map(|pose| [pose.x_m, pose.y_m]);
    let Some(projection) = Projection::fitting(places.clone(), [16.0, 36.0, width - 16.0, height - 40.0]) else {
        return svg.finish();
    };
    let step = poses.len().div_ceil(MAX_POINTS).max(1);
    let mut points: Vec<[f64; 2]> = places.clone().step_by(step).map(|place| projection.place(place)).collect();
    points.extend(places.next_back().map(|place| projection.place(place)));
    svg.polyline(&points, &format!("stroke=\"{}\" stroke-width=\"2\"", series(0)));
    svg.dots(points.first().copied(), 8.0, INK, "");
    let bar_m = projection.bar_m(110.0);
    let (from, y) = (width - 16.0 - bar_m * projection.scale, height - 24.0);
    svg.line([from, y], [width - 16.0, y], &format!("stroke=\"{INK}\" stroke-width=\"2\""));
    svg.text([width - 16.0, y + 16.0], 12.0, Anchor::End, &format!("fill=\"{QUIET_INK}\""), &format!("{bar_m:.0} m"));
    svg.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    #[test]
    fn paths_are_drawn_and_what_was_assumed_is_said() {
        // 20 mph for 30 s: 267.3 m straight on.
        let mut recording = recording_of(&[0.0; 300], 100);
        let page_of = |recording: &Recording| {
            let mut page = Page::new("t", "l");
            driven_paths(&mut page, recording);
            page.finish()
        };
        let text = page_of(&recording);
        assert!(text.contains("Session 1, from line 1: 267 m") && text.contains("`udacity` is assumed"), "{text}");
        assert!(!text.contains("no speed was recorded"));
        recording.rows.iter_mut().for_each(|row| row.speed_mph = f32::NAN);
        assert!(page_of(&recording).contains("14.4 m/s is assumed"));
        recording.rows.iter_mut().for_each(|row| row.speed_mph = 0.0);
        assert!(page_of(&recording).contains("14.4 m/s is assumed"), "a column of zeros says no speed");
        let (first, rest) = recording.rows.split_first_mut().unwrap();
        first.speed_mph = 0.1;
        rest.iter_mut().for_each(|row| row.speed_mph = 0.0);
        assert!(!page_of(&recording).contains("The driven path"), "a car that stands drives no path");
    }

    #[test]
    fn a_bend_to_the_right_bends_down() {
        let recording = recording_of(&[0.5; 60], 100);
        let sessions = DrivenSessions::of(&recording, recording.geometry.clone()).sessions;
        let svg = drawing("t", &sessions[0], [400.0, 300.0]);
        let points = svg.split("d=\"M").nth(1).and_then(|rest| rest.split('"').next()).expect("a path");
        let places: Vec<Vec<f64>> =
            points.split('L').map(|p| p.split(' ').map(|v| v.parse().unwrap()).collect()).collect();
        assert!(places.len() >= 60 && places[10][0] > places[0][0] && places[10][1] > places[0][1], "{points}");
    }
}
