//! Charts: axes with units, a legend, lines, dots and bars.
//!
//! A chart is drawn once for wide pages and once for phones, and a chart of positive values with a linear and with a
//! logarithmic y axis; the page's style shows one of them. Attributes of the drawing tell the page's script which value lies
//! where, so that it can show values under the pointer.

mod axis;

pub use axis::{Axis, Scale};

use super::palette::{GRID, INK, QUIET_INK};
use super::svg::{Anchor, Svg, text_width, wrapped};
use axis::PixelMap;

/// Size of the labels of the ticks, pixels.
const TICK_SIZE: f64 = 12.0;
/// Size of axis labels and legend, pixels.
const LABEL_SIZE: f64 = 13.0;
/// Size of the title, pixels.
const TITLE_SIZE: f64 = 15.0;
/// Room left of the axes.
const LEFT: f64 = 64.0;
/// Room right of the axes.
const RIGHT: f64 = 18.0;
/// Room below the axes.
const BELOW: f64 = 44.0;
/// Width of a drawing for phones, pixels.
pub(crate) const NARROW: f64 = 358.0;
/// Height of a chart for phones, pixels.
const NARROW_HEIGHT: f64 = 300.0;
/// How the values of a series are drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Mark {
    /// A line of this width in pixels.
    Line(f64),
    /// A dashed line.
    Dashed,
    /// Dots of this diameter in pixels.
    Dots(f64),
    /// A bar from zero, as wide as the distance to its neighbours; on a logarithmic axis from the bottom.
    Bars {
        /// Width of a bar in units of x.
        width: f64,
    },
}

#[derive(Clone, Debug)]
struct Series {
    name: String,
    colour: String,
    mark: Mark,
    points: Vec<[f64; 2]>,
}

/// A shaded range of x.
#[derive(Clone, Debug)]
struct Shade {
    from: f64,
    to: f64,
    colour: String,
    name: String,
}

/// A chart to be drawn.
#[derive(Clone, Debug)]
pub struct Chart {
    title: String,
    size: [f64; 2],
    x: Axis,
    y: Axis,
    series: Vec<Series>,
    shades: Vec<Shade>,
}

impl Chart {
    /// An empty chart of `size` (width, height) pixels on a wide page.
    pub fn new(title: impl Into<String>, size: [f64; 2], x: Axis, y: Axis) -> Chart {
        Chart { title: title.into(), size, x, y, series: Vec::new(), shades: Vec::new() }
    }

    /// Adds values. An empty name leaves the series out of the legend. Of long lines only the extremes of each column of
    /// pixels are drawn.
    pub fn add(mut self, name: &str, colour: &str, mark: Mark, points: Vec<[f64; 2]>) -> Chart {
        self.series.push(Series { name: name.into(), colour: colour.into(), mark, points });
        self
    }

    /// Shades a range of x in `colour`; the legend explains it by `name`.
    pub fn shade(mut self, from: f64, to: f64, colour: &str, name: &str) -> Chart {
        self.shades.push(Shade { from, to, colour: colour.into(), name: name.into() });
        self
    }

    /// The drawings in one element, for a page.
    pub fn draw(&self) -> String {
        let mut scales = vec![self.y.scale];
        if self.can_switch() {
            scales.push(if self.y.scale == Scale::Log { Scale::Linear } else { Scale::Log });
        }
        let mut text = String::from("<figure class=\"chart\">");
        if let [_, other] = scales[..] {
            let name = if other == Scale::Log { "logarithmic" } else { "linear" };
            text += &format!("<label><input type=\"checkbox\"/> {name}</label>");
        }
        for (k, scale) in scales.into_iter().enumerate() {
            let scaled = Chart { y: Axis { scale, ..self.y.clone() }, ..self.clone() };
            let class = if k == 0 { "own" } else { "other" };
            text += &format!("<div class=\"{class}\"><div class=\"wide\">{}</div>", scaled.svg(self.size));
            text += &format!("<div class=\"narrow\">{}</div></div>", scaled.svg([NARROW, NARROW_HEIGHT]));
        }
        text + "</figure>\n"
    }

    /// Whether both kinds of y axis make sense: curves of positive values over a range that is not given.
    fn can_switch(&self) -> bool {
        let mut values = self.series.iter().flat_map(|s| &s.points).map(|p| p[1]).filter(|y| y.is_finite()).peekable();
        let curves = self.series.iter().all(|s| !matches!(s.mark, Mark::Bars { .. }));
        curves && self.y.range.is_none() && values.peek().is_some() && values.all(|y| y > 0.0)
    }

    /// The drawing of `size` (width, height) pixels.
    fn svg(&self, size: [f64; 2]) -> String {
        let mut svg = Svg::new(size[0], size[1]);
        self.draw_into(&mut svg, size);
        svg.finish()
    }

