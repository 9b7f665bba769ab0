//! What the label of a row is, and the steering of a car that stands beside the driven path.

use super::augment::Augmentation;
use super::label_spec::{LabelKind, LabelSpec};
use super::outputs::Outputs;
use super::spec::{Correction, Item, Mirror, SampleSpec};
use crate::Result;
use crate::dataset::driven::DrivenSessions;
use crate::dataset::recording::{Recording, View};
use crate::geometry::{CarGeometry, Offset, Pose};

/// The labels of the rows of some recordings, and what they become for a car beside the driven path.
#[derive(Debug)]
pub struct Targets {
    recordings: Vec<OfRecording>,
    notices: Vec<String>,
    /// Number of outputs beside the steering.
    beside_steering: usize,
    /// Whether rows have no label because their recording lacks one beside the steering.
    unrecorded: bool,
}

#[derive(Debug)]
struct OfRecording {
    /// Label of each row; NaN for rows that have none.
    labels: Vec<f32>,
    /// Camera and car, and what each row aims at; only where something asks for geometry.
    geometry: Option<(CarGeometry, Vec<Aim>)>,
    /// Labels beside the steering, `[rows][outputs − 1]`.
    beside_steering: Vec<f32>,
}

impl OfRecording {
    /// With the steering alone.
    fn of(labels: Vec<f32>, geometry: Option<(CarGeometry, Vec<Aim>)>) -> OfRecording {
        OfRecording { labels, geometry, beside_steering: Vec::new() }
    }
}

/// The point that a driver aims at, seen from where the car is.
#[derive(Debug, Clone, Copy)]
struct Aim {
    right_m: f32,
    ahead_m: f32,
    /// Way to it along the path.
    look_ahead_m: f32,
}

impl Aim {
    /// Steering of a car at `offset` from the row's own place.
    fn steering(self, car: &CarGeometry, offset: Offset) -> f64 {
        let (dx, dz) = (f64::from(self.right_m) - offset.right_m, f64::from(self.ahead_m) - offset.ahead_m);
        let (sin, cos) = (libm::sin(offset.turn), libm::cos(offset.turn));
        car.steering_towards(dx * cos - dz * sin, dx * sin + dz * cos, f64::from(self.look_ahead_m))
    }
}

impl Targets {
    /// The labels of `recordings` by `spec`, with the geometry that `samples` and `augmentation` ask for.
    pub fn of(
        recordings: &[Recording],
        spec: &LabelSpec,
        samples: &SampleSpec,
        augmentation: &Augmentation,
    ) -> Targets {
        let geometry = spec.kind == LabelKind::Path
            || samples.side_cameras == Some(Correction::Geometry)
            || samples.mirror == Mirror::Geometry
            || augmentation.view.is_some()
            || augmentation.shift_steering_per_px == Some(Correction::Geometry);
        let mut targets =
            Targets { recordings: Vec::new(), notices: Vec::new(), beside_steering: 0, unrecorded: false };
        recordings.iter().for_each(|recording| targets.add(recording, spec, geometry));
        targets
    }

    /// The same with `more` behind them, drives whose labels are made as those of the first.
    pub fn with_drives(mut self, more: &[Recording], spec: &LabelSpec) -> Targets {
        let geometry = self.recordings.iter().any(|recording| recording.geometry.is_some());
        more.iter().for_each(|recording| self.add(recording, spec, geometry));
        self
    }

    fn add(&mut self, recording: &Recording, spec: &LabelSpec, geometry: bool) {
        if geometry {
            self.add_driven(recording, spec);
        } else {
            self.recordings.push(OfRecording::of(steering(recording), None));
        }
        if let Some(of) = self.recordings.last_mut().filter(|_| spec.shift_s > 0.0) {
            of.labels = later(recording, &of.labels, spec.shift_s);
        }
    }

