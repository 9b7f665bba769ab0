//! The view from beside the path, made of the view from the path.
//!
//! A camera that has moved sees the ground plane through a homography, and what is far away through the homography of its turn
//! alone. [`ViewWarp`] uses the first below the horizon and the second above it, as NVIDIA did for PilotNet (Bojarski et al.
//! 2016). It is exact for a flat road; what stands on the ground leans.

use super::camera::CarGeometry;
use super::driven_path::Offset;

/// How the pixels of a picture lie in the camera's picture: `column * scale + origin`, and the same for rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PixelGrid {
    /// Height and width of the picture, pixels.
    pub size: [usize; 2],
    /// Row and column of the camera's picture at the upper left corner.
    pub origin: [f64; 2],
    /// Rows and columns of the camera's picture for each row and column of this one.
    pub scale: [f64; 2],
}

impl PixelGrid {
    /// All of the camera's picture, as `size` (height, width) pixels.
    pub fn whole(geometry: &CarGeometry, size: [usize; 2]) -> PixelGrid {
        PixelGrid::part(geometry, [0.0, 1.0], size)
    }

    /// The rows from `rows[0]` to `rows[1]`, shares of the picture's height, as `size` (height, width) pixels.
    pub fn part(geometry: &CarGeometry, rows: [f64; 2], size: [usize; 2]) -> PixelGrid {
        let [height, width] = geometry.image.map(|side| side as f64);
        PixelGrid {
            size,
            origin: [rows[0] * height, 0.0],
            scale: [(rows[1] - rows[0]) * height / size[0] as f64, width / size[1] as f64],
        }
    }

    /// From (column, row, 1) of this picture to that of the camera's.
    fn picture_to_camera(self) -> Matrix {
        let ([y, x], [sy, sx]) = (self.origin, self.scale);
        Matrix([[sx, 0.0, x], [0.0, sy, y], [0.0, 0.0, 1.0]])
    }

    /// From (column, row, 1) of the camera's picture to that of this one.
    fn camera_to_picture(self) -> Matrix {
        let ([y, x], [sy, sx]) = (self.origin, self.scale);
        Matrix([[1.0 / sx, 0.0, -x / sx], [0.0, 1.0 / sy, -y / sy], [0.0, 0.0, 1.0]])
    }
}

/// A planned warp from one camera's picture to the picture of a displaced camera.
#[derive(Clone, Debug)]
pub struct ViewWarp {
    size: [usize; 2],
    /// From (column, row, 1) of the wanted picture to that of the given one, below and above the horizon.
    ground: Matrix,
    far: Matrix,
    /// The height of the ray through (column, row, 1) of the wanted picture: negative below the horizon.
    rise: [f64; 3],
}

impl ViewWarp {
    /// The warp to the centre camera of a car that stands at `offset` from where the picture was taken, by a camera `taken_m` to
    /// the right of that car's centre camera. Both pictures have the pixels of `grid`.
    pub fn new(geometry: &CarGeometry, grid: PixelGrid, taken_m: f64, offset: Offset) -> ViewWarp {
        ViewWarp::between(geometry, grid, taken_m, offset, 0.0)
    }

    /// As [`new`](Self::new), to a camera `wanted_m` to the right of the displaced car's centre camera.
    pub fn between(geometry: &CarGeometry, grid: PixelGrid, taken_m: f64, offset: Offset, wanted_m: f64) -> ViewWarp {
        ViewWarp::planned(geometry, grid, taken_m, offset, wanted_m, false)
    }

    /// As [`new`](Self::new), in a world that is mirrored, left and right: the car stands at the mirror image of `offset`, and its
    /// camera is mounted as ever. A picture of a rolled or turned camera that is mirrored column by column would show the horizon as
    /// no camera of the car sees it.
    pub fn mirrored(geometry: &CarGeometry, grid: PixelGrid, taken_m: f64, offset: Offset) -> ViewWarp {
        ViewWarp::planned(geometry, grid, taken_m, offset, 0.0, true)
    }

