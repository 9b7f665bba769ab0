//! Tests of the simulator as a whole.

use std::fs;
use std::path::Path;

use sha2::{Digest, Sha256};

use super::road::builtin;
use super::road::spec::TrackSpec;
use super::trial::run::run_trial;
use super::trial::trajectory::trajectory_csv;
use super::*;
use crate::Error;
use crate::geometry::CarGeometry;
use crate::observer::Unobserved;

fn lake_spec() -> TrackSpec {
    toml::from_str(builtin::text("lake").unwrap()).unwrap()
}

fn refusal(spec: TrackSpec) -> String {
    match Track::from_spec(spec, "my.toml") {
        Ok(_) => panic!("the track was accepted"),
        Err(error) => error.to_string(),
    }
}

#[test]
fn built_in_tracks_keep_their_promises() {
    for (name, held_out, smallest_m) in
        [("lake", false, 25.0), ("mountain", false, 15.0), ("coast", true, 25.0), ("forest", true, 25.0)]
    {
        let track = Track::load(name).unwrap();
        assert_eq!((track.name(), track.held_out()), (name, held_out));
        assert!((600.0..=1500.0).contains(&track.length_m));
        let sharpest = track.stations.iter().map(|s| s.curvature.abs()).fold(0.0, f64::max);
        assert!(1.0 / sharpest >= smallest_m, "{name}: {}", 1.0 / sharpest);
    }
    let widths = |name| Track::load(name).unwrap().stations.iter().map(|s| s.width_m).collect::<Vec<_>>();
    assert!(widths("lake").iter().all(|w| (8.5..=9.5).contains(w)));
    assert!(widths("mountain").iter().all(|w| (7.0..=8.0).contains(w)));
}

#[test]
fn random_tracks_exist_for_every_seed_and_high_seeds_are_held_out() {
    for seed in (0..150).chain(999_990..1_000_110).chain([u64::MAX / 7, u64::MAX]) {
        let track = Track::load(&format!("random:{seed}")).unwrap();
        assert_eq!(track.held_out(), seed >= 1_000_000);
        assert!((600.0..=1500.0).contains(&track.length_m), "random:{seed}: {} m", track.length_m);
        assert!(track.stations.iter().all(|s| s.curvature.abs() <= 1.0 / 25.0));
        // What is drawn passes the checks that a track file must pass, its stretches too.
        Track::from_spec(track.spec.clone(), "again").unwrap();
    }
    assert!(matches!(Track::load("random:x"), Err(Error::Usage(m)) if m.contains("seed")));
}

/// First 16 digits of the hash of a road's line: places, heights, widths and crossfalls, bit by bit.
fn hash_of_line(name: &str) -> String {
    let mut hash = Sha256::new();
    for s in &Track::load(name).unwrap().stations {
        [s.x, s.y, s.z, s.width_m, s.crossfall].iter().for_each(|v| hash.update(v.to_le_bytes()));
    }
    hash.finalize().iter().take(8).map(|b| format!("{b:02x}")).collect()
}

/// What a track looks like may change, where its road runs may not: drives on it are compared from version to version.
#[test]
fn roads_run_where_they_always_ran() {
    for (name, hash) in [
        ("lake", "08ad2e7bae9953d3"),
        ("mountain", "ebf4b25d0bb430e3"),
        ("random:1", "92f4a3f28eac7e1e"),
        ("random:7", "02946c316e46748e"),
        ("random:1000001", "0008cd8927a617f8"),
    ] {
        assert_eq!(hash_of_line(name), hash, "{name}");
    }
}

#[test]
fn nothing_stands_on_a_road_and_the_new_things_are_seen() {
    let sprites_of = |track: &Track, wide_m: f32| {
        let of_width = |s: &&scenery::world::Sprite| track.world().pictures[s.picture].width_m == wide_m;
        track.world().sprites.iter().filter(of_width).count()
    };
    for name in ["lake", "mountain", "random:2", "random:3", "random:1000001"] {
        let track = Track::load(name).unwrap();
        for sprite in &track.world().sprites {
            let at = track.locate(f64::from(sprite.foot.x), f64::from(sprite.foot.y));
            let edge_m = at.offset_m.abs() - track.stations[at.station].width_m / 2.0;
            assert!(edge_m > 1.0, "{name}: something stands {edge_m} m from the edge");
        }
    }
    let (full, mut bare) = (Track::load("lake").unwrap(), lake_spec());
    (bare.land.woods, bare.land.pylons) = (0.0, false);
    let bare = Track::from_spec(bare, "bare").unwrap();
    let (pine_m, pylon_m) = (5.0, 9.0);
    assert!(sprites_of(&full, pine_m) > sprites_of(&bare, pine_m) + 50);
    assert!(sprites_of(&full, pylon_m) > 2 && sprites_of(&bare, pylon_m) == 0);
}

