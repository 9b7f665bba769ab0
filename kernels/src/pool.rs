//! Max and average pooling over windows that lie fully inside the image (no padding, sizes rounded down).
//!
//! # NaN
//! [`max_forward`] skips a NaN; a window of NaN alone gives minus infinity, and its gradient reaches no input.
//! [`average_forward`] passes a NaN on.

/// The sizes of a pooling layer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoolShape {
    /// Channels.
    pub c: usize,
    /// Input height.
    pub h: usize,
    /// Input width.
    pub w: usize,
    /// Window height, at least 1.
    pub kh: usize,
    /// Window width, at least 1.
    pub kw: usize,
    /// Rows between windows, at least 1.
    pub stride_h: usize,
    /// Columns between windows, at least 1.
    pub stride_w: usize,
}

impl PoolShape {
    /// Output height: windows that fit, 0 if the window is higher than the image.
    pub fn out_h(&self) -> usize {
        if self.h < self.kh { 0 } else { (self.h - self.kh) / self.stride_h + 1 }
    }

    /// Output width: windows that fit, 0 if the window is wider than the image.
    pub fn out_w(&self) -> usize {
        if self.w < self.kw { 0 } else { (self.w - self.kw) / self.stride_w + 1 }
    }

    /// Checks the lengths of a batch of inputs and one of outputs.
    pub(crate) fn check(&self, kernel: &str, n: usize, x_len: usize, y_len: usize) {
        assert!(self.kh > 0 && self.kw > 0 && self.stride_h > 0 && self.stride_w > 0, "{kernel}: {self:?} has a 0");
        assert_eq!(x_len, n * self.c * self.h * self.w, "{kernel}: input length for {n} of {self:?}");
        assert_eq!(y_len, n * self.c * self.out_h() * self.out_w(), "{kernel}: output length for {n} of {self:?}");
    }
}

per_isa! {
    /// The maximum of each window. `x`: `[n][c][h][w]`, `y`: `[n][c][out_h][out_w]`, overwritten.
    pub fn max_forward<S>(_simd: S, shape: &PoolShape, n: usize, x: &[f32], y: &mut [f32]) {
        shape.check("max_forward", n, x.len(), y.len());
        let &PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        if x.is_empty() || y.is_empty() {
            return;
        }
        for (x, y) in x.chunks_exact(h * w).zip(y.chunks_exact_mut(out_h * out_w)).take(n * c) {
            for (oy, y) in y.chunks_exact_mut(out_w).enumerate() {
                y.fill(f32::NEG_INFINITY);
                for row in x[oy * stride_h * w..].chunks_exact(w).take(kh) {
                    match (kw, stride_w) {
                        (2, 2) => max_of_blocks::<2>(y, row),
                        (4, 4) => max_of_blocks::<4>(y, row),
                        _ => max_of_windows(y, row, kw, stride_w),
                    }
                }
            }
        }
    }
}

/// `y[i]` becomes the maximum of itself and block `i` of a row.
#[inline(always)]
fn max_of_blocks<const K: usize>(y: &mut [f32], row: &[f32]) {
    for (y, block) in y.iter_mut().zip(row.as_chunks::<K>().0) {
        let mut max = *y;
        for &x in block {
            max = if x > max { x } else { max };
        }
        *y = max;
    }
}

/// `y[i]` becomes the maximum of itself and the `kw` elements of a row from `i * stride` on.
#[inline(always)]
fn max_of_windows(y: &mut [f32], row: &[f32], kw: usize, stride: usize) {
    for kx in 0..kw {
        for (y, &x) in y.iter_mut().zip(row[kx..].iter().step_by(stride)) {
            *y = if x > *y { x } else { *y };
        }
    }
}

per_isa! {
    /// The gradient of [`max_forward`], `y = max of window`: the first maximum in row-major order receives `dy`. Gradients of
    /// overlapping windows are added up. `dx` is overwritten.
    pub fn max_backward<S>(
        _simd: S,
        shape: &PoolShape,
        n: usize,
        x: &[f32],
        y: &[f32],
        dy: &[f32],
        dx: &mut [f32],
    ) {
        shape.check("max_backward", n, x.len(), y.len());
        shape.check("max_backward", n, dx.len(), dy.len());
        let &PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        dx.fill(0.0);
        if y.is_empty() {
            return;
        }
        for plane in 0..n * c {
            let x = &x[plane * h * w..][..h * w];
            let dx = &mut dx[plane * h * w..][..h * w];
            let y = &y[plane * out_h * out_w..][..out_h * out_w];
            let dy = &dy[plane * out_h * out_w..][..out_h * out_w];
            for (oy, (y, dy)) in y.chunks_exact(out_w).zip(dy.chunks_exact(out_w)).enumerate() {
                let rows = oy * stride_h * w..(oy * stride_h + kh) * w;
                let (x, dx) = (&x[rows.clone()], &mut dx[rows]);
                match (kw, stride_w) {
                    (2, 2) if stride_h >= kh => max_back_blocks::<2>(w, x, y, dy, dx),
                    (4, 4) if stride_h >= kh => max_back_blocks::<4>(w, x, y, dy, dx),
                    _ => max_back_windows(w, kw, stride_w, x, y, dy, dx),
                }
            }
        }
    }
}

