//! The compute kernels of steersman.
