//! Our simulator in the place of DonkeySim, the simulator of donkeycar and `gym_donkeycar`: TCP and JSON, port 9091.
//!
//! The server writes one object a line, twenty pictures a second of the clock, whether the client answers or not. With
//! [`Scene::Menu`] a connection begins as in the simulator's menu: `scene_selection_ready`, then the client asks for the names of the scenes
//! and loads one. With [`Scene::Race`] it begins in the scene: `car_loaded`. Every scene is the one track. Each connection has its own car,
//! and cars do not meet.
//!
//! `messages` reads what clients send, `car` drives and writes telemetry, `server` has the sockets. [`client`] drives the real one.

mod car;
pub mod client;
mod messages;
mod server;

pub use messages::Reading;
pub use server::{DonkeySimOptions, DonkeySimServer, Scene};

/// Port that clients connect to.
pub const DEFAULT_PORT: u16 = 9091;
