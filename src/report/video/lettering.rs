//! Text in pictures: Noto Sans Mono, so that numbers do not move while their digits change.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

use crate::picture::RgbImage;

/// Height of a line of text.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Size {
    /// 16 pixels.
    Small,
    /// 20 pixels.
    Medium,
    /// 24 pixels.
    Large,
}

impl Size {
    fn raster(self) -> RasterHeight {
        match self {
            Size::Small => RasterHeight::Size16,
            Size::Medium => RasterHeight::Size20,
            Size::Large => RasterHeight::Size24,
        }
    }

    /// Width of a character, pixels.
    pub fn advance(self, bold: bool) -> usize {
        get_raster_width(weight(bold), self.raster())
    }
}

fn weight(bold: bool) -> FontWeight {
    if bold { FontWeight::Bold } else { FontWeight::Regular }
}

/// Writes `text` with its upper left corner at (`left`, `top`); what lies outside is cut off. Characters that the font
/// lacks become `?`.
pub(super) fn draw_text(
    picture: &mut RgbImage,
    [left, top]: [usize; 2],
    size: Size,
    bold: bool,
    rgb: [u8; 3],
    text: &str,
) {
    let advance = size.advance(bold);
    for (k, character) in text.chars().enumerate() {
        let shape = |c| get_raster(c, weight(bold), size.raster());
        let Some(shape) = shape(character).or_else(|| shape('?')) else { continue };
        for (row, levels) in shape.rows().enumerate() {
            for (column, level) in levels.iter().enumerate() {
                let (y, x) = (top + row, left + k * advance + column);
                if *level > 0 && y < picture.height && x < picture.width {
                    let below = picture.pixel(y, x);
                    let mixed = |c: usize| {
                        (u32::from(below[c]) * u32::from(255 - level) + u32::from(rgb[c]) * u32::from(*level)) / 255
                    };
                    picture.set_pixel(y, x, std::array::from_fn(|c| mixed(c) as u8));
                }
            }
        }
    }
}

/// As [`draw_text`], with the upper right corner at (`right`, `top`).
pub(super) fn draw_text_right(
    picture: &mut RgbImage,
    [right, top]: [usize; 2],
    size: Size,
    bold: bool,
    rgb: [u8; 3],
    text: &str,
) {
    let width = size.advance(bold) * text.chars().count();
    draw_text(picture, [right.saturating_sub(width), top], size, bold, rgb, text);
}

/// `text`, or its end behind an ellipsis if it has more than `max_chars` characters.
pub(super) fn end_of(text: &str, max_chars: usize) -> String {
    let length = text.chars().count();
    if length <= max_chars {
        text.into()
    } else {
        "...".chars().chain(text.chars().skip(length + 3 - max_chars)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_character_that_is_needed_has_a_shape_and_stays_in_its_cell() {
        for size in [Size::Small, Size::Medium, Size::Large] {
            for character in "0123456789+-.°/×abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ:()%".chars() {
                let advance = size.advance(true);
                let mut picture = RgbImage::filled(30, 3 * advance, [255; 3]);
                draw_text(&mut picture, [advance, 2], size, true, [0; 3], &character.to_string());
                let ink: Vec<usize> =
                    (0..picture.width).filter(|x| (0..30).any(|y| picture.pixel(y, *x) != [255; 3])).collect();
                assert!(
                    !ink.is_empty() && ink.iter().all(|x| (advance..2 * advance).contains(x)),
                    "{character} {ink:?}"
                );
            }
        }
    }

    #[test]
    fn text_is_cut_off_at_the_edge_and_long_names_keep_their_end() {
        let mut picture = RgbImage::filled(10, 10, [255; 3]);
        draw_text(&mut picture, [4, 4], Size::Large, false, [0; 3], "W\u{4e00}");
        draw_text_right(&mut picture, [3, 0], Size::Small, false, [0; 3], "wide");
        assert!(picture.pixels.iter().any(|level| *level < 128));
        assert_eq!((end_of("model", 5), end_of("runs/a/model", 8)), ("model".into(), "...model".into()));
    }
}
