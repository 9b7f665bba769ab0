//! Sizes beyond which a file is refused.

use crate::engine::tensor::Shape;

/// Longest JSON that is parsed, in bytes. Architectures have kilobytes; parsed, a hostile one takes 36 times its length.
pub(super) const MAX_JSON_BYTES: usize = 1 << 20;

/// Most rows, and most columns, of a map.
const MAX_SIDE: usize = 8192;
/// Most numbers of a map; products of such sizes stay far from overflowing.
const MAX_MAP: usize = 1 << 26;

/// Checks that maps of `shape` are small enough to be computed with.
pub(super) fn check_size(shape: Shape) -> Result<(), String> {
    let Shape { c, h, w } = shape;
    if h.max(w) > MAX_SIDE || c.saturating_mul(h).saturating_mul(w) > MAX_MAP {
        return Err(format!(
            "a map of {h}x{w}x{c} is too large: up to {MAX_SIDE} rows and columns and {MAX_MAP} numbers in all can be imported"
        ));
    }
    Ok(())
}
