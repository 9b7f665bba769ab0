//! The page of `inspect --out`: what a recording looks like, before anything is trained on it.

use crate::dataset::colour::Colour;
use crate::dataset::inspect::{Inspection, Suspicion, contradiction, seen_steering};
use crate::dataset::preprocess::Preprocessing;
use crate::dataset::{Correction, Item, Recording, View};
use crate::picture::RgbImage;
use crate::recipe::Recipe;
use crate::report::charts::chart::{Axis, Chart, Mark};
use crate::report::charts::palette;
use crate::report::charts::steering::{driven_times, histogram};
use crate::report::pages::driven_paths::driven_paths;
use crate::report::pages::html::{Figure, Page};
use crate::report::pages::split_view::SplitView;
use crate::report::tone::Tone;

/// Rows of the sample sheet, worst frames, and frames in all colour spaces, for a page of one recording.
const SAMPLES: usize = 5;
/// See [`SAMPLES`].
const WORST: usize = 12;
/// See [`SAMPLES`].
const COLOURED: usize = 2;
/// Length of the window in which labels and pictures are compared, in seconds.
const WINDOW_S: f64 = 30.0;
/// A wide chart.
const WIDE: [f64; 2] = [1120.0, 260.0];
/// Two charts side by side.
const HALF: [f64; 2] = [552.0, 320.0];

/// The page for `inspections`, split and preprocessed as `recipe` says with `seed`. Many recordings have fewer pictures each,
/// so that the page stays small.
pub fn page(inspections: Vec<Inspection>, recipe: &Recipe, seed: u64) -> String {
    let paths: Vec<&str> = inspections.iter().map(|i| i.report.path.as_str()).collect();
    let title = if let [path] = paths[..] { path.to_string() } else { format!("{} recordings", paths.len()) };
    let lead = format!("Inspected for the recipe {}. {}", recipe.name, paths.join(", "));
    let mut page = Page::new(&title, &lead);
    let share = |most: usize| (most / inspections.len().max(1)).max(1);
    for inspection in &inspections {
        if inspections.len() > 1 {
            page.section(&inspection.report.path);
        }
        overview(&mut page, inspection);
        labels(&mut page, inspection);
        driven_paths(&mut page, &inspection.recording);
        if !inspection.frames.is_empty() && !inspection.recording.rows.is_empty() {
            samples(&mut page, &inspection.recording, recipe, share(SAMPLES));
            colours(&mut page, &inspection.recording, &recipe.preprocessing, share(COLOURED));
            worst(&mut page, inspection, share(WORST));
        }
    }
    let recordings: Vec<Recording> = inspections.into_iter().map(|inspection| inspection.recording).collect();
    training(&mut page, &recordings, recipe, seed);
    page.finish()
}

