//! Drawings as SVG: charts, maps, network diagrams, and the colours that they share.

pub mod chart;
pub mod map;
pub mod network_diagram;
pub mod palette;
pub mod sparkline;
pub mod steering;
pub mod steering_line;
pub mod svg;
