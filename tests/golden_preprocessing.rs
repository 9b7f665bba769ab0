//! Our preprocessing against OpenCV: at most one grey level off, 0.05 on average.
//! `tests/golden/README.md` says what the file holds and how to make it.

mod common;

use common::formula::hash;
use serde::Deserialize;
use steersman::dataset::preprocess::Preprocessing;

#[derive(Deserialize)]
struct Golden {
    cases: Vec<Case>,
}

#[derive(Deserialize)]
struct Case {
    name: String,
    image: String,
    size: [usize; 2],
    rows: [usize; 2],
    resize: [usize; 2],
    interpolation: String,
    colour: String,
    colour_first: bool,
    #[serde(default)]
    blur: bool,
    shape: [usize; 3],
    means: Vec<f64>,
    samples: Vec<u8>,
}

fn road([h, w]: [usize; 2]) -> Vec<u8> {
    let noise = hash("road");
    let pixel = |y: usize, x: usize, c: usize| {
        let gradient = [x * 255 / (w - 1), y * 255 / (h - 1), (x + y) * 255 / (w + h - 2)][c] as i64;
        let edge = if (x / 16 + y / 16).is_multiple_of(2) { -40 } else { 40 };
        let grain = i64::from(noise((y * w + x) * 3 + c) >> 24) % 65 - 32;
        (gradient + edge + grain).clamp(0, 255) as u8
    };
    (0..h * w * 3).map(|i| pixel(i / 3 / w, i / 3 % w, i % 3)).collect()
}

fn colours([h, w]: [usize; 2]) -> Vec<u8> {
    let noise = hash("colours");
    let byte = |index: usize| i64::from(noise(index) >> 24);
    let pixel = |y: usize, x: usize, c: usize| {
        let at = (y * w + x) * 3;
        let g = byte(at + c);
        let value = match y {
            0 => 4 * x as i64 % 256,
            1 => 4 * x as i64 % 256 + 3,
            2 => 255 * (x as i64 >> c & 1),
            y if y >= 3 * h / 4 => byte(at) + g % 9 - 4,
            y if y >= h / 2 => g / 8,
            _ => g,
        };
        value.clamp(0, 255) as u8
    };
    (0..h * w * 3).map(|i| pixel(i / 3 / w, i / 3 % w, i % 3)).collect()
}

#[test]
fn every_case_agrees_with_opencv() {
    let path = format!("{}/tests/golden/preprocessing.json", env!("CARGO_MANIFEST_DIR"));
    let golden: Golden = serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap();
    let mut failures = Vec::new();
    for case in &golden.cases {
        let image = match case.image.as_str() {
            "road" => road(case.size),
            _ => colours(case.size),
        };
        let table = format!(
            "source = {:?}\nrows = {:?}\nresize = {:?}\ninterpolation = {:?}\ncolour = {:?}\ncolour_first = {}\nblur = {}",
            case.size, case.rows, case.resize, case.interpolation, case.colour, case.colour_first, case.blur
        );
        let preprocessing: Preprocessing = toml::from_str(&table).unwrap();
        assert_eq!(preprocessing.output(), case.shape, "{}", case.name);
        let mut planes = vec![0; preprocessing.output_len()];
        preprocessing.plan(case.size[0], case.size[1]).unwrap().apply(&image, &mut planes);

        // Hue is an angle: 0 to 179, then 0 again.
        let plane_len = case.shape[1] * case.shape[2];
        let is_hue = |index: usize| ["hsv", "hls"].contains(&case.colour.as_str()) && index < plane_len;
        let place = hash(&format!("place/{}", case.name));
        let distance = |(k, sample): (usize, &u8)| {
            let index = place(k) as usize % planes.len();
            let direct = planes[index].abs_diff(*sample);
            if is_hue(index) { direct.min(180 - direct.min(180)) } else { direct }
        };
        let distances: Vec<u8> = case.samples.iter().enumerate().map(distance).collect();
        let largest = distances.iter().max().copied().unwrap_or(u8::MAX);
        let average = distances.iter().map(|d| f64::from(*d)).sum::<f64>() / distances.len() as f64;
        let means = planes.chunks(plane_len).zip(&case.means).enumerate().map(|(plane, (values, expected))| {
            let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / plane_len as f64;
            // The mean of an angle says nothing where it wraps.
            if is_hue(plane * plane_len) { 0.0 } else { (mean - expected).abs() }
        });
        let mean_error = means.fold(0.0, f64::max);
        if largest > 1 || average > 0.05 || mean_error > 0.05 {
            failures
                .push(format!("{}: {largest} levels off, {average:.3} on average, means {mean_error:.3}", case.name));
        }
    }
    assert!(golden.cases.len() >= 20);
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}
