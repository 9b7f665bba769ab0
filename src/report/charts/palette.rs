//! Colours that colour-blind people can tell apart (Okabe and Ito 2008), for light and for dark ground.
//!
//! Drawings name the colours for light ground. A page adds [`dark_rules`], which exchange them where the system is dark.

/// Text and axes.
pub const INK: &str = "#1a1a1a";
/// Secondary text.
pub const QUIET_INK: &str = "#5a5a5a";
/// Grid lines.
pub const GRID: &str = "#dddddd";
/// Areas that are not meant to stand out.
pub const PALE: &str = "#ececec";
/// Ground of every drawing.
pub const GROUND: &str = "#ffffff";
/// A road seen from above.
pub const ROAD: &str = "#d9d9d9";
/// Edge of a road.
pub const ROAD_EDGE: &str = "#9a9a9a";

/// Blue: the usual colour of data.
pub const BLUE: &str = "#0072B2";
/// Vermilion: what to look at, or what is wrong.
pub const VERMILION: &str = "#D55E00";
/// Bluish green.
pub const GREEN: &str = "#009E73";
/// Orange.
pub const ORANGE: &str = "#E69F00";
/// Sky blue.
pub const SKY: &str = "#56B4E9";
/// Reddish purple.
pub const PURPLE: &str = "#CC79A7";

/// Steering of a model, on every page, in every film and on the live page.
pub const MODEL: &str = "#B87F00";
/// Steering that a model is compared with: the recorded driver's, or the expert's.
pub const REFERENCE: &str = BLUE;
/// [`MODEL`] in a camera's picture, where a light orange shows better.
pub const MODEL_RGB: [u8; 3] = [0xff, 0xb0, 0x00];
/// [`REFERENCE`] in a camera's picture.
pub const REFERENCE_RGB: [u8; 3] = [0x00, 0x72, 0xb2];

/// Colours of series in their order; it begins again after the last.
pub const SERIES: [&str; 7] = [BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, INK];

/// Colours that change on dark ground, and what they become there.
const DARK: [(&str, &str); 11] = [
    (INK, "#e8e8e8"),
    (QUIET_INK, "#a9b0b7"),
    (GRID, "#343b42"),
    (PALE, "#2b3138"),
    (GROUND, "#14181c"),
    (ROAD, "#3a4148"),
    (ROAD_EDGE, "#6b737b"),
    (BLUE, "#4aa8e4"),
    (VERMILION, "#ff8a3d"),
    (GREEN, "#2ec596"),
    (MODEL, "#ffb000"),
];

/// The colour of series `i`.
pub fn series(i: usize) -> &'static str {
    SERIES[i % SERIES.len()]
}

/// Shade of stretches of a chart, for light and for dark ground.
pub const SHADES: [(&str, &str); 5] = [
    ("#dcdcdc", "#40464d"),
    ("#cfe6f5", "#1f4560"),
    ("#fbe3c0", "#5a4415"),
    ("#f3dcea", "#55314a"),
    ("#f7cdb6", "#63301a"),
];

/// Light yellow over red to near black, in equal steps of lightness: heat maps in print and for the colour-blind. Points of
/// ColorBrewer's `YlOrRd`; whoever overlays it leaves the light end transparent.
const HEAT: [[f64; 3]; 6] = [
    [255.0, 255.0, 204.0],
    [254.0, 217.0, 118.0],
    [253.0, 141.0, 60.0],
    [227.0, 26.0, 28.0],
    [160.0, 0.0, 40.0],
    [70.0, 0.0, 30.0],
];

/// The same on dark ground, where much is light: grey blue over red to light yellow.
const DARK_HEAT: [[f64; 3]; 6] = [
    [84.0, 110.0, 140.0],
    [96.0, 125.0, 160.0],
    [150.0, 110.0, 170.0],
    [226.0, 90.0, 120.0],
    [253.0, 150.0, 70.0],
    [255.0, 240.0, 150.0],
];

