//! The transforms of Winograd minimal filtering F(M, 3) along the rows of a map, for M of 2 and 4.
//!
//! The M outputs `y[i] = sum over j < 3 of g[j] d[i + j]` are coefficients of the product of two polynomials, one of them reversed. A
//! product is known from its values at M + 2 points: 0, 1, -1 and infinity for M = 2, also 2 and -2 for M = 4. So
//! `y = A' ((G g) * (B' d))`, with M + 2 multiplications instead of 3 M. Only `G` has entries that are not integers.
//!
//! S. Winograd, *Arithmetic Complexity of Computations*, 1980; A. Lavin and S. Gray, *Fast Algorithms for Convolutional
//! Neural Networks*, arXiv:1509.09308. Along one direction only, the rounding errors of F(4, 3) are 2 to 2.5 times
//! those of the direct sum, and those of F(2, 3) are no larger than its own.
//!
//! All functions use the first M + 2, M or 3 elements of an array.

use crate::simd::Simd;

/// The largest number of points, and of rows of an input tile.
pub(super) const MAX_POINTS: usize = 6;
/// The largest number of rows of an output tile.
pub(super) const MAX_ROWS: usize = 4;
/// The point 1: its value is the sum of all rows, in the output and in the output gradient.
pub(super) const POINT_ONE: usize = 1;

/// `a + b`.
#[inline(always)]
fn add<S: Simd>(simd: S, a: S::V, b: S::V) -> S::V {
    simd.mul_add(a, simd.splat(1.0), b)
}

/// `a - b`.
#[inline(always)]
fn minus<S: Simd>(simd: S, a: S::V, b: S::V) -> S::V {
    simd.mul_add(b, simd.splat(-1.0), a)
}

/// `a * factor + b`.
#[inline(always)]
fn scaled<S: Simd>(simd: S, a: S::V, factor: f32, b: S::V) -> S::V {
    simd.mul_add(a, simd.splat(factor), b)
}

/// `B' d`: rows of the input to points.
#[inline(always)]
pub(super) fn input<S: Simd, const M: usize>(simd: S, d: [S::V; MAX_POINTS]) -> [S::V; MAX_POINTS] {
    if M == 2 {
        [minus(simd, d[0], d[2]), add(simd, d[1], d[2]), minus(simd, d[2], d[1]), minus(simd, d[3], d[1]), d[4], d[5]]
    } else {
        let (even, odd) = (scaled(simd, d[2], -4.0, d[4]), scaled(simd, d[1], -4.0, d[3]));
        let (wide_even, wide_odd) = (minus(simd, d[4], d[2]), minus(simd, d[3], d[1]));
        [
            scaled(simd, d[0], 4.0, scaled(simd, d[2], -5.0, d[4])),
            add(simd, even, odd),
            minus(simd, even, odd),
            scaled(simd, wide_odd, 2.0, wide_even),
            scaled(simd, wide_odd, -2.0, wide_even),
            scaled(simd, d[1], 4.0, scaled(simd, d[3], -5.0, d[5])),
        ]
    }
}

/// `A' m`: points to rows of the output.
#[inline(always)]
pub(super) fn output<S: Simd, const M: usize>(simd: S, m: [S::V; MAX_POINTS]) -> [S::V; MAX_ROWS] {
    let (even, odd) = (add(simd, m[1], m[2]), minus(simd, m[1], m[2]));
    if M == 2 {
        let zero = simd.splat(0.0);
        [add(simd, m[0], even), add(simd, m[3], odd), zero, zero]
    } else {
        let (wide_even, wide_odd) = (add(simd, m[3], m[4]), minus(simd, m[3], m[4]));
        [
            add(simd, add(simd, m[0], even), wide_even),
            scaled(simd, wide_odd, 2.0, odd),
            scaled(simd, wide_even, 4.0, even),
            scaled(simd, wide_odd, 8.0, add(simd, m[5], odd)),
        ]
    }
}

