//! The road: its reference line, what may be asked about it, and the checks a track must pass.
//!
//! The reference line is the middle of the road. It is kept as *stations* about 1 m apart, each with position, direction,
//! curvature, slope, banking and width. A point of the world is located by its distance `s_m` along the line and its
//! offset `offset_m` from it (+ = right of the line, looking along it).

use crate::simulator::math::{sin_cos, tan};
use crate::simulator::road::spec::TrackSpec;
use crate::simulator::road::spec::Wall;
use crate::{Error, Result};

/// Distance from the edge of the road to the face of a wall, m.
pub const WALL_GAP_M: f64 = 0.7;

/// One point of the reference line.
#[derive(Clone, Copy, Debug)]
pub struct Station {
    /// East, m.
    pub x: f64,
    /// North, m.
    pub y: f64,
    /// Up, m.
    pub z: f64,
    /// Direction of the line, unit vector, east part.
    pub tx: f64,
    /// Direction of the line, north part.
    pub ty: f64,
    /// Curvature, 1/m, + = bends to the right.
    pub curvature: f64,
    /// Slope: rise per metre along the line.
    pub slope: f64,
    /// Banking: fall per metre to the right.
    pub crossfall: f64,
    /// Width of the road, m.
    pub width_m: f64,
}

/// Where a point lies relative to the reference line.
#[derive(Clone, Copy, Debug)]
pub struct Location {
    /// Index of the nearest station.
    pub station: usize,
    /// Distance along the line from its start, m, in [0, lap length).
    pub s_m: f64,
    /// Distance from the line, m, + = right.
    pub offset_m: f64,
    /// Direction of the line here, unit vector, east part.
    pub tx: f64,
    /// Direction of the line here, north part.
    pub ty: f64,
}

/// A road that has passed its checks: all that is known of a track before anything is drawn.
pub struct Road {
    /// The track file.
    pub spec: TrackSpec,
    /// The reference line.
    pub stations: Vec<Station>,
    /// Length of a lap, m.
    pub length_m: f64,
}

impl Road {
    /// Reads a road from the text of a track file; `place` names the file in errors.
    ///
    /// # Errors
    /// As [`from_spec`](Road::from_spec), and anything that is no track file.
    pub fn from_toml(text: &str, place: &str) -> Result<Road> {
        let spec: TrackSpec = toml::from_str(text).map_err(|e| {
            let before = e.span().and_then(|span| text.get(..span.start)).unwrap_or_default();
            Error::data_at(place, 1 + before.matches('\n').count() as u64, e.message())
        })?;
        Road::from_spec(spec, place)
    }

    /// Builds and checks a road; `place` names it in errors.
    ///
    /// # Errors
    /// Fewer than 6 points, a line that is not closed, a lap outside 600-1,500 m, a bend tighter than allowed, a slope above
    /// 20 %, a width outside 5-14 m, a bank above 10 degrees, parts of the road closer together than 14 m between edges, an
    /// unknown look, a number outside its range.
    pub fn from_spec(spec: TrackSpec, place: &str) -> Result<Road> {
        let fail = |message: String| Err(Error::Data { place: place.to_string(), message });
        if let Err(message) = spec.check() {
            return fail(message);
        }
        let (stations, length_m) = stations_of(&spec.points);
        if !(600.0..=1500.0).contains(&length_m) {
            return fail(format!("the lap is {length_m:.0} m long; 600 to 1500 m are allowed, so scale the points"));
        }
        if let Err(message) = spec.check_stretches(length_m) {
            return fail(message);
        }
        let lowest_m = stations.iter().map(|s| s.z).fold(f64::MAX, f64::min);
        if let Some(level) = spec.land.water_level_m.filter(|level| f64::from(*level) > lowest_m - 0.5) {
            let highest = lowest_m - 0.5;
            return fail(format!(
                "land: water_level_m {level} would flood the road; at most {highest:.1}, or leave it out"
            ));
        }
        let road = Road { spec, stations, length_m };
        road.check_stations(place)?;
        road.check_distances(place)?;
        Ok(road)
    }

    /// The road that has this description, which passed the checks when it was built first.
    pub(crate) fn again(spec: TrackSpec) -> Road {
        let (stations, length_m) = stations_of(&spec.points);
        Road { spec, stations, length_m }
    }

