//! `steersman sim --as donkeysim`: the built-in simulator in the place of DonkeySim.

use std::net::{IpAddr, SocketAddr};

use clap::{Args, ValueEnum};

use crate::cli::arguments::camera_preset;
use crate::cli::process::stop_on_ctrl_c;
use crate::cli::terminal::counted;
use crate::donkeysim::{DEFAULT_PORT, DonkeySimOptions, DonkeySimServer, Reading, Scene};
use crate::error::Result;
use crate::simulator::Track;

/// Simulators whose place ours can take besides Udacity's.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum Role {
    /// DonkeySim, of donkeycar and gym_donkeycar: a server for their clients
    Donkeysim,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Begin {
    /// In the menu, where the client chooses a scene
    Menu,
    /// On the track
    Race,
}

#[derive(Debug, Args)]
#[command(next_help_heading = "With --as donkeysim")]
pub struct DonkeySimArgs {
    /// Port to listen at; 0 takes any free one
    #[arg(long, requires = "role", default_value_t = DEFAULT_PORT)]
    port: u16,
    /// Address to listen at; 0.0.0.0 lets other machines connect
    #[arg(long, requires = "role", default_value = "127.0.0.1", value_name = "ADDRESS")]
    host: IpAddr,
    /// Where a connection begins; every scene of the menu is --track
    #[arg(long, requires = "role", value_enum, default_value_t = Begin::Menu)]
    scene: Begin,
    /// Read messages as the real simulator does: one for each write of the client, with numbers in strings
    #[arg(long, requires = "role")]
    strict: bool,
    /// Pictures from the camera of another car: udacity, udacity-straight, steersman or donkeycar
    #[arg(long, requires = "role", value_name = "PRESET")]
    camera: Option<String>,
}

pub fn run(args: &DonkeySimArgs, track: &Track, seed: u64) -> Result<()> {
    let options = DonkeySimOptions {
        address: SocketAddr::new(args.host, args.port),
        scene: match args.scene {
            Begin::Menu => Scene::Menu,
            Begin::Race => Scene::Race,
        },
        reading: if args.strict { Reading::Strict } else { Reading::Lenient },
        seed,
        car: args.camera.as_deref().map(camera_preset).transpose()?,
    };
    let server = DonkeySimServer::bind(options)?;
    eprintln!("{} waits as DonkeySim for clients at {}; Ctrl-C ends it", track.name(), server.address()?);
    let stop = stop_on_ctrl_c()?;
    let mut say = |text: String| {
        eprintln!("{text}");
        Ok(())
    };
    let clients = server.run(track, &mut say, &stop)?;
    eprintln!("the simulator has ended after {}", counted(clients as usize, "client"));
    Ok(())
}