    /// The same with `views` behind them, single pictures each with the steering that leads back to a path: that is the label, whatever
    /// the recipe says, and the car is taken to go on as it is steered. `spec` says how far ahead it aims.
    pub fn with_views(mut self, views: &[Recording], spec: &LabelSpec) -> Targets {
        let geometry = self.recordings.iter().any(|recording| recording.geometry.is_some());
        for recording in views {
            let car = &recording.geometry;
            let driven = DrivenSessions::of(recording, car.clone());
            let look_ahead = spec.look_ahead(car);
            let speeds_mps = driven.sessions.iter().flat_map(|session| &session.speed_mps);
            let aims = speeds_mps.zip(&recording.rows).map(|(&speed_mps, row)| {
                let look_ahead_m = look_ahead.distance_m(speed_mps);
                let there = Pose::default().moved(look_ahead_m, car.curvature(f64::from(row.steering)));
                let to = Pose::default().offset_to(there);
                Aim { right_m: to.right_m as f32, ahead_m: to.ahead_m as f32, look_ahead_m: look_ahead_m as f32 }
            });
            let geometry = geometry.then(|| (car.clone(), aims.collect()));
            self.recordings.push(OfRecording::of(steering(recording), geometry));
        }
        self
    }

    /// The same with the labels of all `outputs` for `recordings`, those that it was made of. What moves the steering leaves the others
    /// as they are: they belong to the row, from wherever it is seen and whether it is mirrored or not. A row that lacks one of them
    /// has no label at all. `spec` says how much later all labels are.
    ///
    /// # Errors
    /// [`Error::Data`](crate::Error::Data) with place and remedy for recordings without what an output learns from.
    pub fn with_outputs<'a>(
        mut self,
        recordings: impl IntoIterator<Item = &'a Recording>,
        outputs: &Outputs,
        spec: &LabelSpec,
    ) -> Result<Targets> {
        self.beside_steering = outputs.count() - 1;
        if self.beside_steering == 0 {
            return Ok(self);
        }
        for (of, recording) in self.recordings.iter_mut().zip(recordings) {
            of.beside_steering = outputs.labels_beside_steering(recording, spec.shift_s, &mut self.notices)?;
            for (label, others) in of.labels.iter_mut().zip(of.beside_steering.chunks_exact(self.beside_steering)) {
                if !label.is_nan() && others.iter().any(|other| other.is_nan()) {
                    *label = f32::NAN;
                    self.unrecorded = true;
                }
            }
        }
        Ok(self)
    }

    /// Number of labels of a row.
    pub fn outputs(&self) -> usize {
        1 + self.beside_steering
    }

    /// Whether rows have no label because their recording lacks one beside the steering.
    pub fn unrecorded(&self) -> bool {
        self.unrecorded
    }

    /// The labels of a row beside its steering, in the order of the outputs.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn labels_beside_steering(&self, item: Item) -> &[f32] {
        let of = &self.recordings[usize::from(item.recording)].beside_steering;
        let row = item.row as usize * self.beside_steering;
        if self.beside_steering == 0 { &[] } else { &of[row..row + self.beside_steering] }
    }

    /// The recorded steering of `recordings`, for samples that need no geometry.
    pub fn wheel(recordings: &[Recording]) -> Targets {
        Targets::of(recordings, &LabelSpec::default(), &SampleSpec::default(), &Augmentation::default())
    }

    fn add_driven(&mut self, recording: &Recording, spec: &LabelSpec) {
        let car = &recording.geometry;
        let driven = DrivenSessions::of(recording, car.clone());
        let look_ahead = spec.look_ahead(car);
        let mut aims = Vec::with_capacity(recording.rows.len());
        for session in &driven.sessions {
            for (row, &speed_mps) in session.speed_mps.iter().enumerate() {
                let look_ahead_m = look_ahead.distance_m(speed_mps);
                let here = session.path.poses()[row];
                // Where the path ends the car is taken to go on as it is steered.
                let there = session.path.pose_at(session.path.along_m(row) + look_ahead_m).unwrap_or_else(|| {
                    let steering = f64::from(recording.rows[session.rows.start + row].steering);
                    here.moved(look_ahead_m, car.curvature(steering))
                });
                let to = here.offset_to(there);
                aims.push(Aim {
                    right_m: to.right_m as f32,
                    ahead_m: to.ahead_m as f32,
                    look_ahead_m: look_ahead_m as f32,
                });
            }
        }
        let labels = match spec.kind {
            LabelKind::Wheel => steering(recording),
            LabelKind::Path => {
                driven.path_labels(look_ahead).into_iter().map(|label| label.unwrap_or(f32::NAN)).collect()
            }
        };
        self.notices.extend(recording.camera_notice());
        if let Some(mps) = driven.assumed_speed_mps {
            self.notices.push(format!("{}: no speed was recorded; {mps:.1} m/s is assumed", recording.path.display()));
        }
        self.recordings.push(OfRecording::of(labels, Some((car.clone(), aims))));
    }

    /// What the user should know: camera presets and speeds that were assumed.
    pub fn notices(&self) -> &[String] {
        &self.notices
    }

    /// The label of a row; `None` where the driven path does not say it: the car stands, or its session ends.
    ///
    /// # Panics
    /// If there is no such row.
    pub fn label(&self, item: Item) -> Option<f32> {
        let label = self.recordings[usize::from(item.recording)].labels[item.row as usize];
        (!label.is_nan()).then_some(label)
    }

    /// Camera and car of a row, if something asks for geometry.
    pub fn geometry(&self, item: Item) -> Option<&CarGeometry> {
        self.recordings[usize::from(item.recording)].geometry.as_ref().map(|(car, _)| car)
    }

    /// The label of a car at `offset` from where it was at a row: that of the row, and by how much more the steering towards the path
    /// turns there than from the row's own place. The label of the row itself if nothing asks for geometry.
    ///
    /// # Panics
    /// If there is no such row, or the row has no label.
    pub fn beside(&self, item: Item, offset: Offset) -> f32 {
        let label = self.label(item).expect("rows without a label are on no side of a split");
        match &self.recordings[usize::from(item.recording)].geometry {
            Some((car, aims)) if offset != Offset::default() => {
                let aim = aims[item.row as usize];
                (f64::from(label) + aim.steering(car, offset) - aim.steering(car, Offset::default())) as f32
            }
            _ => label,
        }
    }

    /// How far `camera` is to the right of the centre camera, m.
    pub(super) fn camera_right_m(&self, item: Item, camera: View) -> f64 {
        let [left_m, right_m] = self.geometry(item).map_or([0.0, 0.0], |car| car.side_offsets_m);
        [0.0, left_m, right_m][camera as usize]
    }

    /// Hands `hash` the bits of what the samples of a row depend on beside `steering`, the recorded one: nothing where labels are the
    /// recorded steering and nothing asks for geometry.
    pub fn hash(&self, item: Item, steering: f32, hash: &mut impl FnMut(u32)) {
        let recording = &self.recordings[usize::from(item.recording)];
        let label = recording.labels[item.row as usize];
        if label.to_bits() != steering.to_bits() {
            hash(label.to_bits());
        }
        if let Some((_, aims)) = &recording.geometry {
            let Aim { right_m, ahead_m, look_ahead_m } = aims[item.row as usize];
            [right_m, ahead_m, look_ahead_m].into_iter().for_each(|m| hash(m.to_bits()));
        }
        self.labels_beside_steering(item).iter().for_each(|label| hash(label.to_bits()));
    }

    /// The geometry of all recordings in words, for a hash; nothing where none is asked for.
    pub fn geometry_text(&self) -> String {
        let cars = self.recordings.iter().filter_map(|recording| recording.geometry.as_ref());
        cars.map(|(car, _)| format!("{car:?}\n")).collect()
    }
}