    fn check_stations(&self, place: &str) -> Result<()> {
        let smallest = self.spec.min_radius_m.max(15.0);
        for (i, station) in self.stations.iter().enumerate() {
            let at = self.s_of(i);
            let message = if station.curvature.abs() * smallest > 1.0 {
                let radius = 1.0 / station.curvature.abs();
                let point = self.nearest_point(station);
                format!(
                    "the road turns too tightly: radius {radius:.1} m at {at:.0} m of the lap, near points[{point}]; at least \
                     {smallest:.0} m, so move the points there apart"
                )
            } else if station.slope.abs() > 0.2 {
                format!("slope {:.0} % at {at:.0} m of the lap; at most 20 %", station.slope * 100.0)
            } else if !(5.0..=14.0).contains(&station.width_m) {
                format!("width {:.1} m at {at:.0} m of the lap; 5 to 14 m are allowed", station.width_m)
            } else if station.crossfall.abs() > 0.1764 {
                format!("bank above 10 degrees at {at:.0} m of the lap")
            } else {
                continue;
            };
            return Err(Error::Data { place: place.to_string(), message });
        }
        Ok(())
    }

    /// Index of the control point nearest to a station.
    fn nearest_point(&self, station: &Station) -> usize {
        let square = |p: &[f64; 5]| (p[0] - station.x) * (p[0] - station.x) + (p[1] - station.y) * (p[1] - station.y);
        let points = self.spec.points.iter().enumerate();
        points.min_by(|a, b| square(a.1).total_cmp(&square(b.1))).map_or(0, |(i, _)| i)
    }

    /// The road must not cross itself or pass close to itself: the land between has one height everywhere.
    fn check_distances(&self, place: &str) -> Result<()> {
        let n = self.stations.len();
        for i in (0..n).step_by(2) {
            for j in (i + 1..n).step_by(2) {
                let (a, b) = (&self.stations[i], &self.stations[j]);
                let clear = (a.width_m + b.width_m) / 2.0 + 14.0;
                let (dx, dy) = (a.x - b.x, a.y - b.y);
                let apart = (j - i).min(n - (j - i)) as f64;
                // Along a bend of radius r the chord is at least 2/pi of the arc, so only far-away parts can be too near.
                if apart > 1.7 * clear && dx * dx + dy * dy < clear * clear {
                    let (at_a, at_b) = (self.s_of(i), self.s_of(j));
                    let gap = (dx * dx + dy * dy).sqrt();
                    let (p, q) = (self.nearest_point(a), self.nearest_point(b));
                    return Err(Error::Data {
                        place: place.to_string(),
                        message: format!(
                            "the road crosses or touches itself: {at_a:.0} m and {at_b:.0} m of the lap are {gap:.1} m apart, \
                             near points[{p}] and points[{q}]; keep {clear:.0} m"
                        ),
                    });
                }
            }
        }
        Ok(())
    }

    /// Distance between stations, m; close to 1.
    pub fn spacing_m(&self) -> f64 {
        self.length_m / self.stations.len() as f64
    }

    /// Distance along the line of station `i`, m.
    pub fn s_of(&self, i: usize) -> f64 {
        i as f64 * self.spacing_m()
    }

    /// The wall beside the road at `s_m`, on the right or on the left.
    pub fn wall_at(&self, s_m: f64, right: bool) -> Option<Wall> {
        self.spec.setting_at(s_m, |stretch| if right { stretch.right_wall } else { stretch.left_wall })
    }

    /// Locates a point by searching the whole line.
    pub fn locate(&self, x: f64, y: f64) -> Location {
        let square = |s: &Station| (s.x - x) * (s.x - x) + (s.y - y) * (s.y - y);
        let mut best = 0;
        for (i, station) in self.stations.iter().enumerate() {
            if square(station) < square(&self.stations[best]) {
                best = i;
            }
        }
        self.locate_at(x, y, best)
    }

    /// Locates a point that lies within a few metres of the station `hint`, where it was a moment ago.
    pub fn locate_near(&self, x: f64, y: f64, hint: usize) -> Location {
        let n = self.stations.len();
        let square = |i: usize| {
            let s = &self.stations[i];
            (s.x - x) * (s.x - x) + (s.y - y) * (s.y - y)
        };
        let mut best = hint % n;
        for step in 1..=8 {
            for i in [(hint + step) % n, (hint + n - step) % n] {
                if square(i) < square(best) {
                    best = i;
                }
            }
        }
        self.locate_at(x, y, best)
    }

    /// Second-order location relative to one station: approximates the line by a circle of the station's curvature.
    fn locate_at(&self, x: f64, y: f64, station: usize) -> Location {
        let s = &self.stations[station];
        let (dx, dy) = (x - s.x, y - s.y);
        let along = dx * s.tx + dy * s.ty;
        let right = dx * s.ty - dy * s.tx;
        let stretch = (1.0 - s.curvature * right).max(0.3);
        let arc = along / stretch;
        let offset_m = right - s.curvature * along * along / (2.0 * stretch);
        let s_m = (self.s_of(station) + arc).rem_euclid(self.length_m);
        // The direction turns clockwise by curvature * arc.
        let turn = (s.curvature * arc).clamp(-0.5, 0.5);
        let (sin, cos) = sin_cos(turn);
        Location { station, s_m, offset_m, tx: s.tx * cos + s.ty * sin, ty: s.ty * cos - s.tx * sin }
    }

