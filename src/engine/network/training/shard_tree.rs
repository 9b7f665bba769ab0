//! How a batch is cut into shards, and the binary tree in which the sums over shards are taken.
//!
//! Both depend on the number of images alone, not on the number of threads or processes: that gives the sums the same bits
//! everywhere. A node over `n` shards has the largest power of two below `n` of them on its left. So a run of shards consists of a few
//! whole subtrees, and a process that owns a run needs to tell the others the sums of these alone.

use std::ops::Range;

/// Upper limit of the shards of a batch: enough to keep 64 threads busy.
pub(super) const MAX_SHARDS: usize = 64;

/// A larger batch has more shards and not larger ones, as long as there are fewer than [`MAX_SHARDS`]. A batch of at most 16 times as many
/// images has up to 16 shards. The weight gradient of a convolution wants some images in a call.
const SHARD_IMAGES: usize = 8;
const FEW_SHARDS: usize = 16;

/// The shards of a batch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Sharding {
    /// Images of the batch.
    images: usize,
    /// Images of each shard but the last.
    shard_images: usize,
}

impl Sharding {
    /// The shards of a batch of `images`; with `pairs` an even number of images in each but the last, so that no pair is cut.
    pub fn new(images: usize, pairs: bool) -> Sharding {
        let shard_images = SHARD_IMAGES.min(images.div_ceil(FEW_SHARDS)).max(images.div_ceil(MAX_SHARDS)).max(1);
        Sharding { images, shard_images: if pairs { shard_images.next_multiple_of(2) } else { shard_images } }
    }

    /// Number of shards.
    pub fn count(self) -> usize {
        self.images.div_ceil(self.shard_images)
    }

    /// Maximum of images in a shard.
    pub fn shard_images(self) -> usize {
        self.shard_images
    }

    /// The images of shard `index`.
    pub fn images_of(self, index: usize) -> Range<usize> {
        self.images_of_run(index..index + 1)
    }

    /// The images of a run of shards.
    pub fn images_of_run(self, shards: Range<usize>) -> Range<usize> {
        let border = |shard: usize| (shard * self.shard_images).min(self.images);
        border(shards.start)..border(shards.end)
    }

    /// The shards that process `rank` of `ranks` owns.
    pub fn run_of(self, rank: usize, ranks: usize) -> Range<usize> {
        self.count() * rank / ranks..self.count() * (rank + 1) / ranks
    }
}

/// The images of a batch of `images` that process `rank` of `ranks` works on in a training step; with `pairs`, if there are pairs among
/// them.
pub fn share(images: usize, pairs: bool, rank: usize, ranks: usize) -> Range<usize> {
    if images == 0 {
        return 0..0;
    }
    let sharding = Sharding::new(images, pairs);
    sharding.images_of_run(sharding.run_of(rank, ranks))
}

/// Number of shards on the left of a node over `len` shards, at least 2.
fn left_len(len: usize) -> usize {
    len.next_power_of_two() / 2
}

/// Calls `found` with the largest whole subtrees of the tree over `tree` that lie in `run`, from left to right.
pub(super) fn subtrees(tree: Range<usize>, run: &Range<usize>, found: &mut impl FnMut(Range<usize>)) {
    if tree.is_empty() || run.end <= tree.start || tree.end <= run.start {
        return;
    }
    if run.start <= tree.start && tree.end <= run.end {
        return found(tree);
    }
    let middle = tree.start + left_len(tree.len());
    subtrees(tree.start..middle, run, found);
    subtrees(middle..tree.end, run, found);
}

/// Works on each of the `items` of a subtree, in parallel, and adds them up along the tree: the sum of a node ends in its first item.
/// `add` adds the second item's sum to the first's, and may take from the second what is no longer needed.
pub(super) fn sum_subtree<T: Send>(
    items: &mut [T],
    work: &(impl Fn(&mut T) + Sync),
    add: &(impl Fn(&mut T, &mut T) + Sync),
) {
    match items {
        [] => {}
        [item] => work(item),
        _ => {
            let (left, right) = items.split_at_mut(left_len(items.len()));
            rayon::join(|| sum_subtree(left, work, add), || sum_subtree(right, work, add));
            add(&mut left[0], &mut right[0]);
        }
    }
}