    fn planned(
        geometry: &CarGeometry,
        grid: PixelGrid,
        taken_m: f64,
        offset: Offset,
        wanted_m: f64,
        mirrored: bool,
    ) -> ViewWarp {
        // Coordinates are right, up, ahead. Rays of the wanted camera in its car's axes, mirrored back into the world that the picture
        // was taken in:
        let mount = rotation(geometry);
        let side = if mirrored { -1.0 } else { 1.0 };
        let wanted_m = side * wanted_m;
        let mirror = Matrix([[side, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]);
        let rays = mirror * mount * lens(geometry).inverse_of_lens() * grid.picture_to_camera();
        // A turn to the right by t takes the displaced car's (right, ahead) into the first car's.
        let (sin, cos) = (libm::sin(offset.turn), libm::cos(offset.turn));
        let turn = Matrix([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]);
        let to_picture = grid.camera_to_picture() * lens(geometry) * mount.transposed();
        let far = to_picture * turn * rays;
        // A ray (x, y, z) with y < 0 meets the ground at (wanted_m + x h / -y, 0, ahead + z h / -y) of the displaced car. With the
        // weight -y the point is linear in the ray; so is its place seen from the camera that took the picture.
        let h = geometry.height_m;
        let hit = Matrix([[h, -wanted_m, 0.0], [0.0, h, 0.0], [0.0, -geometry.ahead_m, h]]);
        let taken = [taken_m, 0.0, geometry.ahead_m];
        let moved = [offset.right_m - taken[0], 0.0, offset.ahead_m - taken[2]];
        // (0, -1, 0) · ray is the weight: the translation is added that many times.
        let shift = Matrix([[0.0, -moved[0], 0.0], [0.0, 0.0, 0.0], [0.0, -moved[2], 0.0]]);
        let ground = to_picture * (turn * hit + shift) * rays;
        ViewWarp { size: grid.size, ground, far, rise: rays.0[1] }
    }

    /// Where the pixel (column, row) of the wanted picture lies in the given one; `None` behind the camera that took it.
    pub fn source(&self, column: f64, row: f64) -> Option<(f64, f64)> {
        let rise = self.rise[0] * column + self.rise[1] * row + self.rise[2];
        let [x, y, w] = (if rise < 0.0 { &self.ground } else { &self.far }).times([column, row, 1.0]);
        (w > 1e-9).then(|| (x / w, y / w))
    }

    /// Whether the pixel (column, row) of the wanted picture shows ground that the given picture shows too.
    pub fn sees_ground(&self, column: f64, row: f64) -> bool {
        let rise = self.rise[0] * column + self.rise[1] * row + self.rise[2];
        let [h, w] = self.size.map(|side| side as f64);
        rise < 0.0
            && self.source(column, row).is_some_and(|(x, y)| (0.5..w - 0.5).contains(&x) && (0.5..h - 0.5).contains(&y))
    }

    /// Makes the wanted picture `to` of the given one `from`, both `[h][w][3]` with the pixels of the grid. Between pixels it
    /// interpolates linearly; beyond the edge it repeats the edge.
    ///
    /// # Panics
    ///
    /// If the lengths are not those of the grid.
    pub fn apply(&self, from: &[u8], to: &mut [u8]) {
        let [h, w] = self.size;
        assert!(from.len() == h * w * 3 && to.len() == h * w * 3, "pictures of {w}x{h} pixels");
        if h < 2 || w < 2 {
            return self.apply_thin(from, to);
        }
        for (row, line) in to.chunks_exact_mut(w * 3).enumerate() {
            let y = row as f64 + 0.5;
            // Along a row everything is linear in the column, so the horizon is crossed once at most.
            let rise = [self.rise[0], self.rise[1] * y + self.rise[2]];
            let is_below = |column: usize| rise[0] * (column as f64 + 0.5) + rise[1] < 0.0;
            let first = is_below(0);
            let crossing = if first == is_below(w - 1) { w } else { ((-rise[1] / rise[0]) as usize).min(w) };
            // The division may be a column off.
            let crossing = (crossing.saturating_sub(1)..w).find(|&column| is_below(column) != first).unwrap_or(w);
            let (left, right) = line.split_at_mut(crossing * 3);
            let [at_left, at_right] = if first { [&self.ground, &self.far] } else { [&self.far, &self.ground] };
            span(from, self.size, &at_left.along_row(y), 0, left);
            span(from, self.size, &at_right.along_row(y), crossing, right);
        }
    }

    /// A picture of a single row or column: nothing lies between pixels.
    fn apply_thin(&self, from: &[u8], to: &mut [u8]) {
        let [h, w] = self.size;
        for (i, pixel) in to.chunks_exact_mut(3).enumerate() {
            let (x, y) = self.source((i % w) as f64 + 0.5, (i / w) as f64 + 0.5).unwrap_or((0.0, 0.0));
            let (x, y) = ((x as usize).min(w - 1), (y as usize).min(h - 1));
            pixel.copy_from_slice(&from[(y * w + x) * 3..(y * w + x) * 3 + 3]);
        }
    }
}

/// Pixels whose sources are found together, so that the compiler can use vectors.
const CHUNK: usize = 64;

/// Fills `line`, the pixels of a row from column `start` on, from `from`. `ends` holds, for the source's column, its row and
/// their weight, the factor of the column and the constant. Pixel centres lie at halves.
fn span(from: &[u8], [h, w]: [usize; 2], ends: &[[f32; 2]; 3], start: usize, line: &mut [u8]) {
    let [u, v, weight] = ends;
    let (last_x, last_y) = ((w - 1) as f32, (h - 1) as f32);
    // The last pixel is that to the right of, or below, the one before.
    let (max_x, max_y) = (w as i32 - 2, h as i32 - 2);
    let (mut at, mut right, mut down) = ([0u32; CHUNK], [0u32; CHUNK], [0u32; CHUNK]);
    let mut begin = start;
    for part in line.chunks_mut(CHUNK * 3) {
        for i in 0..CHUNK {
            let x = (begin + i) as f32 + 0.5;
            let scale = (weight[0] * x + weight[1]).max(1e-9);
            let column = ((u[0] * x + u[1]) / scale - 0.5).max(0.0).min(last_x);
            let row = ((v[0] * x + v[1]) / scale - 0.5).max(0.0).min(last_y);
            let (column, row) = ((column * 256.0) as i32, (row * 256.0) as i32);
            let (x0, y0) = ((column >> 8).min(max_x), (row >> 8).min(max_y));
            at[i] = (y0 * w as i32 + x0) as u32 * 3;
            (right[i], down[i]) = ((column - (x0 << 8)) as u32, (row - (y0 << 8)) as u32);
        }
        for (i, pixel) in part.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            let (at, fx, fy) = (at[i] as usize, right[i], down[i]);
            let (upper, lower) = (&from[at..at + 6], &from[at + w * 3..at + w * 3 + 6]);
            *pixel = std::array::from_fn(|c| {
                let upper = u32::from(upper[c]) * (256 - fx) + u32::from(upper[c + 3]) * fx;
                let lower = u32::from(lower[c]) * (256 - fx) + u32::from(lower[c + 3]) * fx;
                ((upper * (256 - fy) + lower * fy + (1 << 15)) >> 16) as u8
            });
        }
        begin += CHUNK;
    }
}

