//! Vectors, angles, noise and random numbers that give the same bits on every machine.
//!
//! The functions of the standard library for sine and arc tangent may differ in their last bit from one platform to the
//! next. The simulator promises the same run for the same seed, so it uses only `+ - * /`, `sqrt` and the polynomials below.

use std::ops::{Add, Mul, Neg, Sub};

/// A point or direction in the world: x east, y north, z up, in metres.
#[derive(Clone, Copy, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Vec3 {
    /// East.
    pub x: f32,
    /// North.
    pub y: f32,
    /// Up.
    pub z: f32,
}

/// Shorthand for [`Vec3`].
pub const fn vec3(x: f32, y: f32, z: f32) -> Vec3 {
    Vec3 { x, y, z }
}

impl Vec3 {
    /// Scalar product.
    pub fn dot(self, o: Vec3) -> f32 {
        self.x * o.x + self.y * o.y + self.z * o.z
    }

    /// Vector product (right-handed).
    pub fn cross(self, o: Vec3) -> Vec3 {
        vec3(self.y * o.z - self.z * o.y, self.z * o.x - self.x * o.z, self.x * o.y - self.y * o.x)
    }

    /// The same direction with length 1.
    pub fn unit(self) -> Vec3 {
        self * (1.0 / self.dot(self).sqrt())
    }
}

impl Add for Vec3 {
    type Output = Vec3;
    fn add(self, o: Vec3) -> Vec3 {
        vec3(self.x + o.x, self.y + o.y, self.z + o.z)
    }
}

impl Sub for Vec3 {
    type Output = Vec3;
    fn sub(self, o: Vec3) -> Vec3 {
        vec3(self.x - o.x, self.y - o.y, self.z - o.z)
    }
}

impl Mul<f32> for Vec3 {
    type Output = Vec3;
    fn mul(self, k: f32) -> Vec3 {
        vec3(self.x * k, self.y * k, self.z * k)
    }
}

impl Neg for Vec3 {
    type Output = Vec3;
    fn neg(self) -> Vec3 {
        self * -1.0
    }
}

/// Sine and cosine of an angle in radians, to about 1e-12.
pub fn sin_cos(angle: f64) -> (f64, f64) {
    use std::f64::consts::FRAC_PI_2;
    let quarter = (angle / FRAC_PI_2).round();
    let x = angle - quarter * FRAC_PI_2;
    let y = x * x;
    let sin = x
        * (1.0
            - y / 6.0 * (1.0 - y / 20.0 * (1.0 - y / 42.0 * (1.0 - y / 72.0 * (1.0 - y / 110.0 * (1.0 - y / 156.0))))));
    let cos = 1.0
        - y / 2.0
            * (1.0
                - y / 12.0
                    * (1.0 - y / 30.0 * (1.0 - y / 56.0 * (1.0 - y / 90.0 * (1.0 - y / 132.0 * (1.0 - y / 182.0))))));
    match (quarter as i64).rem_euclid(4) {
        0 => (sin, cos),
        1 => (cos, -sin),
        2 => (-sin, -cos),
        _ => (-cos, sin),
    }
}

/// Tangent of an angle in radians.
pub fn tan(angle: f64) -> f64 {
    let (sin, cos) = sin_cos(angle);
    sin / cos
}

/// Arc tangent in radians, to about 1e-12: the argument is halved three times, then the power series is summed.
pub fn atan(x: f64) -> f64 {
    let mut y = x;
    for _ in 0..3 {
        y /= 1.0 + (1.0 + y * y).sqrt();
    }
    let square = y * y;
    let mut sum = 0.0;
    for k in (0..10).rev() {
        sum = 1.0 / (2 * k + 1) as f64 - square * sum;
    }
    8.0 * y * sum
}

/// Direction of the vector (x, y) in radians, anticlockwise from x, in (-pi, pi].
pub fn atan2(y: f64, x: f64) -> f64 {
    use std::f64::consts::{FRAC_PI_2, PI};
    if x.abs() >= y.abs() {
        let turn = if x >= 0.0 {
            0.0
        } else if y >= 0.0 {
            PI
        } else {
            -PI
        };
        if x == 0.0 { 0.0 } else { atan(y / x) + turn }
    } else {
        FRAC_PI_2.copysign(y) - atan(x / y)
    }
}