/// The pose of a car whose picture was moved to the right by the angle `angle` (rad), as if its camera had turned to the left where it
/// is: the rear axle swings to the right.
pub(super) fn turn_of_camera(car: &CarGeometry, angle: f64) -> Offset {
    let (sin, cos) = (libm::sin(angle), libm::cos(angle));
    Offset { right_m: car.ahead_m * sin, ahead_m: car.ahead_m * (1.0 - cos), turn: -angle }
}

/// `then` seen from `first`, seen from the origin.
pub(super) fn chained(first: Offset, then: Offset) -> Offset {
    Pose::default().offset_to(Pose::default().displaced(first).displaced(then))
}

/// The labels `shift_s` later in the session of each row, between rows by linear interpolation; NaN beyond its end.
pub(super) fn later(recording: &Recording, labels: &[f32], shift_s: f64) -> Vec<f32> {
    let mut shifted = vec![f32::NAN; labels.len()];
    for session in &recording.sessions {
        let time_ms = |row: usize| recording.rows[row].time_ms as f64;
        let mut after = session.start;
        for row in session.clone() {
            let wanted_ms = time_ms(row) + 1000.0 * shift_s;
            // Also where the shift is lost in rounding.
            after = after.max(row + 1);
            while after < session.end && time_ms(after) < wanted_ms {
                after += 1;
            }
            if after >= session.end {
                break;
            }
            let (from_ms, to_ms) = (time_ms(after - 1), time_ms(after));
            let share = (wanted_ms - from_ms) / (to_ms - from_ms);
            let (from, to) = (f64::from(labels[after - 1]), f64::from(labels[after]));
            shifted[row] = if share == 1.0 { labels[after] } else { (from + share * (to - from)) as f32 };
        }
    }
    shifted
}

