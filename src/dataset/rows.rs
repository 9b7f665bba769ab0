//! Collecting the rows that a format reads: their pictures are looked for, their labels become shares of full lock, and what
//! cannot be used is counted.

use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::description::{DESCRIPTION_FILE, Description, Unit};
use super::formats::Format;
use super::pictures::files::{Files, Locator};
use super::recording::{Recording, Row, View, usual_preset};
use super::store::Store;
use super::unusable::{Reason, Unusable};
use crate::geometry::GeometryEntry;
use crate::picture::decode;
use crate::text::escaped;
use crate::{Error, Result};

/// Rows whose pictures are looked at together; so much of a log is held as text.
const CHUNK: usize = 4096;
/// Labels may exceed full lock by this much, for rounding.
const LABEL_SLACK: f64 = 1e-3;
/// Rows whose side pictures are compared with that of the centre.
const COMPARED: usize = 12;
/// Kinds of suspicious labels that are kept to find their unit.
const MAX_BEYOND: usize = 100_000;

/// What becomes of the rows that a person has left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LeftOut {
    /// They are dropped and counted.
    Drop,
    /// They stay and say so: [`Row::excluded`]. For a person who looks through the recording.
    Keep,
}

/// Whether the pictures of a recording are looked at while it is read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ImageCheck {
    /// Each picture must exist, begin as a JPEG or PNG and end as one; it is decoded where its end is unusual. This costs some
    /// microseconds a picture.
    Verify,
    /// Rows are believed; for logs whose pictures are elsewhere.
    Skip,
}

/// A row as a format reads it, before its pictures are looked for.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Entry {
    /// Line of the log, from 1.
    pub line: u32,
    /// What it is named by where a person leaves it out: the line of a log, the number of a tub's record.
    pub number: u32,
    /// Whether the recording itself marks it as left out by a person.
    pub excluded: bool,
    /// Paths as written: centre, left, right.
    pub images: [Option<String>; 3],
    /// The label, in the unit of the recording.
    pub steering: f64,
    /// NaN where it was not recorded; so are brake and speed.
    pub throttle: f32,
    pub brake: f32,
    pub speed_mph: f32,
    /// Whether a person took the wheel from a model that drove.
    pub taken_over: bool,
    /// Time, where the row has one.
    pub time_ms: Option<i64>,
    /// Folder or session it was written in: rows of another one belong to another drive.
    pub source: String,
    /// Stretches before it that were left out by a person: rows before and after one belong to different drives.
    pub cuts: u32,
}

/// Of rows that cannot be named where a person leaves rows out.
pub(crate) const NO_NUMBER: u32 = u32::MAX;

impl Entry {
    /// Of `line`, which is its number, too; with nothing recorded.
    pub fn at(line: u32) -> Entry {
        Entry {
            line,
            number: line,
            excluded: false,
            cuts: 0,
            images: [const { None }; 3],
            steering: f64::NAN,
            throttle: f32::NAN,
            brake: f32::NAN,
            speed_mph: f32::NAN,
            taken_over: false,
            time_ms: None,
            source: String::new(),
        }
    }
}

/// Where each camera's picture is, or what is wrong with it.
type Found = [Option<Result<(PathBuf, String), (Reason, String)>>; 3];

/// Collects the rows of a recording.
pub(crate) struct Rows<'a> {
    said: &'a Description,
    /// What becomes of the rows that a person has left out.
    left_out: LeftOut,
    /// Rows that a person has left out.
    excluded: usize,
    /// Whether a row was driven by no person who took over, left out or not.
    driven_on: bool,
    /// Whether the last row was one of them.
    cut: bool,
    /// Stretches that a person has left out so far.
    cuts: u32,
    locator: Locator<'a>,
    check: ImageCheck,
    unit: Unit,
    /// What rows count as where there are no plausible times.
    assumed_hz: f64,
    /// The file that is read, for messages.
    place: Arc<str>,
    pending: Vec<(Entry, Arc<str>)>,
    sources: BTreeMap<(u32, String), u16>,
    rows: Vec<Row>,
    files: Files,
    unusable: Unusable,
    notices: Vec<String>,
    /// Pictures of the left and right camera that cannot be used.
    bad_sides: [Unusable; 2],
    /// Rows whose side picture is that of the centre.
    same_sides: [usize; 2],
    /// Labels that are no shares of full lock, where no unit was named; and the line of the first.
    beyond: Vec<f64>,
    beyond_line: String,
    /// Labels beyond full lock after they were turned into shares of it.
    clamped: usize,
}

