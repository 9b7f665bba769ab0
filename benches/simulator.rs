//! How fast the simulator takes pictures, records and drives; one core each.

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use steersman::model_file::{Model, TrainingRecord};
use steersman::pilot::Pilot;
use steersman::recipe::Recipe;
use steersman::simulator::jpeg;
use steersman::simulator::run_trial;
use steersman::simulator::{
    Camera, DriveState, Driver, Expert, Mount, Renderer, RgbFrame, Simulation, Speed, Start, Track, TrialOptions,
    Variant,
};
use steersman_kernels::Isa;

/// Cameras all around a lap, so that every kind of view is in the mean.
fn cameras(track: &Track) -> Vec<Camera> {
    (0..64)
        .map(|k| {
            let s_m = track.length_m * f64::from(k) / 64.0;
            let start = Start { s_m, reverse: false, offset_m: 0.3, heading_deg: 1.0 };
            Camera::new(&Simulation::new(track, start, 9.0).body_pose(), Mount::Center)
        })
        .collect()
}

fn pictures(c: &mut Criterion) {
    let mut group = c.benchmark_group("simulator");
    for name in ["lake", "mountain", "coast", "forest"] {
        let track = Track::load(name).expect("a built-in track");
        let (world, cameras) = (track.world(), cameras(&track));
        let variant = Variant::new(world, 1);
        let (mut renderer, mut frame, mut bytes) = (Renderer::default(), RgbFrame::default(), Vec::new());
        group.throughput(Throughput::Elements(cameras.len() as u64));
        group.bench_function(BenchmarkId::new("render", name), |b| {
            b.iter(|| {
                for camera in &cameras {
                    renderer.render(world, &variant, camera, Mount::Center, &mut frame);
                    black_box(&frame);
                }
            });
        });
        group.bench_function(BenchmarkId::new("render_and_jpeg", name), |b| {
            b.iter(|| {
                for camera in &cameras {
                    renderer.render(world, &variant, camera, Mount::Center, &mut frame);
                    bytes.clear();
                    jpeg::encode(&frame, &mut bytes).expect("a frame of the right size");
                    black_box(&bytes);
                }
            });
        });
    }
    group.finish();
}

/// Looks at every picture, through a network where there is one, and steers like the expert.
struct Watching(Option<Pilot>);

impl Driver for Watching {
    fn steer(&mut self, frame: &RgbFrame, state: &DriveState) -> f32 {
        if let Some(pilot) = &mut self.0 {
            black_box(pilot.steer(frame.view())).expect("a picture of the right size");
        }
        black_box(frame);
        Expert.steer(frame, state)
    }
}

/// A network with random weights: as fast as a trained one.
fn untrained(recipe: &str) -> Pilot {
    let recipe = Recipe::find(recipe, &[]).expect("a built-in recipe");
    let parameters = recipe.network(Isa::best()).expect("layers that fit").initialize(1);
    let model = Model { recipe, parameters, record: TrainingRecord::default(), training_rows: Vec::new() };
    Pilot::new(model, Isa::best()).expect("layers that fit")
}

/// Simulated seconds count as elements: elements a second are the real-time factor. Each has 20 pictures, drawn, encoded
/// and decoded.
fn closed_loop(c: &mut Criterion) {
    let track = Track::load("lake").expect("a built-in track");
    let options = TrialOptions { laps: 1, speed: Speed::Fixed(20.0), latency_ms: 0.0, noise: 0.0, assisted: false };
    let mut group = c.benchmark_group("simulator");
    for (name, pilot) in [("expert", None), ("lenet", Some(untrained("lenet")))] {
        let mut driver = Watching(pilot);
        let seconds = run_trial(&track, &mut driver, &options, 1).expect("a run").time_s;
        group.sample_size(10).throughput(Throughput::Elements(seconds as u64));
        let id = BenchmarkId::new("drive_simulated_seconds", name);
        group.bench_function(id, |b| b.iter(|| run_trial(&track, &mut driver, &options, 1)));
    }
    group.finish();
}

criterion_group!(benches, pictures, closed_loop);
criterion_main!(benches);
