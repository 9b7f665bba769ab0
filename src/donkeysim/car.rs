//! The car that a client drives: our simulator with DonkeySim's telemetry.

use jpeg_encoder::{ColorType, Encoder};
use serde_json::{Value, json};

use crate::dataset::resize::{Interpolation, Resizer};
use crate::geometry::CarGeometry;
use crate::simulator::camera::front_camera::FrontCamera;
use crate::simulator::car::dynamics::{Controls, STEPS_PER_S};
use crate::simulator::{Simulation, Start, Track};
use crate::{Error, Result};

/// DonkeySim builds its scenes so many times as large as the world: its newer versions divide positions, speeds and
/// accelerations by this, and the cross-track error not.
const SCENE_SCALE: f64 = 8.0;

/// Pictures a second.
pub const FRAMES_PER_S: u64 = 20;

/// Way behind which the first crossing of the starting line is told, m.
const FIRST_CROSSING_M: f64 = 1.0;

/// Quality of the JPEG pictures.
const QUALITY: u8 = 90;

/// Height and width of the pictures unless the client asks for others.
const SIZE: [usize; 2] = [120, 160];

/// A car at the start of a track, and its camera.
pub struct DonkeyCar<'a> {
    track: &'a Track,
    simulation: Simulation<'a>,
    camera: FrontCamera<'a>,
    controls: Controls,
    size: [usize; 2],
    /// Frames since the scene was entered.
    frames: u64,
    /// Speed and direction a frame ago.
    before: Option<(f64, f64)>,
    /// Laps since the start, and whether the client knows that the first has begun.
    laps: Option<u64>,
}