/// From camera axes (right, up, along the optical axis) to the car's (right, up, ahead): roll, then pitch, then yaw.
fn rotation(geometry: &CarGeometry) -> Matrix {
    let [(sp, cp), (sy, cy), (sr, cr)] = [geometry.pitch_deg, geometry.yaw_deg, geometry.roll_deg].map(|deg| {
        let angle = deg.to_radians();
        (libm::sin(angle), libm::cos(angle))
    });
    let roll = Matrix([[cr, -sr, 0.0], [sr, cr, 0.0], [0.0, 0.0, 1.0]]);
    let pitch = Matrix([[1.0, 0.0, 0.0], [0.0, cp, -sp], [0.0, sp, cp]]);
    let yaw = Matrix([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]]);
    yaw * pitch * roll
}

/// From camera axes to (column, row, 1) of the camera's picture.
fn lens(geometry: &CarGeometry) -> Matrix {
    let ([h, w], f) = (geometry.image.map(|side| side as f64), geometry.focal_px);
    Matrix([[f, 0.0, w / 2.0], [0.0, -f, h / 2.0], [0.0, 0.0, 1.0]])
}

/// A 3x3 matrix, row by row.
#[derive(Clone, Copy, Debug)]
struct Matrix([[f64; 3]; 3]);

impl Matrix {
    fn times(&self, v: [f64; 3]) -> [f64; 3] {
        self.0.map(|[a, b, c]| a * v[0] + b * v[1] + c * v[2])
    }

    /// The product with (x, `y`, 1): the factor of x and the constant of each entry.
    fn along_row(&self, y: f64) -> [[f32; 2]; 3] {
        self.0.map(|[a, b, c]| [a as f32, (b * y + c) as f32])
    }

    fn transposed(self) -> Matrix {
        Matrix(std::array::from_fn(|i| std::array::from_fn(|k| self.0[k][i])))
    }

    /// The inverse of a matrix that [`lens`] made.
    fn inverse_of_lens(self) -> Matrix {
        let [[fx, _, cx], [_, fy, cy], _] = self.0;
        Matrix([[1.0 / fx, 0.0, -cx / fx], [0.0, 1.0 / fy, -cy / fy], [0.0, 0.0, 1.0]])
    }
}

impl std::ops::Mul for Matrix {
    type Output = Matrix;

    fn mul(self, o: Matrix) -> Matrix {
        Matrix(std::array::from_fn(|i| std::array::from_fn(|k| (0..3).map(|j| self.0[i][j] * o.0[j][k]).sum())))
    }
}

