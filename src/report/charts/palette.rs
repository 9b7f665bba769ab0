//! Colours that colour-blind people can tell apart (Okabe and Ito 2008), for dark text on a light ground.

/// Text and axes.
pub const INK: &str = "#1a1a1a";
/// Secondary text.
pub const QUIET_INK: &str = "#5a5a5a";
/// Grid lines.
pub const GRID: &str = "#dddddd";
/// Areas that are not meant to stand out.
pub const PALE: &str = "#ececec";

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

/// Colours of series in their order; it begins again after the last.
pub const SERIES: [&str; 7] = [BLUE, VERMILION, GREEN, ORANGE, PURPLE, SKY, INK];

/// The colour of series `i`.
pub fn series(i: usize) -> &'static str {
    SERIES[i % SERIES.len()]
}

/// Light yellow over red to near black, in equal steps of lightness: heat maps in print and for the colour-blind. Points of
/// ColorBrewer's `YlOrRd`, the light end left transparent by whoever overlays it.
const HEAT: [[f64; 3]; 6] = [
    [255.0, 255.0, 204.0],
    [254.0, 217.0, 118.0],
    [253.0, 141.0, 60.0],
    [227.0, 26.0, 28.0],
    [160.0, 0.0, 40.0],
    [70.0, 0.0, 30.0],
];

/// The colour of `share`, 0 (light) to 1 (dark), of a heat map.
pub fn heat(share: f64) -> [u8; 3] {
    let place = share.clamp(0.0, 1.0) * (HEAT.len() - 1) as f64;
    let i = (place as usize).min(HEAT.len() - 2);
    let t = place - i as f64;
    std::array::from_fn(|c| (HEAT[i][c] + (HEAT[i + 1][c] - HEAT[i][c]) * t).round() as u8)
}

/// The same as `#rrggbb`.
pub fn heat_hex(share: f64) -> String {
    let [r, g, b] = heat(share);
    format!("#{r:02x}{g:02x}{b:02x}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heat_darkens_steadily_and_stays_in_its_range() {
        let lightness = |share| heat(share).map(u32::from).iter().sum::<u32>();
        assert!((0..20).all(|i| lightness(f64::from(i) / 20.0) > lightness(f64::from(i + 1) / 20.0)));
        assert_eq!((heat(-1.0), heat_hex(2.0)), ([255, 255, 204], "#46001e".into()));
    }
}
