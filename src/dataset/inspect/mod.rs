//! What a recording holds, for `steersman inspect`.

pub(crate) mod advice;
mod describe;
mod frames;
mod lag;
mod report;
mod suspicious;
mod text;

use std::path::Path;

use crate::Result;
use crate::dataset::description::Description;
use crate::dataset::load::load_with;
use crate::dataset::recording::Recording;
use crate::dataset::rows::ImageCheck;
use crate::dataset::samples::{Balance, LabelSpec, SampleSpec};
use crate::observer::{Observer, Progress};
use describe::describe;
pub use frames::Frame;
pub use lag::Lag;
pub use report::{Gaps, Pictures, Report, Session, Size, Spread, Steering};
pub use suspicious::{STANDING_MPH, Stretch, Suspicion, contradiction, seen_steering};

/// Steering from here on counts as full lock.
pub const FULL_LOCK: f32 = 0.999;
/// Labels up to here, to either side, count as straight: 1 degree of the wheels at 25 degrees of full lock.
pub const STRAIGHT: f32 = 0.04;

/// A recording, read and looked at.
#[derive(Debug)]
pub struct Inspection {
    /// The rows.
    pub recording: Recording,
    /// The centre camera's frame of each row, where it could be read.
    pub frames: Vec<Option<Frame>>,
    /// The findings.
    pub report: Report,
}

/// What training will do with the rows, so that no advice asks for what is done already: entries of the recipe.
#[derive(Debug, Clone, Default)]
pub struct Treatment {
    /// Which images of a row are used.
    pub samples: SampleSpec,
    /// Thinning out of over-frequent labels.
    pub balance: Balance,
    /// Where labels come from. The driven path is smooth whatever the hands did, and has no label where the car stands.
    pub labels: LabelSpec,
}

/// Reads the recording at `path`, of which the user says `said`, looks at its pictures and describes it. Where no image can be
/// read, the log alone is described. The advice is for training that does what `treatment` says. `observer` is told the share of
/// the pictures that is done.
///
/// # Errors
/// As [`load_with`]; the observer's own.
pub fn inspect(
    path: &Path,
    said: &Description,
    treatment: &Treatment,
    observer: &mut (dyn Observer<Progress> + Send),
) -> Result<Inspection> {
    let checked = load_with(path, said, ImageCheck::Verify)?;
    if checked.rows.is_empty() && checked.total_rows() > 0 {
        let log_alone = load_with(path, said, ImageCheck::Skip)?;
        if !log_alone.rows.is_empty() {
            let mut report = describe(path, &log_alone, &[], treatment);
            report.notices.insert(0, "no row has its images; the figures are those of the log alone".into());
            report.cameras.clear();
            (report.usable, report.unusable) = (0, checked.unusable);
            report.advice = advice::advice(&report, treatment);
            return Ok(Inspection { recording: log_alone, frames: Vec::new(), report });
        }
    }
    let frames = frames::look(&checked, observer)?;
    let report = describe(path, &checked, &frames, treatment);
    Ok(Inspection { recording: checked, frames, report })
}

/// The suspicious stretches of `recording`, for which it looks at its pictures.
///
/// # Errors
/// The observer's own.
pub(crate) fn stretches(recording: &Recording, observer: &mut (dyn Observer<Progress> + Send)) -> Result<Vec<Stretch>> {
    let frames = frames::look(recording, observer)?;
    Ok(suspicious::find(recording, &frames, Lag::of(recording, &frames)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dataset::inspect::describe::gaps;
    use crate::dataset::testing::{recording_of, recordings_folder};
    use crate::observer::Unobserved;

    #[test]
    fn labels_are_described() {
        let report = describe(
            Path::new("drive"),
            &recording_of(&[0.0, 0.0, 1.0, -1.0, 0.5, -0.06], 100),
            &[],
            &Treatment::default(),
        );
        let steering = report.steering.clone().unwrap();
        assert_eq!((steering.spread.min, steering.spread.max), (-1.0, 1.0));
        assert!(
            (steering.zero_share - 1.0 / 3.0).abs() < 1e-12 && (steering.full_lock_share - 1.0 / 3.0).abs() < 1e-12
        );
        let filled: Vec<_> = steering.histogram.iter().enumerate().filter(|(_, n)| **n > 0).collect();
        assert_eq!(filled, [(0, &1), (9, &1), (10, &2), (15, &1), (20, &1)]);
        assert_eq!((report.driven_s, report.rate_hz), (0.5, Some(10.0)));
        assert_eq!((steering.left_share, steering.right_share, steering.distinct), (1.0 / 3.0, 1.0 / 3.0, 5));
        // 20 mph are 8.94 m/s, for half a second.
        assert!((report.distance_m.unwrap() - 4.4704).abs() < 1e-6 && report.standing_share == Some(0.0));
        let text = report.to_string();
        for part in ["6 of 6 usable", "33.3 % exactly 0", "centre, left, right", "+0.0       2 ####", "10.0 rows/s"] {
            assert!(text.contains(part), "{part} in\n{text}");
        }
    }

    #[test]
    fn missing_rows_are_gaps() {
        let mut recording = recording_of(&[0.1; 40], 100);
        recording.rows[20..].iter_mut().for_each(|row| row.time_ms += 300);
        assert_eq!(gaps(&recording), Gaps { count: 1, longest_s: 0.4 });
        assert_eq!(gaps(&recording_of(&[0.1; 40], 100)).count, 0);
    }

    #[test]
    fn an_empty_recording_has_a_report() {
        let text = describe(Path::new("x"), &recording_of(&[], 100), &[], &Treatment::default()).to_string();
        assert!(text.contains("0 of 0 usable"), "{text}");
    }

    #[test]
    fn reports_turn_into_json() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("log.csv");
        std::fs::write(&path, "c.jpg,l.jpg,r.jpg,0.5,1,0,9\nc.jpg,l.jpg,r.jpg,x,1,0,9\n").unwrap();
        let report = inspect(&path, &Description::default(), &Treatment::default(), &mut Unobserved).unwrap().report;
        let json = serde_json::to_value(&report).unwrap();
        assert_eq!((json["rows"].as_u64(), json["usable"].as_u64()), (Some(2), Some(0)));
        assert_eq!(json["unusable"]["not-a-number"]["rows"], 1);
        assert_eq!(json["unusable"]["image-missing"]["rows"], 1);
        assert_eq!(json["steering"]["max"], 0.5);
        assert!(report.to_string().contains("log alone"));
    }

    #[test]
    fn the_log_variants_are_described() {
        let Some(root) = recordings_folder() else { return };
        for (name, rows) in [("bydavy-mixed", 150), ("jwasham12-track2-mac", 150), ("spgitmonish-own-header", 149)] {
            let path = root.join("csv-variants").join(format!("{name}.csv"));
            let report =
                inspect(&path, &Description::default(), &Treatment::default(), &mut Unobserved).unwrap().report;
            assert_eq!((report.rows, report.usable), (rows, 0), "{name}");
            assert!(report.steering.is_some());
        }
        let lake = inspect(&root.join("lake-sample"), &Description::default(), &Treatment::default(), &mut Unobserved)
            .unwrap()
            .report;
        assert!((lake.steering.unwrap().zero_share - 0.56).abs() < 0.01);
        assert_eq!(lake.image_size, Some([160, 320]));
        let pictures = lake.pictures.unwrap();
        assert_eq!((pictures.seen, pictures.undecodable), (3000, 0));
        assert!(lake.advice.iter().any(|advice| advice.contains("balance.keep_zero=0.4")), "{:?}", lake.advice);
    }
}
