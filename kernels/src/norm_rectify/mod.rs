//! Batch normalisation, a rectifier and, where it follows, max pooling of 2x2 windows, in one pass.
//!
//! Forward is `z = x scale[c] + shift[c]`, `y = pool(f(z))`. Only `x` and `y` are kept. The gradient is computed from `x` again: finding
//! the maximum of a window a second time costs less than writing and reading its argmax.
//!
//! The gradient takes two passes over `x`, with the sums over the whole batch between them:
//! - [`backward_sums`]: `dz = f'(z) dy` at the argmax of each window, else 0; the sums of `dz`, of `dz xhat` and of the slopes' gradient;
//! - [`backward`]: `dx = gain (dz - mean(dz) - xhat mean(dz xhat))` with `xhat = (x - mean) inv_std`. It overwrites `x`.
//!
//! # NaN
//! ReLU turns a NaN into 0, and the gradient there is 0. A slope passes a NaN on. A pooled window skips a NaN, except that with
//! slopes a NaN in the upper left place makes the whole window NaN.

mod backward;
mod backward_sums;
mod forward;
mod gradient;
mod operands;
mod windows;

pub use backward::backward;
pub use backward_sums::backward_sums;
pub use forward::forward;
pub use operands::{ChannelMeans, ChannelStatistics, RectifyShape, Slopes};