#[test]
fn numbers_of_the_land_outside_their_range_are_refused_by_name() {
    for (entry, set) in [
        ("mounds_m", (|land, v| land.mounds_m = v) as fn(&mut road::spec::Land, f32)),
        ("sandy", |land, v| land.sandy = v),
        ("woods", |land, v| land.woods = v),
    ] {
        for value in [-0.1, 21.0, f32::NAN] {
            let mut spec = lake_spec();
            set(&mut spec.land, value);
            assert!(refusal(spec).contains(&format!("land: {entry} is")), "{entry} {value}");
        }
    }
}

#[test]
fn unknown_tracks_name_the_nearest() {
    let Err(error) = Track::load("moutain") else { panic!("accepted") };
    assert!(error.to_string().contains("did you mean `mountain`"), "{error}");
    assert!(matches!(Track::load("nowhere/track.toml"), Err(Error::Io { .. })));
}

#[test]
fn a_track_file_cannot_pass_for_a_built_in_track() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("mine.toml");
    let path = path.to_str().unwrap();
    for (own, taken) in [("lake", true), ("random:7", true), ("lakeside", false)] {
        fs::write(path, toml::to_string(&TrackSpec { name: own.into(), ..lake_spec() }).unwrap()).unwrap();
        let expected = if taken { format!("{own} ({path})") } else { own.to_string() };
        assert_eq!(Track::load(path).unwrap().name(), expected);
    }
    assert_eq!(Track::load("lake").unwrap().name(), "lake");
}

#[test]
fn bad_track_files_are_refused_with_place_and_remedy() {
    let eight = |i: usize| {
        let a = i as f64 / 24.0 * std::f64::consts::TAU;
        [170.0 * a.sin(), 90.0 * (2.0 * a).sin(), 3.0, 8.0, 0.0]
    };
    let crossing = refusal(TrackSpec { points: (0..24).map(eight).collect(), ..lake_spec() });
    assert!(crossing.starts_with("my.toml: ") && crossing.contains("crosses or touches itself"), "{crossing}");

    let mut tight = lake_spec();
    let at = tight.points[5];
    tight.points[6] = [at[0] + 3.0, at[1] + 3.0, 0.0, 9.0, 0.0];
    tight.points[7] = [at[0] + 30.0, at[1] - 20.0, 0.0, 9.0, 0.0];
    let tight = refusal(tight);
    assert!(tight.contains("radius") && tight.contains("at least 25 m"), "{tight}");

    let mut long = lake_spec();
    long.points.iter_mut().for_each(|p| (p[0], p[1]) = (p[0] * 2.0, p[1] * 2.0));
    assert!(refusal(long).contains("600 to 1500 m"));
    assert!(refusal(TrackSpec { points: lake_spec().points[..4].to_vec(), ..lake_spec() }).contains("at least 6"));
    let mut steep = lake_spec();
    steep.points[3][2] = 60.0;
    assert!(refusal(steep).contains("slope"));
    let mut lost = lake_spec();
    lost.stretch[1].look = Some("glass".to_string());
    assert!(refusal(lost).contains("`glass`"));
    let Err(error) = Track::from_toml("name = 3", "my.toml") else { panic!("accepted") };
    assert!(error.to_string().starts_with("my.toml:1: "));
}

/// Hash of every file of a folder, names included, in the order of the names.
fn hash_of(folder: &Path) -> String {
    let mut hash = Sha256::new();
    let mut paths: Vec<_> = fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
    paths.sort();
    for path in paths {
        hash.update(path.file_name().unwrap().as_encoded_bytes());
        if path.is_dir() {
            hash.update(hash_of(&path));
        } else {
            hash.update(fs::read(&path).unwrap());
        }
    }
    hash.finalize().iter().map(|b| format!("{b:02x}")).collect()
}