fn overview(page: &mut Page, Inspection { report, recording, .. }: &Inspection) {
    page.section("What was found");
    for advice in &report.advice {
        page.advice(advice, Tone::Warning);
    }
    if report.advice.is_empty() {
        page.advice("Nothing to complain of.", Tone::Good);
    }
    for notice in &report.notices {
        page.paragraph(&format!("Note: {notice}."));
    }
    let percent = |share: f64| format!("{:.1} %", 100.0 * share);
    let mut rows = vec![
        ["usable rows".to_string(), format!("{} of {}", report.usable, report.rows)],
        [
            "sessions".into(),
            format!("{}, {:.0} s driven within {:.0} s", report.sessions.len(), report.driven_s, report.span_s),
        ],
    ];
    let mut add = |name: &str, value: Option<String>| rows.extend(value.map(|value| [name.to_string(), value]));
    add("rate", report.rate_hz.map(|hz| format!("{hz:.1} rows a second")));
    add("distance", report.distance_m.map(|m| format!("{m:.0} m")));
    add("speed", report.speed_mph.map(|s| format!("{:.1} to {:.1} mph, mean {:.1}", s.min, s.max, s.mean)));
    add("standing", report.standing_share.map(percent));
    if let Some(s) = &report.steering {
        let straight = (1.0 - s.left_share - s.right_share).max(0.0);
        let turns =
            format!("{} left, {} straight, {} right", percent(s.left_share), percent(straight), percent(s.right_share));
        add("turns", Some(turns));
        add("exactly zero", Some(percent(s.zero_share)));
        add("at full lock", Some(percent(s.full_lock_share)));
        add("different labels", Some(s.distinct.to_string()));
    }
    if let Some(p) = &report.pictures {
        add(
            "pictures",
            Some(format!("{} read, {} undecodable, {} copies, {} frozen", p.seen, p.undecodable, p.copies, p.frozen)),
        );
        let lag = p.lag.map(|lag| format!("{:.0} ms after the label (correlation {:.2})", lag.ms, lag.correlation));
        add("the picture follows", Some(lag.unwrap_or_else(|| "cannot be told".into())));
    }
    let size = report.image_size.map_or(String::new(), |[h, w]| format!(", {w}x{h} pixels"));
    let cameras: Vec<&str> = report.cameras.iter().map(|camera| camera.name()).collect();
    add("cameras", Some(if cameras.is_empty() { "no images".into() } else { cameras.join(", ") + &size }));
    for (reason, tally) in &report.unusable.0 {
        add(reason.text(), Some(format!("{} rows, as in {}", tally.rows, tally.examples.join("; "))));
    }
    if recording.sessions.len() > 1 {
        let longest = report.sessions.iter().map(|session| session.length_s).fold(0.0, f64::max);
        add("longest session", Some(format!("{longest:.0} s")));
    }
    page.table(&["", ""], &rows.into_iter().map(Vec::from).collect::<Vec<_>>());
}

/// Shade of a suspicious stretch, on light ground.
fn suspicion_colour(what: Suspicion) -> &'static str {
    let index = match what {
        Suspicion::Standing => 0,
        Suspicion::Frozen => 1,
        Suspicion::FullLock => 2,
        Suspicion::StuckLabel => 3,
        Suspicion::Contradiction => 4,
    };
    palette::SHADES[index].0
}

fn labels(page: &mut Page, inspection: &Inspection) {
    let Inspection { recording, report, frames } = inspection;
    if recording.rows.is_empty() {
        return;
    }
    page.section("Steering over time");
    let times = driven_times(recording);
    let over_time = |value: &dyn Fn(usize) -> f64| -> Vec<[f64; 2]> {
        let mut points = Vec::with_capacity(times.len() + recording.sessions.len());
        for session in &recording.sessions {
            points.extend(session.clone().map(|row| [times[row], value(row)]));
            points.push([times[session.end - 1], f64::NAN]);
        }
        points
    };
    let x = || Axis::new("time driven, s");
    let steering = |row: usize| f64::from(recording.rows[row].steering);
    let mut chart = Chart::new("Labels", WIDE, x(), Axis::new("steering, + = right").range(-1.0, 1.0)).add(
        "",
        palette::BLUE,
        Mark::Line(1.2),
        over_time(&steering),
    );
    for stretch in &report.suspicious {
        let (from, to) = (times[stretch.rows.start], times[stretch.rows.end - 1]);
        chart = chart.shade(from, to, suspicion_colour(stretch.what), stretch.what.text());
    }
    let mut charts = vec![chart.draw()];
    if report.speed_mph.is_some() {
        let speed = over_time(&|row| f64::from(recording.rows[row].speed_mph));
        let size = [WIDE[0], 200.0];
        charts.push(
            Chart::new("Speed", size, x(), Axis::new("mph")).add("", palette::GREEN, Mark::Line(1.5), speed).draw(),
        );
    }
    page.drawings(&charts);
    if let Some(lag) = report.pictures.and_then(|pictures| pictures.lag) {
        let window = busiest_window(recording, &times);
        let label = window.clone().map(|row| [times[row], steering(row)]).collect();
        let seen =
            window.map(|row| [times[row], seen_steering(recording, frames, lag, row).unwrap_or(f64::NAN)]).collect();
        let title = format!("The busiest {WINDOW_S:.0} s: do labels and pictures tell the same story?");
        let chart = Chart::new(title, WIDE, x(), Axis::new("steering, + = right"))
            .add("label", palette::BLUE, Mark::Line(2.0), label)
            .add("turn of the far scene, scaled to steering", palette::VERMILION, Mark::Line(2.0), seen);
        page.drawings(&[chart.draw()]);
        page.paragraph(&format!(
            "The far scene moves sideways when the car turns. Drawn {:.0} ms earlier, where it fits the labels best; the \
             correlation is {:.2} over all rows.",
            lag.ms, lag.correlation
        ));
    }
    if !report.suspicious.is_empty() {
        page.subsection("Stretches to look at (shaded above)");
        let row = |s: &crate::dataset::inspect::Stretch| {
            let [first, last] = s.lines;
            vec![format!("{first} to {last}"), s.what.text().into(), format!("{:.1} s", s.length_s)]
        };
        let listed: Vec<_> = report.suspicious.iter().take(40).map(row).collect();
        page.table(&["lines of the log", "why", "length"], &listed);
        if report.suspicious.len() > listed.len() {
            page.paragraph(&format!("And {} more.", report.suspicious.len() - listed.len()));
        }
    }
}

