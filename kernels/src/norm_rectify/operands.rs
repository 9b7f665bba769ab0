//! The operands of both passes.

/// The sizes of `[n][c][h][w]` maps, and whether pooling follows.
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
    pub(super) fn x_len(&self) -> usize {
        self.c * self.h * self.w
    }

    /// Elements of a channel after pooling.
    pub(super) fn y_plane(&self) -> usize {
        if self.pooled { (self.h / 2) * (self.w / 2) } else { self.h * self.w }
    }

    pub(super) fn check(&self, kernel: &str, n: usize, x: usize, y: usize, statistics: &[&[f32]], slopes: Slopes) {
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

/// The slopes of a rectifier: the factor of values at or below 0.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Slopes<'a> {
    /// ReLU: the result is 0.
    Zero,
    /// PReLU with one slope for each channel.
    PerChannel(&'a [f32]),
    /// PReLU with one slope for each element of the image.
    PerPosition(&'a [f32]),
}

impl<'a> Slopes<'a> {
    /// Number of slopes.
    pub(super) fn len(self) -> usize {
        match self {
            Slopes::Zero => 0,
            Slopes::PerChannel(slopes) | Slopes::PerPosition(slopes) => slopes.len(),
        }
    }

    /// The slope of `channel`, if it has a single one, else 0.
    pub(super) fn single(self, channel: usize) -> f32 {
        if let Slopes::PerChannel(slopes) = self { slopes[channel] } else { 0.0 }
    }

    /// The slopes of a range of elements of the image, if each has its own.
    pub(super) fn each(self, range: std::ops::Range<usize>) -> &'a [f32] {
        if let Slopes::PerPosition(slopes) = self { &slopes[range] } else { &[] }
    }
}

/// The statistics of each channel that the gradient needs: `[c]` each.
#[derive(Clone, Copy, Debug)]
pub struct ChannelStatistics<'a> {
    /// Mean of `x` over the batch.
    pub mean: &'a [f32],
    /// One over the standard deviation of `x`.
    pub inv_std: &'a [f32],
    /// `z = x scale + shift`.
    pub scale: &'a [f32],
    /// See `scale`.
    pub shift: &'a [f32],
}

/// The means of the gradient of each channel over the batch: `[c]` each.
#[derive(Clone, Copy, Debug)]
pub struct ChannelMeans<'a> {
    /// Mean of `dz`.
    pub dz: &'a [f32],
    /// Mean of `dz` times the normalised `x`.
    pub dz_xhat: &'a [f32],
    /// `gamma inv_std`.
    pub gain: &'a [f32],
}
