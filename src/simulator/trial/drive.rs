//! Many trials of one driver on one track, and the comparison of two drivers.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::calm::Calm;
use crate::observer::{Observer, Progress, Tally};
use crate::simulator::track::Track;
use crate::simulator::trial::driver::{Driver, Expert};
use crate::simulator::trial::event::DriveEvent;
use crate::simulator::trial::outcome::{Failure, INTERVENTION_M, Trial, autonomy_percent, line_errors_m};
use crate::simulator::trial::run::{run_trial, run_trial_observed};
use crate::simulator::trial::statistics::{PairedTest, wilson_interval};
use crate::simulator::trial::summary::{DriveOptions, DriveResult, DriveSummary, TrialPair};
use crate::{Error, Result};

/// Drives every seed of `options` twice, free and assisted, with trials in parallel; results do not depend on the number of
/// threads. `new_driver` makes a fresh driver for each trial.
///
/// # Errors
/// Impossible options, a driver that cannot be made, and the observer's own.
pub fn drive<F>(
    track: &Track,
    new_driver: F,
    options: &DriveOptions,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<DriveResult>
where
    F: Fn() -> Result<Box<dyn Driver>> + Sync,
{
    require_all(drive_as_far(track, new_driver, options, observer)?)
}

/// As [`drive`]; but if the observer ends it with [`Error::Interrupted`], the result of the seeds that were driven until then, if there
/// are any. Also whether it was ended so.
///
/// # Errors
/// As [`drive`].
fn drive_as_far<F>(
    track: &Track,
    new_driver: F,
    options: &DriveOptions,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<(DriveResult, bool)>
where
    F: Fn() -> Result<Box<dyn Driver>> + Sync,
{
    options.check()?;
    if new_driver()?.needs_frame() {
        // Built within a seed, by many threads, it could wait for a thread that has begun another seed meanwhile and waits for it.
        track.world();
    }
    let (tally, stopped) = (Tally::new(options.runs, observer), AtomicBool::new(false));
    // Whatever ends one seed ends the drive.
    let stop = |_: &Error| stopped.store(true, Ordering::Relaxed);
    let seed = |k: usize| {
        if stopped.load(Ordering::Relaxed) {
            return Err(Error::Interrupted);
        }
        let measured = measure(track, &new_driver, options, k as u64, None).inspect_err(stop)?;
        match tally.add(1).inspect_err(stop) {
            Ok(()) | Err(Error::Interrupted) => Ok(measured),
            Err(error) => Err(error),
        }
    };
    let measured: Vec<Result<Measured>> = (0..options.runs).into_par_iter().map(seed).collect();
    let result = put_together(track, options, measured, rayon::current_num_threads())?;
    Ok((result, stopped.into_inner()))
}

/// The result, if all seeds were driven.
fn require_all((result, stopped): (DriveResult, bool)) -> Result<DriveResult> {
    if stopped { Err(Error::Interrupted) } else { Ok(result) }
}

/// As [`drive`], to the same bits, but one trial after the other; `observer` is told every frame.
///
/// # Errors
/// As [`drive`], and the observer's own.
pub fn drive_observed<F>(
    track: &Track,
    new_driver: F,
    options: &DriveOptions,
    observer: &mut dyn for<'a> Observer<DriveEvent<'a>>,
) -> Result<DriveResult>
where
    F: Fn() -> Result<Box<dyn Driver>>,
{
    require_all(drive_observed_as_far(track, new_driver, options, observer)?)
}

/// As [`drive_observed`]; but if the observer ends it with [`Error::Interrupted`], the result of the seeds that were driven until then, if
/// there are any. Also whether it was ended so.
///
/// # Errors
/// As [`drive_observed`].
pub fn drive_observed_as_far<F>(
    track: &Track,
    new_driver: F,
    options: &DriveOptions,
    observer: &mut dyn for<'a> Observer<DriveEvent<'a>>,
) -> Result<(DriveResult, bool)>
where
    F: Fn() -> Result<Box<dyn Driver>>,
{
    options.check()?;
    let mut measured = Vec::new();
    for k in 0..options.runs as u64 {
        measured.push(measure(track, &new_driver, options, k, Some(&mut *observer)));
        if measured.last().is_some_and(Result::is_err) {
            break;
        }
    }
    let stopped = measured.last().is_some_and(Result::is_err);
    Ok((put_together(track, options, measured, 1)?, stopped))
}

/// The measurements of one seed.
#[derive(Serialize, Deserialize)]
pub(crate) struct Measured {
    pair: TrialPair,
    expert: Trial,
    simulated_s: f64,
    busy_s: f64,
}

/// Drives the `k`-th seed free, assisted, and with the expert.
pub(crate) fn measure<F>(
    track: &Track,
    new_driver: &F,
    options: &DriveOptions,
    k: u64,
    mut observer: Option<&mut dyn for<'a> Observer<DriveEvent<'a>>>,
) -> Result<Measured>
where
    F: Fn() -> Result<Box<dyn Driver>>,
{
    let seed = options.seed.wrapping_add(k);
    let mut go = |assisted| {
        let mut driver = new_driver()?;
        match &mut observer {
            Some(observer) => {
                run_trial_observed(track, driver.as_mut(), &options.trial_options(assisted), seed, &mut **observer)
            }
            None => run_trial(track, driver.as_mut(), &options.trial_options(assisted), seed),
        }
    };
    let began = Instant::now();
    let free = go(false)?;
    let mut simulated_s = free.time_s;
    // A trial without an intervention is the same with help as without.
    let assisted = if free.failure.is_none() && free.worst_cte_m <= INTERVENTION_M {
        free.clone()
    } else {
        let assisted = go(true)?;
        simulated_s += assisted.time_s;
        assisted
    };
    let busy_s = began.elapsed().as_secs_f64();
    let expert = run_trial(track, &mut Expert, &options.trial_options(false), seed)?;
    Ok(Measured { pair: TrialPair { seed, free, assisted }, expert, simulated_s, busy_s })
}

/// The result of all seeds that were driven, by `threads` threads; some were not if the drive was interrupted.
///
/// # Errors
///
/// [`Error::Interrupted`] if none was driven; any other error of a seed.
pub(crate) fn put_together(
    track: &Track,
    options: &DriveOptions,
    results: Vec<Result<Measured>>,
    threads: usize,
) -> Result<DriveResult> {
    let mut measured = Vec::with_capacity(results.len());
    for result in results {
        match result {
            Ok(seed) => measured.push(seed),
            Err(Error::Interrupted) => {}
            Err(error) => return Err(error),
        }
    }
    if measured.is_empty() {
        return Err(Error::Interrupted);
    }
    let sum = |of: fn(&Measured) -> f64| measured.iter().map(of).sum::<f64>();
    let (simulated_s, busy_s) = (sum(|m| m.simulated_s), sum(|m| m.busy_s));
    let (expert_sum, expert_s) = (sum(|m| m.expert.whiteness_sum), sum(|m| m.expert.time_s));
    let expert_calm = Some(Calm::of(measured.iter().map(|m| m.expert.calm_frames())));
    let realtime_factor = simulated_s / busy_s.max(1e-9) * threads.min(options.runs) as f64;
    let runs: Vec<TrialPair> = measured.into_iter().map(|m| m.pair).collect();
    let summary = DriveSummary {
        expert_whiteness_deg_s: (expert_sum / expert_s.max(1e-9)).sqrt(),
        expert_calm,
        realtime_factor,
        ..summarise(track, options, &runs)
    };
    Ok(DriveResult { trials: runs, summary })
}

fn summarise(track: &Track, options: &DriveOptions, runs: &[TrialPair]) -> DriveSummary {
    let sum = |f: &dyn Fn(&TrialPair) -> f64| runs.iter().map(f).sum::<f64>();
    let free = || runs.iter().flat_map(|r| &r.free.moments);
    let [cte_mean_m, cte_rms_m, cte_p95_m] = line_errors_m(free());
    let time_s = sum(&|r| r.free.time_s).max(1e-9);
    let interventions: usize = runs.iter().map(|r| r.assisted.interventions).sum();
    let whole = runs.iter().filter(|r| r.free.laps_completed == options.laps).count();
    let (completed_low, completed_high) = wilson_interval(whole, runs.len());
    DriveSummary {
        track: track.name().to_string(),
        held_out: track.held_out(),
        trained_on_held_out: Vec::new(),
        runs: runs.len(),
        laps_completed: runs.iter().map(|r| r.free.laps_completed).sum(),
        laps_total: runs.len() * options.laps,
        completed_low,
        completed_high,
        autonomy_percent: autonomy_percent(interventions, sum(&|r| r.assisted.time_s)),
        interventions,
        interventions_per_km: interventions as f64 / (sum(&|r| r.assisted.distance_m) / 1000.0).max(1e-9),
        distance_m: sum(&|r| r.free.distance_m),
        cte_mean_m,
        cte_rms_m,
        cte_p95_m,
        off_road_s: sum(&|r| r.free.off_road_s),
        crashes: runs.iter().filter(|r| r.free.failure == Some(Failure::Crash)).count(),
        mean_speed_mph: free().map(|m| m.speed_mph).sum::<f64>() / free().count().max(1) as f64,
        whiteness_deg_s: (sum(&|r| r.free.whiteness_sum) / time_s).sqrt(),
        expert_whiteness_deg_s: 0.0,
        calm: Some(Calm::of(runs.iter().map(|r| r.free.calm_frames()))),
        expert_calm: None,
        realtime_factor: 0.0,
    }
}

/// Compares two drives with the same seeds: autonomy, completed laps, distance from the line, and how calm they are.
///
/// # Errors
/// If the drives are of different tracks or seeds.
pub fn compare(a: &DriveResult, b: &DriveResult) -> Result<Vec<PairedTest>> {
    let seeds = |d: &DriveResult| d.trials.iter().map(|r| r.seed).collect::<Vec<_>>();
    if a.summary.track != b.summary.track || seeds(a) != seeds(b) {
        return Err(Error::Input("only drives of one track with the same seeds can be compared".to_string()));
    }
    let test = |measure: &str, f: &dyn Fn(&TrialPair) -> f64| {
        let values = |d: &DriveResult| d.trials.iter().map(f).collect::<Vec<_>>();
        PairedTest::new(measure, &values(a), &values(b))
    };
    let mean_cte = |r: &TrialPair| {
        let moments = &r.assisted.moments;
        moments.iter().map(|m| m.cte_m.abs()).sum::<f64>() / moments.len().max(1) as f64
    };
    Ok(vec![
        test("autonomy, %", &|r| r.assisted.autonomy_percent()),
        test("laps completed", &|r| r.free.laps_completed as f64),
        test("distance from the line in assisted runs, m", &mean_cte),
        test("whiteness, deg/s", &|r| r.free.whiteness_deg_s()),
        test("wheel reversals a minute", &|r| Calm::of([r.free.calm_frames()]).reversals_per_min),
        test("lateral jerk, m/s³", &|r| Calm::of([r.free.calm_frames()]).lateral_jerk_rms_mps3),
    ])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::observer::Unobserved;
    use crate::simulator::car::speed::Speed;
    use crate::simulator::trial::driver::Zero;

    fn go(track: &str, expert: bool, runs: usize) -> DriveResult {
        let track = Track::load(track).unwrap();
        let make = || -> Result<Box<dyn Driver>> { Ok(if expert { Box::new(Expert) } else { Box::new(Zero) }) };
        drive(&track, make, &DriveOptions { runs, ..Default::default() }, &mut Unobserved).unwrap()
    }

    #[test]
    fn the_expert_is_autonomous_zero_is_not_and_the_difference_is_no_chance() {
        let (expert, zero) = (go("coast", true, 8), go("coast", false, 8));
        let s = &expert.summary;
        assert_eq!((s.laps_completed, s.laps_total, s.crashes, s.interventions), (8, 8, 0, 0));
        assert!(s.autonomy_percent == 100.0 && s.held_out && s.completed_high == 1.0 && s.completed_low > 0.6);
        assert!(s.cte_mean_m <= s.cte_rms_m && s.cte_rms_m <= s.cte_p95_m && s.cte_p95_m < 0.3);
        assert!((s.mean_speed_mph - 20.0).abs() < 1.0, "{}", s.mean_speed_mph);
        assert!((s.whiteness_deg_s - s.expert_whiteness_deg_s).abs() < 1e-9);
        assert_eq!(s.calm, s.expert_calm);
        let calm = s.calm.unwrap();
        assert!(calm.reversals_per_min > 0.0 && calm.reversals_per_min < 20.0, "{calm:?}");
        assert!(calm.angle_change_p95_deg > 0.0 && calm.angle_change_p95_deg < 0.5, "{calm:?}");
        assert!(calm.lateral_jerk_rms_mps3 > 0.1 && calm.lateral_jerk_rms_mps3 < 5.0, "{calm:?}");
        assert_eq!(zero.summary.laps_completed, 0);
        // NVIDIA (2016) charges 6 s for each intervention.
        let assisted_s: f64 = zero.trials.iter().map(|pair| pair.assisted.time_s).sum();
        let charged_s = 6.0 * zero.summary.interventions as f64;
        let expected = (100.0 * (1.0 - charged_s / assisted_s)).max(0.0);
        assert!(zero.summary.interventions > 8 && (zero.summary.autonomy_percent - expected).abs() < 1e-9);
        assert!(zero.summary.autonomy_percent < 90.0 && zero.summary.interventions_per_km > 3.0);
        let tests = compare(&zero, &expert).unwrap();
        assert!(tests[0].significant() && tests[0].mean_b > tests[0].mean_a && tests[1].significant());
        assert!(compare(&expert, &expert).unwrap().iter().all(|t| !t.significant()));
        assert!(compare(&expert, &go("lake", true, 8)).is_err());
    }

    #[test]
    fn threads_do_not_change_results() {
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| go("mountain", true, 4).trials)
        };
        assert_eq!(with(1), with(3));
    }

    #[test]
    fn a_drive_that_is_watched_has_the_same_runs() {
        struct Watching(Vec<(u64, bool)>, usize, Vec<f64>);
        impl<'a> Observer<DriveEvent<'a>> for Watching {
            fn observe(&mut self, event: DriveEvent) -> Result<()> {
                match event {
                    DriveEvent::Begin { seed, options } => self.0.push((seed, options.assisted)),
                    DriveEvent::Frame(_) => self.1 += 1,
                    DriveEvent::End(trial) => self.2.push(trial.time_s),
                }
                Ok(())
            }
        }
        let track = Track::load("lake").unwrap();
        let make = || -> Result<Box<dyn Driver>> { Ok(Box::new(Zero)) };
        let options = DriveOptions { runs: 2, seed: 3, ..Default::default() };
        let mut watching = Watching(Vec::new(), 0, Vec::new());
        let watched = drive_observed(&track, make, &options, &mut watching).unwrap();
        let unseen = drive(&track, make, &options, &mut Unobserved).unwrap();
        assert_eq!(watched.trials, unseen.trials);
        let summary = DriveSummary { realtime_factor: unseen.summary.realtime_factor, ..watched.summary };
        assert_eq!(summary, unseen.summary);
        assert_eq!(watching.0, [(3, false), (3, true), (4, false), (4, true)]);
        let times = unseen.trials.iter().flat_map(|pair| [pair.free.time_s, pair.assisted.time_s]);
        assert_eq!(watching.2, times.collect::<Vec<_>>());
        assert_eq!(
            watching.1,
            unseen.trials.iter().map(|r| r.free.moments.len() + r.assisted.moments.len()).sum::<usize>()
        );
    }

    #[test]
    fn a_drive_that_is_stopped_keeps_the_seeds_that_were_driven() {
        struct Stopping(usize);
        impl Observer<Progress> for Stopping {
            fn observe(&mut self, _: Progress) -> Result<()> {
                self.0 -= 1;
                if self.0 == 0 { Err(Error::Interrupted) } else { Ok(()) }
            }
        }
        impl<'a> Observer<DriveEvent<'a>> for Stopping {
            fn observe(&mut self, event: DriveEvent) -> Result<()> {
                match event {
                    DriveEvent::Begin { seed: 5, .. } => Err(Error::Interrupted),
                    _ => Ok(()),
                }
            }
        }
        let track = Track::load("lake").unwrap();
        let make = || -> Result<Box<dyn Driver>> { Ok(Box::new(Zero)) };
        let options = DriveOptions { runs: 4, seed: 3, ..Default::default() };
        let all = drive(&track, make, &options, &mut Unobserved).unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let (far, stopped) = pool.install(|| drive_as_far(&track, make, &options, &mut Stopping(2))).unwrap();
        assert!(stopped && far.trials == all.trials[..2] && far.summary.runs == 2 && far.summary.laps_total == 2);
        let (far, stopped) = drive_observed_as_far(&track, make, &options, &mut Stopping(1)).unwrap();
        assert!(stopped && far.trials == all.trials[..2]);
        assert!(matches!(drive(&track, make, &options, &mut Stopping(4)), Err(Error::Interrupted)));
        let from_5 = DriveOptions { seed: 5, ..options };
        let nothing = drive_observed_as_far(&track, make, &from_5, &mut Stopping(1));
        assert!(matches!(nothing, Err(Error::Interrupted)));
    }

    #[test]
    fn impossible_options_and_a_stop_are_errors() {
        let track = Track::load("lake").unwrap();
        let make = || -> Result<Box<dyn Driver>> { Ok(Box::new(Zero)) };
        for bad in [
            DriveOptions { runs: 0, ..Default::default() },
            DriveOptions { speed: Speed::Fixed(80.0), ..Default::default() },
            DriveOptions { latency_ms: -1.0, ..Default::default() },
            DriveOptions { noise: f64::NAN, ..Default::default() },
        ] {
            assert!(matches!(drive(&track, make, &bad, &mut Unobserved), Err(Error::Usage(_))));
        }
        assert!(matches!(
            drive(&track, make, &DriveOptions::default(), &mut |_| Err(Error::Interrupted)),
            Err(Error::Interrupted)
        ));
    }
}
