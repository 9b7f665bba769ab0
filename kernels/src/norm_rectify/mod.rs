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

    /// The slopes of the rows `rows` of `w` elements of `channel`.
    #[inline(always)]
    fn of(self, shape: &RectifyShape, channel: usize, rows: std::ops::Range<usize>) -> Slopes<'a> {
        match self {
            Slopes::Zero => Slopes::Zero,
            Slopes::PerChannel(slopes) => Slopes::PerChannel(&slopes[channel..=channel]),
            Slopes::PerPosition(slopes) => {
                let row = channel * shape.h;
                Slopes::PerPosition(&slopes[(row + rows.start) * shape.w..(row + rows.end) * shape.w])
            }
        }
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