impl std::ops::Add for Matrix {
    type Output = Matrix;

    fn add(self, o: Matrix) -> Matrix {
        Matrix(std::array::from_fn(|i| std::array::from_fn(|k| self.0[i][k] + o.0[i][k])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn udacity() -> CarGeometry {
        CarGeometry::preset("udacity").unwrap()
    }

    fn whole() -> PixelGrid {
        PixelGrid::whole(&udacity(), [160, 320])
    }

    /// The pixel that shows the ground point (right, ahead) of a car at the origin, by its camera `mount_m` to the right: trigonometry
    /// of one ray, written down apart from the matrices above.
    fn pixel_of(right_m: f64, ahead_m: f64, mount_m: f64) -> (f64, f64) {
        let g = udacity();
        let (x, y, z) = (right_m - mount_m, -g.height_m, ahead_m - g.ahead_m);
        // Undo yaw, then pitch, then roll.
        let (yaw, pitch, roll) = (g.yaw_deg.to_radians(), g.pitch_deg.to_radians(), g.roll_deg.to_radians());
        let (x, z) = (x * yaw.cos() - z * yaw.sin(), x * yaw.sin() + z * yaw.cos());
        let (y, z) = (y * pitch.cos() + z * pitch.sin(), -y * pitch.sin() + z * pitch.cos());
        let (x, y) = (x * roll.cos() + y * roll.sin(), -x * roll.sin() + y * roll.cos());
        (160.0 + x / z * g.focal_px, 80.0 - y / z * g.focal_px)
    }

    #[test]
    fn without_a_displacement_every_pixel_stays() {
        let warp = ViewWarp::new(&udacity(), whole(), 0.0, Offset::default());
        for (column, row) in [(0.5, 0.5), (160.0, 56.0), (160.0, 57.0), (319.5, 159.5)] {
            let (x, y) = warp.source(column, row).unwrap();
            assert!((x - column).abs() < 1e-9 && (y - row).abs() < 1e-9);
        }
        let picture: Vec<u8> = (0..160 * 320 * 3).map(|i| (i * 7 % 251) as u8).collect();
        let mut same = vec![0; picture.len()];
        warp.apply(&picture, &mut same);
        assert!(picture.iter().zip(&same).all(|(a, b)| a.abs_diff(*b) <= 1));
    }

    #[test]
    fn points_of_the_ground_keep_their_colour() {
        for offset in [
            Offset { right_m: 0.7, ahead_m: 0.0, turn: 0.0 },
            Offset { right_m: -0.4, ahead_m: 0.9, turn: 0.12 },
            Offset { right_m: 0.0, ahead_m: -0.5, turn: -0.2 },
        ] {
            for (taken_m, wanted_m) in [(0.0, 0.0), (-0.806, 0.0), (0.825, -0.806)] {
                let warp = ViewWarp::between(&udacity(), whole(), taken_m, offset, wanted_m);
                for (right_m, ahead_m) in [(0.0, 9.0), (-2.0, 14.0), (3.0, 30.0)] {
                    // The same point in the axes of the displaced car.
                    let (x, z) = (right_m - offset.right_m, ahead_m - offset.ahead_m);
                    let (sin, cos) = offset.turn.sin_cos();
                    let (x, z) = (x * cos - z * sin, x * sin + z * cos);
                    let (column, row) = pixel_of(x, z, wanted_m);
                    let (found_column, found_row) = warp.source(column, row).unwrap();
                    let (true_column, true_row) = pixel_of(right_m, ahead_m, taken_m);
                    assert!((found_column - true_column).abs() < 1e-6, "{found_column} {true_column}");
                    assert!((found_row - true_row).abs() < 1e-6, "{found_row} {true_row}");
                }
            }
        }
    }

    #[test]
    fn the_sky_turns_and_does_not_shift() {
        let aside = ViewWarp::new(&udacity(), whole(), 0.0, Offset { right_m: 1.0, ..Offset::default() });
        assert_eq!(aside.source(100.0, 10.0).map(|(x, _)| (x * 1e6).round() / 1e6), Some(100.0));
        let turned = ViewWarp::new(&udacity(), whole(), 0.0, Offset { turn: 0.1, ..Offset::default() });
        // A car turned to the right sees at column 100, 23.4 deg left of the axis, what was 0.1 rad to the right of that.
        let (column, _) = turned.source(100.0, 56.0).unwrap();
        let expected = 160.0 + 138.564 * ((-60.0f64 / 138.564).atan() + 0.1).tan();
        assert!((column - expected).abs() < 2.0, "{column} {expected}");
    }

    #[test]
    fn a_part_of_the_picture_is_warped_as_the_whole() {
        // The rows and the size of the recipe `default`.
        let part = PixelGrid::part(&udacity(), [56.0 / 160.0, 136.0 / 160.0], [40, 160]);
        let offset = Offset { right_m: 0.5, ahead_m: 0.0, turn: -0.05 };
        let [small, large] = [part, whole()].map(|grid| ViewWarp::new(&udacity(), grid, 0.0, offset));
        for (column, row) in [(40.0, 30.0), (120.0, 12.0), (80.0, 39.0)] {
            let (x, y) = small.source(column, row).unwrap();
            let (whole_x, whole_y) = large.source(column * 2.0, row * 2.0 + 56.0).unwrap();
            assert!((x * 2.0 - whole_x).abs() < 1e-9 && (y * 2.0 + 56.0 - whole_y).abs() < 1e-9);
        }
        assert!(large.sees_ground(160.0, 120.0) && !large.sees_ground(160.0, 20.0));
    }

    #[test]
    fn pixels_are_interpolated_where_their_source_lies() {
        let linear = |x: f64, y: f64| 10.0 + 0.5 * x + 0.3 * y;
        let picture: Vec<u8> = (0..160 * 320)
            .flat_map(|i| [linear((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5).round() as u8; 3])
            .collect();
        let mut warped = vec![0; picture.len()];
        for offset in
            [Offset { right_m: 0.7, ahead_m: 0.0, turn: 0.1 }, Offset { right_m: -0.4, ahead_m: 0.9, turn: -0.12 }]
        {
            for warp in [
                ViewWarp::new(&udacity(), whole(), 0.825, offset),
                ViewWarp::mirrored(&udacity(), whole(), -0.806, offset),
            ] {
                warp.apply(&picture, &mut warped);
                for (i, pixel) in warped.as_chunks::<3>().0.iter().enumerate() {
                    let (x, y) = warp.source((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5).unwrap();
                    let grey = linear(x.clamp(0.5, 319.5), y.clamp(0.5, 159.5));
                    let near = pixel.iter().all(|&found| (f64::from(found) - grey).abs() < 1.3);
                    assert!(near, "{offset:?}, {} {}: {pixel:?} {grey}", i % 320, i / 320);
                }
            }
        }
    }

    #[test]
    fn thin_pictures_are_warped_too() {
        for size in [[1, 1], [1, 7], [9, 1]] {
            let grid = PixelGrid::whole(&udacity(), size);
            let picture: Vec<u8> = (0..size[0] * size[1] * 3).map(|i| i as u8).collect();
            let mut same = vec![255; picture.len()];
            ViewWarp::new(&udacity(), grid, 0.0, Offset::default()).apply(&picture, &mut same);
            assert_eq!(picture, same, "{size:?}");
        }
    }

    #[test]
    fn a_mirrored_world_is_seen_by_the_camera_as_it_is_mounted() {
        // A car at `offset`, whose picture a side camera of a car on the path takes. In the mirrored world the same ground point has
        // the opposite sign, and so has the car's place.
        for (taken_m, offset) in [
            (0.0, Offset::default()),
            (-0.806, Offset { right_m: -0.9, ahead_m: 0.0, turn: 0.08 }),
            (0.825, Offset { right_m: 0.5, ahead_m: 0.3, turn: -0.1 }),
        ] {
            let warp = ViewWarp::mirrored(&udacity(), whole(), taken_m, offset);
            for (right_m, ahead_m) in [(0.0, 9.0), (-2.0, 14.0), (3.0, 30.0)] {
                let (x, z) = (right_m - offset.right_m, ahead_m - offset.ahead_m);
                let (sin, cos) = offset.turn.sin_cos();
                let (x, z) = (x * cos - z * sin, x * sin + z * cos);
                let (column, row) = pixel_of(-x, z, 0.0);
                let (found_column, found_row) = warp.source(column, row).unwrap();
                let (true_column, true_row) = pixel_of(right_m, ahead_m, taken_m);
                assert!((found_column - true_column).abs() < 1e-6, "{found_column} {true_column}");
                assert!((found_row - true_row).abs() < 1e-6, "{found_row} {true_row}");
            }
        }
        // Column by column, the horizon of a rolled camera would tilt the other way: by 2 * 1.2 degrees, 13 rows across the picture.
        let warp = ViewWarp::mirrored(&udacity(), whole(), 0.0, Offset::default());
        let [left, right] = [0.5, 319.5].map(|column| warp.source(column, 60.0).unwrap().1 - 60.0);
        assert!((left - right).abs() > 12.0, "{left} {right}");
    }
}
