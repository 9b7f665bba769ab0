use super::*;
use crate::dataset::augment::ViewSpec;
use crate::dataset::cache::Overflow;
use crate::dataset::colour::Colour;
use crate::dataset::load;
use crate::dataset::samples::{Balance, Correction, LabelSpec};
use crate::dataset::split::{SplitMode, SplitSpec, split};
use crate::dataset::testing::jpeg_of;
use crate::engine::loss::Pairs;
use crate::engine::random::uniform;
use crate::geometry::{Offset, PixelGrid, ViewWarp};
use std::fs;
use std::path::Path;

mod audit;

/// A drive of `rows` rows at 10 Hz whose images differ from row to row and from camera to camera.
fn drive(folder: &Path, rows: usize) {
    fs::create_dir_all(folder.join("IMG")).unwrap();
    let mut text = String::new();
    for i in 0..rows {
        let time = format!("2020_01_01_10_{:02}_{:02}_{:03}", i / 600, i / 10 % 60, i % 10 * 100);
        for (c, camera) in ["center", "left", "right"].into_iter().enumerate() {
            let pixels: Vec<u8> = (0..16 * 24)
                .flat_map(|p| [(p % 24 * 10) as u8, stripe(p % 24 / 4, i), (c * 80 + p / 24) as u8])
                .collect();
            fs::write(folder.join("IMG").join(format!("{camera}_{time}.jpg")), jpeg_of(24, 16, &pixels)).unwrap();
        }
        let steering = (i % 21) as f32 / 10.0 - 1.0;
        text += &format!("center_{time}.jpg,left_{time}.jpg,right_{time}.jpg,{steering},1,0,9\n");
    }
    fs::write(folder.join("driving_log.csv"), text).unwrap();
}

fn spec() -> LoaderSpec {
    LoaderSpec {
        preprocessing: Preprocessing {
            source: [16, 24],
            rows: [4, 16],
            resize: [6, 12],
            colour: Colour::Yuv,
            scale: 1.0 / 255.0,
            offset: -0.5,
            ..Default::default()
        },
        samples: SampleSpec { side_cameras: Some(Correction::Fixed(0.25)), flip: Flip::Both, ..Default::default() },
        augmentation: Augmentation::default(),
        batch: 32,
        seed: 11,
        cache: CacheSpec::default(),
    }
}

fn augmented() -> LoaderSpec {
    let augmentation = Augmentation {
        brightness: Some([0.8, 1.2]),
        shadow_probability: 0.5,
        shift_px: 4.0,
        shift_steering_per_px: Some(Correction::Fixed(0.01)),
        ..Default::default()
    };
    LoaderSpec { augmentation, ..spec() }
}

/// Everything that goes by geometry, on the car's own mount.
fn geometric() -> LoaderSpec {
    let augmentation = Augmentation {
        view: Some(ViewSpec { offset_m: 1.0, turn_deg: 6.0, probability: 0.7 }),
        shift_px: 4.0,
        shift_steering_per_px: Some(Correction::Geometry),
        ..Default::default()
    };
    let samples = SampleSpec {
        side_cameras: Some(Correction::Geometry),
        flip: Flip::Random,
        mirror: Mirror::Geometry,
        validation_flips: true,
        ..Default::default()
    };
    LoaderSpec { augmentation, samples, ..spec() }
}

fn recordings(folder: &Path, rows: usize) -> Arc<[Recording]> {
    drive(folder, rows);
    Arc::from([load(folder).unwrap()])
}

fn targets(recordings: &[Recording], spec: &LoaderSpec) -> Arc<Targets> {
    Arc::new(Targets::of(recordings, &LabelSpec::default(), &spec.samples, &spec.augmentation))
}

fn divide(recordings: &[Recording], spec: &LoaderSpec) -> Split {
    let half = SplitSpec { mode: SplitMode::Blocks, validation_share: 0.3 };
    split(recordings, &targets(recordings, spec), &half, &spec.samples, &Balance::default(), spec.seed).unwrap()
}

