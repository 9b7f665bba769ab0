//! The track file: the line, the looks of the road, the roadside and the light, as strict TOML.

use serde::{Deserialize, Serialize};

/// A colour, 0 to 255 each: red, green, blue.
pub type Rgb = [u8; 3];

/// A whole track as written in `data/tracks/*.toml`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrackSpec {
    /// Name as used on the command line.
    pub name: String,
    /// Whether training must not see this track.
    pub held_out: bool,
    /// Smallest radius the reference line may have, m; at least 15.
    #[serde(default = "default_min_radius_m")]
    pub min_radius_m: f64,
    /// Control points of a closed uniform cubic B-spline, at least 6:
    /// `[x m, y m, z m, road width m, bank deg]`, bank > 0 where the right side is lower.
    pub points: Vec<[f64; 5]>,
    /// Looks of the road, which stretches refer to by name; the first one applies where no stretch names another.
    pub look: Vec<Look>,
    /// What differs along the lap; later stretches override earlier ones.
    #[serde(default)]
    pub stretch: Vec<Stretch>,
    /// The land beside the road.
    pub land: Land,
    /// Sun, sky and air.
    pub light: Light,
}

impl TrackSpec {
    /// Checks everything that does not need the reference line.
    ///
    /// # Errors
    /// A sentence that names the entry, what it must be, and the remedy.
    pub(crate) fn check(&self) -> Result<(), String> {
        self.check_points()?;
        within("min_radius_m", self.min_radius_m, 15.0, 200.0)?;
        if self.look.is_empty() {
            return Err("look: at least one [[look]] is needed".to_string());
        }
        for look in &self.look {
            let at = |key: &str| format!("look `{}`: {key}", look.name);
            within(&at("grain"), look.grain.into(), 0.0, 1.0)?;
            within(&at("shoulder_m"), look.shoulder_m.into(), 0.0, 3.5)?;
        }
        let (land, light) = (&self.land, &self.light);
        for (name, value, low, high) in [
            ("land: hills_m", f64::from(land.hills_m), 0.0, 200.0),
            ("land: plants_per_100_m", land.plants_per_100_m.into(), 0.0, 100.0),
            ("land: plants_from_m", land.plants_from_m.into(), 0.5, 60.0),
            ("land: mounds_m", land.mounds_m.into(), 0.0, 20.0),
            ("land: sandy", land.sandy.into(), 0.0, 1.0),
            ("land: woods", land.woods.into(), 0.0, 1.0),
            ("light: sun_azimuth_deg", light.sun_azimuth_deg, -360.0, 360.0),
            ("light: sun_elevation_deg", light.sun_elevation_deg, 5.0, 85.0),
            ("light: shade", light.shade.into(), 0.1, 1.0),
            ("light: haze_m", light.haze_m.into(), 10.0, 1e5),
            ("light: clouds", light.clouds.into(), 0.0, 1.0),
        ] {
            within(name, value, low, high)?;
        }
        Ok(())
    }

    fn check_points(&self) -> Result<(), String> {
        let points = &self.points;
        if points.len() < 6 {
            return Err(format!("points: {} given, a closed line needs at least 6", points.len()));
        }
        if let Some(i) = points.iter().position(|p| p.iter().any(|v| !v.is_finite() || v.abs() > 1e5)) {
            return Err(format!("points[{i}]: every number must be finite and below 100,000"));
        }
        // Way from each point to the next; from the last one back to the first.
        let gap_m = |i: usize| {
            let (a, b) = (points[i], points[(i + 1) % points.len()]);
            ((a[0] - b[0]) * (a[0] - b[0]) + (a[1] - b[1]) * (a[1] - b[1])).sqrt()
        };
        let last = points.len() - 1;
        if gap_m(last) < 1.0 {
            return Err(format!(
                "points[{last}] is where points[0] is; the line closes by itself, so leave the last point out"
            ));
        }
        if let Some(i) = (0..last).find(|i| gap_m(*i) < 1.0) {
            return Err(format!("points[{i}] and points[{}] are at the same place; leave one out", i + 1));
        }
        let widest_m = (0..last).map(gap_m).fold(0.0, f64::max);
        if gap_m(last) > 3.0 * widest_m {
            return Err(format!(
                "the line is not closed: from points[{last}] back to points[0] it is {:.0} m, elsewhere at most \
                 {widest_m:.0} m from point to point; add points on the way back",
                gap_m(last)
            ));
        }
        Ok(())
    }