impl<'a> Rows<'a> {
    /// For a recording in `format`, whose top folder is `top` and whose pictures are looked for from `base` on.
    pub fn new(
        store: &'a Store,
        top: &Path,
        base: &Path,
        format: &Format,
        said: &'a Description,
        (check, left_out): (ImageCheck, LeftOut),
    ) -> Result<Self> {
        Ok(Self {
            said,
            left_out,
            excluded: 0,
            driven_on: false,
            cut: false,
            cuts: 0,
            locator: Locator::new(store, top, base)?,
            check,
            unit: said.unit.unwrap_or(format.unit),
            assumed_hz: format.hz,
            place: "".into(),
            pending: Vec::new(),
            sources: BTreeMap::new(),
            rows: Vec::new(),
            files: Files::default(),
            unusable: Unusable::default(),
            notices: Vec::new(),
            bad_sides: Default::default(),
            same_sides: [0; 2],
            beyond: Vec::new(),
            beyond_line: String::new(),
            clamped: 0,
        })
    }

    /// What the user says about the recording.
    pub fn said(&self) -> &'a Description {
        self.said
    }

    /// A row that a person has left out: whether it stays. If not, the rows before and after it belong to different sessions.
    pub fn keeps_excluded(&mut self) -> bool {
        let keeps = self.left_out == LeftOut::Keep;
        self.cut |= !keeps;
        keeps
    }

    /// Names the file that is read from now on.
    pub fn read_from(&mut self, place: &str) {
        self.place = place.into();
    }

    /// The unit of the labels, unless the user has named one.
    pub fn set_unit(&mut self, unit: Unit) {
        self.unit = self.said.unit.unwrap_or(unit);
    }

    /// Something the user should know.
    pub fn notice(&mut self, text: String) {
        self.notices.push(text);
    }

    /// Counts a row that cannot be used.
    pub fn unusable(&mut self, line: u32, reason: Reason, detail: &str) {
        let place = &self.place;
        self.unusable.add(reason, || format!("{}:{line}: {}", escaped(place), escaped(detail)));
    }

    /// Takes a row.
    pub fn push(&mut self, mut entry: Entry) -> Result<()> {
        let named = |range: &[u32; 2]| (range[0]..=range[1]).contains(&entry.number);
        entry.excluded |= self.said.exclude.iter().any(named);
        self.driven_on |= !entry.taken_over;
        if entry.excluded && !self.keeps_excluded() {
            self.excluded += 1;
            return Ok(());
        }
        self.cuts += u32::from(std::mem::take(&mut self.cut));
        entry.cuts = self.cuts;
        if !entry.steering.is_finite() {
            self.unusable(entry.line, Reason::LabelOutOfRange, &format!("steering {} is no number", entry.steering));
            return Ok(());
        }
        if self.unit == Unit::Lock {
            if entry.steering.abs() > 1.0 + LABEL_SLACK {
                if self.beyond.is_empty() {
                    self.beyond_line = format!("{}:{}", escaped(&self.place), entry.line);
                }
                if self.beyond.len() < MAX_BEYOND {
                    self.beyond.push(entry.steering);
                }
                let detail = format!("steering {} is not in [-1, 1]", entry.steering);
                self.unusable(entry.line, Reason::LabelOutOfRange, &detail);
                return Ok(());
            }
        } else {
            let full_lock_deg = self.said.full_lock_deg.unwrap_or(self.unit.full_lock_deg());
            entry.steering = self.unit.to_lock(entry.steering, full_lock_deg);
            self.clamped += usize::from(entry.steering.abs() > 1.0 + LABEL_SLACK);
        }
        self.pending.push((entry, self.place.clone()));
        if self.pending.len() >= CHUNK { self.look_at_images() } else { Ok(()) }
    }

    /// Finds the pictures of the pending rows, on all threads, and keeps the rows that can be used.
    fn look_at_images(&mut self) -> Result<()> {
        let (locator, check) = (&self.locator, self.check);
        let find = |written: &String| match check {
            ImageCheck::Verify => locator.check(written),
            ImageCheck::Skip => Ok(locator.assume(written)),
        };
        let found: Vec<Found> =
            self.pending.par_iter().map(|(row, _)| row.images.each_ref().map(|i| i.as_ref().map(find))).collect();
        for ((row, place), found) in std::mem::take(&mut self.pending).into_iter().zip(found) {
            self.keep(row, &place, found)?;
        }
        Ok(())
    }

    fn keep(&mut self, row: Entry, place: &str, mut found: Found) -> Result<()> {
        let fault = match &found[0] {
            Some(Ok(_)) => None,
            Some(Err((reason, detail))) => Some((*reason, detail.as_str())),
            None => Some((Reason::TooFewFields, "no picture of the centre camera")),
        };
        let at = |detail: &str| format!("{}:{}: {}", escaped(place), row.line, escaped(detail));
        if let Some((reason, detail)) = fault {
            self.unusable.add(reason, || at(detail));
            return Ok(());
        }
        for side in 0..2 {
            if let Some(Err((reason, detail))) = &found[side + 1] {
                self.bad_sides[side].add(*reason, || at(detail));
            }
            if found[side + 1].is_some() && found[side + 1] == found[0] {
                self.same_sides[side] += 1;
                found[side + 1] = None;
            }
        }
        let images = found.each_ref().map(|image| match image {
            Some(Ok((folder, file))) => Some((folder.as_path(), file.as_str())),
            _ => None,
        });
        let top = self.locator.top().to_path_buf();
        let images = self.files.add(images).map_err(|message| Error::data(&top, message))?;
        let next = self.sources.len();
        let drive = (row.cuts, row.source);
        let source = match self.sources.get(&drive) {
            Some(&number) => number,
            None => {
                let number = u16::try_from(next)
                    .map_err(|_| Error::data(&top, "the rows lie in more than 65,535 folders or stretches"))?;
                self.sources.insert(drive, number);
                number
            }
        };
        self.rows.push(Row {
            steering: row.steering.clamp(-1.0, 1.0) as f32,
            throttle: row.throttle,
            brake: row.brake,
            speed_mph: row.speed_mph,
            taken_over: row.taken_over,
            excluded: row.excluded,
            number: row.number,
            time_ms: row.time_ms.unwrap_or(i64::MIN),
            line: row.line,
            source,
            images,
        });
        Ok(())
    }

    /// All that was collected.
    pub fn collect(mut self) -> Result<Collected> {
        self.look_at_images()?;
        let trouble = (self.said.unit.is_none() && !self.beyond.is_empty())
            .then(|| unit_trouble(&self.rows, &mut self.beyond, &self.beyond_line));
        if self.clamped > 0 {
            self.notices.push(format!("{} labels beyond full lock count as full lock", self.clamped));
        }
        if self.excluded > 0 {
            self.notices.push(format!("{} rows are left out by `exclude` in {DESCRIPTION_FILE}", self.excluded));
        } else if !self.said.exclude.is_empty() && self.left_out == LeftOut::Drop {
            self.notices.push(format!("`exclude` in {DESCRIPTION_FILE} names no row of the recording"));
        }
        Ok(Collected {
            check: self.check,
            hz: self.said.hz,
            camera: self.said.camera.clone(),
            assumed_hz: self.assumed_hz,
            all_taken_over: !self.driven_on,
            rows: self.rows,
            files: self.files,
            unusable: self.unusable,
            notices: self.notices,
            unit_trouble: trouble,
            bad_sides: self.bad_sides,
            same_sides: self.same_sides,
        })
    }
}

