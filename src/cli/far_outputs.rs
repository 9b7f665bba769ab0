//! A notice where a model steers far beyond full lock.

/// Full lock is 1. Models of a steering beyond 1 exist, as labels of cars do, but hardly one beyond this.
const FAR: f32 = 2.0;

/// Warns on standard error if more than a twentieth of `steering` lies beyond [`FAR`] or is no number.
pub fn notice_far_outputs(steering: impl Iterator<Item = f32>) {
    let (mut count, mut far, mut farthest) = (0usize, 0usize, 0.0f32);
    for value in steering {
        count += 1;
        far += usize::from(!(value.abs() <= FAR));
        farthest = farthest.max(value.abs());
    }
    if far * 20 > count {
        eprintln!(
            "warning: {far} of {count} answers lie beyond {FAR}, up to {farthest:.1}, where 1 is full lock: an imported model may \
             see pictures as it was not trained to (import --preprocessing, --fit), or give another unit (import --output-scale)"
        );
    }
}