/// The rows of the [`WINDOW_S`] seconds within one session in which the label changes most.
fn busiest_window(recording: &Recording, times: &[f64]) -> std::ops::Range<usize> {
    let mut best = (f64::NEG_INFINITY, 0..0);
    for session in &recording.sessions {
        let (mut first, mut change) = (session.start, 0.0);
        let step = |row: usize| f64::from((recording.rows[row].steering - recording.rows[row - 1].steering).abs());
        for row in session.start..session.end {
            if row > session.start {
                change += step(row);
            }
            while times[row] - times[first] > WINDOW_S {
                first += 1;
                change -= step(first);
            }
            if change > best.0 {
                best = (change, first..row + 1);
            }
        }
    }
    best.1
}

/// `count` rows from hard left to hard right, evenly spaced in the order of their labels.
fn from_left_to_right(recording: &Recording, count: usize) -> Vec<usize> {
    let mut rows: Vec<usize> = (0..recording.rows.len()).collect();
    rows.sort_by(|&a, &b| recording.rows[a].steering.total_cmp(&recording.rows[b].steering));
    let place = |i: usize| match count {
        1 => 0.5,
        _ => 0.02 + 0.96 * i as f64 / (count - 1) as f64,
    };
    (0..count).map(|i| rows[((rows.len() - 1) as f64 * place(i)).round() as usize]).collect()
}

/// A label with its sign, which zero has not.
fn signed(label: f32) -> String {
    let text = format!("{label:+.3}");
    if text.trim_start_matches(['+', '-']) == "0.000" { "0".into() } else { text }
}

fn camera_figure(image: &RgbImage, caption: String) -> Figure {
    Figure { source: image.jpeg_address(), caption, pixelated: false }
}

