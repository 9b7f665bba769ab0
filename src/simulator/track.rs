//! A track: a road and its visible world.

use std::ops::Deref;
use std::path::Path;
use std::sync::OnceLock;

use crate::simulator::road::builtin;
use crate::simulator::road::line::Road;
use crate::simulator::road::random_track;
use crate::simulator::road::spec::TrackSpec;
use crate::simulator::scenery::world::World;
use crate::{Error, Result};

/// What the names of random tracks begin with.
const RANDOM: &str = "random:";

/// A track ready to drive on: all of its [`Road`], and its visible world, which is built when the first picture is taken.
pub struct Track {
    road: Road,
    world: OnceLock<World>,
}

impl Deref for Track {
    type Target = Road;

    fn deref(&self) -> &Road {
        &self.road
    }
}

impl Track {
    fn new(road: Road) -> Track {
        Track { road, world: OnceLock::new() }
    }

    /// Finds a track: a built-in name (`lake`), `random:SEED`, or the path of a track file ending in `.toml`.
    ///
    /// # Errors
    /// An unknown name, naming the nearest known one; an unreadable file; a track that fails the checks of
    /// [`Road::from_spec`].
    pub fn load(name: &str) -> Result<Track> {
        if let Some(seed) = name.strip_prefix(RANDOM) {
            let seed = seed.parse().map_err(|_| {
                Error::Usage(format!("track `{name}`: `{seed}` is no seed; write for example random:7"))
            })?;
            return random_track::generate(seed).map(Track::new);
        }
        if let Some(text) = builtin::text(name) {
            return Track::from_toml(text, &format!("data/tracks/{name}.toml"));
        }
        if name.ends_with(".toml") {
            let text = std::fs::read_to_string(name).map_err(Error::io(Path::new(name)))?;
            let mut road = Road::from_toml(&text, name)?;
            // Reports tell tracks by their names, so a file must not pass for a track that comes with the program.
            let own = &road.spec.name;
            if builtin::text(own).is_some() || own.starts_with(RANDOM) {
                road.spec.name = format!("{own} ({name})");
            }
            return Ok(Track::new(road));
        }
        let known = builtin::names().collect::<Vec<_>>();
        let nearest =
            known.iter().max_by(|a, b| strsim::jaro_winkler(name, a).total_cmp(&strsim::jaro_winkler(name, b)));
        Err(Error::Usage(format!(
            "unknown track `{name}`; did you mean `{}`? Known: {}, random:SEED, or a path ending in .toml",
            nearest.unwrap_or(&"lake"),
            known.join(", ")
        )))
    }

    /// Reads a track from the text of a track file; `place` names the file in errors.
    ///
    /// # Errors
    /// As [`Road::from_toml`].
    pub fn from_toml(text: &str, place: &str) -> Result<Track> {
        Road::from_toml(text, place).map(Track::new)
    }

    /// Builds and checks a track; `place` names it in errors.
    ///
    /// # Errors
    /// As [`Road::from_spec`].
    pub fn from_spec(spec: TrackSpec, place: &str) -> Result<Track> {
        Road::from_spec(spec, place).map(Track::new)
    }

    /// The track whose road has this description, on another rank or with its visible world yet to be built.
    pub(crate) fn again(spec: TrackSpec) -> Track {
        Track::new(Road::again(spec))
    }

    /// Whether the track is held out of training.
    pub fn held_out(&self) -> bool {
        self.spec.held_out
    }

    /// Name in reports: of built-in and random tracks the one on the command line; of a file its `name`, followed by its path
    /// if the name is that of a built-in or random track.
    pub fn name(&self) -> &str {
        &self.spec.name
    }

    /// The visible world; built on first use.
    pub fn world(&self) -> &World {
        self.world.get_or_init(|| World::build(&self.road))
    }
}