/// The rows of a recording, and what was found out about them.
pub(crate) struct Collected {
    check: ImageCheck,
    hz: Option<f64>,
    camera: Option<GeometryEntry>,
    assumed_hz: f64,
    /// Whether a person took over in all rows, also in those that were left out.
    all_taken_over: bool,
    rows: Vec<Row>,
    files: Files,
    unusable: Unusable,
    notices: Vec<String>,
    unit_trouble: Option<String>,
    bad_sides: [Unusable; 2],
    same_sides: [usize; 2],
}

impl Collected {
    /// The recording at `path`, whose files lie in `store`.
    /// `folder` is that of the log.
    pub fn into_recording(
        mut self,
        path: &Path,
        folder: PathBuf,
        store: Store,
        format: &'static Format,
    ) -> Result<Recording> {
        // Who drove all of it took the wheel from nobody.
        if self.all_taken_over {
            self.rows.iter_mut().for_each(|row| row.taken_over = false);
        }
        let camera = self.camera.unwrap_or_default();
        let geometry = camera.resolve(usual_preset(format.id))?;
        let notices = store.notice().into_iter().chain(self.notices).collect();
        let mut recording = Recording {
            path: path.into(),
            folder,
            format,
            rows: self.rows,
            sessions: Vec::new(),
            unusable: self.unusable,
            notices,
            image_size: None,
            geometry,
            camera_named: camera.is_complete(),
            times_plausible: true,
            unit_trouble: self.unit_trouble,
            picture_hashes: Vec::new(),
            files: self.files,
            store,
        };
        for (side, (bad, same)) in self.bad_sides.iter().zip(self.same_sides).enumerate() {
            recording.settle_side(View::ALL[side + 1], bad, same);
        }
        if self.check == ImageCheck::Verify {
            recording.drop_copied_sides();
            let mut bytes = Vec::new();
            if recording.read_picture(0, View::Centre, &mut bytes).is_ok() {
                recording.image_size = decode::image_size(&bytes).ok();
            }
        }
        recording.settle_times(self.hz, self.assumed_hz);
        recording.settle_sessions();
        Ok(recording)
    }
}