fn steering(recording: &Recording) -> Vec<f32> {
    recording.rows.iter().map(|row| row.steering).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::testing::recording_of;

    fn item(row: u32) -> Item {
        Item::new(0, row, [View::Centre])
    }

    fn geometric() -> SampleSpec {
        SampleSpec { side_cameras: Some(Correction::Geometry), ..SampleSpec::default() }
    }

    fn path() -> LabelSpec {
        LabelSpec { kind: LabelKind::Path, ..LabelSpec::default() }
    }

    #[test]
    fn views_keep_their_labels_and_lead_back_from_beside() {
        let driven = [recording_of(&[0.2; 40], 100)];
        let views = [recording_of(&[0.3, -0.4], 200)];
        let targets = Targets::of(&driven, &path(), &geometric(), &Augmentation::default()).with_views(&views, &path());
        let view = |row| Item::new(1, row, [View::Centre]);
        assert_eq!([0, 1].map(|row| targets.label(view(row))), [Some(0.3), Some(-0.4)]);
        // Further to the right it steers more to the left, from wherever it was.
        let right = Offset { right_m: 0.5, ..Offset::default() };
        assert!([0, 1].iter().all(|&row| targets.beside(view(row), right) < targets.label(view(row)).unwrap() - 0.05));
        assert_eq!(Targets::wheel(&driven).with_views(&views, &path()).label(view(1)), Some(-0.4));
    }

    #[test]
    fn labels_of_the_path_are_pursuit() {
        // Straight on for 2 s, then a bend; 20 mph are 8.9408 m/s, so the aim of 0.7 s is 6.2586 m ahead.
        let steering: Vec<f32> = (0..60).map(|row| if row < 20 { 0.0 } else { 0.5 }).collect();
        let recordings = [recording_of(&steering, 100)];
        let targets = Targets::of(&recordings, &path(), &SampleSpec::default(), &Augmentation::default());
        assert_eq!(targets.label(item(5)), Some(0.0));
        // On the circle the chord of the arc is steered at, which is a little shorter than the arc.
        let label = targets.label(item(40)).unwrap();
        assert!((label - 0.5).abs() < 0.01, "{label}");
        // Row 15 sees the bend ahead, at half a row before row 20: it turns in earlier than the wheel did.
        let before = targets.label(item(15)).unwrap();
        assert!((0.01..0.1).contains(&before), "{before}");
        assert_eq!(targets.label(item(58)), None, "its session ends");
        let wheel = Targets::wheel(&recordings);
        assert_eq!((wheel.label(item(15)), wheel.label(item(58))), (Some(0.0), Some(0.5)));
        assert_eq!(wheel.beside(item(3), Offset { right_m: 1.0, ..Offset::default() }), 0.0);
        assert!(targets.notices()[0].contains("`udacity` is assumed") && wheel.notices().is_empty());
    }

    #[test]
    fn shifted_labels_are_those_of_later_and_stay_in_their_session() {
        // Two sessions at 10 Hz.
        let mut recordings = [recording_of(&[0.0, 0.1, 0.3, 0.7, -0.5, -0.4, -0.2], 100)];
        recordings[0].sessions = vec![0..4, 4..7];
        let shifted = |shift_s| {
            let spec = LabelSpec { shift_s, ..LabelSpec::default() };
            let targets = Targets::of(&recordings, &spec, &SampleSpec::default(), &Augmentation::default());
            (0..7).map(|row| targets.label(item(row))).collect::<Vec<_>>()
        };
        let now = [0.0, 0.1, 0.3, 0.7, -0.5, -0.4, -0.2].map(Some);
        assert_eq!(shifted(0.0), now);
        assert_eq!(shifted(0.1), [Some(0.1), Some(0.3), Some(0.7), None, Some(-0.4), Some(-0.2), None]);
        let between = shifted(0.15);
        for (label, expected) in between.iter().zip([Some(0.2), Some(0.5), None, None, Some(-0.3), None, None]) {
            assert_eq!(label.is_some(), expected.is_some(), "{between:?}");
            assert!((label.unwrap_or(0.0) - expected.unwrap_or(0.0)).abs() < 1e-6, "{between:?}");
        }
        assert!(
            LabelSpec { shift_s: -0.1, ..LabelSpec::default() }.validate().unwrap_err().to_string().contains("shift_s")
        );
    }

    #[test]
    fn beside_the_path_the_label_leads_back() {
        let mut recordings = [recording_of(&[0.0; 60], 100)];
        recordings[0].rows.iter_mut().for_each(|row| row.speed_mph = 10.0 / 0.447_04);
        let targets = Targets::of(&recordings, &LabelSpec::default(), &geometric(), &Augmentation::default());
        // 10 m/s: 7 m ahead. From 0.8 m to the right: 2 * -0.8 / (49 + 0.64) 1/m, times 2.87 m, is atan 5.2851 deg of 25.
        let aside = |right_m, turn| targets.beside(item(10), Offset { right_m, ahead_m: 0.0, turn });
        assert!((aside(0.8, 0.0) + 0.211_40).abs() < 1e-4, "{}", aside(0.8, 0.0));
        assert_eq!(aside(-0.8, 0.0), -aside(0.8, 0.0));
        // Turned by 0.1 rad to the right, the aim is 7 sin(0.1) to the left: atan(2 * 0.69883 / 49 * 2.87) = 4.6806 deg.
        assert!((aside(0.0, 0.1) + 0.187_22).abs() < 1e-4, "{}", aside(0.0, 0.1));
        // Where the path ends the car would have gone straight on.
        let end = targets.beside(item(59), Offset { right_m: 0.8, ..Offset::default() });
        assert!((end - aside(0.8, 0.0)).abs() < 1e-6, "{end}");
    }

    #[test]
    fn side_cameras_and_shifts_follow_from_the_mount() {
        let mut recordings = [recording_of(&[0.1; 60], 100)];
        recordings[0].rows.iter_mut().for_each(|row| row.speed_mph = 10.0 / 0.447_04);
        recordings[0].geometry = CarGeometry { side_offsets_m: [-0.8, 0.8], ..recordings[0].geometry.clone() };
        let targets = Targets::of(&recordings, &LabelSpec::default(), &geometric(), &Augmentation::default());
        let [centre, left, right] = View::ALL.map(|camera| geometric().label(&targets, item(10), camera));
        assert_eq!(centre, 0.1);
        assert!((left - 0.1 - 0.211).abs() < 0.01 && (0.1 - right - 0.211).abs() < 0.01, "{left} {right}");
        // A picture that moved to the right by one pixel: the aim 7 m ahead of the axle, 4.4 m ahead of the camera, lies
        // 4.4 m / 138.56 = 31.8 mm to the right: 2 * 0.0318 / 49 * 2.87 rad of 25 deg.
        let moved = targets.beside(item(10), turn_of_camera(&recordings[0].geometry, 1.0 / 138.564)) - 0.1;
        assert!((moved - 0.0085).abs() < 2e-4, "{moved}");
    }

    #[test]
    fn offsets_are_chained_and_wrong_entries_are_named() {
        let first = Offset { right_m: 1.0, ahead_m: 0.0, turn: std::f64::consts::FRAC_PI_2 };
        let both = chained(first, Offset { right_m: 0.0, ahead_m: 2.0, turn: 0.1 });
        assert!((both.right_m - 3.0).abs() < 1e-12 && both.ahead_m.abs() < 1e-12);
        assert!((both.turn - std::f64::consts::FRAC_PI_2 - 0.1).abs() < 1e-12);
        for (text, named) in [("look_ahead_s = -1", "look_ahead_s"), ("min_wheelbases = nan", "min_wheelbases")] {
            let error = toml::from_str::<LabelSpec>(text).unwrap().validate().unwrap_err().to_string();
            assert!(error.contains(named), "{error}");
        }
        assert!(toml::from_str::<LabelSpec>("kind = 'line'").is_err());
        assert!(toml::from_str::<LabelSpec>("kind = 'path'\nseconds = 1").is_err());
    }
}
