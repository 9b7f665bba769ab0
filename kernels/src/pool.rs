//! Maximum and average pooling over windows that lie fully inside the image (no padding, sizes rounded down).

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
    fn check(&self, kernel: &str, n: usize, x_len: usize, y_len: usize) {
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
                let top = oy * stride_h * w;
                y.fill(f32::NEG_INFINITY);
                for ky in 0..kh {
                    let row = &x[top + ky * w..][..w];
                    for kx in 0..kw {
                        max_into(y, &row[kx..], stride_w);
                    }
                }
            }
        }
    }
}

/// `y[i] = max(y[i], x[i * stride])`; constant strides vectorise.
#[inline(always)]
fn max_into(y: &mut [f32], x: &[f32], stride: usize) {
    #[inline(always)]
    fn run(y: &mut [f32], x: &[f32], stride: usize) {
        let x = &x[..(y.len() - 1) * stride + 1];
        for (i, y) in y.iter_mut().enumerate() {
            let value = x[i * stride];
            *y = if value > *y { value } else { *y };
        }
    }
    match stride {
        1 => run(y, x, 1),
        2 => run(y, x, 2),
        4 => run(y, x, 4),
        _ => run(y, x, stride),
    }
}

per_isa! {
    /// The gradient of [`max_forward`]: the first position in row-major window order that equals the maximum receives
    /// `dy`; where windows overlap, gradients add up. `dx` is overwritten.
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
            for oy in 0..out_h {
                for ox in 0..out_w {
                    let out = (plane * out_h + oy) * out_w + ox;
                    let corner = oy * stride_h * w + ox * stride_w;
                    let first = (0..kh * kw).map(|k| corner + k / kw * w + k % kw).find(|&at| x[at] == y[out]);
                    if let Some(at) = first {
                        dx[at] += dy[out];
                    }
                }
            }
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
    /// The gradient of [`average_forward`]: each position of a window receives an equal share of `dy`; where windows
    /// overlap, gradients add up. `dx` is overwritten.
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