/// Stripes that no two of the first 256 rows have nearly in common.
fn stripe(column: usize, row: usize) -> u8 {
    ((11 * column * column * column + 1) * 53 * row % 256) as u8
}

/// All batches of two epochs, as bits.
fn epochs(loader: &mut Loader) -> Vec<(Vec<u32>, Vec<u32>, Vec<SampleId>)> {
    let mut batches = Vec::new();
    let mut batch = Batch::default();
    for epoch in 0..2 {
        loader.begin_epoch(epoch);
        for i in 0..loader.batches() {
            loader.fill(i, &mut batch).unwrap();
            assert_eq!(batch.x.len(), batch.n * loader.spec.preprocessing.output_len());
            let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect();
            batches.push((bits(&batch.x), bits(&batch.labels), batch.samples.clone()));
        }
    }
    batches
}

#[test]
fn batches_do_not_depend_on_threads_or_cache() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    for spec in [spec(), augmented(), geometric()] {
        let split = divide(&recordings, &spec);
        let run = |threads: usize, memory_bytes: usize, overflow: Overflow| {
            let cache = CacheSpec { memory_bytes, overflow, folder: None };
            let spec = LoaderSpec { cache, ..spec.clone() };
            let (mut training, mut validation) =
                Loader::pair(&recordings, &targets(&recordings, &spec), &split, &spec).unwrap();
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| (epochs(&mut training), epochs(&mut validation)))
        };
        let expected = run(1, 1 << 30, Overflow::File);
        for (threads, memory_bytes, overflow) in [
            (2, 1 << 30, Overflow::File),
            (5, 0, Overflow::File),
            (2, 20_000, Overflow::File),
            (5, 0, Overflow::Decode),
        ] {
            assert!(expected == run(threads, memory_bytes, overflow), "{threads} {memory_bytes} {overflow:?}");
        }
    }
}

#[test]
fn an_epoch_shows_every_image_and_its_mirror_once() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let split = divide(&recordings, &spec());
    let (mut training, mut validation) =
        Loader::pair(&recordings, &targets(&recordings, &spec()), &split, &spec()).unwrap();
    assert_eq!(training.images(), split.training.len() * 3);
    assert_eq!(validation.images(), split.validation.len());
    let batches = epochs(&mut training);
    let (first, second) = batches.split_at(training.batches());
    let sorted = |batches: &[(Vec<u32>, Vec<u32>, Vec<SampleId>)]| {
        let mut all: Vec<_> = batches.iter().flat_map(|b| &b.2).map(|s| (s.row, s.camera, s.mirrored)).collect();
        all.sort_unstable();
        all
    };
    assert_eq!(sorted(first).len(), training.images() * 2);
    assert!(sorted(first).windows(2).all(|pair| pair[0] != pair[1]));
    assert_eq!(sorted(first), sorted(second));
    assert_ne!(first[0].2, second[0].2, "a new order in each epoch");
    let validation = epochs(&mut validation);
    assert!(validation.iter().all(|batch| batch.2.iter().all(|s| !s.mirrored && s.camera == View::Centre)));
    assert!(validation[0].2.is_sorted_by_key(|sample| sample.row));
}

#[test]
fn labels_follow_camera_and_mirror() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = spec();
    spec.preprocessing.colour = Colour::Rgb;
    let split = divide(&recordings, &spec);
    let loader = Loader::training(&recordings, &targets(&recordings, &spec), &split, &spec).unwrap();
    let mut batch = Batch::default();
    let (mut mirrors, width) = (0, 12);
    for i in 0..loader.batches() {
        loader.fill(i, &mut batch).unwrap();
        for (sample, (&label, x)) in batch.samples.iter().zip(batch.labels.iter().zip(batch.x.chunks_exact(3 * 6 * 12)))
        {
            let steering = recordings[0].rows[sample.row as usize].steering;
            let corrected = steering + [0.0, 0.25, -0.25][sample.camera as usize];
            assert_eq!(label, if sample.mirrored { -corrected } else { corrected });
            // Red grows to the right in every picture, unless it is mirrored.
            assert_eq!(x[0] > x[width - 1], sample.mirrored);
            mirrors += usize::from(sample.mirrored);
        }
    }
    assert_eq!(mirrors * 2, loader.samples());
}