fn along(points: &[[f64; 3]; 6], share: f64) -> [u8; 3] {
    let place = share.clamp(0.0, 1.0) * (points.len() - 1) as f64;
    let i = (place as usize).min(points.len() - 2);
    let t = place - i as f64;
    std::array::from_fn(|c| (points[i][c] + (points[i + 1][c] - points[i][c]) * t).round() as u8)
}

fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}

/// The colour of `share`, 0 (light) to 1 (dark), of a heat map.
pub fn heat(share: f64) -> [u8; 3] {
    along(&HEAT, share)
}

/// The same as `#rrggbb`.
pub fn heat_hex(share: f64) -> String {
    hex(heat(share))
}

/// What saliency adds to a picture: its colour at `value`, 0 (nothing) to 1 (most), purple over pink to light yellow, which no
/// landscape has.
pub fn saliency(value: f64) -> [u8; 3] {
    const POINTS: [[f64; 3]; 6] = [
        [60.0, 0.0, 110.0],
        [130.0, 0.0, 160.0],
        [220.0, 20.0, 150.0],
        [255.0, 90.0, 110.0],
        [255.0, 180.0, 70.0],
        [255.0, 250.0, 170.0],
    ];
    along(&POINTS, value)
}

/// The same as `#rrggbb`.
pub fn saliency_hex(value: f64) -> String {
    hex(saliency(value))
}

/// CSS that exchanges the colours of drawings for those of dark ground. `heat_shares` are the shares of a heat map that
/// drawings of the page use.
pub fn dark_rules(heat_shares: &[f64]) -> String {
    let mut rules = String::new();
    let mut add = |light: &str, dark: &str| {
        rules +=
            &format!("svg [fill=\"{light}\"] {{ fill: {dark}; }} svg [stroke=\"{light}\"] {{ stroke: {dark}; }}\n");
    };
    DARK.iter().chain(&SHADES).for_each(|(light, dark)| add(light, dark));
    heat_shares.iter().for_each(|share| add(&heat_hex(*share), &hex(along(&DARK_HEAT, *share))));
    rules
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heat_darkens_steadily_and_stays_in_its_range() {
        let lightness = |share| heat(share).map(u32::from).iter().sum::<u32>();
        assert!((0..20).all(|i| lightness(f64::from(i) / 20.0) > lightness(f64::from(i + 1) / 20.0)));
        assert_eq!((heat(-1.0), heat_hex(2.0)), ([255, 255, 204], "#46001e".into()));
        let brightness = |share| along(&DARK_HEAT, share).map(u32::from).iter().sum::<u32>();
        assert!((0..20).all(|i| brightness(f64::from(i) / 20.0) < brightness(f64::from(i + 1) / 20.0)));
    }

    /// Contrast of two colours as WCAG 2.2 defines it.
    fn contrast(a: &str, b: &str) -> f64 {
        let luminance = |colour: &str| -> f64 {
            let channel = |k: usize| {
                let share = f64::from(u8::from_str_radix(&colour[k..k + 2], 16).unwrap()) / 255.0;
                if share <= 0.03928 { share / 12.92 } else { ((share + 0.055) / 1.055).powf(2.4) }
            };
            0.2126 * channel(1) + 0.7152 * channel(3) + 0.0722 * channel(5)
        };
        let (a, b) = (luminance(a), luminance(b));
        (a.max(b) + 0.05) / (a.min(b) + 0.05)
    }

    #[test]
    fn text_and_lines_stand_out_on_both_grounds() {
        let dark = |light: &str| DARK.iter().find(|(from, _)| *from == light).unwrap().1;
        for text in [INK, QUIET_INK] {
            assert!(contrast(text, GROUND) >= 4.5 && contrast(dark(text), dark(GROUND)) >= 4.5, "{text}");
        }
        for line in [BLUE, VERMILION, GREEN, MODEL] {
            let (light, dark) = (contrast(line, GROUND), contrast(dark(line), dark(GROUND)));
            assert!(light >= 3.0 && dark >= 3.0, "{line}: {light:.1} {dark:.1}");
        }
    }
}