    fn draw_into(&self, svg: &mut Svg, [width, height]: [f64; 2]) {
        let mut top = 0.0;
        // The switch of the scale stands right of the title.
        for line in wrapped(&self.title, TITLE_SIZE, width - LEFT.min(width / 8.0) - 110.0) {
            top += 20.0;
            svg.text([8.0, top], TITLE_SIZE, Anchor::Start, "font-weight=\"600\"", &line);
        }
        top = top.max(20.0) + 22.0;
        svg.text([8.0, top], LABEL_SIZE, Anchor::Start, &fill(QUIET_INK), &self.y.label);
        let above = self.legend(svg, width, top);
        let area = Area { left: LEFT, right: width - RIGHT, top: above, bottom: height - BELOW };
        let series: Vec<Series> = self
            .series
            .iter()
            .map(|series| match series.mark {
                Mark::Line(_) | Mark::Dashed => {
                    Series { points: thin_out(series.points.clone(), width as usize), ..series.clone() }
                }
                _ => series.clone(),
            })
            .collect();
        let bars = series.iter().any(|series| matches!(series.mark, Mark::Bars { .. }));
        let margin = |series: &Series| if let Mark::Bars { width } = series.mark { width / 2.0 } else { 0.0 };
        let xs = series.iter().flat_map(|s| {
            let margin = margin(s);
            s.points.iter().flat_map(move |p| [p[0] - margin, p[0] + margin])
        });
        let ys = series.iter().flat_map(|s| s.points.iter().map(|p| p[1])).chain(bars.then_some(0.0));
        let x = PixelMap::new(&self.x, xs, [area.left, area.right], false);
        let y = PixelMap::new(&self.y, ys, [area.bottom, area.top], true);
        for (name, map, label) in [("data-x", &x, &self.x.label), ("data-y", &y, &self.y.label)] {
            let [from, to] = map.pixels;
            svg.attribute(name, &format!("{} {} {from} {to} {}", map.low, map.high, u8::from(map.scale == Scale::Log)));
            svg.attribute(&format!("{name}-label"), label);
        }

        for Shade { from, to, colour, .. } in &self.shades {
            let (left, right) = (x.place(*from), x.place(*to));
            svg.rect([left, area.top], [(right - left).max(1.0), area.bottom - area.top], &fill(colour));
        }
        let grid = format!("stroke=\"{GRID}\" stroke-width=\"1\"");
        for (value, label) in y.ticks((area.bottom - area.top) / 40.0) {
            let at = y.place(value);
            svg.line([area.left, at], [area.right, at], &grid);
            svg.text([area.left - 7.0, at + 4.0], TICK_SIZE, Anchor::End, "", &label);
        }
        let ticks = x.ticks((area.right - area.left) / 80.0);
        for (value, label) in &ticks {
            let at = x.place(*value);
            svg.line([at, area.bottom], [at, area.bottom + 5.0], &stroke(INK, 1.0));
            svg.text([at, area.bottom + 18.0], TICK_SIZE, Anchor::Middle, "", label);
        }
        svg.line([area.left, area.bottom], [area.right, area.bottom], &stroke(INK, 1.0));
        if y.low < 0.0 && y.high > 0.0 {
            svg.line([area.left, y.place(0.0)], [area.right, y.place(0.0)], &stroke(INK, 1.0));
        }
        let middle = (area.left + area.right) / 2.0;
        svg.text([middle, height - 8.0], LABEL_SIZE, Anchor::Middle, &fill(QUIET_INK), &self.x.label);
        series.iter().for_each(|series| draw_series(svg, series, &x, &y, area.bottom));
    }

    /// Draws the legend, in as many lines as it needs, and returns where the axes may begin. The name of the y axis stands
    /// before it, on the line at `top`.
    fn legend(&self, svg: &mut Svg, width: f64, top: f64) -> f64 {
        let mut entries: Vec<(&str, &str, Option<Mark>)> = Vec::new();
        for series in self.series.iter().filter(|series| !series.name.is_empty()) {
            entries.push((&series.name, &series.colour, Some(series.mark)));
        }
        for shade in &self.shades {
            if entries.iter().all(|(name, ..)| *name != shade.name) {
                entries.push((&shade.name, &shade.colour, None));
            }
        }
        let (mut x, mut y) = (text_width(&self.y.label, LABEL_SIZE) + 34.0, top);
        for (name, colour, mark) in entries {
            let needed = 30.0 + text_width(name, LABEL_SIZE) + 14.0;
            if x > 8.0 && x + needed > width {
                (x, y) = (8.0, y + 19.0);
            }
            match mark {
                Some(Mark::Line(_)) => svg.line([x, y - 4.5], [x + 22.0, y - 4.5], &stroke(colour, 3.0)),
                Some(Mark::Dashed) => {
                    let style = format!("{} stroke-dasharray=\"6 4\"", stroke(colour, 2.0));
                    svg.line([x, y - 4.5], [x + 22.0, y - 4.5], &style);
                }
                Some(Mark::Dots(_)) => svg.dots([[x + 12.0, y - 4.5]], 8.0, colour, ""),
                Some(Mark::Bars { .. }) | None => svg.rect([x + 5.0, y - 11.0], [14.0, 12.0], &fill(colour)),
            }
            svg.text([x + 28.0, y], LABEL_SIZE, Anchor::Start, "", name);
            x += needed;
        }
        y + 14.0
    }
}