/// The RGB stage of the image of `camera` at `row`.
fn rgb_stage(recording: &Recording, row: usize, camera: View, spec: &LoaderSpec) -> Vec<u8> {
    let image = recording.picture(row, camera).unwrap();
    let mut rgb = vec![0; spec.preprocessing.rgb_len()];
    spec.preprocessing.plan(image.height, image.width).unwrap().to_rgb_stage(&image.pixels, &mut rgb);
    rgb
}

/// The network's input for an RGB stage.
fn input(rgb: &[u8], spec: &LoaderSpec) -> Vec<f32> {
    let (mut planes, mut x) = (vec![0; spec.preprocessing.output_len()], vec![0.0; spec.preprocessing.output_len()]);
    spec.preprocessing.plan(16, 24).unwrap().finish(rgb, &mut planes);
    spec.preprocessing.to_input(&planes, &mut x);
    x
}

#[test]
fn views_come_from_the_nearest_camera_and_are_labelled_from_where_they_are_seen() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = geometric();
    spec.augmentation.shift_px = 0.0;
    let split = divide(&recordings, &spec);
    let targets = targets(&recordings, &spec);
    let loader = Loader::training(&recordings, &targets, &split, &spec).unwrap();
    let car = &recordings[0].geometry;
    let grid = PixelGrid::part(car, [4.0 / 16.0, 1.0], [6, 12]);
    let mut batch = Batch::default();
    let mut seen = [0; 3];
    for i in 0..loader.batches() {
        loader.fill(i, &mut batch).unwrap();
        for (k, (sample, x)) in batch.samples.iter().zip(batch.x.chunks_exact(3 * 6 * 12)).enumerate() {
            let number = loader.order[i * 32 + k];
            let view = spec.augmentation.view.unwrap().draw(&mut rng(11, Purpose::View, 0, number.into()));
            let item = Item::new(0, sample.row, View::ALL);
            // The cameras of the preset are 0.806 m to the left and 0.825 m to the right.
            let (camera, taken_m) = match (view, sample.camera) {
                (Some(Offset { right_m: ..-0.403, .. }), _) | (None, View::Left) => (View::Left, -0.806),
                (Some(Offset { right_m: 0.4125.., .. }), _) | (None, View::Right) => (View::Right, 0.825),
                _ => (View::Centre, 0.0),
            };
            seen[camera as usize] += usize::from(view.is_some());
            let offset = view.unwrap_or(Offset { right_m: taken_m, ..Offset::default() });
            let label = targets.beside(item, offset);
            assert_eq!(batch.labels[k], if sample.mirrored { -label } else { label });
            let taken = rgb_stage(&recordings[0], sample.row as usize, camera, &spec);
            let mut warped = vec![0; taken.len()];
            match (view, sample.mirrored) {
                (None, false) => warped.copy_from_slice(&taken),
                (_, false) => ViewWarp::new(car, grid, taken_m, offset).apply(&taken, &mut warped),
                (_, true) => ViewWarp::mirrored(car, grid, taken_m, offset).apply(&taken, &mut warped),
            }
            assert_eq!(x, input(&warped, &spec), "row {} {camera:?} {view:?} {}", sample.row, sample.mirrored);
        }
    }
    assert!(seen.iter().all(|&n| n > 30), "{seen:?}");
}

#[test]
fn shifts_by_geometry_have_the_sign_of_the_picture_in_mirrored_worlds_too() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = geometric();
    spec.augmentation.view = None;
    let split = divide(&recordings, &spec);
    let targets = targets(&recordings, &spec);
    let shifted = Loader::training(&recordings, &targets, &split, &spec).unwrap();
    let mut batch = Batch::default();
    shifted.fill(0, &mut batch).unwrap();
    for (k, sample) in batch.samples.iter().enumerate() {
        let item = Item::new(0, sample.row, View::ALL);
        let plain = spec.samples.label(&targets, item, sample.camera) * if sample.mirrored { -1.0 } else { 1.0 };
        let mut draw = rng(11, Purpose::Augment, 0, shifted.order[k].into());
        let columns = (uniform(&mut draw, -4.0, 4.0) / 2.0).round();
        // To the right where the picture went to the right, whichever world it shows.
        let change = f64::from(batch.labels[k] - plain);
        assert!(if columns == 0.0 { change == 0.0 } else { change * columns > 0.0 }, "{columns} {change}");
    }
}

