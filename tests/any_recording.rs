//! Any recording in: damaged and unusual folders, built from the simulator's own pictures. Each case says what is put in, what
//! is said, and how many rows are used.

mod common;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use common::archive::{Tree, tar_gz, zip};
use steersman::dataset::{self, Description, ImageCheck, Recording, View, parse_columns, recordings_below};
use steersman::simulator::{RecordOptions, Track, record};

/// Rows of the drive that all cases are made from.
const ROWS: usize = 40;

/// The drive: names and bytes of its pictures, and its labels.
struct Drive {
    /// Bytes of the pictures, `[row][camera]`.
    pictures: Vec<[Vec<u8>; 3]>,
    names: Vec<[String; 3]>,
    steering: Vec<f64>,
}

fn drive() -> &'static Drive {
    static DRIVE: OnceLock<Drive> = OnceLock::new();
    DRIVE.get_or_init(|| {
        let scratch = tempfile::tempdir().unwrap();
        let folder = scratch.path().join("drive");
        let options = RecordOptions { laps: 0.06, seed: 3, ..RecordOptions::default() };
        record(&Track::load("lake").unwrap(), &options, &folder, &mut steersman::observer::Unobserved).unwrap();
        let log = fs::read_to_string(folder.join("driving_log.csv")).unwrap();
        let (mut pictures, mut names, mut steering) = (Vec::new(), Vec::new(), Vec::new());
        for row in log.lines().skip(1).take(ROWS) {
            let fields: Vec<&str> = row.split(", ").collect();
            let of = |i: usize| fields[i].strip_prefix("IMG/").unwrap().to_owned();
            names.push([of(0), of(1), of(2)]);
            pictures.push([0, 1, 2].map(|i| fs::read(folder.join(fields[i])).unwrap()));
            steering.push(fields[3].parse().unwrap());
        }
        assert_eq!(names.len(), ROWS);
        Drive { pictures, names, steering }
    })
}

/// The drive as Udacity's sample data, with the log's lines made by `line` from row, names and label.
fn logged(header: &str, line: impl Fn(usize, &[String; 3], f64) -> String) -> Tree {
    let drive = drive();
    let mut tree = Tree::new();
    let mut log = header.to_owned();
    for row in 0..ROWS {
        for (name, bytes) in drive.names[row].iter().zip(&drive.pictures[row]) {
            tree.insert(format!("IMG/{name}"), bytes.clone());
        }
        log += &line(row, &drive.names[row], drive.steering[row]);
        log.push('\n');
    }
    tree.insert("driving_log.csv".into(), log.into_bytes());
    tree
}

const HEADER: &str = "center,left,right,steering,throttle,brake,speed\n";

/// A row as Udacity's simulator writes it.
fn usual([c, l, r]: &[String; 3], steering: f64) -> String {
    format!("IMG/{c},IMG/{l},IMG/{r},{steering},0.5,0,20")
}

fn plain() -> Tree {
    logged(HEADER, |_, names, steering| usual(names, steering))
}

fn write(tree: &Tree, folder: &Path) -> PathBuf {
    for (name, bytes) in tree {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
    folder.to_path_buf()
}

fn load(path: &Path, said: &Description) -> Result<Recording, String> {
    dataset::load_with(path, said, ImageCheck::Verify).map_err(|e| e.to_string())
}

/// Everything that is said about a recording.
fn told(recording: &Recording) -> String {
    let unusable =
        recording.unusable.0.iter().map(|(reason, t)| format!("{} {} {:?}", t.rows, reason.text(), t.examples));
    let trouble = recording.unit_trouble().map(str::to_owned).into_iter();
    trouble.chain(recording.notices.clone()).chain(unusable).collect::<Vec<_>>().join("\n")
}

/// One case: what is put in, and what must come out.
struct Case {
    name: &'static str,
    tree: Tree,
    said: Description,
    /// Parts of what is said.
    told: &'static [&'static str],
    rows: usize,
}

