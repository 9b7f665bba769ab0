//! From a file's bytes to network input, one image on one thread, for each shipped recipe.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
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
    group.finish();
}

criterion_group!(benches, loader);
criterion_main!(benches);