/// The gradient of a row of windows that neither overlap nor leave gaps; `x` and `dx` are its input rows of width `w`.
#[inline(always)]
fn max_back_blocks<const K: usize>(w: usize, x: &[f32], y: &[f32], dy: &[f32], dx: &mut [f32]) {
    /// Windows at a time: their state stays in registers or the first-level cache.
    const STRIP: usize = 64;
    for (strip, (y, dy)) in y.chunks(STRIP).zip(dy.chunks(STRIP)).enumerate() {
        // The value that each window still searches: its maximum, then NaN, which equals nothing.
        let mut sought = [f32::NAN; STRIP];
        sought[..y.len()].copy_from_slice(y);
        let mut gradient = [0.0; STRIP];
        gradient[..y.len()].copy_from_slice(dy);
        for (x, dx) in x.chunks_exact(w).zip(dx.chunks_exact_mut(w)) {
            let blocks = strip * STRIP * K..(strip * STRIP + y.len()) * K;
            let (x, dx) = (x[blocks.clone()].as_chunks::<K>().0, dx[blocks].as_chunks_mut::<K>().0);
            // Columns of the windows side by side: then each step is a plain loop, which vectorises.
            let mut columns = [[0.0f32; STRIP]; K];
            for (i, x) in x.iter().enumerate().take(STRIP) {
                for j in 0..K {
                    columns[j][i] = x[j];
                }
            }
            for column in &mut columns {
                for i in 0..STRIP {
                    let found = column[i] == sought[i];
                    column[i] = if found { gradient[i] } else { 0.0 };
                    sought[i] = if found { f32::NAN } else { sought[i] };
                }
            }
            for (i, dx) in dx.iter_mut().enumerate().take(STRIP) {
                for j in 0..K {
                    dx[j] = columns[j][i];
                }
            }
        }
    }
}

/// The gradient of a row of windows of any kind, added to `dx`.
#[inline(always)]
fn max_back_windows(w: usize, kw: usize, stride: usize, x: &[f32], y: &[f32], dy: &[f32], dx: &mut [f32]) {
    let kh = x.len() / w;
    for (ox, (&y, &dy)) in y.iter().zip(dy).enumerate() {
        let mut window = (0..kh * kw).map(|k| k / kw * w + ox * stride + k % kw);
        if let Some(at) = window.find(|&at| x[at] == y) {
            dx[at] += dy;
        }
    }
}

per_isa! {
    /// The mean of each window. `x`: `[n][c][h][w]`, `y`: `[n][c][out_h][out_w]`, overwritten.
    pub fn average_forward<S>(_simd: S, shape: &PoolShape, n: usize, x: &[f32], y: &mut [f32]) {
        shape.check("average_forward", n, x.len(), y.len());
        let &PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        if y.is_empty() {
            return;
        }
        let share = 1.0 / (kh * kw) as f32;
        for plane in 0..n * c {
            let x = &x[plane * h * w..][..h * w];
            for oy in 0..out_h {
                let y = &mut y[(plane * out_h + oy) * out_w..][..out_w];
                y.fill(0.0);
                for ky in 0..kh {
                    let row = &x[(oy * stride_h + ky) * w..][..w];
                    for kx in 0..kw {
                        for (y, &x) in y.iter_mut().zip(row[kx..].iter().step_by(stride_w)) {
                            *y += x;
                        }
                    }
                }
                for y in y {
                    *y *= share;
                }
            }
        }
    }
}

per_isa! {
    /// The gradient of [`average_forward`], `y = mean of window`: each position of a window receives an equal share of `dy`.
    /// Gradients of overlapping windows are added up. `dx` is overwritten.
    pub fn average_backward<S>(_simd: S, shape: &PoolShape, n: usize, dy: &[f32], dx: &mut [f32]) {
        shape.check("average_backward", n, dx.len(), dy.len());
        let &PoolShape { c, h, w, kh, kw, stride_h, stride_w } = shape;
        let (out_h, out_w) = (shape.out_h(), shape.out_w());
        dx.fill(0.0);
        if dy.is_empty() {
            return;
        }
        let share = 1.0 / (kh * kw) as f32;
        for plane in 0..n * c {
            let dx = &mut dx[plane * h * w..][..h * w];
            for oy in 0..out_h {
                let dy = &dy[(plane * out_h + oy) * out_w..][..out_w];
                for ky in 0..kh {
                    let row = &mut dx[(oy * stride_h + ky) * w..][..w];
                    for kx in 0..kw {
                        for (dx, &dy) in row[kx..].iter_mut().step_by(stride_w).zip(dy) {
                            *dx += dy * share;
                        }
                    }
                }
            }
        }
    }
}
