//! The window that slides over each channel.

use steersman_kernels::pool::PoolShape;

use crate::engine::layers::kind::{check_sizes, pair};
use crate::engine::tensor::Shape;

/// Windows of `window` (height, width), `stride` apart, on maps of `input`.
///
/// # Errors
///
/// A sentence that says what does not fit.
pub(super) fn pool_shape(input: Shape, window: [usize; 2], stride: [usize; 2]) -> Result<PoolShape, String> {
    let ([kh, kw], [stride_h, stride_w]) = (window, stride);
    if kh == 0 || kw == 0 || stride_h == 0 || stride_w == 0 {
        return Err("window and stride must be at least 1".into());
    }
    if kh > input.h || kw > input.w {
        return Err(format!("a {kh}x{kw} window does not fit into the {}x{} input", input.h, input.w));
    }
    Ok(PoolShape { c: input.c, h: input.h, w: input.w, kh, kw, stride_h, stride_w })
}

/// Shape of an input.
pub(super) fn input_of(shape: &PoolShape) -> Shape {
    Shape::new(shape.c, shape.h, shape.w)
}

/// Shape of an output.
pub(super) fn output_of(shape: &PoolShape) -> Shape {
    Shape::new(shape.c, shape.out_h(), shape.out_w())
}

/// `max pool 2x2`, `max pool 3x3 stride 2x2`.
pub(super) fn describe(what: &str, window: [usize; 2], stride: Option<[usize; 2]>) -> String {
    match stride.filter(|stride| *stride != window) {
        None => format!("{what} {}", pair(window)),
        Some(stride) => format!("{what} {} stride {}", pair(window), pair(stride)),
    }
}

/// Refuses sizes that no sensible network has.
pub(super) fn check([h, w]: [usize; 2], stride: Option<[usize; 2]>) -> Result<(), String> {
    let [sh, sw] = stride.unwrap_or([1, 1]);
    check_sizes(&[("window", h), ("window", w), ("stride", sh), ("stride", sw)])
}
