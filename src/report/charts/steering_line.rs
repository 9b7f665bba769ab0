//! A steering angle drawn into the camera's picture.

use crate::picture::RgbImage;

/// Steering lines are drawn at this many times the angle of the wheels.
pub const STEERING_SCALE: f64 = 2.0;

/// Draws a steering angle as a line from the middle of the lower edge, outlined so that it shows on any ground.
pub fn draw_steering(picture: &mut RgbImage, wheels_deg: f64, rgb: [u8; 3]) {
    let (height, width) = (picture.height as f64, picture.width as f64);
    let (sin, cos) = (STEERING_SCALE * wheels_deg).clamp(-85.0, 85.0).to_radians().sin_cos();
    let from = [width / 2.0, height * 0.98];
    let to = [from[0] + 0.45 * height * sin, from[1] - 0.45 * height * cos];
    let thickness = (height / 50.0).max(1.5);
    picture.draw_line(from, to, thickness + 2.0, [255; 3]);
    picture.draw_line(from, to, thickness, rgb);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::charts::palette::REFERENCE_RGB;

    #[test]
    fn a_line_leans_by_twice_the_angle_of_the_wheels() {
        let mut picture = RgbImage::filled(100, 200, [0; 3]);
        draw_steering(&mut picture, 22.5, REFERENCE_RGB);
        // Twice 22.5 degrees: as far to the right as up.
        assert_eq!(picture.pixel(98 - 20, 100 + 20), REFERENCE_RGB);
        assert_eq!(picture.pixel(98 - 20, 100 - 20), [0; 3]);
    }
}