/// `A dy`, the transpose of [`output`]: rows of the output gradient to points.
#[inline(always)]
pub(super) fn output_gradient<S: Simd, const M: usize>(simd: S, dy: [S::V; MAX_ROWS]) -> [S::V; MAX_POINTS] {
    if M == 2 {
        [dy[0], add(simd, dy[0], dy[1]), minus(simd, dy[0], dy[1]), dy[1], dy[1], dy[1]]
    } else {
        let (even, odd) = (add(simd, dy[0], dy[2]), add(simd, dy[1], dy[3]));
        let (wide_even, wide_odd) = (scaled(simd, dy[2], 4.0, dy[0]), scaled(simd, dy[3], 4.0, dy[1]));
        [
            dy[0],
            add(simd, even, odd),
            minus(simd, even, odd),
            scaled(simd, wide_odd, 2.0, wide_even),
            scaled(simd, wide_odd, -2.0, wide_even),
            dy[3],
        ]
    }
}

/// `G g`: taps of the filter to points.
#[inline(always)]
pub(super) fn filter<const M: usize>(g: [f32; 3]) -> [f32; MAX_POINTS] {
    let outer = g[0] + g[2];
    if M == 2 {
        [g[0], (outer + g[1]) * 0.5, (outer - g[1]) * 0.5, g[2], 0.0, 0.0]
    } else {
        let (wide, twice) = (g[0] + 4.0 * g[2], 2.0 * g[1]);
        let (near, far) = (-1.0 / 6.0, 1.0 / 24.0);
        [g[0] * 0.25, (outer + g[1]) * near, (outer - g[1]) * near, (wide + twice) * far, (wide - twice) * far, g[2]]
    }
}

/// `G' p`, the transpose of [`filter`]: the gradient of the points of a filter to that of its taps.
#[inline(always)]
pub(super) fn filter_gradient<const M: usize>(p: [f32; MAX_POINTS]) -> [f32; 3] {
    let (near_even, near_odd) = (p[1] + p[2], p[1] - p[2]);
    if M == 2 {
        [p[0] + 0.5 * near_even, 0.5 * near_odd, p[3] + 0.5 * near_even]
    } else {
        let (far_even, far_odd) = (p[3] + p[4], p[3] - p[4]);
        [
            0.25 * p[0] - near_even / 6.0 + far_even / 24.0,
            far_odd / 12.0 - near_odd / 6.0,
            p[5] - near_even / 6.0 + far_even / 6.0,
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simd::portable::Portable;

    /// `f` of arrays of numbers, each in all lanes.
    fn on_numbers<const N: usize, const R: usize>(
        values: [f32; N],
        f: impl Fn([<Portable as Simd>::V; N]) -> [<Portable as Simd>::V; R],
    ) -> [f32; R] {
        let simd = Portable;
        f(values.map(|value| simd.splat(value))).map(|v| simd.sum(v) / Portable::LANES as f32)
    }

    fn filters_and_gradients_agree<const M: usize>() {
        let g = [0.5, -1.25, 2.0];
        let d = [1.0, -2.0, 0.5, 3.0, -0.75, 1.5];
        let dy = [0.25, -1.0, 1.5, 2.0];
        let (filter_points, points) = (filter::<M>(g), on_numbers(d, |d| input::<_, M>(Portable, d)));
        let mut products = [0.0; MAX_POINTS];
        (0..M + 2).for_each(|u| products[u] = filter_points[u] * points[u]);
        let y = on_numbers(products, |m| output::<_, M>(Portable, m));
        for i in 0..M {
            let expected: f32 = (0..3).map(|j| g[j] * d[i + j]).sum();
            approx::assert_relative_eq!(y[i], expected, epsilon = 1e-5);
        }
        let dy_points = on_numbers(dy, |dy| output_gradient::<_, M>(Portable, dy));
        let mut products = [0.0; MAX_POINTS];
        (0..M + 2).for_each(|u| products[u] = dy_points[u] * points[u]);
        let dg = filter_gradient::<M>(products);
        for j in 0..3 {
            let expected: f32 = (0..M).map(|i| dy[i] * d[i + j]).sum();
            approx::assert_relative_eq!(dg[j], expected, epsilon = 1e-4);
        }
        approx::assert_relative_eq!(dy_points[POINT_ONE], dy[..M].iter().sum::<f32>(), epsilon = 1e-6);
        // Without its last tap a filter does not need the last point, without its first tap not the first point.
        assert_eq!(filter::<M>([1.0, 2.0, 0.0])[M + 1], 0.0);
        assert_eq!(filter::<M>([0.0, 2.0, 1.0])[0], 0.0);
    }

    #[test]
    fn the_transforms_filter_and_so_do_their_transposes() {
        filters_and_gradients_agree::<2>();
        filters_and_gradients_agree::<4>();
    }
}