/// Draws the values of one series; `bottom` is the lower edge of the axes.
fn draw_series(svg: &mut Svg, series: &Series, x: &PixelMap, y: &PixelMap, bottom: f64) {
    let points = series.points.iter().map(|p| [x.place(p[0]), y.place(p[1])]);
    let named = |kind: &str| format!("class=\"{kind}\" data-name=\"{}\"", super::svg::escape(&series.name));
    match series.mark {
        Mark::Line(width) => {
            let points: Vec<_> = points.collect();
            svg.polyline(&points, &format!("{} {}", stroke(&series.colour, width), named("curve")));
            if points.len() < 40 {
                svg.dots(points, width + 4.0, &series.colour, "");
            }
        }
        Mark::Dashed => {
            let style = format!("{} stroke-dasharray=\"6 4\" {}", stroke(&series.colour, 1.5), named("curve"));
            svg.polyline(&points.collect::<Vec<_>>(), &style);
        }
        Mark::Dots(diameter) => {
            svg.dots(points, diameter, &series.colour, &format!("stroke-opacity=\"0.45\" {}", named("dots")));
        }
        Mark::Bars { width } => {
            let zero = if y.scale == Scale::Log { bottom } else { y.place(0.0) };
            for point in series.points.iter().filter(|p| p[1].is_finite() && p[1] != 0.0) {
                let (left, right) = (x.place(point[0] - width / 2.0), x.place(point[0] + width / 2.0));
                let top = y.place(point[1]);
                // A hairline between neighbours; no bar is too small to be seen.
                let high = (zero - top).abs().max(1.0);
                let size = [(right - left - 1.0).max(1.0), high];
                let style = format!("{} {} data-at=\"{} {}\"", fill(&series.colour), named("bar"), point[0], point[1]);
                svg.rect([left + 0.5, zero.min(top).min(zero - 1.0)], size, &style);
            }
        }
    }
}

#[derive(Clone, Copy)]
struct Area {
    left: f64,
    right: f64,
    top: f64,
    bottom: f64,
}

/// `fill="colour"`.
pub(in crate::report::charts) fn fill(colour: &str) -> String {
    format!("fill=\"{colour}\"")
}

/// `stroke="colour" stroke-width="width"`.
pub(in crate::report::charts) fn stroke(colour: &str, width: f64) -> String {
    format!("stroke=\"{colour}\" stroke-width=\"{width}\"")
}

