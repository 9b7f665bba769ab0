//! Batch normalisation, a rectifier and, where it follows, maximum pooling of 2x2 windows, in one pass.
//!
//! `y = pool(f(x scale[c] + shift[c]))`. Only `x` and `y` are kept. The gradient is found from `x` again: the largest
//! of a window is looked for a second time, which costs less than reading what was written for it.
//!
//! In the gradient, `z` is the normalised value that goes into the rectifier and `dz` its gradient. It is taken in two
//! passes over `x`, with the whole batch between them: [`backward_sums`] and [`backward`], which puts the gradient of `x`
//! in the place of `x`.

mod backward;
mod forward;

pub use backward::{backward, backward_sums};
pub use forward::forward;

use crate::simd::{ALIGNMENT, Purpose, Simd, get_pairs};

/// How the slopes of a row are found: none, one for all, or a list.
const ZERO: u8 = 0;
const ONE: u8 = 1;
const EACH: u8 = 2;

/// How far ahead of the work in `x`, in elements, cache lines are asked for. The rows of windows are two streams next to
/// each other, which processors do not foresee well.
const AHEAD: usize = 1024;

/// Has what the windows of two rows from `x` on need some time later fetched: twice `LANES` elements of each row are
/// read at a time.
#[inline(always)]
fn prefetch_windows<S: Simd>(simd: S, x: *const f32, at: usize) {
    for line in (0..4 * S::LANES).step_by(ALIGNMENT) {
        simd.prefetch(x.wrapping_add(AHEAD + 4 * at + line), Purpose::ReadSoon);
    }
}

/// The values of `count` windows, at most `LANES`, in row-major order; of the two rows, those from window `at` on. The
/// windows are in the order of [`Simd::load_pairs`].
#[inline(always)]
fn get_windows<S: Simd>(simd: S, rows: [&[f32]; 2], at: usize, count: usize) -> [S::V; 4] {
    let [a, b] = get_pairs(simd, rows[0], 2 * at, count);
    let [c, d] = get_pairs(simd, rows[1], 2 * at, count);
    [a, b, c, d]
}

/// What a rectifier makes of `z`. That of ReLU for NaN is 0.
#[inline(always)]
fn rectified<S: Simd, const SLOPES: u8>(simd: S, z: S::V, slope: S::V) -> S::V {
    let zero = simd.splat(0.0);
    if SLOPES == ZERO { simd.max(z, zero) } else { simd.select_greater(z, zero, z, simd.mul_add(z, slope, zero)) }
}

/// The rectified values of windows, and the largest of each. ReLU is left out of the former: it does not fall, so it can
/// be taken of the largest, and where that is above 0 the place is the same.
#[inline(always)]
fn largest<S: Simd, const SLOPES: u8>(simd: S, z: [S::V; 4], slopes: [S::V; 4]) -> ([S::V; 4], S::V) {
    let mut f = z;
    if SLOPES != ZERO {
        for i in 0..4 {
            f[i] = rectified::<S, SLOPES>(simd, z[i], slopes[i]);
        }
    }
    let mut most = if SLOPES == ZERO { simd.splat(0.0) } else { f[0] };
    for f in f {
        // In this order NaN does not count, unless with slopes it comes first.
        most = simd.max(f, most);
    }
    (f, most)
}

/// What follows the normalisation of `[n][c][h][w]` maps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RectifyShape {
    /// Channels.
    pub c: usize,
    /// Height before pooling.
    pub h: usize,
    /// Width before pooling.
    pub w: usize,
    /// Whether the maximum of 2x2 windows, 2 apart, is taken; a last odd row or column is left out.
    pub pooled: bool,
}

impl RectifyShape {
    /// Elements of an image before pooling.
    fn x_len(&self) -> usize {
        self.c * self.h * self.w
    }

    /// Elements of a channel after pooling.
    fn y_plane(&self) -> usize {
        if self.pooled { (self.h / 2) * (self.w / 2) } else { self.h * self.w }
    }

    fn check(&self, kernel: &str, n: usize, x: usize, y: usize, statistics: &[&[f32]], slopes: Slopes) {
        assert_eq!(x, n * self.x_len(), "{kernel}: input length for {n} of {self:?}");
        assert_eq!(y, n * self.c * self.y_plane(), "{kernel}: output length for {n} of {self:?}");
        assert!(statistics.iter().all(|s| s.len() == self.c), "{kernel}: a statistic is not c long");
        let fits = match slopes {
            Slopes::Zero => true,
            Slopes::PerChannel(slopes) => slopes.len() == self.c,
            Slopes::PerPosition(slopes) => slopes.len() == self.x_len(),
        };
        assert!(fits, "{kernel}: wrong number of slopes for {self:?}");
    }
}

/// What a rectifier multiplies values at or below 0 by.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Slopes<'a> {
    /// ReLU: the result is 0.
    Zero,
    /// PReLU with one slope a channel.
    PerChannel(&'a [f32]),
    /// PReLU with one slope an element of the image.
    PerPosition(&'a [f32]),
}

impl<'a> Slopes<'a> {
    /// How many slopes there are.
    fn len(self) -> usize {
        match self {
            Slopes::Zero => 0,
            Slopes::PerChannel(slopes) | Slopes::PerPosition(slopes) => slopes.len(),
        }
    }

    /// The slope of `channel`, where it has a single one.
    fn single(self, channel: usize) -> f32 {
        if let Slopes::PerChannel(slopes) = self { slopes[channel] } else { 0.0 }
    }

    /// The slopes of a range of elements of the image, where each has its own.
    fn each(self, range: std::ops::Range<usize>) -> &'a [f32] {
        if let Slopes::PerPosition(slopes) = self { &slopes[range] } else { &[] }
    }
}

/// What batch normalisation knows of each channel, for the gradient: `[c]` each.
#[derive(Clone, Copy, Debug)]
pub struct ChannelStatistics<'a> {
    /// Mean of `x` over the batch.
    pub mean: &'a [f32],
    /// One over the deviation of `x`.
    pub inv_std: &'a [f32],
    /// `z = x scale + shift`.
    pub scale: &'a [f32],
    /// See `scale`.
    pub shift: &'a [f32],
}

/// What the batch says of the gradient of each channel: `[c]` each.
#[derive(Clone, Copy, Debug)]
pub struct ChannelMeans<'a> {
    /// Mean of `dz`.
    pub dz: &'a [f32],
    /// Mean of `dz` times the normalised `x`.
    pub dz_xhat: &'a [f32],
    /// `gamma inv_std`.
    pub gain: &'a [f32],
}
