//! Mirroring by geometry against a mirrored track.

use crate::geometry::{CarGeometry, Offset, PixelGrid, ViewWarp};
use crate::simulator::camera::pinhole::{Camera, HEIGHT, Mount, RgbFrame, WIDTH};
use crate::simulator::camera::renderer::Renderer;
use crate::simulator::car::pose::BodyPose;
use crate::simulator::math::{Vec3, vec3};
use crate::simulator::road::builtin;
use crate::simulator::scenery::light::Variant;
use crate::simulator::track::Track;

/// The track file `text` of a world where north is south.
fn mirrored(text: &str) -> String {
    let mut table: toml::Table = text.parse().unwrap();
    for point in table["points"].as_array_mut().unwrap() {
        for i in [1, 4] {
            let value = &mut point.as_array_mut().unwrap()[i];
            *value = toml::Value::Float(-value.as_float().unwrap());
        }
    }
    let azimuth = &mut table["light"]["sun_azimuth_deg"];
    *azimuth = toml::Value::Float(-azimuth.as_float().unwrap());
    for list in ["look", "stretch"] {
        for entry in table[list].as_array_mut().unwrap() {
            let entry = entry.as_table_mut().unwrap();
            for [left, right] in [["left", "right"], ["left_wall", "right_wall"]] {
                let [a, b] = [entry.remove(left), entry.remove(right)];
                entry.extend(a.map(|side| (right.to_string(), side)));
                entry.extend(b.map(|side| (left.to_string(), side)));
            }
        }
    }
    table.to_string()
}

/// A car on the line at `s_m`, on the plane of the road.
fn body(track: &Track, s_m: f64) -> BodyPose {
    let s = track.at(s_m);
    let up =
        vec3(-(s.slope * s.tx - s.crossfall * s.ty) as f32, -(s.slope * s.ty + s.crossfall * s.tx) as f32, 1.0).unit();
    let forward = vec3(s.tx as f32, s.ty as f32, s.slope as f32).unit();
    BodyPose { origin: vec3(s.x as f32, s.y as f32, s.z as f32), forward, right: forward.cross(up), up }
}

#[test]
fn a_frame_that_is_mirrored_by_geometry_is_what_the_camera_sees_of_the_mirrored_track() {
    let text = builtin::text("lake").unwrap();
    let [track, mirror] = [text.to_string(), mirrored(text)].map(|text| Track::from_toml(&text, "lake").unwrap());
    let flipped = |v: Vec3| vec3(v.x, -v.y, v.z);
    let car = CarGeometry::preset("steersman").unwrap();
    let warp = ViewWarp::mirrored(&car, PixelGrid::whole(&car, [HEIGHT, WIDTH]), 0.0, Offset::default());
    let take = |track: &Track, body: &BodyPose| {
        let mut frame = RgbFrame::default();
        let variant = Variant::new(track.world(), 1);
        let camera = Camera::new(body, Mount::Center);
        Renderer::default().render(track.world(), &variant, &camera, Mount::Center, &mut frame);
        frame.pixels
    };
    let (mut by_geometry, mut by_columns, mut n) = (0, 0, 0);
    for s_m in [100.0, 180.0, 215.0, 250.0, 430.0, 660.0] {
        let here = body(&track, s_m);
        let there = BodyPose {
            origin: flipped(here.origin),
            forward: flipped(here.forward),
            right: flipped(here.right) * -1.0,
            up: flipped(here.up),
        };
        let (taken, wanted) = (take(&track, &here), take(&mirror, &there));
        let mut made = vec![0; taken.len()];
        warp.apply(&taken, &mut made);
        // The road from 3.5 m ahead of the camera on, as wide as it is; the horizon lies at row 57.
        for row in 80..130 {
            for column in 0..WIDTH {
                if (column as f64 - 160.0).abs() > 3.5 * (row as f64 - 57.0) {
                    continue;
                }
                for c in 0..3 {
                    let at = |column: usize| (row * WIDTH + column) * 3 + c;
                    by_geometry += usize::from(wanted[at(column)].abs_diff(made[at(column)]));
                    by_columns += usize::from(wanted[at(column)].abs_diff(taken[at(WIDTH - 1 - column)]));
                    n += 1;
                }
            }
        }
    }
    let [by_geometry, by_columns] = [by_geometry, by_columns].map(|sum| sum as f64 / f64::from(n));
    println!("mean difference on the road: {by_geometry:.2} grey levels by geometry, {by_columns:.2} by columns");
    assert!(by_geometry < 0.6 * by_columns, "{by_geometry:.2} grey levels, column by column {by_columns:.2}");
}
