//! From a file's bytes to network input, one image on one thread, for each shipped recipe; the changes of the recipe `default`, all
//! and without noise; and the view from beside the path of 80x320 pixels.

use std::hint::black_box;

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use steersman::dataset::augment::Augmentation;
use steersman::engine::random::{Purpose, rng};
use steersman::geometry::{CarGeometry, Offset, PixelGrid, ViewWarp};
use steersman::picture::{RgbImage, decode::decode_rgb};
use steersman::recipe::{Recipe, SHIPPED};

fn loader(c: &mut Criterion) {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("data/sample/IMG");
    let mut names: Vec<_> = std::fs::read_dir(folder).expect("the sample log is there").flatten().collect();
    names.sort_by_key(|entry| entry.file_name());
    let jpeg = std::fs::read(names[0].path()).expect("the sample log is readable");

    let mut group = c.benchmark_group("one image");
    group.throughput(Throughput::Elements(1));
    let mut image = RgbImage::default();
    // Also where a filter leaves the next line out.
    decode_rgb(&jpeg, &mut image).expect("the sample is a JPEG");
    group.bench_function("decode", |b| b.iter(|| decode_rgb(&jpeg, &mut image)));
    for (name, _) in SHIPPED {
        let preprocessing = Recipe::find(name, &[]).expect("the recipe is built in").preprocessing;
        let mut preprocessor = preprocessing.plan(image.height, image.width).expect("the sample has pixels");
        let (mut planes, mut input) = (vec![0; preprocessing.output_len()], vec![0.0; preprocessing.output_len()]);
        group.bench_function(format!("preprocess for {name}"), |b| {
            b.iter(|| {
                preprocessor.apply(&image.pixels, &mut planes);
                preprocessing.to_input(&planes, &mut input);
            });
        });
    }
    let Recipe { augmentation, preprocessing, .. } = Recipe::find("default", &[]).expect("the recipe is built in");
    let without_noise = Augmentation { pixel_noise: 0.0, block_noise: 0.0, ..augmentation.clone() };
    let [height, width] = preprocessing.rgb_size();
    for (what, augmentation) in [("augment", augmentation), ("augment without noise", without_noise)] {
        let (mut rgb, mut rng) = (vec![100; height * width * 3], rng(1, Purpose::Test, 0, 0));
        group.bench_function(format!("{what} for default"), |b| {
            b.iter(|| {
                rgb.fill(black_box(100));
                augmentation.apply(&preprocessing, &mut rgb, &mut rng)
            });
        });
    }
    let car = CarGeometry::preset("udacity").expect("a preset");
    let grid = PixelGrid::part(&car, [56.0 / 160.0, 136.0 / 160.0], [80, 320]);
    let (from, mut to) = (vec![100; 80 * 320 * 3], vec![0; 80 * 320 * 3]);
    group.bench_function("view from beside the path", |b| {
        b.iter(|| {
            let offset = Offset { right_m: black_box(0.4), ahead_m: 0.0, turn: black_box(0.05) };
            ViewWarp::new(&car, grid, 0.0, offset).apply(&from, &mut to);
        });
    });
    group.finish();
}

criterion_group!(benches, loader);
criterion_main!(benches);
