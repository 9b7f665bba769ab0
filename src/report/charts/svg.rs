//! Writing SVG: shapes and text with numbers rounded to a hundredth and text escaped.

use std::fmt::Write as _;

use super::palette::{GROUND, INK};
use crate::text::escaped_lines;

/// Fonts every system has one of.
pub const FONT: &str = "system-ui, -apple-system, 'Segoe UI', 'DejaVu Sans', Arial, sans-serif";

/// Which point of a text its position names.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Anchor {
    /// Its left end.
    Start,
    /// Its middle.
    Middle,
    /// Its right end.
    End,
}

impl Anchor {
    fn name(self) -> &'static str {
        match self {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        }
    }
}

/// A drawing. Positions are pixels at 100 %, y downwards; `style` is a list of SVG attributes.
#[derive(Clone, Debug)]
pub struct Svg {
    width: f64,
    height: f64,
    attributes: String,
    body: String,
}

impl Svg {
    /// An empty drawing.
    pub fn new(width: f64, height: f64) -> Svg {
        Svg { width, height, attributes: String::new(), body: String::new() }
    }

    /// Gives the whole drawing an attribute.
    pub fn attribute(&mut self, name: &str, value: &str) {
        // Writing to a string cannot fail.
        let _ = write!(self.attributes, " {name}=\"{}\"", escape(value));
    }

    /// A rectangle.
    pub fn rect(&mut self, [x, y]: [f64; 2], [width, height]: [f64; 2], style: &str) {
        let (x, y, width, height) = (number(x), number(y), number(width.max(0.0)), number(height.max(0.0)));
        self.put(format_args!("<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" {style}/>"));
    }

    /// A straight line.
    pub fn line(&mut self, from: [f64; 2], to: [f64; 2], style: &str) {
        let ([x1, y1], [x2, y2]) = (from.map(number), to.map(number));
        self.put(format_args!("<line x1=\"{x1}\" y1=\"{y1}\" x2=\"{x2}\" y2=\"{y2}\" {style}/>"));
    }

    /// A line through `points`, broken where one is not finite.
    pub fn polyline(&mut self, points: &[[f64; 2]], style: &str) {
        let mut path = String::new();
        let mut pen_down = false;
        for point in points {
            if point.iter().all(|v| v.is_finite()) {
                let [x, y] = point.map(number);
                // Writing to a string cannot fail.
                let _ = write!(path, "{}{x} {y}", if pen_down { "L" } else { "M" });
            }
            pen_down = point.iter().all(|v| v.is_finite());
        }
        if !path.is_empty() {
            self.put(format_args!("<path d=\"{path}\" fill=\"none\" stroke-linejoin=\"round\" {style}/>"));
        }
    }

    /// A closed area.
    pub fn polygon(&mut self, points: &[[f64; 2]], style: &str) {
        let mut path = String::new();
        for [x, y] in points.iter().map(|point| point.map(number)) {
            let _ = write!(path, "{x},{y} ");
        }
        self.put(format_args!("<polygon points=\"{}\" {style}/>", path.trim_end()));
    }

    /// Many dots of one kind, as a single path: 10,000 of them stay small.
    pub fn dots(&mut self, points: impl IntoIterator<Item = [f64; 2]>, diameter: f64, colour: &str, style: &str) {
        let mut path = String::new();
        for [x, y] in points.into_iter().filter(|point| point.iter().all(|v| v.is_finite())) {
            let _ = write!(path, "M{} {}h0", number(x), number(y));
        }
        if !path.is_empty() {
            self.put(format_args!(
                "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{}\" stroke-linecap=\"round\" \
                 {style}/>",
                number(diameter)
            ));
        }
    }

    /// Text of `size` pixels with its base line at y.
    pub fn text(&mut self, [x, y]: [f64; 2], size: f64, anchor: Anchor, style: &str, text: &str) {
        let fill = if style.contains("fill=") { String::new() } else { format!(" fill=\"{INK}\"") };
        let (x, y, size, anchor, text) = (number(x), number(y), number(size), anchor.name(), escape(text));
        self.put(format_args!(
            "<text x=\"{x}\" y=\"{y}\" font-size=\"{size}\" text-anchor=\"{anchor}\"{fill} {style}>{text}</text>"
        ));
    }

    /// The drawing as an element to stand in a page, or in a file of its own.
    pub fn finish(self) -> String {
        let (width, height) = (number(self.width), number(self.height));
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}\" height=\"{height}\" viewBox=\"0 0 {width} \
             {height}\" font-family=\"{FONT}\"{}>\n<rect width=\"{width}\" height=\"{height}\" \
             fill=\"{GROUND}\"/>\n{}</svg>\n",
            self.attributes, self.body
        )
    }

    fn put(&mut self, element: std::fmt::Arguments) {
        let _ = writeln!(self.body, "{element}");
    }
}

/// `text` in lines of at most `width` pixels at `size`, broken between words.
pub fn wrapped(text: &str, size: f64, width: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if text_width(line, size) + text_width(word, size) + 0.5 * size <= width => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.into()),
        }
    }
    lines
}

/// Width in pixels of `text` at `size`, by the mean width of a letter; good enough to leave room for it.
pub fn text_width(text: &str, size: f64) -> f64 {
    0.56 * size * text.chars().count() as f64
}

/// At most two decimals, none that say nothing.
fn number(value: f64) -> String {
    let text = format!("{value:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

/// `text` with what XML would take for markup replaced, and what it forbids or a reader cannot see written out.
pub fn escape(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in escaped_lines(text).chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '\'' => escaped.push_str("&#39;"),
            c => escaped.push(c),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_drawing_is_well_formed_whatever_its_text() {
        let mut svg = Svg::new(100.0, 50.0);
        svg.text([1.0, 2.0], 12.0, Anchor::Middle, "", "a < b & \"c\" \u{1}\u{ffff}");
        svg.rect([0.0, 0.0], [-1.0, 3.0], "fill=\"none\"");
        svg.polygon(&[[0.0, 0.0], [1.0, 1.0]], "");
        let text = svg.finish();
        let document = roxmltree::Document::parse(&text).unwrap();
        let found = document.descendants().find(|node| node.has_tag_name(("http://www.w3.org/2000/svg", "text")));
        assert_eq!(found.unwrap().text(), Some("a < b & \"c\" \\u{1}\\u{ffff}"));
        assert!(text.contains("width=\"0\" height=\"3\""), "{text}");
    }

    #[test]
    fn a_line_is_broken_where_a_value_is_missing() {
        let mut svg = Svg::new(10.0, 10.0);
        svg.polyline(&[[0.0, 1.0], [1.0, 2.0], [2.0, f64::NAN], [3.0, 4.0]], "");
        svg.dots([[1.0, 1.0], [f64::NAN, 2.0]], 3.0, "#000000", "");
        let text = svg.finish();
        assert!(text.contains("d=\"M0 1L1 2M3 4\"") && text.contains("d=\"M1 1h0\""), "{text}");
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([0.1 + 0.2, -0.001, 10.0, 1234.567].map(number), ["0.3", "0", "10", "1234.57"]);
    }
}