    /// Checks the stretches of a lap of `length_m`.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub(crate) fn check_stretches(&self, length_m: f64) -> Result<(), String> {
        for stretch in &self.stretch {
            let at = format!("stretch from {} m", stretch.from_m);
            for place in [stretch.from_m, stretch.to_m] {
                if !(0.0..=length_m).contains(&place) {
                    return Err(format!("{at}: {place} m is not on the lap of {length_m:.0} m"));
                }
            }
            if let Some(name) = stretch.look.as_ref().filter(|name| !self.look.iter().any(|l| l.name == **name)) {
                let known: Vec<&str> = self.look.iter().map(|l| l.name.as_str()).collect();
                return Err(format!("{at}: no [[look]] is called `{name}`; there are {}", known.join(", ")));
            }
        }
        Ok(())
    }
}

impl TrackSpec {
    /// What the track sets at `s_m` of the lap: `setting` of the last stretch there that has one.
    pub(crate) fn setting_at<T>(&self, s_m: f64, setting: impl Fn(&Stretch) -> Option<T>) -> Option<T> {
        self.stretch.iter().rev().filter(|stretch| stretch.covers(s_m)).find_map(setting)
    }
}

fn within(name: &str, value: f64, low: f64, high: f64) -> Result<(), String> {
    // Numbers kept in 32 bits have digits behind those that were written.
    let written = (value * 1e6).round() / 1e6;
    if (low..=high).contains(&written) { Ok(()) } else { Err(format!("{name} is {written}; {low} to {high} is meant")) }
}

fn default_min_radius_m() -> f64 {
    25.0
}

/// How the road is made and painted.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Look {
    /// Name that stretches use.
    pub name: String,
    /// What the road is made of.
    pub surface: Surface,
    /// Mean colour of the surface.
    pub tone: Rgb,
    /// Strength of the surface's grain, 0 (none) to 1.
    pub grain: f32,
    /// Paint on the reference line.
    #[serde(default)]
    pub centre: Centre,
    /// Left edge, seen in the direction of the points.
    pub left: Edge,
    /// Right edge.
    pub right: Edge,
    /// Colour of the ground beyond each edge.
    pub shoulder: Rgb,
    /// Width of that ground, m, 0 to 3.5.
    pub shoulder_m: f32,
}

/// Road materials.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Surface {
    /// Asphalt with visible stones.
    Asphalt,
    /// Asphalt with repaired patches and cracks.
    Patched,
    /// Rows of paving stones.
    Cobble,
    /// Asphalt laid in lanes, with sealed seams along and across.
    Seamed,
    /// Slabs of concrete with joints; only on held-out tracks.
    Concrete,
    /// Loose gravel with wheel tracks; only on held-out tracks.
    Gravel,
}

/// Paint on the reference line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Centre {
    /// No paint.
    #[default]
    None,
    /// White, 4 m of paint in every 12 m.
    Dashed,
    /// One solid white line.
    Solid,
    /// One solid yellow line.
    Yellow,
}

/// What marks an edge of the road.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Edge {
    /// Nothing: the surface just ends.
    Bare,
    /// A solid white line.
    White,
    /// A solid yellow line, then a strip of asphalt and a wide pale apron of concrete that rises outwards.
    YellowKerbstone,
    /// A solid yellow line.
    Yellow,
    /// A solid yellow line, then red and white kerb blocks with a strip of pale concrete beyond.
    Kerb,
    /// White dashes, 1 m in every 3 m; only on held-out tracks.
    Dashes,
    /// A ragged border of grass growing in; only on held-out tracks.
    Overgrown,
}

