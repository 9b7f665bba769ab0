//! Training.
mod loss;
pub use loss::Loss;