#[test]
fn rows_stay_together_where_the_recipe_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = spec();
    spec.samples.group = Group::Rows;
    spec.batch = 25; // four rows of six samples
    let split = divide(&recordings, &spec);
    let loader = Loader::training(&recordings, &targets(&recordings, &spec), &split, &spec).unwrap();
    let mut batch = Batch::default();
    assert_eq!(loader.batches(), split.training.len().div_ceil(4));
    loader.fill(0, &mut batch).unwrap();
    assert_eq!(batch.n, 24);
    for row in batch.samples.chunks_exact(6) {
        assert!(row.iter().all(|sample| sample.row == row[0].row));
    }
}

#[test]
fn random_mirrors_change_from_epoch_to_epoch() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let mut spec = spec();
    spec.samples.flip = Flip::Random;
    let split = divide(&recordings, &spec);
    let mut loader = Loader::training(&recordings, &targets(&recordings, &spec), &split, &spec).unwrap();
    assert_eq!(loader.samples(), loader.images());
    let batches = epochs(&mut loader);
    let mirrored = |batches: &[(Vec<u32>, Vec<u32>, Vec<SampleId>)]| {
        let all = batches.iter().flat_map(|batch| &batch.2);
        all.filter(|sample| sample.mirrored).map(|s| (s.row, s.camera)).collect::<std::collections::BTreeSet<_>>()
    };
    let (first, second) = (mirrored(&batches[..loader.batches()]), mirrored(&batches[loader.batches()..]));
    let share = first.len() as f64 / loader.images() as f64;
    assert!((share - 0.5).abs() < 0.15, "{share}");
    assert_ne!(first, second);
}

#[test]
fn broken_images_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let path = recordings[0].image_path(0, View::Left).unwrap();
    fs::write(&path, b"\xff\xd8 no picture \xff\xd9").unwrap();
    let wheel = Arc::new(Targets::wheel(&recordings));
    let none = SplitSpec { validation_share: 0.0, ..Default::default() };
    let split = split(&recordings, &wheel, &none, &spec().samples, &Balance::default(), 0).unwrap();
    let mut loader = Loader::training(&recordings, &wheel, &split, &spec()).unwrap();
    let batches = epochs(&mut loader);
    let samples: usize = batches.iter().map(|batch| batch.2.len()).sum();
    assert_eq!(samples, 2 * (loader.samples() - 2));
    // Those behind the gap have moved up with their labels.
    for (_, labels, ids) in &batches {
        for (&label, id) in labels.iter().zip(ids) {
            let of_row = recordings[0].rows[id.row as usize].steering;
            let seen = of_row + [0.0, 0.25, -0.25][id.camera as usize];
            assert_eq!(f32::from_bits(label), if id.mirrored { -seen } else { seen }, "{id:?}");
        }
    }
    let (count, examples) = loader.undecodable();
    assert_eq!(count, 1);
    assert!(examples[0].contains("left_2020") && examples[0].contains("JPEG"), "{examples:?}");
}

