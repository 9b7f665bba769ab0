//! Convolution with fewer multiplications: Winograd minimal filtering F(m, r) along the rows of the maps.
//!
//! F(m, r) computes m outputs of a filter of r taps with m + r - 1 multiplications instead of m r (S. Winograd, *Arithmetic
//! Complexity of Computations*, 1980; A. Lavin and S. Gray, *Fast Algorithms for Convolutional Neural Networks*, CVPR 2016,
//! arXiv:1509.09308). Here r = 3 and m, the rows of a tile, is 2 or 4.
//!
//! A tile of m rows of the output is computed from m + 2 *points* of the input rows it needs (see [`transform`]). At each point, the
//! output is a sum over taps of one row each: the same kernel as in the direct algorithm, `tap_sum`, with a third of the taps.
//! A strip of tiles is small enough to keep its points in the second-level cache.
//!
//! A stride splits the rows into phases whose filters have 2 or 3 taps. All phases share the points of the output. A filter of 2
//! taps does not need one of the points, which is left out.
//!
//! [`choice`] decides which shapes gain.

mod choice;
mod forward;
mod input_gradient;
mod input_points;
mod point_sum;
mod strips;
mod tiles;
mod transform;
mod weight_gradient;

pub(super) use forward::Forward;
pub(super) use input_gradient::InputGradient;
pub(super) use weight_gradient::WeightGradient;
