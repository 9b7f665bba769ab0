//! Image to patch matrix and back.