/// Every batch of an epoch begins with pairs as `smoothness` says; returns how many of each kind there are, and the samples.
fn assert_pairs(loader: &mut Loader, smoothness: &Smoothness) -> ([usize; 2], usize) {
    let mut batch = Batch::default();
    let (len, mut found, mut samples) = (loader.spec.preprocessing.output_len(), [0, 0], 0);
    let mut changed = 0;
    for k in 0..loader.batches() {
        loader.fill(k, &mut batch).unwrap();
        let Pairs { spatial, temporal } = batch.pairs;
        let most = smoothness.pairs(loader.spec.batch);
        assert!(batch.n <= loader.spec.batch && spatial <= most.spatial && temporal <= most.temporal);
        assert!(2 * (spatial + temporal) <= batch.n);
        for pair in 0..spatial + temporal {
            let [a, b] = [2 * pair, 2 * pair + 1];
            let ([x_a, x_b], [s_a, s_b]) =
                ([a, b].map(|i| &batch.x[i * len..][..len]), [batch.samples[a], batch.samples[b]]);
            let steering = |s: SampleId| loader.recordings[0].rows[s.row as usize].steering;
            let sign = if s_a.mirrored { -1.0 } else { 1.0 };
            let asked = batch.labels[a] - batch.labels[b] - sign * (steering(s_a) - steering(s_b));
            if pair < spatial {
                assert_eq!(s_a, s_b);
                // Shifts by whole columns of two pixels: the labels tell how far they lie apart.
                assert!((asked / 0.02 - (asked / 0.02).round()).abs() < 1e-3);
                changed += usize::from(x_a != x_b);
            } else {
                assert_eq!((s_a.camera, s_a.mirrored), (s_b.camera, s_b.mirrored));
                assert_eq!(s_a.row.abs_diff(s_b.row), 1);
                assert!(asked.abs() < 1e-5, "one shift for both: {asked}");
                assert_ne!(x_a, x_b);
            }
        }
        found = [found[0] + spatial, found[1] + temporal];
        samples += batch.n;
    }
    assert!(changed * 10 >= found[0] * 9, "{changed} of {} spatial pairs differ", found[0]);
    (found, samples)
}

#[test]
fn batches_hold_pairs_of_one_image_and_of_neighbours() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let none = SplitSpec { validation_share: 0.0, ..Default::default() };
    let spec = LoaderSpec { batch: 20, ..augmented() };
    let targets = targets(&recordings, &spec);
    let split = split(&recordings, &targets, &none, &spec.samples, &Balance::default(), 0).unwrap();
    let load = || Loader::training(&recordings, &targets, &split, &spec).unwrap();
    let batches = load().batches();
    assert_eq!(batches, 45);
    for (spatial, temporal, found) in [(1.0, 1.0, [3, 2]), (0.5, 0.0, [5, 0]), (0.0, 2.0, [0, 5])] {
        let smoothness = Smoothness { spatial, temporal, ..Smoothness::default() };
        let mut loader = load();
        assert_eq!(loader.pair_up(&smoothness), 450, "every image has a neighbour");
        assert_eq!((loader.batches(), loader.samples()), (batches, 900), "an epoch is as long as without pairs");
        assert_eq!(assert_pairs(&mut loader, &smoothness), (found.map(|count| count * batches), 900));
        let with = |threads| {
            let mut loader = load();
            loader.pair_up(&smoothness);
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| epochs(&mut loader))
        };
        assert_eq!(with(1), with(3));
    }
    // A pair with a broken picture goes as a whole.
    fs::write(recordings[0].image_path(70, View::Left).unwrap(), b"\xff\xd8 no picture \xff\xd9").unwrap();
    let smoothness = Smoothness { pairs_share: 1.0, spatial: 1.0, temporal: 1.0 };
    let mut loader = load();
    loader.pair_up(&smoothness);
    let (found, samples) = assert_pairs(&mut loader, &smoothness);
    assert!(samples < 900 && samples % 2 == 0 && found[0] + found[1] == samples / 2, "{found:?}, {samples}");
}

/// The second recording is the simulator's: all of its rows can be drawn.
fn mixed(folder: &Path, simulator_rows: usize, simulator_share: f64) -> (Arc<[Recording]>, Split, LoaderSpec) {
    let [own, simulator] = ["own", "simulator"].map(|name| folder.join(name));
    drive(&own, 150);
    drive(&simulator, simulator_rows);
    let recordings: Arc<[Recording]> = Arc::from([load(&own).unwrap(), load(&simulator).unwrap()]);
    let samples = SampleSpec { simulator_share, ..augmented().samples };
    let spec = LoaderSpec { samples, ..augmented() };
    let mut split = divide(&recordings[..1], &spec);
    let targets = targets(&recordings, &spec);
    split.draw_from(&recordings, 1, &targets, &spec.samples, &Balance::default(), 1).unwrap();
    (recordings, split, spec)
}

