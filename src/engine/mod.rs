//! The engine: layers with hand-written backward passes, networks and their plans, the optimizer. It reads no file, opens no
//! socket and knows no clock but the stopwatch.

pub mod layers;
pub mod loss;
pub mod network;
pub mod optimizer;
pub mod parameters;
pub mod random;
pub mod stopwatch;
pub mod tensor;
