//! `steersman bench`: the engine alone, on random arrays in memory.

use std::time::Instant;

use clap::Args;
use ndarray::{ArrayView1, ArrayView4, ArrayViewMut1};
use rayon::prelude::*;
use serde::Serialize;
use steersman_kernels::conv::ConvAlgorithm;
use steersman_kernels::peak::measure_peak_gflops;
use steersman_kernels::{Backend, Isa};

use super::arguments::RecipeArgs;
use super::process::pool;
use super::terminal::print_json;
use crate::cluster::process::peak_memory_mb;
use crate::engine::network::{InferencePlan, Network, Parameters, Predictor, StageTime, StepInput, TrainingPlan};
use crate::engine::optimizer::Optimizer;
use crate::engine::random::{Purpose, rng, uniform};
use crate::engine::stopwatch::Stopwatch;
use crate::error::{Error, Result};
use crate::recipe::Recipe;

/// Largest batch: beyond it, eight of them do not fit into memory.
const MAX_BATCH: usize = 16_384;

/// How many batches of random images are held in memory.
const BATCHES: usize = 8;

/// Measure training and prediction of a network on random arrays: no files, no decoding
#[derive(Debug, Args)]
pub struct BenchArgs {
    #[command(flatten)]
    recipe: RecipeArgs,
    /// Images in a batch
    #[arg(long, default_value_t = 128)]
    batch: usize,
    /// Threads; 0 is one for each core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// How convolutions are computed: auto (the fastest for each shape) or im2col (the textbook way) [default: auto]
    #[arg(long, value_name = "NAME")]
    algorithm: Option<ConvAlgorithm>,
    /// Seconds for each of the measurements
    #[arg(long, default_value_t = 3.0)]
    seconds: f64,
    /// Also measure how long each layer takes, forward and backward, in training steps
    #[arg(long)]
    profile: bool,
    /// Print one JSON object as the last line
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct BenchResult {
    train_images_per_second: f64,
    /// Arithmetic of convolutions and dense layers: two operations a multiply-add, training as three forward passes.
    train_gflops: f64,
    /// One image on one thread.
    infer_us_p50: f64,
    infer_us_p99: f64,
    /// Whole batches on all threads.
    infer_images_per_second: f64,
    /// Fused multiply-adds in registers, all threads at once, in the same run.
    peak_gflops: f64,
    /// From the start of the process to the end of the first training step.
    first_step_s: f64,
    /// Absent where the system does not tell.
    peak_rss_mb: Option<f64>,
    isa: &'static str,
    /// How convolutions are computed: `auto` or `im2col`.
    algorithm: &'static str,
    threads: usize,
    /// With `--profile`.
    #[serde(skip_serializing_if = "Option::is_none")]
    profile: Option<StepProfile>,
}

/// Where the time of a training step goes: CPU time, summed over threads.
#[derive(Serialize)]
struct StepProfile {
    layers: Vec<LayerTime>,
    /// Adding up gradients and the optimizer's step.
    update_ms: f64,
    /// The rest of threads times wall time: batch-norm sums put together, waiting at barriers.
    other_ms: f64,
}

/// What layers that run as one take of a training step.
#[derive(Serialize)]
struct LayerTime {
    layers: String,
    forward_ms: f64,
    /// 10^9 operations a second on one core, two a multiply-add; 0 for layers without multiply-adds.
    forward_gflops: f64,
    backward_ms: f64,
    backward_gflops: f64,
}

pub fn run(args: BenchArgs, started: Instant) -> Result<()> {
    let sensible = (1..=MAX_BATCH).contains(&args.batch) && args.seconds > 0.0 && args.seconds < 1e6;
    if !sensible {
        return Err(Error::Usage(format!(
            "--batch must be 1 to {MAX_BATCH}, --seconds more than 0 and less than a million"
        )));
    }
    let recipe = args.recipe.find()?;
    let pool = pool(args.threads)?;
    let result = pool.install(|| measure(&recipe, &args, started))?;
    if args.json {
        return print_json(&result);
    }
    let share = 100.0 * result.train_gflops / result.peak_gflops;
    let BenchResult { threads, isa, algorithm, .. } = result;
    let algorithm = if algorithm == ConvAlgorithm::Auto.name() { String::new() } else { format!(", {algorithm}") };
    println!("{}, batch {}, {threads} threads, {isa}{algorithm}", recipe.name, args.batch);
    println!(
        "training      {:>9.0} images/s   {:.1} GFLOP/s, {share:.1} % of {:.0}",
        result.train_images_per_second, result.train_gflops, result.peak_gflops
    );
    println!("prediction    {:>9.0} images/s", result.infer_images_per_second);
    println!("one image     {:>9.0} us median  {:.0} us p99 (1 thread)", result.infer_us_p50, result.infer_us_p99);
    println!("first step    {:>9.3} s after the start", result.first_step_s);
    if let Some(megabytes) = result.peak_rss_mb {
        println!("peak memory   {megabytes:>9.0} MB");
    }
    if let Some(profile) = &result.profile {
        print_profile(profile, result.peak_gflops / result.threads as f64);
    }
    Ok(())
}

fn measure(recipe: &Recipe, args: &BenchArgs, started: Instant) -> Result<BenchResult> {
    let conv = args.algorithm.unwrap_or_else(ConvAlgorithm::of_environment);
    let network = recipe.network(Backend { isa: Isa::best(), conv })?;
    let mut parameters = network.initialize(1);
    // The first step waits for its own batch alone, as in training.
    let mut x = vec![random_numbers(args.batch * network.input().len(), 0)];
    let labels: Vec<Vec<f32>> =
        (0..BATCHES).map(|batch| random_numbers(args.batch * network.output().len(), 1 << 32 | batch as u64)).collect();

    let mut plan = TrainingPlan::new(&network, args.batch);
    let mut optimizer = Optimizer::new(recipe.optimizer, recipe.clip_gradient_norm, network.tensors(), network.isa());
    let mut step = 0;
    let mut train_step =
        |plan: &mut TrainingPlan, optimizer: &mut Optimizer, x: &[Vec<f32>], parameters: &mut Parameters| {
            let batch = step % BATCHES;
            let input = StepInput {
                x: images(&network, &x[batch]),
                labels: ArrayView1::from(&labels[batch]),
                seed: 1,
                step: step as u64,
            };
            plan.step(&network, parameters, &recipe.loss, input);
            let norm = plan.gradient_norm();
            optimizer.step(recipe.optimizer.learning_rate(), &mut parameters.values, plan.gradient_mut(), norm);
            step += 1;
        };
    train_step(&mut plan, &mut optimizer, &x, &mut parameters);
    let first_step_s = started.elapsed().as_secs_f64();
    x.extend((1..BATCHES).map(|batch| random_numbers(args.batch * network.input().len(), batch as u64)));

    let (mut steps, training) = (0, Instant::now());
    while training.elapsed().as_secs_f64() < args.seconds {
        train_step(&mut plan, &mut optimizer, &x, &mut parameters);
        steps += 1;
    }
    let train_images_per_second = (steps * args.batch) as f64 / training.elapsed().as_secs_f64();
    let profile = args.profile.then(|| {
        let update = Stopwatch::on();
        plan.measure(update.clone());
        optimizer.measure(update.clone());
        let (mut steps, started) = (0, Instant::now());
        while steps == 0 || started.elapsed().as_secs_f64() < args.seconds {
            train_step(&mut plan, &mut optimizer, &x, &mut parameters);
            steps += 1;
        }
        let thread_s = started.elapsed().as_secs_f64() * rayon::current_num_threads() as f64;
        StepProfile::of(&plan.stage_times(&network), update.seconds(), thread_s, steps, args.batch)
    });

    let infer_images_per_second = infer_throughput(&network, &parameters, &x, args);
    let (infer_us_p50, infer_us_p99) = infer_latency(recipe.network(Isa::best())?, parameters, &x[0], args.seconds);
    let peaks = rayon::broadcast(|_| measure_peak_gflops(network.isa(), args.seconds.min(1.0)));
    Ok(BenchResult {
        train_images_per_second,
        train_gflops: train_images_per_second * network.multiply_adds() as f64 * 2.0 * 3.0 / 1e9,
        infer_us_p50,
        infer_us_p99,
        infer_images_per_second,
        peak_gflops: peaks.iter().sum(),
        first_step_s,
        peak_rss_mb: peak_memory_mb(),
        isa: network.isa().name(),
        algorithm: conv.name(),
        threads: rayon::current_num_threads(),
        profile,
    })
}

impl StepProfile {
    /// Of `steps` steps with `batch` images that took `thread_s` seconds times threads.
    fn of(stages: &[StageTime], update_s: f64, thread_s: f64, steps: usize, batch: usize) -> StepProfile {
        let ms = |seconds: f64| 1e3 * seconds / steps as f64;
        let gflops = |multiply_adds: u64, seconds: f64| {
            if seconds > 0.0 { 2e-9 * multiply_adds as f64 * (steps * batch) as f64 / seconds } else { 0.0 }
        };
        let layers = stages.iter().map(|stage| LayerTime {
            layers: stage.layers.clone(),
            forward_ms: ms(stage.forward_s),
            forward_gflops: gflops(stage.forward_multiply_adds, stage.forward_s),
            backward_ms: ms(stage.backward_s),
            backward_gflops: gflops(stage.backward_multiply_adds, stage.backward_s),
        });
        let in_stages: f64 = stages.iter().map(|stage| stage.forward_s + stage.backward_s).sum();
        StepProfile {
            layers: layers.collect(),
            update_ms: ms(update_s),
            other_ms: ms((thread_s - in_stages - update_s).max(0.0)),
        }
    }
}

/// The table of a training step, against the multiply-add peak of one core.
fn print_profile(profile: &StepProfile, peak_gflops: f64) {
    println!("\none training step, CPU time of all threads; GFLOP/s of one core, share of its peak");
    println!("{:<28} {:^26}   {:^26}", "layers", "forward", "backward");
    let pass = |ms: f64, gflops: f64| match gflops {
        0.0 => format!("{ms:>8.2} ms {:>15}", ""),
        _ => format!("{ms:>8.2} ms {gflops:>7.1} {:>5.1} %", 100.0 * gflops / peak_gflops),
    };
    for LayerTime { layers, forward_ms, forward_gflops, backward_ms, backward_gflops } in &profile.layers {
        println!("{layers:<28} {}   {}", pass(*forward_ms, *forward_gflops), pass(*backward_ms, *backward_gflops));
    }
    for (name, ms) in [("gradient sums and optimizer", profile.update_ms), ("other, idle", profile.other_ms)] {
        println!("{name:<28} {}", pass(ms, 0.0));
    }
}

/// Numbers in [-0.5, 0.5), drawn on all threads.
fn random_numbers(len: usize, stream: u64) -> Vec<f32> {
    /// Numbers of one stream.
    const PART: usize = 1 << 16;
    let mut numbers = vec![0.0; len];
    numbers.par_chunks_mut(PART).enumerate().for_each(|(part, numbers)| {
        let mut random = rng(1, Purpose::Test, part as u64, stream);
        numbers.fill_with(|| uniform(&mut random, -0.5, 0.5) as f32);
    });
    numbers
}

/// The images in `x`, `(n, c, h, w)`.
fn images<'a>(network: &Network, x: &'a [f32]) -> ArrayView4<'a, f32> {
    let n = x.len() / network.input().len();
    ArrayView4::from_shape(network.input().batch(n), x).expect("whole images")
}

