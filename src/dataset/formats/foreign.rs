//! Files that are recognised and cannot be read: what they are, and how they become a recording.

use std::path::Path;

use crate::dataset::recording::file_name;
use crate::dataset::store::Store;

/// A kind of file: its first bytes (at an offset), endings of its name, what it is, and what to do.
struct Foreign {
    magic: &'static [(usize, &'static [u8])],
    endings: &'static [&'static str],
    is: &'static str,
    remedy: &'static str,
}

const MODEL: &str = "name the model first, then the recordings";
const TABLE: &str = "save the sheet as CSV (comma separated), and name that file";
const FRAMES: &str = "a video alone has no labels: export its frames (ffmpeg -i FILE IMG/%06d.jpg) and write a CSV of picture names and steering";

const KINDS: [Foreign; 13] = [
    Foreign {
        magic: &[(0, b"#ROSBAG V")],
        endings: &[".bag"],
        is: "a ROS bag",
        remedy: "export its images and its steering to a folder and a CSV (timestamp,frame_id,filename,angle), for instance with \
                 udacity-driving-reader's bagdump",
    },
    Foreign {
        magic: &[(0, b"\x89MCAP0\r\n")],
        endings: &[".mcap", ".db3"],
        is: "a ROS 2 bag",
        remedy: "export its images and its steering to a folder and a CSV (timestamp,frame_id,filename,angle)",
    },
    Foreign {
        magic: &[(0, b"\x89HDF\r\n\x1a\n")],
        endings: &[".h5", ".hdf5"],
        is: "an HDF5 file: a Keras model, or a data set such as comma.ai's",
        remedy: "a model is read by `steersman import`; of a data set, write the pictures to files and a CSV of names and steering",
    },
    Foreign {
        magic: &[(0, b"PAR1")],
        endings: &[".parquet"],
        is: "a Parquet table",
        remedy: "convert it to CSV (pandas: read_parquet, to_csv), with pictures as files",
    },
    Foreign {
        magic: &[(4, b"ftyp"), (0, b"\x1a\x45\xdf\xa3"), (8, b"AVI ")],
        endings: &[".mp4", ".mkv", ".webm", ".avi", ".mov", ".hevc"],
        is: "a video",
        remedy: FRAMES,
    },
    Foreign {
        magic: &[(0, b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1")],
        endings: &[".xls"],
        is: "an Excel workbook",
        remedy: TABLE,
    },
    Foreign { magic: &[], endings: &[".xlsx", ".ods"], is: "a spreadsheet", remedy: TABLE },
    Foreign {
        magic: &[(0, b"\x93NUMPY")],
        endings: &[".npy", ".npz"],
        is: "a NumPy array",
        remedy: "write its pictures to files and a CSV of names and steering",
    },
    Foreign {
        magic: &[(0, b"SQLite format 3\0")],
        endings: &[".sqlite"],
        is: "an SQLite database",
        remedy: "export the table as CSV, with pictures as files",
    },
    Foreign {
        magic: &[],
        endings: &[".tfrecord", ".tfrecords", ".pkl", ".pickle", ".p"],
        is: "a file of another program's objects",
        remedy: "write its pictures to files and a CSV of names and steering",
    },
    Foreign { magic: &[], endings: &[".safetensors", ".keras", ".onnx"], is: "a model, no recording", remedy: MODEL },
    Foreign {
        magic: &[(0, b"7z\xbc\xaf\x27\x1c"), (0, b"Rar!"), (0, b"\xfd7zXZ"), (0, b"BZh"), (0, b"\x28\xb5\x2f\xfd")],
        endings: &[".7z", ".rar", ".tar.xz", ".tar.bz2", ".tar.zst"],
        is: "an archive of another kind than .zip and .tar.gz",
        remedy: "unpack it first",
    },
    Foreign {
        magic: &[(0, b"\xff\xd8\xff"), (0, b"\x89PNG\r\n\x1a\n")],
        endings: &[".jpg", ".jpeg", ".png"],
        is: "a picture",
        remedy: "name the folder of the log; `steersman predict` takes single pictures",
    },
];

/// What the file at `path` is, and what to do with it, if it is one of those that cannot be read.
pub(crate) fn name_of_foreign(store: &Store, path: &Path) -> Option<String> {
    let mut head = Vec::new();
    let input = store.open(path).ok()?;
    std::io::Read::read_to_end(&mut std::io::Read::take(input, 64), &mut head).ok()?;
    let name = file_name(path).to_lowercase();
    let has_magic = |kind: &&Foreign| {
        kind.magic.iter().any(|(at, bytes)| head.get(*at..).is_some_and(|rest| rest.starts_with(bytes)))
    };
    let is_named = |kind: &&Foreign| kind.endings.iter().any(|ending| name.ends_with(ending));
    if head.starts_with(b"PK\x03\x04") && (name.ends_with(".csv") || name.ends_with(".txt")) {
        return Some(format!("is an Excel workbook under another name: {TABLE}"));
    }
    let kind = KINDS.iter().find(has_magic).or_else(|| KINDS.iter().find(is_named))?;
    Some(format!("is {}: {}", kind.is, kind.remedy))
}