/// What to tell the user of labels that are no shares of full lock.
fn unit_trouble(rows: &[Row], beyond: &mut [f64], line: &str) -> String {
    let first = beyond[0];
    let count = beyond.len();
    let mut all: Vec<f64> = rows.iter().map(|row| f64::from(row.steering)).chain(beyond.iter().copied()).collect();
    all.sort_unstable_by(f64::total_cmp);
    let (min, max) = (all[0], all[all.len() - 1]);
    let units = Unit::likely(min, all[all.len() / 2], max);
    let looks: Vec<&str> = units.iter().map(|unit| unit.text()).collect();
    let meaning = |unit: &Unit| {
        let sharpest_deg = unit.front_wheels_deg(min).max(unit.front_wheels_deg(max));
        format!("--unit {unit} if the front wheels turned by {sharpest_deg:.1} degrees in the sharpest bend")
    };
    let choices: Vec<String> = units.iter().map(meaning).collect();
    format!(
        "{count} of {} labels are not in [-1, 1], the first is {first} ({line}): these labels look like {}. Say {}; or unit = \
         \"{}\" in steersman.toml beside the log; --unit lock leaves these rows out",
        all.len(),
        looks.join(" or "),
        choices.join(", "),
        units[0]
    )
}

impl Recording {
    /// Says what became of the pictures of a side camera: `bad` ones cannot be used, `same` ones are those of the centre.
    fn settle_side(&mut self, view: View, bad: &Unusable, same: usize) {
        let name = view.name();
        if same > 0 {
            self.notices.push(format!("the {name} picture of {same} rows is the centre picture: it is not used"));
        }
        let bad_rows = bad.rows();
        if bad_rows > 0 && !self.has(view) {
            self.notices.push(format!("no image of the {name} camera can be read; the camera falls away"));
        } else if bad_rows > 0 {
            let reasons = bad.0.iter().map(|(reason, tally)| {
                format!("{} ({})", reason.text(), tally.examples.first().map_or("", String::as_str))
            });
            let reasons: Vec<String> = reasons.collect();
            self.notices.push(format!(
                "{bad_rows} pictures of the {name} camera cannot be used, their rows are used without them: {}",
                reasons.join("; ")
            ));
        }
    }

    /// Side cameras fall away whose pictures are copies of those of the centre, as far as some rows tell.
    fn drop_copied_sides(&mut self) {
        for view in [View::Left, View::Right] {
            let rows: Vec<usize> = (0..self.rows.len()).filter(|&row| self.row_has(row, view)).collect();
            let step = rows.len().div_ceil(COMPARED).max(1);
            let [mut centre, mut side] = [Vec::new(), Vec::new()];
            let mut is_copy = |&row: &usize| {
                self.read_picture(row, View::Centre, &mut centre).is_ok()
                    && self.read_picture(row, view, &mut side).is_ok()
                    && centre == side
            };
            if !rows.is_empty() && rows.iter().step_by(step).all(&mut is_copy) {
                self.rows.iter_mut().for_each(|row| row.images[view as usize] = None);
                let name = view.name();
                self.notices
                    .push(format!("the pictures of the {name} camera are copies of the centre ones: no {name} camera"));
            }
        }
    }
}