fn infer_throughput(network: &Network, parameters: &Parameters, x: &[Vec<f32>], args: &BenchArgs) -> f64 {
    let mut plan = InferencePlan::new(network, args.batch);
    let mut y = vec![0.0; args.batch * network.output().len()];
    plan.run(network, parameters, images(network, &x[0]), ArrayViewMut1::from(&mut y));
    let (mut batches, started) = (0, Instant::now());
    while started.elapsed().as_secs_f64() < args.seconds {
        plan.run(network, parameters, images(network, &x[batches % BATCHES]), ArrayViewMut1::from(&mut y));
        batches += 1;
    }
    (batches * args.batch) as f64 / started.elapsed().as_secs_f64()
}

/// Median and 99th percentile of the time for one image, in microseconds.
fn infer_latency(network: Network, parameters: Parameters, x: &[f32], seconds: f64) -> (f64, f64) {
    let mut predictor = Predictor::new(network, parameters, 1);
    let mut times = Vec::new();
    let started = Instant::now();
    let (image_len, outputs) = (predictor.network().input().len(), predictor.network().output().len());
    let mut y = vec![0.0; outputs];
    for image in x.chunks_exact(image_len).cycle() {
        let image = images(predictor.network(), image);
        let before = Instant::now();
        predictor.run(image, ArrayViewMut1::from(&mut y));
        times.push(before.elapsed().as_secs_f64() * 1e6);
        if started.elapsed().as_secs_f64() >= seconds {
            break;
        }
    }
    times.sort_by(f64::total_cmp);
    let percentile = |p: usize| times[(times.len() - 1) * p / 100];
    (percentile(50), percentile(99))
}
