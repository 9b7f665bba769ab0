//! Shapes and initial values of tensors.
//!
//! Tensors are plain `f32` slices in planned buffers, row-major. A batch of feature maps is `[n][c][h][w]` (NCHW); after
//! [`flatten`](crate::engine::layers::Flatten) an image is a vector, kept as a map of `c` channels of one position.

use std::fmt;

use rand::Rng;
use serde::{Deserialize, Serialize};

use crate::engine::random::{uniform, unit};

/// Size of one image's feature map: channels, height, width.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct Shape {
    /// Channels (colour planes, filters, or units of a dense layer).
    pub c: usize,
    /// Height in rows.
    pub h: usize,
    /// Width in columns.
    pub w: usize,
}

impl Shape {
    /// A map of `c` channels, `h` rows and `w` columns.
    pub const fn new(c: usize, h: usize, w: usize) -> Shape {
        Shape { c, h, w }
    }

    /// A vector of `units` numbers.
    pub const fn vector(units: usize) -> Shape {
        Shape { c: units, h: 1, w: 1 }
    }

    /// Shape of an array of `n` images: `(n, c, h, w)`.
    pub const fn batch(self, n: usize) -> (usize, usize, usize, usize) {
        (n, self.c, self.h, self.w)
    }

    /// Length of one image: c · h · w.
    pub const fn len(self) -> usize {
        self.c * self.h * self.w
    }

    /// Whether an image is empty.
    pub const fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Positions of a channel: h · w.
    pub const fn positions(self) -> usize {
        self.h * self.w
    }
}

/// Prints a map as `h x w x c`, the way the write-ups and Keras give it, and a vector as its length.
impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.positions() == 1 { write!(f, "{}", self.c) } else { write!(f, "{}x{}x{}", self.h, self.w, self.c) }
    }
}

/// Initial values of a tensor.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Initializer {
    /// Uniform in ±√(6 / (fan_in + fan_out)) (Glorot and Bengio 2010).
    #[default]
    GlorotUniform,
    /// Normal with mean 0 and variance 2 / fan_in, not truncated (He et al. 2015).
    HeNormal,
    /// Every element the same.
    Constant(f32),
}

/// Number of inputs that feed one output (fan-in), and of outputs that one input feeds (fan-out).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fans {
    /// Inputs of one output: input channels times kernel positions.
    pub fan_in: usize,
    /// Outputs of one input: output channels times kernel positions.
    pub fan_out: usize,
}

impl Initializer {
    /// Fills `values` with numbers drawn from `rng`.
    pub fn fill(self, fans: Fans, rng: &mut impl Rng, values: &mut [f32]) {
        match self {
            Initializer::GlorotUniform => {
                let limit = (6.0 / (fans.fan_in + fans.fan_out) as f64).sqrt();
                values.fill_with(|| uniform(rng, -limit, limit) as f32);
            }
            Initializer::HeNormal => {
                let deviation = (2.0 / fans.fan_in as f64).sqrt();
                values.fill_with(|| (standard_normal(rng) * deviation) as f32);
            }
            Initializer::Constant(value) => values.fill(value),
        }
    }
}

/// A draw from the normal distribution with mean 0 and variance 1 (Box and Muller 1958).
pub(crate) fn standard_normal(rng: &mut impl Rng) -> f64 {
    let u = 1.0 - unit(rng); // in (0, 1]: the logarithm stays finite
    let angle = std::f64::consts::TAU * unit(rng);
    (-2.0 * u.ln()).sqrt() * angle.cos()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::random::{Purpose, rng};

    fn draw(init: Initializer, fans: Fans) -> Vec<f32> {
        let mut values = vec![f32::NAN; 100_000];
        init.fill(fans, &mut rng(1, Purpose::Initialise, 0, 0), &mut values);
        values
    }

    fn mean(values: &[f32], f: impl Fn(f64) -> f64) -> f64 {
        values.iter().map(|&v| f(v as f64)).sum::<f64>() / values.len() as f64
    }

    #[test]
    fn glorot_uniform_fills_its_interval_evenly() {
        let values = draw(Initializer::GlorotUniform, Fans { fan_in: 27, fan_out: 72 });
        let limit = (6.0f64 / 99.0).sqrt();
        assert!(values.iter().all(|v| (v.abs() as f64) < limit));
        assert!(mean(&values, |v| v).abs() < 0.01 * limit);
        assert!((mean(&values, |v| v * v) / (limit * limit / 3.0) - 1.0).abs() < 0.02);
    }

    #[test]
    fn he_normal_has_variance_two_over_fan_in_and_long_tails() {
        let values = draw(Initializer::HeNormal, Fans { fan_in: 50, fan_out: 3 });
        let deviation = 0.2;
        assert!(mean(&values, |v| v).abs() < 0.01 * deviation);
        assert!((mean(&values, |v| v * v) / (deviation * deviation) - 1.0).abs() < 0.02);
        let beyond_two = mean(&values, |v| f64::from(v.abs() > 2.0 * deviation));
        assert!((beyond_two - 0.0455).abs() < 0.004, "a truncated normal has none: {beyond_two}");
    }

    #[test]
    fn shapes_print_as_the_write_ups_do() {
        assert_eq!(Shape::new(8, 38, 158).to_string(), "38x158x8");
        assert_eq!(Shape::vector(100).to_string(), "100");
    }
}
