//! `steersman experiment replay`: does driving on a recording tell how well a model drives?

use std::path::Path;

use serde::Serialize;

use crate::cli::process::{pool, stop_on_ctrl_c};
use crate::cli::terminal::{JobDisplay, print_json};
use crate::error::{Error, Result};
use crate::main_job::replay_experiment::{
    self, RankCorrelations, ReplayExperimentEvent, ReplayPlan, ReplayRow, models, write_csv, write_page,
};
use crate::observer::Observer;

/// What `experiment replay --json` prints.
#[derive(Serialize)]
struct Report<'a> {
    rows: &'a [ReplayRow],
    /// Absent if there are too few.
    rank_correlations: Option<RankCorrelations>,
}

/// What the experiment needs of the command line.
pub(super) struct ReplayExperimentArgs {
    /// Tracks; `lake` if there are none.
    pub tracks: Vec<String>,
    /// Seeds with which each model is trained.
    pub seeds: u64,
    pub runs: usize,
    /// Three small models on short recordings.
    pub quick: bool,
    pub cache_mib: usize,
    pub threads: usize,
    pub json: bool,
}

/// Runs the experiment; its rows go to `out`, which exists, and a page to `page`.
pub(super) fn run(args: ReplayExperimentArgs, out: &Path, page: &Path) -> Result<()> {
    let stop = stop_on_ctrl_c()?;
    let (pool, mut display) = (pool(args.threads)?, JobDisplay::new(&stop));
    let tracks = if args.tracks.is_empty() { vec!["lake".into()] } else { args.tracks };
    let mut plan =
        ReplayPlan { models: models(args.seeds), tracks, laps: [1.0, 1.0], runs: args.runs, cache_mib: args.cache_mib };
    if args.quick {
        use replay_experiment::{Origin, Share};
        let of = 0;
        plan.models = vec![
            Origin::Trained { recipe: "lenet", epochs: 2, seed: 1, share: Share::Lap },
            Origin::Spoilt { of, noise: 0.05 },
            Origin::Spoilt { of, noise: 0.2 },
        ];
        plan.laps = [0.3, 0.15];
    }
    let mut done = Vec::new();
    let mut observer = |event| match event {
        ReplayExperimentEvent::Job(event) => display.observe(event),
        ReplayExperimentEvent::Row(row) => {
            done.push(row);
            write_csv(out, &done)
        }
    };
    let result = pool.install(|| replay_experiment::run(&plan, &mut observer, &stop)).map(drop);
    // After a stop or an error too, what is done is shown and kept.
    if done.is_empty() {
        std::fs::remove_file(out).map_err(Error::io(out))?;
        return result;
    }
    write_page(page, &done)?;
    let found = RankCorrelations::of(&done);
    if args.json {
        print_json(&Report { rows: &done, rank_correlations: found })?;
        return result;
    }
    print_table(&done, found);
    println!("every model: {}, {}", out.display(), page.display());
    result
}

fn print_table(rows: &[ReplayRow], found: Option<RankCorrelations>) {
    println!("                                                          autonomy             on the recordings' rows");
    println!("model                                        track    simulator recordings      error    path error");
    for row in rows {
        println!(
            "{:<44} {:<10} {:>5.1} %  {:>7.1} %  {:>9.2} {:>13.2}",
            row.model,
            row.track,
            row.autonomy_percent,
            row.replay_autonomy_percent,
            row.wheel_relative_to_zero,
            row.path_relative_to_zero
        );
    }
    println!("errors: squared, ÷ that of a wheel held straight");
    match found {
        Some(found) => println!(
            "rank correlation with the autonomy in the simulator: recordings {:.2} (interventions a km {:.2}), error {:.2}, path \
             error {:.2}",
            found.replay_autonomy, found.replay_interventions, found.validation_error, found.path_error
        ),
        None => println!("note: too few models, or all alike: there is no rank correlation"),
    }
}