fn samples(page: &mut Page, recording: &Recording, recipe: &Recipe, count: usize) {
    page.section("What the cameras see");
    let cameras: Vec<View> =
        [View::Left, View::Centre, View::Right].into_iter().filter(|&camera| recording.has(camera)).collect();
    let used = match recipe.samples.side_cameras {
        _ if cameras.len() < 2 => String::new(),
        Some(Correction::Geometry) => "; the labels of the side cameras follow from where they are mounted".into(),
        Some(Correction::Fixed(by)) => {
            format!("; the recipe adds {by} to the label of the left camera and takes it off that of the right")
        }
        None => "; the recipe uses the centre camera only".into(),
    };
    page.paragraph(&format!("From hard left to hard right{used}. A mirrored picture has the negated label."));
    let mut figures = Vec::new();
    let targets = recipe.steering_targets(std::slice::from_ref(recording));
    for row in from_left_to_right(recording, count) {
        let (line, item) = (recording.rows[row].line, Item::new(0, row as u32, [View::Centre]));
        // The driven path does not say every label.
        let label_of = |camera: View| targets.label(item).map(|_| recipe.samples.label(&targets, item, camera));
        let said = |label: Option<f32>| label.map_or("none".into(), signed);
        for &camera in &cameras {
            let Some(image) = recording.picture(row, camera) else { continue };
            let label = if recipe.samples.side_cameras.is_some() || camera == View::Centre {
                said(label_of(camera))
            } else {
                "unused".into()
            };
            figures.push(camera_figure(&image, format!("line {line}, {}: label {label}", camera.name())));
            if camera == *cameras.last().unwrap_or(&View::Centre)
                && let Some(centre) = recording.picture(row, View::Centre)
            {
                figures.push(camera_figure(
                    &centre.mirrored(),
                    format!("line {line}, centre mirrored: label {}", said(label_of(View::Centre).map(|label| -label))),
                ));
            }
        }
    }
    // With one camera, two rows of the log stand in each line.
    page.figures(if cameras.len() == 1 { 4 } else { cameras.len() + 1 }, &figures);
}

fn colours(page: &mut Page, recording: &Recording, spec: &Preprocessing, count: usize) {
    let mut rows = from_left_to_right(recording, count.max(2));
    rows.truncate(count);
    let images: Vec<(usize, RgbImage)> =
        rows.into_iter().filter_map(|row| Some((row, recording.picture(row, View::Centre)?))).collect();
    let Some((_, image)) = images.first() else { return };
    page.section("What the network sees");
    let ([first, end], [height, width]) = (kept(image, spec), spec.resize);
    page.paragraph(&format!(
        "Rows {first} to {end} of {}x{} pixels, resized to {width}x{height}, in every colour space there is. The recipe's own is \
         {}.",
        image.width,
        image.height,
        spec.colour.name()
    ));
    for (row, image) in images {
        page.subsection(&format!("Line {}, label {}", recording.rows[row].line, signed(recording.rows[row].steering)));
        let mut figures =
            vec![camera_figure(&kept_rows(&image, spec), "the camera's picture; what is kept is not darkened".into())];
        for colour in Colour::ALL {
            let own = if colour == spec.colour { ", the recipe's" } else { "" };
            let spec = Preprocessing { colour, ..spec.clone() };
            let Ok(mut preprocessor) = spec.plan(image.height, image.width) else { continue };
            let mut planes = vec![0; spec.output_len()];
            preprocessor.apply(&image.pixels, &mut planes);
            let source = sheet(&planes, height, width);
            figures.push(Figure {
                source: source.png_address(),
                caption: format!("{}{own}: {}", colour.name(), colour.plane_names().join(", ")),
                pixelated: true,
            });
        }
        page.figures(3, &figures);
    }
}

/// The rows of `image` that preprocessing keeps, first and end.
fn kept(image: &RgbImage, spec: &Preprocessing) -> [usize; 2] {
    spec.rows.map(|row| row * image.height / spec.source[0])
}

/// The picture with everything that preprocessing cuts off darkened.
fn kept_rows(image: &RgbImage, spec: &Preprocessing) -> RgbImage {
    let [first, end] = kept(image, spec);
    RgbImage::from_fn(image.height, image.width, |row, column| {
        let pixel = image.pixel(row, column);
        if (first..end).contains(&row) { pixel } else { pixel.map(|level| level / 3) }
    })
}

/// Planes as grey pictures: wide ones below each other, others beside each other. A single plane is drawn as large as three.
fn sheet(planes: &[u8], height: usize, width: usize) -> RgbImage {
    const GAP: usize = 2;
    let below = 2 * width > 3 * height;
    let count = planes.len() / (height * width);
    let [down, across] = if below { [count, 1] } else { [1, count] };
    let mut sheet = RgbImage::filled(down * (height + GAP) - GAP, across * (width + GAP) - GAP, [255; 3]);
    for (i, plane) in planes.chunks_exact(height * width).enumerate() {
        let (top, left) = if below { (i * (height + GAP), 0) } else { (0, i * (width + GAP)) };
        sheet.paste(&RgbImage::grey(height, width, plane), top, left);
    }
    sheet
}

