//! Batch normalisation, rectifier and pooling in one pass.

use steersman_kernels::Isa;
use steersman_kernels::norm_rectify::{self, ChannelMeans, ChannelStatistics, RectifyShape, Slopes as Rectifier};

use crate::engine::layers::{BatchNorm, BatchStatistics, Layer, Moments, Pass, Slopes};
use crate::engine::tensor::Shape;

/// What [`BatchNorm`], [`Relu`](crate::engine::layers::Relu) or [`PRelu`](crate::engine::layers::PRelu), and [`MaxPool`](crate::engine::layers::MaxPool) of 2x2 windows do
/// one after the other, in one pass over the maps. The normalised and the rectified maps are never written.
///
/// Not a [`Layer`], for the gradient of the input takes the place of the input. Parameters are those of the layers, one
/// after the other.
#[derive(Clone, Debug)]
pub struct NormRectify {
    norm: BatchNorm,
    /// `None` for ReLU.
    slopes: Option<Slopes>,
    shape: RectifyShape,
    isa: Isa,
}

impl NormRectify {
    /// `norm`, then a ReLU or, with `slopes`, a PReLU, then the pooling if `pooled`.
    pub fn new(norm: BatchNorm, slopes: Option<Slopes>, pooled: bool, isa: Isa) -> NormRectify {
        let Shape { c, h, w } = norm.input();
        NormRectify { norm, slopes, shape: RectifyShape { c, h, w, pooled }, isa }
    }

    /// Sums and means over the whole batch: those of the batch normalisation.
    pub fn batch_statistics(&self) -> &dyn BatchStatistics {
        &self.norm
    }

    /// Length of gamma and beta, which come first among the parameters.
    fn norm_len(&self) -> usize {
        2 * self.shape.c
    }

    fn rectifier<'a>(&self, params: &'a [f32]) -> Rectifier<'a> {
        match self.slopes {
            None => Rectifier::Zero,
            Some(Slopes::PerChannel) => Rectifier::PerChannel(&params[self.norm_len()..]),
            Some(Slopes::PerPosition) => Rectifier::PerPosition(&params[self.norm_len()..]),
        }
    }

    /// Length of the scratch buffer of [`infer`](NormRectify::infer).
    pub fn scratch_len(&self) -> usize {
        2 * self.shape.c
    }

    /// Evaluation of `n` images with the running statistics: overwrites `y`.
    pub fn infer(&self, params: &[f32], statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let (scale, shift) = self.norm.scale_and_shift(&params[..self.norm_len()], statistics, scratch);
        norm_rectify::forward(self.isa, &self.shape, n, x, scale, shift, self.rectifier(params), y);
    }

    /// Training: overwrites `y`.
    pub fn forward(&self, params: &[f32], pass: &Pass, n: usize, x: &[f32], y: &mut [f32]) {
        let Moments { scale, shift, .. } = self.norm.split(pass.moments);
        norm_rectify::forward(self.isa, &self.shape, n, x, scale, shift, self.rectifier(params), y);
    }

    /// Overwrites `sums` with what [`BatchStatistics::finish_backward`] wants of the images in `x`, and adds to `dparams`.
    pub fn backward_sums(
        &self,
        params: &[f32],
        moments: &[f32],
        x: &[f32],
        dy: &[f32],
        sums: &mut [f64],
        dparams: &mut [f32],
    ) {
        let (dnorm, dslopes) = dparams.split_at_mut(self.norm_len());
        let statistics = channel_statistics(&self.norm.split(moments));
        let n = x.len() / self.norm.input().len();
        sums.fill(0.0);
        let slopes = self.rectifier(params);
        norm_rectify::backward_sums(self.isa, &self.shape, n, x, dy, statistics, slopes, sums, dslopes);
        self.norm.add_gradients(sums, dnorm);
    }

    /// Puts the gradient of the input in its place.
    pub fn backward(&self, params: &[f32], pass: &Pass, n: usize, x: &mut [f32], dy: &[f32]) {
        let moments = self.norm.split(pass.moments);
        let means = ChannelMeans { dz: moments.mean_dy, dz_xhat: moments.mean_dy_xhat, gain: moments.gain };
        let statistics = channel_statistics(&moments);
        norm_rectify::backward(self.isa, &self.shape, n, x, dy, statistics, means, self.rectifier(params));
    }
}

fn channel_statistics<'a>(moments: &Moments<'a>) -> ChannelStatistics<'a> {
    let Moments { mean, inv_std, scale, shift, .. } = *moments;
    ChannelStatistics { mean, inv_std, scale, shift }
}
