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
        // Coordinates are right, up, ahead. Rays of the wanted camera in its car's axes:
        let mount = rotation(geometry);
        let rays = mount * lens(geometry).inverse_of_lens() * grid.picture_to_camera();
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
        for (row, line) in to.chunks_exact_mut(w * 3).enumerate() {
            let y = row as f64 + 0.5;
            // Along a row everything is linear in the column.
            let rise = [self.rise[0], self.rise[1] * y + self.rise[2]];
            let ends = [&self.ground, &self.far].map(|m| m.0.map(|[a, b, c]| [a, b * y + c]));
            for (column, pixel) in line.chunks_exact_mut(3).enumerate() {
                let x = column as f64 + 0.5;
                let below = rise[0] * x + rise[1] < 0.0;
                let [u, v, weight] = ends[usize::from(!below)].map(|[a, b]| a * x + b);
                let scale = if weight > 1e-9 { 1.0 / weight } else { 0.0 };
                let sample = bilinear(from, self.size, (u * scale) as f32, (v * scale) as f32);
                pixel.copy_from_slice(&sample);
            }
        }
    }
}

/// The colour at (column, row) of a picture, pixel centres at halves.
fn bilinear(picture: &[u8], [h, w]: [usize; 2], column: f32, row: f32) -> [u8; 3] {
    let place = |at: f32, n: usize| {
        let at = (at - 0.5).clamp(0.0, (n - 1) as f32);
        let first = (at as usize).min(n - 1);
        (first, (first + 1).min(n - 1), ((at - first as f32) * 256.0) as u32)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (place(column, w), place(row, h));
    let at = |y: usize, x: usize| &picture[(y * w + x) * 3..(y * w + x) * 3 + 3];
    let (a, b, c, d) = (at(y0, x0), at(y0, x1), at(y1, x0), at(y1, x1));
    std::array::from_fn(|i| {
        let top = u32::from(a[i]) * (256 - fx) + u32::from(b[i]) * fx;
        let bottom = u32::from(c[i]) * (256 - fx) + u32::from(d[i]) * fx;
        ((top * (256 - fy) + bottom * fy + (1 << 15)) >> 16) as u8
    })
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
}
