//! The time of a run, split by activity.

use std::time::{Duration, Instant};

use cpu_time::ProcessTime;
use serde::{Deserialize, Serialize};

use crate::dataset::loader::LoaderTimes;
use crate::engine::network::{Network, TrainingPlan};
use crate::engine::stopwatch::Stopwatch;

/// The stopwatches of a run.
#[derive(Debug)]
pub(super) struct Profile {
    started: Instant,
    /// CPU time of the process at the start, where the system provides it.
    cpu_started: Option<ProcessTime>,
    pub loading: LoaderTimes,
    /// Adding the shards' gradients up, and the optimizer.
    pub update: Stopwatch,
    pub evaluation: Stopwatch,
    pub waiting: Stopwatch,
}

/// The time of a run since this process began it, split by activity. Times of work are CPU seconds summed over the threads: two
/// busy threads add two seconds in each second.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProfileReport {
    /// Threads that share the work.
    pub threads: usize,
    /// Wall time.
    pub wall_s: f64,
    /// Reading and decoding image files.
    pub decode_s: f64,
    /// From the image to the network's input: crop, size, colour, scaling, mirroring.
    pub preprocess_s: f64,
    /// Random changes to training images.
    pub augment_s: f64,
    /// Forward passes of training.
    pub forward_s: f64,
    /// Backward passes.
    pub backward_s: f64,
    /// Adding up gradients and the optimizer's step.
    pub update_s: f64,
    /// The network on the validation side.
    pub evaluation_s: f64,
    /// The rest of `threads` times `wall_s`: reading logs, writing models, waiting for the disk or for
    /// other programs, and threads that were idle.
    pub other_s: f64,
    /// Wall time that the network waited for its next batch.
    pub waiting_for_data_s: f64,
    /// CPU time of the process; absent where the system does not provide it.
    pub cpu_s: Option<f64>,
    /// `cpu_s` as a share of `threads` times `wall_s`, in percent.
    pub busy_percent: Option<f64>,
}

impl Profile {
    pub fn start() -> Profile {
        let loading = LoaderTimes { decode: Stopwatch::on(), preprocess: Stopwatch::on(), augment: Stopwatch::on() };
        Profile {
            started: Instant::now(),
            cpu_started: ProcessTime::try_now().ok(),
            loading,
            update: Stopwatch::on(),
            evaluation: Stopwatch::on(),
            waiting: Stopwatch::on(),
        }
    }

    /// What has been measured so far. Call it inside the rayon pool of the run.
    pub fn report(&self, network: &Network, plan: &TrainingPlan) -> ProfileReport {
        let wall_s = self.started.elapsed().as_secs_f64();
        let threads = rayon::current_num_threads();
        let capacity_s = threads as f64 * wall_s;
        let stages = plan.stage_times(network);
        let cpu = self.cpu_started.and_then(|started| Some(ProcessTime::try_now().ok()?.duration_since(started)));
        let cpu_s = cpu.as_ref().map(Duration::as_secs_f64);
        let mut report = ProfileReport {
            threads,
            wall_s,
            decode_s: self.loading.decode.seconds(),
            preprocess_s: self.loading.preprocess.seconds(),
            augment_s: self.loading.augment.seconds(),
            forward_s: stages.iter().map(|stage| stage.forward_s).sum(),
            backward_s: stages.iter().map(|stage| stage.backward_s).sum(),
            update_s: self.update.seconds(),
            evaluation_s: self.evaluation.seconds(),
            other_s: 0.0,
            waiting_for_data_s: self.waiting.seconds(),
            cpu_s,
            busy_percent: cpu_s.map(|cpu_s| 100.0 * cpu_s / capacity_s),
        };
        let work: f64 = report.parts().iter().map(|(_, seconds)| seconds).sum();
        report.other_s = (capacity_s - work).max(0.0);
        report
    }
}

impl ProfileReport {
    /// The parts of `threads` times `wall_s`, with their names.
    pub fn parts(&self) -> [(&'static str, f64); 8] {
        [
            ("decode", self.decode_s),
            ("preprocess", self.preprocess_s),
            ("augment", self.augment_s),
            ("forward", self.forward_s),
            ("backward", self.backward_s),
            ("update", self.update_s),
            ("evaluation", self.evaluation_s),
            ("other, idle", self.other_s),
        ]
    }

    /// A table for people.
    pub fn table(&self) -> String {
        let capacity_s = self.threads as f64 * self.wall_s;
        let mut text = format!("time of {} threads over {:.1} s\n", self.threads, self.wall_s);
        for (name, seconds) in self.parts() {
            text += &format!("  {name:<12} {seconds:>8.2} s {:>5.1} %\n", 100.0 * seconds / capacity_s);
        }
        text += &format!("the next batch was late for {:.2} s in all", self.waiting_for_data_s);
        if let (Some(cpu_s), Some(busy)) = (self.cpu_s, self.busy_percent) {
            text += &format!("; CPU time {cpu_s:.1} s, cores busy {busy:.0} %");
        }
        text
    }
}