fn check(cases: Vec<Case>) {
    let mut failures = Vec::new();
    for Case { name, tree, said, told: parts, rows } in cases {
        let folder = tempfile::tempdir().unwrap();
        let path = write(&tree, folder.path());
        let (found, text) = match load(&path, &said) {
            Ok(recording) => {
                // Labels must be right, not only there.
                let drive = drive();
                let known: BTreeMap<&[u8], f64> =
                    drive.pictures.iter().zip(&drive.steering).map(|(p, s)| (&p[0][..], *s)).collect();
                for row in 0..recording.rows.len() {
                    let mut bytes = Vec::new();
                    recording.read_picture(row, View::Centre, &mut bytes).unwrap();
                    if let Some(expected) = known.get(&bytes[..]).filter(|_| recording.require_usable().is_ok()) {
                        let label = f64::from(recording.rows[row].steering);
                        if (label - expected).abs() > 1e-4 {
                            failures.push(format!("{name}: row {row} has the label {label}, not {expected}"));
                        }
                    }
                }
                let usable = if recording.require_usable().is_ok() { recording.rows.len() } else { 0 };
                (usable, told(&recording))
            }
            Err(message) => (0, message),
        };
        if found != rows {
            failures.push(format!("{name}: {found} rows are used, not {rows}; said: {text}"));
        }
        for part in parts.iter().filter(|part| !text.contains(*part)) {
            failures.push(format!("{name}: `{part}` is not said: {text}"));
        }
        println!(
            "{name:<44} {found:>3} rows  {}",
            text.lines().next().unwrap_or("-").chars().take(110).collect::<String>()
        );
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

fn case(name: &'static str, tree: Tree, told: &'static [&'static str], rows: usize) -> Case {
    Case { name, tree, said: Description::default(), told, rows }
}

fn said(toml: &str) -> Description {
    toml::from_str(toml).unwrap()
}

#[test]
fn labels_are_never_wrong_without_a_word() {
    let yaw =
        |_: usize, [c, l, r]: &[String; 3], s: f64| format!("IMG/{c},IMG/{l},IMG/{r},{},{s},0.5,0,20", s * 0.3 + 0.1);
    let ambiguous = "center,left,right,yaw_angle,wheel_angle,throttle,brake,speed\n";
    let choose = || Description { columns: parse_columns("steering=5").unwrap(), ..Default::default() };
    let scaled = |scale: f64, offset: f64| logged(HEADER, move |_, names, s| usual(names, s * scale + offset));
    let with = |mut tree: Tree, name: &str, text: &str| {
        tree.insert(name.into(), text.as_bytes().to_vec());
        tree
    };
    // One bend is sharp enough to tell degrees from radians.
    let sharp = logged(HEADER, |row, names, s| usual(names, if row == 20 { 12.5 } else { s * 25.0 }));
    // Three labels of a straight drive are beyond 1, or beyond -1.
    let few =
        |beyond: f64| logged(HEADER, move |row, names, s| usual(names, if row % 13 == 5 { beyond } else { s * 0.1 }));
    let tub = |mode: &'static str| {
        let mut tree = Tree::new();
        let mut catalog = String::new();
        for row in 0..ROWS {
            let name = format!("{row}_cam_image_array_.jpg");
            tree.insert(format!("images/{name}"), drive().pictures[row][0].clone());
            let mode = if row < 10 { mode } else { "user" };
            let (user, pilot) =
                if mode == "user" { (drive().steering[row], 0.9) } else { (0.0, drive().steering[row]) };
            catalog += &format!(
                "{{\"_index\": {row}, \"_timestamp_ms\": {}, \"cam/image_array\": \"{name}\", \"user/angle\": {user}, \
                 \"user/throttle\": 0.5, \"user/mode\": \"{mode}\", \"pilot/angle\": {pilot}}}\n",
                1000 + 50 * row
            );
        }
        tree.insert("catalog_0.catalog".into(), catalog.into_bytes());
        tree.insert(
            "manifest.json".into(),
            b"[]\n[]\n{}\n{}\n{\"paths\": [\"catalog_0.catalog\"], \"deleted_indexes\": null}\n".to_vec(),
        );
        tree
    };
    check(vec![
        case("plain", plain(), &[], ROWS),
        case(
            "yaw_angle before steering",
            logged("center,left,right,yaw_angle,steering,throttle,brake,speed\n", yaw),
            &[],
            ROWS,
        ),
        case("two angles", logged(ambiguous, yaw), &["--columns steering=", "4 yaw_angle, 5 wheel_angle"], 0),
        Case { said: choose(), ..case("two angles, --columns", logged(ambiguous, yaw), &[], ROWS) },
        case(
            "two angles, steersman.toml",
            with(logged(ambiguous, yaw), "steersman.toml", "[columns]\nsteering = 'wheel_angle'"),
            &[],
            ROWS,
        ),
        case(
            "unknown entry in steersman.toml",
            with(plain(), "steersman.toml", "colour = 3"),
            &["steersman.toml", "colour"],
            0,
        ),
        case("degrees", sharp, &["degrees of the front wheels", "--unit degrees"], 0),
        Case { said: said("unit = 'degrees'"), ..case("degrees, --unit", scaled(25.0, 0.0), &[], ROWS) },
        Case { said: said("unit = 'radians'"), ..case("radians, --unit", scaled(25f64.to_radians(), 0.0), &[], ROWS) },
        case("servo", scaled(45.0, 90.0), &["servo", "--unit servo"], 0),
        Case { said: said("unit = 'servo'"), ..case("servo, --unit", scaled(45.0, 90.0), &[], ROWS) },
        case("a few labels beyond 1", few(17.0), &["3 of 40 labels are not in [-1, 1]"], 0),
        case("a few labels beyond -1", few(-17.0), &["3 of 40 labels are not in [-1, 1]"], 0),
        case(
            "labels beyond 1 by rounding",
            logged(HEADER, |row, n, s| usual(n, if row == 3 { s } else { s + 0.0 })),
            &[],
            ROWS,
        ),
        case("tub: a pilot drove 10 rows", tub("local_angle"), &["10 records that a pilot drove"], ROWS - 10),
        case("tub: the user drove", tub("user"), &["a tub has one camera"], ROWS),
        case(
            "left and right are the centre picture",
            logged(HEADER, |_, [c, _, _], s| format!("IMG/{c},IMG/{c},IMG/{c},{s},0.5,0,20")),
            &["left picture of 40 rows is the centre picture", "right picture of 40 rows"],
            ROWS,
        ),
        case(
            "all three pictures are copies",
            {
                let mut tree = plain();
                for row in 0..ROWS {
                    for side in 1..3 {
                        tree.insert(format!("IMG/{}", drive().names[row][side]), drive().pictures[row][0].clone());
                    }
                }
                tree
            },
            &["copies of the centre ones: no left camera", "no right camera"],
            ROWS,
        ),
    ]);
}

#[test]
fn no_good_row_is_lost() {
    let without = |names: &[(usize, usize)]| {
        let mut tree = plain();
        names.iter().for_each(|(row, camera)| drop(tree.remove(&format!("IMG/{}", drive().names[*row][*camera]))));
        tree
    };
    let pictures = |change: fn(usize, Vec<u8>) -> Vec<u8>| {
        let mut tree = plain();
        for row in 0..ROWS {
            tree.insert(format!("IMG/{}", drive().names[row][0]), change(row, drive().pictures[row][0].clone()));
        }
        tree
    };
    let moved = |from: &str, to: &str| -> Tree {
        plain().into_iter().map(|(name, bytes)| (name.replacen(from, to, 1), bytes)).collect()
    };
    let far = |_: usize, [c, l, r]: &[String; 3], s: f64| {
        format!("/home/me/run 1/IMG/{c},/home/me/run 1/IMG/{l},/home/me/run 1/IMG/{r},{s},0.5,0,20")
    };
    let into_sub_folders: Tree =
        logged(HEADER, far).into_iter().map(|(name, bytes)| (name.replacen("IMG/", "IMG/run 1/", 1), bytes)).collect();
    let latin: Tree = {
        let mut tree = plain();
        let log = String::from_utf8(tree["driving_log.csv"].clone())
            .unwrap()
            .replace(HEADER, "Straße,links,rechts,Lenkung,Gas,Bremse,Tempo\n");
        tree.insert("driving_log.csv".into(), log.chars().map(|c| c as u8).collect());
        tree
    };
    let text = |change: fn(String) -> Vec<u8>| {
        let mut tree = plain();
        let log = String::from_utf8(tree["driving_log.csv"].clone()).unwrap();
        tree.insert("driving_log.csv".into(), change(log));
        tree
    };
    check(vec![
        case(
            "3 side pictures missing",
            without(&[(3, 1), (9, 1), (20, 2)]),
            &["2 pictures of the left camera", "1 pictures of the right"],
            ROWS,
        ),
        case("3 centre pictures missing", without(&[(3, 0), (9, 0), (20, 0)]), &["3 image missing"], ROWS - 3),
        case("padding behind the end marker", pictures(|_, bytes| [bytes, vec![0; 500]].concat()), &[], ROWS),
        case(
            "half of a picture",
            pictures(|row, bytes| if row < 4 { bytes[..bytes.len() / 2].to_vec() } else { bytes }),
            &["4 image damaged"],
            ROWS - 4,
        ),
        case("IMG is called img", moved("IMG/", "img/"), &[], ROWS),
        case("pictures in sub-folders of IMG", into_sub_folders, &[], ROWS),
        case("paths of another machine", logged("", far), &[], ROWS),
        case(
            "8 columns, the first 7 usual",
            logged("center,left,right,steering,throttle,brake,speed,lap\n", |_, n, s| usual(n, s) + ",3"),
            &[],
            ROWS,
        ),
        case("Latin-1, a header in German", latin, &[], ROWS),
        case("UTF-16", text(|log| log.encode_utf16().flat_map(u16::to_le_bytes).collect()), &[], ROWS),
        case(
            "UTF-8 with a mark, CR",
            text(|log| format!("\u{feff}{}", log.replace('\n', "\r")).into_bytes()),
            &[],
            ROWS,
        ),
        case("tabs", text(|log| log.replace(',', "\t").into_bytes()), &[], ROWS),
        case(
            "semicolons and decimal commas",
            logged("center;left;right;steering;throttle;brake;speed\n", |_, [c, l, r], s| {
                format!("IMG/{c};IMG/{l};IMG/{r};{};0,5;0;20,5", s.to_string().replace('.', ","))
            }),
            &[],
            ROWS,
        ),
    ]);
}

/// The pictures of the centre camera under names made from the row.
fn centre(folder: &str, name: impl Fn(usize) -> String) -> Tree {
    (0..ROWS).map(|row| (format!("{folder}{}", name(row)), drive().pictures[row][0].clone())).collect()
}

fn with_file(mut tree: Tree, name: &str, text: String) -> Tree {
    tree.insert(name.into(), text.into_bytes());
    tree
}

#[test]
fn formats_are_told_by_what_they_are() {
    let steering = |row: usize| drive().steering[row];
    let lines = |of: &dyn Fn(usize) -> String| (0..ROWS).map(|row| of(row) + "\n").collect::<String>();
    let record = |row: usize| {
        format!(
            "{{\"cam/image_array\": \"{row}_cam-image_array_.jpg\", \"user/angle\": {}, \"user/throttle\": 0.2, \"user/mode\": \"user\", \"milliseconds\": {}}}",
            steering(row),
            row * 50
        )
    };
    let mut tub1 = centre("", |row| format!("{row}_cam-image_array_.jpg"));
    (0..ROWS).for_each(|row| drop(tub1.insert(format!("record_{row}.json"), record(row).into_bytes())));
    tub1.insert("meta.json".into(), b"{}".to_vec());
    tub1.insert("exclude.json".into(), b"[3, 4]".to_vec());
    tub1.insert("record_7.json".into(), b"{\"cam/im".to_vec());
    let wheel = |row: usize| (steering(row) * 400.0).to_radians();
    let mut challenge =
        String::from("index,timestamp,width,height,frame_id,filename,angle,torque,speed,lat,long,alt\n");
    let mut pictures = Tree::new();
    for row in 0..ROWS {
        for (camera, name) in ["center", "left", "right"].iter().enumerate() {
            let stamp = 1_479_424_215_877_962_784_u64 + row as u64 * 50_000_000 + camera as u64 * 3_000_000;
            pictures.insert(format!("{name}/{stamp}.jpg"), drive().pictures[row][camera].clone());
            challenge +=
                &format!("0,{stamp},640,480,{name}_camera,{name}/{stamp}.jpg,{},0.1,8.9,37.3,-122.3,42\n", wheel(row));
        }
    }
    let data_txt = lines(&|row| {
        format!("{row}.jpg {},2018-07-01 17:09:{:02}:{:03}", steering(row) * 400.0, row / 20, row % 20 * 50)
    });
    let catalog = |key: &str| {
        lines(&|row| {
            format!(
                "{{\"_index\": {row}, \"_timestamp_ms\": {}, \"cam/image_array\": \"{row}_cam_image_array_.jpg\", \"{key}\": {}}}",
                50 * row,
                steering(row)
            )
        })
    };
    let images = || centre("images/", |row| format!("{row}_cam_image_array_.jpg"));
    check(vec![
        case("donkeycar tub, format 1", tub1, &["2 records marked as deleted", "the record cannot be read"], ROWS - 3),
        case("challenge 2", with_file(pictures, "interpolated.csv", challenge), &[], ROWS),
        case(
            "data.txt",
            with_file(centre("data/", |row| format!("{row}.jpg")), "data.txt", data_txt),
            &["degrees of the steering wheel"],
            ROWS,
        ),
        case(
            "labels in names",
            centre("", |row| format!("frame_{row:05}_ttl_0.25_agl_{}_mil_0.0.jpg", steering(row))),
            &["20 Hz"],
            ROWS,
        ),
        case(
            "catalogs without a manifest",
            with_file(images(), "catalog_0.catalog", catalog("user/angle")),
            &["no manifest.json"],
            ROWS,
        ),
        case(
            "a cut manifest",
            with_file(
                with_file(images(), "catalog_0.catalog", catalog("user/angle")),
                "manifest.json",
                "[]\n[]\n{}\n{}\n{\"pat".into(),
            ),
            &["manifest.json is damaged"],
            ROWS,
        ),
        case(
            "user/steering for user/angle",
            with_file(images(), "catalog_0.catalog", catalog("user/steering")),
            &[],
            ROWS,
        ),
        case(
            "a cut catalog",
            with_file(images(), "catalog_0.catalog", catalog("user/angle") + "{\"_index\": 40, \"cam"),
            &["the record cannot be read"],
            ROWS,
        ),
        case("a ROS bag", with_file(Tree::new(), "drive.bag", "#ROSBAG V2.0\n".into()), &["a ROS bag", "export"], 0),
        case("a video", with_file(Tree::new(), "drive.mp4", "\0\0\0\x20ftypisom".into()), &["a video", "ffmpeg"], 0),
        case("an Excel workbook", with_file(Tree::new(), "log.xlsx", "PK".into()), &["spreadsheet", "CSV"], 0),
        case("Parquet", with_file(Tree::new(), "log.parquet", "PAR1".into()), &["Parquet", "to_csv"], 0),
        case("nothing", Tree::new(), &["no recording here"], 0),
    ]);
}

#[test]
fn archives_and_folders_of_recordings_are_read_in_place() {
    let folder = tempfile::tempdir().unwrap();
    let plain_zip = folder.path().join("drive.zip");
    fs::write(&plain_zip, zip(&plain(), "my drive/")).unwrap();
    let tar = folder.path().join("drive.tar.gz");
    fs::write(&tar, tar_gz(&plain())).unwrap();
    write(&plain(), &folder.path().join("sub/one"));
    for path in [&plain_zip, &tar] {
        let recording = load(path, &Description::default()).unwrap();
        assert_eq!(recording.rows.len(), ROWS, "{}", told(&recording));
        assert!(recording.has(View::Left) && recording.image_size == Some([160, 320]));
        let mut bytes = Vec::new();
        recording.read_picture(7, View::Right, &mut bytes).unwrap();
        assert!(bytes == drive().pictures[7][2]);
    }
    let message = load(folder.path(), &Description::default()).unwrap_err();
    assert!(message.contains("holds 3 recordings") && message.contains("--recursive"), "{message}");
    let found = recordings_below(folder.path()).unwrap();
    assert_eq!(found, [tar.clone(), plain_zip.clone(), folder.path().join("sub/one")]);
    // A cut archive has what came before the cut.
    let bytes = fs::read(&tar).unwrap();
    fs::write(&tar, &bytes[..bytes.len() * 3 / 4]).unwrap();
    match load(&tar, &Description::default()) {
        Ok(recording) => assert!(told(&recording).contains("ends early"), "{}", told(&recording)),
        Err(message) => assert!(message.contains("no recording") || message.contains("archive"), "{message}"),
    }
}

#[cfg(unix)]
#[test]
fn nothing_but_files_within_the_recording_is_opened() {
    let fifo = |path: &Path| {
        let made = std::process::Command::new("mkfifo").arg(path).status().unwrap();
        assert!(made.success());
    };
    let folder = tempfile::tempdir().unwrap();
    let outside = tempfile::tempdir().unwrap();
    fs::write(outside.path().join("x.jpg"), &drive().pictures[0][0]).unwrap();
    let written = [
        "/dev/zero".to_owned(),
        "../outside.jpg".to_owned(),
        outside.path().join("x.jpg").display().to_string(),
        r"\\server\share\x.jpg".to_owned(),
        "IMG/pipe.jpg".to_owned(),
    ];
    let mut tree = plain();
    let rows: String = written.iter().map(|path| format!("{path},,,0.1,0.5,0,20\n")).collect();
    let log = String::from_utf8(tree["driving_log.csv"].clone()).unwrap() + &rows;
    tree.insert("driving_log.csv".into(), log.into_bytes());
    write(&tree, folder.path());
    fifo(&folder.path().join("IMG/pipe.jpg"));
    let recording = load(folder.path(), &Description::default()).unwrap();
    assert_eq!((recording.rows.len(), recording.unusable.rows()), (ROWS, written.len()), "{}", told(&recording));
    assert!(told(&recording).contains("no regular file"), "{}", told(&recording));
    // A log that is a FIFO, and a recording that is one.
    let other = tempfile::tempdir().unwrap();
    fifo(&other.path().join("driving_log.csv"));
    assert!(load(other.path(), &Description::default()).is_err());
    assert!(load(&other.path().join("driving_log.csv"), &Description::default()).unwrap_err().contains("FIFO"));
    assert!(load(Path::new("/dev/zero"), &Description::default()).unwrap_err().contains("device"));
}

#[test]
fn rows_with_one_picture_never_stand_on_both_sides() {
    use steersman::dataset::split::{SplitSpec, split};
    use steersman::dataset::{Balance, SampleSpec, Targets};
    let folder = tempfile::tempdir().unwrap();
    let first = write(&plain(), &folder.path().join("a"));
    let second = write(&plain(), &folder.path().join("b"));
    let doubled = {
        let mut tree = plain();
        let log = String::from_utf8(tree["driving_log.csv"].clone()).unwrap();
        let rows = log.strip_prefix(HEADER).unwrap();
        tree.insert("driving_log.csv".into(), format!("{HEADER}{rows}{rows}").into_bytes());
        write(&tree, &folder.path().join("c"))
    };
    for (name, paths) in
        [("given twice", vec![&first, &first]), ("a copy", vec![&first, &second]), ("listed twice", vec![&doubled])]
    {
        let mut recordings: Vec<Recording> = paths
            .iter()
            .map(|path| load(path, &Description { hz: Some(2.0), ..Default::default() }).unwrap())
            .collect();
        recordings.iter_mut().for_each(Recording::hash_pictures);
        for seed in 0..10 {
            let (spec, samples, targets) = (SplitSpec::default(), SampleSpec::default(), Targets::wheel(&recordings));
            let split = split(&recordings, &targets, &spec, &samples, &Balance::default(), seed).unwrap();
            let hashes = |side: &[dataset::Item]| -> Vec<u64> {
                side.iter()
                    .map(|item| recordings[usize::from(item.recording)].picture_hash(item.row as usize).unwrap())
                    .collect()
            };
            let training = hashes(&split.training);
            assert!(!split.validation.is_empty() && !training.is_empty());
            assert!(hashes(&split.validation).iter().all(|hash| !training.contains(hash)), "{name}, seed {seed}");
            assert!(split.summary().contains("show the same picture as an earlier row"), "{name}: {}", split.summary());
        }
    }
}
