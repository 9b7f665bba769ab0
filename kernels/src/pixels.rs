//! Bytes of a picture to floats.

per_isa! {
    /// `dst = src * scale + offset` for each byte.
    pub fn u8_to_f32<S>(_simd: S, src: &[u8], scale: f32, offset: f32, dst: &mut [f32]) {
        assert_eq!(src.len(), dst.len(), "u8_to_f32: src and dst differ in length");
        for (dst, &src) in dst.iter_mut().zip(src) {
            *dst = f32::from(src) * scale + offset;
        }
    }
}