fn worst(page: &mut Page, inspection: &Inspection, count: usize) {
    let Inspection { recording, frames, report } = inspection;
    let lag = report.pictures.and_then(|pictures| pictures.lag);
    page.section("Frames to look at");
    let step = |row: usize| match row.checked_sub(1) {
        Some(before) if recording.session_of(before) == recording.session_of(row) => {
            f64::from((recording.rows[row].steering - recording.rows[before].steering).abs())
        }
        _ => 0.0,
    };
    let brightness = |row: usize| frames[row].map(|frame| f64::from(frame.brightness));
    let rows = || (0..recording.rows.len()).filter(|&row| frames[row].is_some());
    let mut chosen: Vec<(usize, String)> = Vec::new();
    let share = count.div_ceil(4);
    let mut choose = |size: &dyn Fn(usize) -> f64, least: f64, caption: &dyn Fn(usize) -> String| {
        let mut sorted: Vec<usize> = rows().filter(|&row| size(row) > least).collect();
        sorted.sort_by(|&a, &b| size(b).total_cmp(&size(a)).then(a.cmp(&b)));
        let mut taken = 0;
        for row in sorted {
            // Neighbours look alike: one of them is enough.
            if taken < share && chosen.iter().all(|(other, _)| other.abs_diff(row) > 15) {
                chosen.push((row, caption(row)));
                taken += 1;
            }
        }
    };
    choose(&|row| contradiction(recording, frames, lag, row).unwrap_or(0.0), 0.02, &|row| {
        let seen = lag.and_then(|lag| seen_steering(recording, frames, lag, row)).unwrap_or(f64::NAN);
        format!("the label contradicts the picture, which turns as at {seen:+.2}")
    });
    choose(&step, 0.1, &|row| format!("the label jumps by {:.2} from the row before", step(row)));
    choose(&|row| brightness(row).map_or(0.0, |level| 255.0 - level), 0.0, &|row| {
        format!("among the darkest: mean grey level {:.0} of 255", brightness(row).unwrap_or(0.0))
    });
    choose(&|row| brightness(row).unwrap_or(0.0), 0.0, &|row| {
        format!("among the brightest: mean grey level {:.0} of 255", brightness(row).unwrap_or(0.0))
    });
    let figures: Vec<Figure> = chosen
        .into_iter()
        .filter_map(|(row, why)| {
            let image = recording.picture(row, View::Centre)?;
            let (line, steering) = (recording.rows[row].line, recording.rows[row].steering);
            Some(camera_figure(&image, format!("line {line}, label {}\n{why}", signed(steering))))
        })
        .collect();
    page.figures(3, &figures);
}

fn training(page: &mut Page, recordings: &[Recording], recipe: &Recipe, seed: u64) {
    page.section("Training and validation");
    let all: Vec<f32> = recordings.iter().flat_map(|r| r.rows.iter().map(|row| row.steering)).collect();
    let before = histogram("Before: labels as recorded", HALF, "rows", &all);
    let (spec, samples, balance) = (&recipe.split, &recipe.samples, &recipe.balance);
    let divided = recipe.targets(recordings, &[], &[]).and_then(|targets| {
        let split = crate::dataset::split::split(recordings, &targets, spec, samples, balance, seed)?;
        Ok((targets, split))
    });
    match divided {
        Ok((targets, split)) => {
            let view = SplitView::of(recordings, &targets, &split, recipe);
            view.describe(page);
            page.subsection("Balance of the labels");
            let after = histogram("After: labels that training sees", HALF, "images an epoch", &view.training_labels);
            page.drawings(&[before, after]);
        }
        Err(error) => {
            page.advice(&format!("The recipe {} cannot be trained on this: {error}.", recipe.name), Tone::Warning);
            page.drawings(&[before]);
        }
    }
}