/// A part of the lap, in metres along the reference line; `from_m > to_m` runs through the start.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stretch {
    /// Where it begins, m.
    pub from_m: f64,
    /// Where it ends, m.
    pub to_m: f64,
    /// Name of a look.
    pub look: Option<String>,
    /// The land on the left.
    pub left: Option<Side>,
    /// The land on the right.
    pub right: Option<Side>,
    /// Wall or barrier on the left.
    pub left_wall: Option<Wall>,
    /// Wall or barrier on the right.
    pub right_wall: Option<Wall>,
}

impl Stretch {
    /// Whether `s_m` of the lap lies on the stretch.
    fn covers(&self, s_m: f64) -> bool {
        if self.from_m <= self.to_m {
            (self.from_m..self.to_m).contains(&s_m)
        } else {
            s_m >= self.from_m || s_m < self.to_m
        }
    }
}

/// The shape of the land beside the road.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Side {
    /// Rolls gently.
    #[default]
    Flat,
    /// Rises by some 5 m.
    Hill,
    /// A rock face of about 12 m.
    Cliff,
    /// Falls away by 9 m.
    Drop,
    /// Falls below the water level.
    Water,
}

/// Solid things along the road; touching one is a crash.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Wall {
    /// A solid dark parapet, 1 m high.
    Parapet,
    /// A steel guard rail on posts.
    Rail,
    /// A pale concrete barrier in pieces of 4 m.
    Barrier,
    /// A low wall of light stones; only on held-out tracks.
    Stone,
    /// A wooden fence; only on held-out tracks.
    Fence,
}

/// The land beside the road.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Land {
    /// Seed of the terrain and of where things stand.
    pub seed: u32,
    /// Height of distant hills, m.
    pub hills_m: f32,
    /// Everything lower is water; below every road point. Left out: no water.
    pub water_level_m: Option<f32>,
    /// Two colours of ground, mixed by noise.
    pub ground: [Rgb; 2],
    /// Colour of steep ground.
    pub rock: Rgb,
    /// Colour of the shore.
    pub shore: Rgb,
    /// Colour of water.
    pub water: Rgb,
    /// What stands beside the road.
    pub plants: Vec<Plant>,
    /// Plants for each 100 m of road and side.
    pub plants_per_100_m: f32,
    /// Nearest plant to the edge of the road, m.
    pub plants_from_m: f32,
    /// Posts beside sharp bends.
    #[serde(default)]
    pub posts: Option<Plant>,
    /// Height of mounds near the road, m; the highest are domes of rock.
    #[serde(default)]
    pub mounds_m: f32,
    /// Share of the ground that is bare, in the colour of the shore, 0 to 1.
    #[serde(default)]
    pub sandy: f32,
    /// How dense woods stand on the slopes and along the horizon, 0 (none) to 1.
    #[serde(default)]
    pub woods: f32,
    /// Pylons of a power line across the land.
    #[serde(default)]
    pub pylons: bool,
}

/// Things that stand beside the road, drawn as upright pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Plant {
    /// A tall conifer with a bare trunk.
    Pine,
    /// A round crown.
    Broadleaf,
    /// A palm.
    Palm,
    /// A low bush.
    Bush,
    /// A slim dark column; only on held-out tracks.
    Cypress,
    /// A dense fir down to the ground; only on held-out tracks.
    Fir,
    /// A white trunk and light leaves; only on held-out tracks.
    Birch,
    /// A clump of reeds.
    Reeds,
    /// A boulder.
    Boulder,
    /// A steel pylon of a power line.
    Pylon,
    /// A red and white board on a white post.
    Board,
    /// A short white post.
    Post,
}

/// Sun, sky and air.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Light {
    /// Direction towards the sun, anticlockwise from east, deg.
    pub sun_azimuth_deg: f64,
    /// Height of the sun above the horizon, deg, 5 to 85.
    pub sun_elevation_deg: f64,
    /// Brightness of shadows relative to full sunlight, 0.1 to 1.
    pub shade: f32,
    /// Colour of sunlight; 255 is neutral.
    pub sun: Rgb,
    /// Sky at the top of the picture.
    pub zenith: Rgb,
    /// Sky at the horizon.
    pub horizon: Rgb,
    /// Distance at which haze hides half of an object, m.
    pub haze_m: f32,
    /// Strength of clouds, 0 (clear) to 1.
    #[serde(default)]
    pub clouds: f32,
}