/// The same for each of the subtrees `roots`, which lie side by side in `items`.
pub(super) fn sum_subtrees<T: Send>(
    items: &mut [T],
    roots: &[Range<usize>],
    work: &(impl Fn(&mut T) + Sync),
    add: &(impl Fn(&mut T, &mut T) + Sync),
) {
    match roots {
        [] => {}
        [root] => sum_subtree(&mut items[..root.len()], work, add),
        [root, rest @ ..] => {
            let (these, others) = items.split_at_mut(root.len());
            rayon::join(|| sum_subtree(these, work, add), || sum_subtrees(others, rest, work, add));
        }
    }
}

/// Adds the sums of the subtrees `roots`, which make up the whole `tree`, along the rest of it. `sums` holds `len` numbers of each root, one
/// after the other; the sum of all ends in the first.
pub(super) fn fold<T>(
    tree: Range<usize>,
    roots: &[Range<usize>],
    sums: &mut [T],
    len: usize,
    add: &impl Fn(&mut [T], &[T]),
) {
    if roots.len() < 2 {
        return;
    }
    let middle = tree.start + left_len(tree.len());
    let left = roots.partition_point(|root| root.start < middle);
    let (left_sums, right_sums) = sums.split_at_mut(left * len);
    fold(tree.start..middle, &roots[..left], left_sums, len, add);
    fold(middle..tree.end, &roots[left..], right_sums, len, add);
    add(&mut left_sums[..len], &right_sums[..len]);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shards_hold_every_image_once_and_do_not_cut_pairs() {
        for images in 1..2100 {
            for pairs in [false, true] {
                let sharding = Sharding::new(images, pairs);
                assert!(sharding.count() <= MAX_SHARDS, "{images}");
                let mut next = 0;
                for shard in 0..sharding.count() {
                    let of = sharding.images_of(shard);
                    assert!(
                        of.start == next && !of.is_empty() && of.len() <= sharding.shard_images(),
                        "{images}: {of:?}"
                    );
                    assert!(!pairs || of.start.is_multiple_of(2));
                    next = of.end;
                }
                assert_eq!(next, images);
            }
        }
        let counts = [1, 16, 64, 128, 256, 384, 1024].map(|images| Sharding::new(images, false).count());
        assert_eq!(counts, [1, 16, 16, 16, 32, 48, 64]);
    }

    /// The sum as text with its brackets: what any grouping into subtrees must give again.
    fn brackets(shards: Range<usize>) -> String {
        let mut items: Vec<String> = shards.map(|shard| shard.to_string()).collect();
        sum_subtree(&mut items, &|_| {}, &|a, b| *a = format!("({a}+{b})"));
        items.swap_remove(0)
    }

    #[test]
    fn the_subtrees_of_any_number_of_processes_fold_to_the_same_tree() {
        assert_eq!(brackets(0..6), "(((0+1)+(2+3))+(4+5))");
        for shards in 1..=64 {
            let whole = brackets(0..shards);
            for ranks in 1..=9 {
                let mut roots = Vec::new();
                let mut sums = Vec::new();
                for rank in 0..ranks {
                    let run = shards * rank / ranks..shards * (rank + 1) / ranks;
                    let before = roots.len();
                    subtrees(0..shards, &run, &mut |root| roots.push(root));
                    let mine = &roots[before..];
                    assert_eq!(mine.iter().map(Range::len).sum::<usize>(), run.len(), "{shards} {ranks}");
                    let mut items: Vec<String> = run.map(|shard| shard.to_string()).collect();
                    sum_subtrees(&mut items, mine, &|_| {}, &|a, b| *a = format!("({a}+{b})"));
                    let first = mine.first().map_or(0, |root| root.start);
                    sums.extend(mine.iter().map(|root| items[root.start - first].clone()));
                }
                fold(0..shards, &roots, &mut sums, 1, &|a: &mut [String], b: &[String]| {
                    a[0] = format!("({}+{})", a[0], b[0])
                });
                assert_eq!(sums[0], whole, "{shards} shards on {ranks} processes");
                if ranks.is_power_of_two() && shards == 64 {
                    assert_eq!(roots.len(), ranks);
                }
            }
        }
    }
}