#[test]
fn a_small_car_is_recorded_with_one_camera_and_its_own_speed() {
    let track = Track::load("lake").unwrap();
    let folder = tempfile::tempdir().unwrap();
    let [own, small] = [None, CarGeometry::preset("donkeycar")].map(|car| {
        let out = folder.path().join(if car.is_some() { "small" } else { "own" });
        record(&track, &RecordOptions { laps: 0.01, car, ..Default::default() }, &out, &mut Unobserved).unwrap();
        crate::dataset::load_with(&out, &Default::default(), crate::dataset::ImageCheck::Verify).unwrap()
    });
    assert_eq!(small.geometry, CarGeometry::preset("donkeycar").unwrap());
    assert_eq!((small.rows.len(), std::fs::read_dir(folder.path().join("small/IMG")).unwrap().count()), (13, 13));
    let picture = std::fs::read_dir(folder.path().join("small/IMG")).unwrap().next().unwrap().unwrap().path();
    assert_eq!(crate::picture::decode::image_size(&std::fs::read(picture).unwrap()), Ok([120, 160]));
    let side = |out: &str| fs::read_to_string(folder.path().join(out).join("recording.toml")).unwrap();
    let [own_side, small_side]: [toml::Table; 2] = ["own", "small"].map(|out| side(out).parse().unwrap());
    assert!(!own_side.contains_key("scale"));
    assert!((small_side["scale"].as_float().unwrap() - 2.87 / 0.26).abs() < 1e-9);
    assert_eq!(own_side["speed_mph"], small_side["speed_mph"], "on the track");
    for (small, own) in small.rows.iter().zip(&own.rows) {
        assert_eq!(small.steering, own.steering);
        assert!((small.speed_mph * 2.87 / 0.26 - own.speed_mph).abs() < 1e-3);
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_for_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let record_with = |threads, seed, name: &str| {
        let track = Track::load("lake").unwrap();
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let options = RecordOptions { laps: 0.03, seed, noise: 0.05, ..Default::default() };
        let out = dir.path().join(name);
        let info = pool.install(|| record(&track, &options, &out, &mut Unobserved)).unwrap();
        assert!(info.rows > 20);
        hash_of(&out)
    };
    let first = record_with(1, 4, "first");
    assert_eq!(first, record_with(3, 4, "second"));
    assert_ne!(first, record_with(1, 5, "third"));
}

#[test]
fn trajectories_repeat_to_the_bit() {
    let options = TrialOptions { laps: 1, speed: Speed::Auto, latency_ms: 60.0, noise: 0.05, assisted: true };
    let drive =
        |seed| trajectory_csv(&run_trial(&Track::load("random:5").unwrap(), &mut Expert, &options, seed).unwrap());
    assert_eq!(drive(8), drive(8));
    assert_ne!(drive(8), drive(9));
}

#[test]
fn recordings_have_the_format_of_udacitys_simulator() {
    let dir = tempfile::tempdir().unwrap();
    let track = Track::load("coast").unwrap();
    let sample = RecordOptions { laps: 0.01, ..Default::default() };
    let out = dir.path().join("new/sample");
    record(&track, &sample, &out, &mut Unobserved).unwrap();
    let text = fs::read_to_string(out.join("driving_log.csv")).unwrap();
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some("center,left,right,steering,throttle,brake,speed"));
    for line in lines {
        let fields: Vec<&str> = line.split(", ").collect();
        assert_eq!(fields.len(), 7);
        for (field, mount) in fields.iter().zip(Mount::ALL) {
            assert!(field.starts_with(&format!("IMG/{}_2026_01_01_", mount.name())), "{field}");
            let picture = image::open(out.join(field)).unwrap();
            assert_eq!((picture.width(), picture.height()), (320, 160));
        }
        let steering: f64 = fields[3].parse().unwrap();
        assert!((-1.0..=1.0).contains(&steering));
    }
    let side: toml::Table = fs::read_to_string(out.join("recording.toml")).unwrap().parse().unwrap();
    assert_eq!(side["held_out"].as_bool(), Some(true));
    assert_eq!(side["rows"].as_integer(), Some(text.lines().count() as i64 - 1));

    let before = hash_of(&out);
    let refused = record(&track, &sample, &out, &mut Unobserved).unwrap_err().to_string();
    assert!(refused.contains("exists already"), "{refused}");
    assert_eq!(before, hash_of(&out));

    let v2 = dir.path().join("v2");
    record(&track, &RecordOptions { format: LogFormat::V2, ..sample.clone() }, &v2, &mut Unobserved).unwrap();
    let text = fs::read_to_string(v2.join("driving_log.csv")).unwrap();
    let first: Vec<&str> = text.lines().next().unwrap().split(',').collect();
    assert!(first.len() == 7 && Path::new(first[0]).is_absolute() && Path::new(first[0]).exists());

    let stopped = record(&track, &sample, &dir.path().join("stopped"), &mut |_| Err(Error::Interrupted));
    assert!(matches!(stopped, Err(Error::Interrupted)));
    let mut left: Vec<_> = fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["new", "v2"], "what was stopped leaves nothing behind");
}