    /// The station at `s_m`, with position, direction and everything else interpolated.
    pub fn at(&self, s_m: f64) -> Station {
        let u = s_m.rem_euclid(self.length_m) / self.spacing_m();
        let i = (u as usize).min(self.stations.len() - 1);
        let t = u - i as f64;
        let (a, b) = (&self.stations[i], &self.stations[(i + 1) % self.stations.len()]);
        let mix = |p: f64, q: f64| p + (q - p) * t;
        // Cubic Hermite for the position: a chord of 1 m would cut the bend by up to 8 mm.
        let h = self.spacing_m();
        let (t2, t3) = (t * t, t * t * t);
        let curve = |p: f64, dp: f64, q: f64, dq: f64| {
            p * (2.0 * t3 - 3.0 * t2 + 1.0)
                + dp * h * (t3 - 2.0 * t2 + t)
                + q * (3.0 * t2 - 2.0 * t3)
                + dq * h * (t3 - t2)
        };
        let (tx, ty) = (mix(a.tx, b.tx), mix(a.ty, b.ty));
        let norm = 1.0 / (tx * tx + ty * ty).sqrt();
        Station {
            x: curve(a.x, a.tx, b.x, b.tx),
            y: curve(a.y, a.ty, b.y, b.ty),
            z: mix(a.z, b.z),
            tx: tx * norm,
            ty: ty * norm,
            curvature: mix(a.curvature, b.curvature),
            slope: mix(a.slope, b.slope),
            crossfall: mix(a.crossfall, b.crossfall),
            width_m: mix(a.width_m, b.width_m),
        }
    }
}

/// Samples the B-spline of the control points about every metre; also returns the length of the lap, m.
fn stations_of(points: &[[f64; 5]]) -> (Vec<Station>, f64) {
    const PARTS: usize = 64;
    let n = points.len();
    // Values and first and second derivatives of the five coordinates at parameter u in [0, n).
    let spline = |u: f64| {
        let i = (u as usize).min(n - 1);
        let t = u - i as f64;
        let [a, b, c, d] = [0, 1, 2, 3].map(|k| points[(i + k) % n]);
        let blend = |w: [f64; 4]| -> [f64; 5] {
            std::array::from_fn(|k| w[0] * a[k] + w[1] * b[k] + w[2] * c[k] + w[3] * d[k])
        };
        let (t2, r) = (t * t, 1.0 - t);
        let value = blend([
            r * r * r / 6.0,
            (3.0 * t2 * t - 6.0 * t2 + 4.0) / 6.0,
            (3.0 * (t + t2 - t2 * t) + 1.0) / 6.0,
            t2 * t / 6.0,
        ]);
        let first = blend([-r * r / 2.0, (3.0 * t2 - 4.0 * t) / 2.0, (1.0 + 2.0 * t - 3.0 * t2) / 2.0, t2 / 2.0]);
        let second = blend([r, 3.0 * t - 2.0, 1.0 - 3.0 * t, t]);
        (value, first, second)
    };
    let mut arc = vec![0.0];
    let mut last = spline(0.0).0;
    for k in 1..=n * PARTS {
        let next = spline((k % (n * PARTS)) as f64 / PARTS as f64).0;
        let (dx, dy) = (next[0] - last[0], next[1] - last[1]);
        arc.push(arc[k - 1] + (dx * dx + dy * dy).sqrt());
        last = next;
    }
    let length = arc[n * PARTS];
    let count = (length.round() as usize).max(6);
    let mut stations = Vec::with_capacity(count);
    let mut k = 0;
    for i in 0..count {
        let target = length * i as f64 / count as f64;
        while arc[k + 1] < target {
            k += 1;
        }
        let u = (k as f64 + (target - arc[k]) / (arc[k + 1] - arc[k]).max(1e-12)) / PARTS as f64;
        let (p, d, dd) = spline(u);
        let speed = (d[0] * d[0] + d[1] * d[1]).sqrt().max(1e-9);
        stations.push(Station {
            x: p[0],
            y: p[1],
            z: p[2],
            tx: d[0] / speed,
            ty: d[1] / speed,
            curvature: (d[1] * dd[0] - d[0] * dd[1]) / (speed * speed * speed),
            slope: d[2] / speed,
            crossfall: tan(p[4].clamp(-45.0, 45.0).to_radians()),
            width_m: p[3],
        });
    }
    (stations, length)
}
