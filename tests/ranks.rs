//! Several processes that train together, played by threads: the result has the bits of one process.

use std::sync::{Arc, Barrier, Mutex};

use ndarray::ArrayView1;
use planned::{NETWORKS, Setup};
use steersman::engine::loss::{PairTerms, Pairs, Smoothness};
use steersman::engine::network::{Parameters, Ranks, StepInput, TrainingPlan, share};

#[path = "common/planned.rs"]
mod planned;

/// Ranks that are threads of this process: what they send lies on a table, for all to read between two meetings.
#[derive(Debug)]
struct ThreadRanks {
    rank: usize,
    table: Arc<Table>,
}

#[derive(Debug)]
struct Table {
    meeting: Barrier,
    /// For each rank, what it sends to each rank.
    sent: Vec<Mutex<Vec<Vec<f64>>>>,
}

impl ThreadRanks {
    fn table(size: usize) -> Arc<Table> {
        Arc::new(Table { meeting: Barrier::new(size), sent: (0..size).map(|_| Mutex::default()).collect() })
    }

    /// What each rank sends to this one, one after the other.
    fn exchange(&self, send: Vec<Vec<f64>>, counts: &[usize]) -> Vec<f64> {
        *self.table.sent[self.rank].lock().unwrap() = send;
        self.table.meeting.wait();
        let from = self.table.sent.iter().map(|sent| sent.lock().unwrap()[self.rank].clone());
        let received: Vec<Vec<f64>> = from.collect();
        self.table.meeting.wait();
        assert_eq!(received.iter().map(Vec::len).collect::<Vec<_>>(), counts);
        received.concat()
    }
}

fn singles(doubles: Vec<f64>, to: &mut [f32]) {
    to.copy_from_slice(&doubles.iter().map(|x| *x as f32).collect::<Vec<_>>());
}

impl Ranks for ThreadRanks {
    fn rank(&self) -> usize {
        self.rank
    }

    fn size(&self) -> usize {
        self.table.sent.len()
    }

    fn gather_f64(&self, mine: &[f64], counts: &[usize], all: &mut [f64]) {
        all.copy_from_slice(&self.exchange(vec![mine.to_vec(); self.size()], counts));
    }

    fn gather_f32(&self, mine: &[f32], counts: &[usize], all: &mut [f32]) {
        let mine: Vec<f64> = mine.iter().copied().map(f64::from).collect();
        singles(self.exchange(vec![mine; self.size()], counts), all);
    }

    fn exchange_f32(&self, send: &[f32], send_counts: &[usize], receive: &mut [f32], receive_counts: &[usize]) {
        let mut rest = send;
        let parts = send_counts.iter().map(|count| {
            let (part, after) = rest.split_at(*count);
            rest = after;
            part.iter().copied().map(f64::from).collect()
        });
        singles(self.exchange(parts.collect(), receive_counts), receive);
        assert!(rest.is_empty());
    }
}

/// Losses and weights after two steps and a pass for statistics with `pairs`, on rank `rank` of those at `table`, or alone.
fn share_of_training(
    setup: &Setup,
    images: usize,
    pairs: &PairTerms,
    place: Option<(usize, &Arc<Table>)>,
) -> (Vec<f64>, Parameters) {
    let plan = TrainingPlan::new(&setup.network, images);
    let (mut plan, share) = match place {
        None => (plan, 0..images),
        Some((rank, table)) => {
            let share = share(images, pairs.images() > 0, rank, table.sent.len());
            (plan.with_ranks(Arc::new(ThreadRanks { rank, table: table.clone() })), share)
        }
    };
    let len = setup.network.input().len();
    let x = planned::images(&setup.network, &setup.x[share.start * len..share.end * len]);
    let labels = ArrayView1::from(&setup.labels[share]);
    let (mut optimizer, mut parameters) = (setup.optimizer(), setup.network.initialize(1));
    let (network, loss) = (&setup.network, &setup.recipe.loss);
    let mut losses = Vec::new();
    for step in 0..2 {
        let input = || StepInput { x, labels, seed: 1, step };
        losses.push(plan.step_of_share(network, &mut parameters, loss, pairs, input(), images));
        let norm = plan.gradient_norm();
        optimizer.step(1e-3, &mut parameters.values, plan.gradient_mut(), norm);
        plan.pass_statistics(network, &mut parameters, pairs, input(), images);
    }
    (losses, parameters)
}

#[test]
fn training_gives_the_same_bits_for_any_number_of_processes() {
    let smoothness = Smoothness { pairs_share: 0.5, spatial: 2.0, temporal: 3.0 };
    let paired = PairTerms::new(&smoothness, Pairs { spatial: 5, temporal: 6 });
    for (recipe, size) in NETWORKS {
        for (images, pairs) in [(2, PairTerms::default()), (37, paired), (40, paired), (70, PairTerms::default())] {
            let setup = Setup::new(recipe, size, images);
            let pool = || rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            let alone = pool().install(|| share_of_training(&setup, images, &pairs, None));
            for ranks in [1, 2, 3, 5] {
                let table = ThreadRanks::table(ranks);
                std::thread::scope(|scope| {
                    let of_rank = |rank| {
                        let (table, setup, pairs) = (&table, &setup, &pairs);
                        scope.spawn(move || {
                            pool().install(|| share_of_training(setup, images, pairs, Some((rank, table))))
                        })
                    };
                    let threads: Vec<_> = (0..ranks).map(of_rank).collect();
                    for (rank, thread) in threads.into_iter().enumerate() {
                        assert!(thread.join().unwrap() == alone, "{recipe}, {images} images, rank {rank} of {ranks}");
                    }
                });
            }
        }
    }
}