/// Mean brightness of a rectangle of a picture.
fn brightness(frame: &RgbFrame, columns: std::ops::Range<usize>, rows: std::ops::Range<usize>) -> f64 {
    let n = (columns.len() * rows.len() * 3) as f64;
    let sum: u64 = rows
        .flat_map(|r| columns.clone().map(move |c| (r * WIDTH + c) * 3))
        .flat_map(|at| &frame.pixels[at..at + 3])
        .map(|p| u64::from(*p))
        .sum();
    sum as f64 / n
}

#[test]
fn a_picture_shows_sky_above_road_and_the_centre_line_where_it_is() {
    let track = Track::load("mountain").unwrap();
    let world = track.world();
    let (mut renderer, mut frame) = (Renderer::default(), RgbFrame::default());
    let mut seen = 0;
    for place in 0..80 {
        let start = Start { s_m: place as f64 * 10.0, reverse: false, offset_m: 1.5, heading_deg: 0.0 };
        let body = Simulation::new(&track, start, 9.0).body_pose();
        let camera = Camera::new(&body, Mount::Center);
        renderer.render(world, &Variant::new(world, 0), &camera, Mount::Center, &mut frame);
        // A dash of the centre line 7 m ahead, if there is one, and the asphalt a metre beside it.
        let s = track.at(start.s_m + 7.0);
        let point = |right: f64| {
            let p = math::vec3(
                (s.x + s.ty * right) as f32,
                (s.y - s.tx * right) as f32,
                (s.z - s.crossfall * right) as f32,
            );
            camera.project(p).unwrap()
        };
        let at = |right: f64| {
            let (column, row) = point(right);
            brightness(&frame, column as usize - 1..column as usize + 2, row as usize..row as usize + 1)
        };
        let along = (start.s_m + 7.0) * world.road_length_m as f64 / track.length_m;
        let phase = (along + f64::from(Variant::new(world, 0).road_shift_m)).rem_euclid(12.0);
        // Not where the edge of a shadow or a repaired patch runs beside the line.
        let even = at(1.0).min(at(-1.0)) > 0.9 * at(1.0).max(at(-1.0));
        if world.road[track.locate(s.x, s.y).station].look != 0 || !even {
            continue;
        }
        if (1.0..3.5).contains(&phase) {
            assert!(at(0.0) > 1.12 * at(1.0).max(at(-1.0)), "{place}: {} {} {}", at(0.0), at(1.0), at(-1.0));
            seen += 1;
        } else if (6.0..10.5).contains(&phase) {
            assert!(at(0.0) < 1.12 * at(1.0).max(at(-1.0)), "{place}");
        }
    }
    assert!(seen >= 5, "{seen}");
}

#[test]
fn a_crest_hides_the_road_behind_it() {
    let mut spec = lake_spec();
    spec.land.water_level_m = None;
    spec.land.hills_m = 0.0;
    spec.land.plants.clear();
    spec.stretch.clear();
    // How much nearer than a point of the road, 35 m behind the top, is what covers its pixel from 30 m before the top.
    let hidden_m = |hump_m: f64| {
        let mut spec = spec.clone();
        spec.points[3][2] = hump_m;
        let track = Track::from_spec(spec, "hump").unwrap();
        let top = (100..160).max_by(|a, b| track.stations[*a].z.total_cmp(&track.stations[*b].z)).unwrap();
        let start = Start { s_m: track.s_of(top) - 30.0, reverse: false, offset_m: 0.0, heading_deg: 0.0 };
        let body = Simulation::new(&track, start, 9.0).body_pose();
        let camera = Camera::new(&body, Mount::Center);
        let (mut renderer, mut frame) = (Renderer::default(), RgbFrame::default());
        renderer.render(track.world(), &Variant::new(track.world(), 0), &camera, Mount::Center, &mut frame);
        let behind = track.stations[top + 35];
        let point = math::vec3(behind.x as f32, behind.y as f32, behind.z as f32);
        let (column, row) = camera.project(point).unwrap();
        camera.view(point).z - renderer.depth_m(column as usize, row as usize)
    };
    assert!(hidden_m(0.0).abs() < 6.0, "{}", hidden_m(0.0));
    assert!(hidden_m(8.0) > 15.0, "{}", hidden_m(8.0));
}

#[test]
fn a_contact_sheet_holds_every_picture() {
    let sheet = contact_sheet(&Track::load("forest").unwrap(), 2, 3, false, 0);
    assert_eq!((sheet.width(), sheet.height()), (2 * 324, 3 * 164));
    assert!(sheet.get_pixel(100, 100) != sheet.get_pixel(424, 264));
}