/// Smooth step from 0 (x <= from) to 1 (x >= to), with zero slope at both ends.
pub fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// `a` for t = 0, `b` for t = 1.
pub fn lerp(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// Mixes 32 bits thoroughly (the finaliser of MurmurHash3).
pub fn hash(mut h: u32) -> u32 {
    h ^= h >> 16;
    h = h.wrapping_mul(0x85eb_ca6b);
    h ^= h >> 13;
    h = h.wrapping_mul(0xc2b2_ae35);
    h ^ (h >> 16)
}

/// A number in [0, 1) that belongs to the lattice point (x, y).
pub fn hash2(x: i32, y: i32, seed: u32) -> f32 {
    let h = hash((x as u32).wrapping_mul(0x9e37_79b1) ^ hash((y as u32).wrapping_add(seed.wrapping_mul(0x85eb_ca77))));
    (h >> 8) as f32 / (1 << 24) as f32
}

/// Value noise in [0, 1): random lattice values, smoothly interpolated; one lattice cell has side 1.
///
/// With `period` the pattern repeats after that many cells in x and in y.
pub fn value_noise(x: f32, y: f32, period: Option<(i32, i32)>, seed: u32) -> f32 {
    let (x0, y0) = (x.floor(), y.floor());
    let (fx, fy) = (smoothstep(0.0, 1.0, x - x0), smoothstep(0.0, 1.0, y - y0));
    let at = |i: i32, j: i32| match period {
        Some((px, py)) => hash2(i.rem_euclid(px), j.rem_euclid(py), seed),
        None => hash2(i, j, seed),
    };
    let (i, j) = (x0 as i32, y0 as i32);
    lerp(lerp(at(i, j), at(i + 1, j), fx), lerp(at(i, j + 1), at(i + 1, j + 1), fx), fy)
}

/// A small random generator (SplitMix64), determined by its seed alone.
#[derive(Clone, Debug)]
pub struct Rng(u64);

impl Rng {
    /// The stream named `stream` of the experiment `seed`; different names give independent numbers.
    pub fn new(seed: u64, stream: &str) -> Rng {
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5bd1_e995_0bad_cafe;
        for byte in stream.bytes() {
            state = (state ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
        let mut rng = Rng(state);
        rng.next_u64();
        rng
    }

    /// The next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in [0, 1).
    pub fn unit(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Uniform in [low, high).
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Uniform in 0..n.
    pub fn below(&mut self, n: usize) -> usize {
        (self.unit() * n as f64) as usize
    }

    /// Normal with mean 0 and standard deviation 1 (sum of twelve uniforms, so never beyond 6).
    pub fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.unit()).sum::<f64>() - 6.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn polynomials_agree_with_the_standard_library() {
        for k in -400..=400 {
            let x = k as f64 * 0.037;
            let (sin, cos) = sin_cos(x);
            assert!((sin - x.sin()).abs() < 1e-11, "sin {x}");
            assert!((cos - x.cos()).abs() < 1e-11, "cos {x}");
            assert!((atan(x) - x.atan()).abs() < 1e-11, "atan {x}");
            for y in [-2.5, -0.3, 0.0, 0.4, 3.0] {
                assert!((atan2(y, x) - y.atan2(x)).abs() < 1e-11, "atan2 {y} {x}");
            }
        }
    }

    #[test]
    fn random_streams_are_repeatable_and_distinct() {
        let draw =
            |seed, name| (0..4).map(|_| 0).scan(Rng::new(seed, name), |r, _| Some(r.next_u64())).collect::<Vec<_>>();
        assert_eq!(draw(1, "start"), draw(1, "start"));
        assert_ne!(draw(1, "start"), draw(2, "start"));
        assert_ne!(draw(1, "start"), draw(1, "light"));
        let mut rng = Rng::new(3, "normal");
        let values: Vec<f64> = (0..4000).map(|_| rng.normal()).collect();
        let mean = values.iter().sum::<f64>() / 4000.0;
        let variance = values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 4000.0;
        assert!(mean.abs() < 0.06 && (variance - 1.0).abs() < 0.1, "{mean} {variance}");
    }

    #[test]
    fn noise_repeats_with_its_period() {
        for (x, y) in [(0.3, 1.7), (3.9, 2.2)] {
            let a = value_noise(x, y, Some((4, 3)), 9);
            let b = value_noise(x + 4.0, y - 3.0, Some((4, 3)), 9);
            assert!((a - b).abs() < 1e-5);
            assert!((0.0..1.0).contains(&a));
        }
    }
}