#[test]
fn an_epoch_shows_all_of_the_recording_and_the_simulators_share_drawn_anew() {
    let folder = tempfile::tempdir().unwrap();
    let (recordings, split, spec) = mixed(folder.path(), 260, 0.25);
    let targets = targets(&recordings, &spec);
    let mut loader = Loader::training(&recordings, &targets, &split, &spec).unwrap();
    let own = split.training.len() * 6;
    let drawn = (own as f64 / 3.0).round() as usize;
    assert_eq!((loader.samples(), loader.simulator_samples()), (own + drawn, drawn));
    assert_eq!(loader.images(), split.training.len() * 3 + 260 * 3);
    let mut shown = |epoch: u32| -> [Vec<String>; 2] {
        loader.begin_epoch(epoch);
        let (mut batch, mut seen) = (Batch::default(), [Vec::new(), Vec::new()]);
        for i in 0..loader.batches() {
            loader.fill(i, &mut batch).unwrap();
            batch.samples.iter().for_each(|id| seen[usize::from(id.recording)].push(format!("{id:?}")));
        }
        for side in &mut seen {
            let all = side.len();
            side.sort();
            side.dedup();
            assert_eq!(side.len(), all, "nothing is shown twice");
        }
        seen
    };
    let [first, second, again] = [shown(0), shown(1), shown(0)];
    assert_eq!((first[0].len(), first[1].len()), (own, drawn));
    assert!(first[0] == second[0] && first[1] != second[1] && second[1].len() == drawn && again == first);
    assert_eq!(loader.samples_used(), own + drawn);

    // A set that is smaller than its share is shown whole.
    let other = tempfile::tempdir().unwrap();
    let (recordings, split, spec) = mixed(other.path(), 40, 0.95);
    let loader = Loader::training(&recordings, &targets, &split, &spec).unwrap();
    assert_eq!(loader.simulator_samples(), 40 * 6);
}

#[test]
fn rows_that_count_several_times_are_decoded_once_and_changed_each_time() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = recordings(folder.path(), 150);
    let spec = augmented();
    let mut split = divide(&recordings, &spec);
    split.times = split.training.iter().map(|item| if item.row == 0 { 3 } else { 1 }).collect();
    fs::write(recordings[0].image_path(1, View::Centre).unwrap(), "no picture").unwrap();
    let mut loader = Loader::training(&recordings, &targets(&recordings, &spec), &split, &spec).unwrap();
    assert_eq!((loader.images(), loader.samples()), (split.training.len() * 3, (split.training.len() + 2) * 6));
    let of_row = |shown: &[(Vec<u32>, Vec<u32>, Vec<SampleId>)], row: u32| -> Vec<Vec<u32>> {
        let len = spec.preprocessing.output_len();
        let samples = shown.iter().flat_map(|(x, _, ids)| x.chunks_exact(len).zip(ids));
        let wanted = SampleId { recording: 0, row, camera: View::Centre, mirrored: false };
        samples.filter(|(_, id)| **id == wanted).map(|(x, _)| x.to_vec()).collect()
    };
    let shown = epochs(&mut loader);
    let mut pictures = of_row(&shown[..shown.len() / 2], 0);
    assert_eq!(pictures.len(), 3);
    pictures.sort();
    pictures.dedup();
    assert_eq!(pictures.len(), 3, "each time with changes of its own");
    assert_eq!(of_row(&shown[..shown.len() / 2], 2).len(), 1);
    // What cannot be decoded is counted once; its mirror goes too.
    let lost = usize::from(split.training.iter().any(|item| item.row == 1));
    assert_eq!((loader.undecodable().0, loader.samples_used()), (lost, loader.samples() - 2 * lost));
}