impl<'a> DonkeyCar<'a> {
    /// A car that stands at the start, with the camera of `car` or the simulator's own. `seed` draws light and textures.
    pub fn new(track: &'a Track, seed: u64, car: Option<&CarGeometry>) -> DonkeyCar<'a> {
        DonkeyCar {
            track,
            simulation: at_start(track),
            camera: FrontCamera::of_car(track, seed, car),
            controls: Controls::default(),
            size: SIZE,
            frames: 0,
            before: None,
            laps: None,
        }
    }

    /// Puts the car back to the start, standing.
    pub fn reset(&mut self) {
        self.simulation = at_start(self.track);
        (self.controls, self.before, self.laps) = (Controls::default(), None, None);
    }

    /// Height and width of the pictures from now on.
    pub fn set_size(&mut self, height: Option<usize>, width: Option<usize>) {
        self.size = [height.unwrap_or(self.size[0]), width.unwrap_or(self.size[1])];
    }

    /// What holds until the next control; the brake takes from the throttle.
    pub fn control(&mut self, steering: f64, throttle: f64, brake: f64) {
        self.controls = Controls { steering, throttle: if brake > 0.0 { -brake } else { throttle } };
    }

    /// Drives to the next picture, and gives the messages to send: the telemetry, and before it a crossing of the starting line.
    ///
    /// # Errors
    ///
    /// If the picture cannot be encoded.
    pub fn frame(&mut self) -> Result<Vec<Value>> {
        let steps_by = |frame: u64| frame * STEPS_PER_S / FRAMES_PER_S;
        let steps = steps_by(self.frames + 1) - steps_by(self.frames);
        self.frames += 1;
        for _ in 0..steps {
            self.simulation.step(self.controls);
        }
        let mut messages = Vec::new();
        let laps = (self.simulation.progress_m / self.track.length_m).floor().max(0.0) as u64;
        // A car that was put back has not crossed the line before it moves.
        let moves = self.simulation.progress_m >= FIRST_CROSSING_M;
        if moves && self.laps.is_none_or(|known| laps > known) {
            self.laps = Some(laps);
            messages.push(json!({
                "msg_type": "collision_with_starting_line",
                "starting_line_index": 0,
                "timeStamp": self.time_s(),
            }));
        }
        messages.push(self.telemetry()?);
        Ok(messages)
    }

    fn time_s(&self) -> f64 {
        self.frames as f64 / FRAMES_PER_S as f64
    }

    fn telemetry(&mut self) -> Result<Value> {
        let image = self.picture()?;
        let simulation = &self.simulation;
        let car = &simulation.car;
        let yaw_rad = car.hx.atan2(car.hy);
        let (speed_before, yaw_before) =
            self.before.replace((car.speed_mps, yaw_rad)).unwrap_or((car.speed_mps, yaw_rad));
        let per_s = FRAMES_PER_S as f64;
        let turn =
            (yaw_rad - yaw_before + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
        let yaw_rate = turn * per_s;
        let pos = |meters: f64| meters / SCENE_SCALE;
        Ok(json!({
            "msg_type": "telemetry",
            "steering_angle": self.controls.steering,
            "throttle": self.controls.throttle,
            "speed": pos(car.speed_mps.abs()),
            "image": image,
            "hit": if simulation.at_wall { "wall" } else { "none" },
            "time": self.time_s(),
            "accel_x": pos(car.speed_mps * yaw_rate),
            "accel_y": 0.0,
            "accel_z": pos((car.speed_mps - speed_before) * per_s),
            "gyro_x": 0.0,
            "gyro_y": yaw_rate,
            "gyro_z": 0.0,
            "pitch": 0.0,
            "yaw": yaw_rad.to_degrees().rem_euclid(360.0),
            "roll": 0.0,
            "activeNode": simulation.location.station,
            "totalNodes": self.track.stations.len(),
            "cte": simulation.cte_m(),
            "pos_x": pos(car.x),
            "pos_y": pos(self.track.stations[simulation.location.station].z),
            "pos_z": pos(car.y),
            "vel_x": pos(car.speed_mps * car.hx),
            "vel_y": 0.0,
            "vel_z": pos(car.speed_mps * car.hy),
        }))
    }

    /// The middle of what the camera sees, in the shape that is asked for, as JPEG in Base64.
    fn picture(&mut self) -> Result<String> {
        let frame = self.camera.frame(&self.simulation);
        let [height, width] = self.size;
        // The largest part of what the camera sees with that shape; even numbers are cut off, so that the middle stays.
        let [high, wide] = frame.size;
        let rows = high.min(wide * height / width).max(1);
        let columns = wide.min(high * width / height).max(1);
        let (rows, columns) = (rows + (high - rows) % 2, columns + (wide - columns) % 2);
        let (top, left) = ((high - rows) / 2, (wide - columns) / 2);
        let row = |y: usize| &frame.pixels[(y * wide + left) * 3..(y * wide + left + columns) * 3];
        let part: Vec<u8> = (top..top + rows).flat_map(|y| row(y).iter().copied()).collect();
        let mut pixels = vec![0; height * width * 3];
        Resizer::new([rows, columns], [height, width], 3, Interpolation::Area).apply(&part, &mut pixels);
        let mut bytes = Vec::new();
        Encoder::new(&mut bytes, QUALITY)
            .encode(&pixels, width as u16, height as u16, ColorType::Rgb)
            .map_err(|e| Error::Codec(format!("a picture could not be encoded as JPEG: {e}")))?;
        Ok(data_encoding::BASE64.encode(&bytes))
    }

    /// Place and direction of a node of the line; numbers beyond the last begin again.
    pub fn node(&self, index: usize) -> Value {
        let index = index % self.track.stations.len();
        let station = &self.track.stations[index];
        let half_yaw = station.tx.atan2(station.ty) / 2.0;
        let [x, y, z] = [station.x, station.z, station.y].map(|meters| meters / SCENE_SCALE);
        json!({
            "msg_type": "node_position", "index": index, "pos_x": x, "pos_y": y, "pos_z": z,
            "Qx": 0.0, "Qy": half_yaw.sin(), "Qz": 0.0, "Qw": half_yaw.cos(),
        })
    }
}

fn at_start(track: &Track) -> Simulation<'_> {
    Simulation::new(track, Start { s_m: 0.0, reverse: false, offset_m: 0.0, heading_deg: 0.0 }, 0.0)
}