/// Of a long line, the lowest and the highest point in each of `columns` runs of points; gaps stay.
fn thin_out(points: Vec<[f64; 2]>, columns: usize) -> Vec<[f64; 2]> {
    if points.len() <= 4 * columns {
        return points;
    }
    let run = points.len().div_ceil(columns);
    let mut kept = Vec::with_capacity(3 * columns);
    for chunk in points.chunks(run) {
        let finite = || chunk.iter().enumerate().filter(|(_, p)| p[1].is_finite());
        let low = finite().min_by(|a, b| a.1[1].total_cmp(&b.1[1])).map(|(i, _)| i);
        let high = finite().max_by(|a, b| a.1[1].total_cmp(&b.1[1])).map(|(i, _)| i);
        let gap = chunk.iter().position(|p| !p[1].is_finite());
        let mut chosen: Vec<usize> = [low, high, gap].into_iter().flatten().collect();
        chosen.sort_unstable();
        chosen.dedup();
        kept.extend(chosen.into_iter().map(|i| chunk[i]));
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(low: f64, high: f64, scale: Scale, count: f64) -> Vec<String> {
        let map = PixelMap { scale, low, high, pixels: [0.0, 100.0] };
        map.ticks(count).into_iter().map(|(_, label)| label).collect()
    }

    #[test]
    fn ticks_are_round_numbers_with_just_enough_decimals() {
        assert_eq!(labels(-1.0, 1.0, Scale::Linear, 5.0), ["-1.0", "-0.5", "0.0", "0.5", "1.0"]);
        assert_eq!(labels(0.0, 30.0, Scale::Linear, 3.0), ["0", "10", "20", "30"]);
        assert_eq!(labels(0.011, 0.3, Scale::Log, 5.0), ["0.02", "0.05", "0.1", "0.2"]);
        assert_eq!(labels(0.021, 0.045, Scale::Log, 5.0), ["0.025", "0.030", "0.035", "0.040", "0.045"]);
        assert_eq!(labels(1e-5, 0.02, Scale::Log, 5.0), ["1e-5", "0.0001", "0.001", "0.01"]);
    }

    #[test]
    fn values_lie_where_the_axis_says() {
        let axis = Axis::new("x");
        let map = PixelMap::new(&axis, [0.0, 10.0].into_iter(), [100.0, 200.0], false);
        assert_eq!([0.0, 5.0, 10.0, 99.0].map(|v| map.place(v)), [100.0, 150.0, 200.0, 200.0]);
        let log = PixelMap::new(&axis.log().range(0.01, 1.0), [].into_iter(), [0.0, 100.0], true);
        assert!((log.place(0.1) - 50.0).abs() < 1e-9 && log.place(0.0).is_nan());
        let rounded = PixelMap::new(&Axis::new("y"), [0.3, 9.4].into_iter(), [0.0, 1.0], true);
        assert_eq!((rounded.low, rounded.high), (0.0, 10.0));
        let constant = PixelMap::new(&Axis::new("rate"), [0.001, 0.001].into_iter(), [0.0, 1.0], true);
        assert!(constant.low >= 0.0 && constant.high < 0.003, "{} {}", constant.low, constant.high);
    }

    #[test]
    fn charts_of_nothing_of_one_value_and_of_missing_values_are_drawn() {
        for points in [vec![], vec![[1.0, 3.0]], vec![[0.0, f64::NAN]], vec![[0.0, 1.0], [1.0, f64::INFINITY]]] {
            for scale in [Scale::Linear, Scale::Log] {
                let axis = Axis { scale, ..Axis::new("loss") };
                let chart = Chart::new("t", [400.0, 300.0], Axis::new("epoch"), axis)
                    .add("line", "#000000", Mark::Line(2.0), points.clone())
                    .add("bars", "#ff0000", Mark::Bars { width: 0.5 }, points.clone());
                let text = chart.draw();
                assert!(roxmltree::Document::parse(&text).is_ok() && !text.contains("NaN") && !text.contains("inf"));
            }
        }
    }

    #[test]
    fn curves_of_positive_values_have_both_scales_and_a_form_for_phones() {
        let chart = |points: Vec<[f64; 2]>| {
            Chart::new("t", [552.0, 340.0], Axis::new("epoch"), Axis::new("loss").log())
                .add("a", "#000000", Mark::Line(2.0), points)
                .draw()
        };
        let text = chart(vec![[1.0, 0.5], [2.0, 0.1]]);
        assert_eq!((text.matches("<svg").count(), text.matches("> linear</label>").count()), (4, 1));
        assert_eq!(text.matches("width=\"358\" height=\"300\" viewBox").count(), 2);
        assert_eq!(chart(vec![[1.0, 0.5], [2.0, 0.0]]).matches("<svg").count(), 2, "a zero has no logarithm");
    }

    #[test]
    fn shades_are_explained_once() {
        let chart = Chart::new("t", [552.0, 340.0], Axis::new("s"), Axis::new("mph"))
            .add("", "#000000", Mark::Line(2.0), vec![[0.0, -1.0], [9.0, 1.0]])
            .shade(1.0, 2.0, "#cccccc", "standing")
            .shade(4.0, 5.0, "#cccccc", "standing");
        let text = chart.svg([552.0, 340.0]);
        assert_eq!((text.matches(">standing<").count(), text.matches("#cccccc").count()), (1, 3));
    }

    #[test]
    fn a_logarithmic_axis_shows_four_decades_at_most() {
        let axis = Axis::new("rate").log();
        let map = PixelMap::new(&axis, [1e-3, 1e-10].into_iter(), [100.0, 0.0], true);
        assert!(map.low > 1e-8 && map.place(1e-10) == 100.0, "{}", map.low);
    }

    #[test]
    fn a_thinned_line_keeps_its_extremes_and_gaps() {
        let mut points: Vec<[f64; 2]> = (0..10_000).map(|i| [f64::from(i), 0.5]).collect();
        (points[1234][1], points[7000][1], points[9000][1]) = (9.0, -9.0, f64::NAN);
        let thin = thin_out(points, 100);
        assert!(thin.len() <= 300);
        for wanted in [9.0, -9.0] {
            assert!(thin.iter().any(|p| p[1] == wanted));
        }
        assert!(thin.iter().any(|p| p[1].is_nan()));
        assert!(thin.windows(2).all(|w| w[0][0] < w[1][0]));
    }
}
