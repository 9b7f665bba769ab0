//! Pages that stand alone: inline drawings, images as `data:` addresses, one inline script, nothing to load. They are
//! written as well-formed XML too, so that any XML reader can check them.

use std::fmt::Write as _;

use crate::report::charts::svg::{FONT, escape};
use crate::report::charts::{map, palette};
use crate::report::tone::Tone;

/// The style of every page: light or dark as the system is, and usable on a phone.
const STYLE: &str = include_str!("page.css");
/// Shows values of charts under the pointer.
const SCRIPT: &str = include_str!("hover.js");

/// Characters of a table's cell that are not broken.
const SHORT: usize = 16;

/// A page in the making.
#[derive(Clone, Debug)]
pub struct Page {
    title: String,
    body: String,
}

/// A picture with words below it.
#[derive(Clone, Debug)]
pub struct Figure {
    /// `data:` address of the picture.
    pub source: String,
    /// What it shows; several lines are separated by `\n`.
    pub caption: String,
    /// Show single pixels as squares when the picture is enlarged.
    pub pixelated: bool,
}

impl Page {
    /// A page headed `title`, with `lead` in smaller print below.
    pub fn new(title: &str, lead: &str) -> Page {
        let body = format!("<h1>{}</h1>\n<p class=\"lead\">{}</p>\n", escape(title), escape(lead));
        Page { title: title.into(), body }
    }

    /// Begins a part.
    pub fn section(&mut self, title: &str) {
        self.put(format_args!("<h2>{}</h2>", escape(title)));
    }

    /// Begins a part of a part.
    pub fn subsection(&mut self, title: &str) {
        self.put(format_args!("<h3>{}</h3>", escape(title)));
    }

    /// A paragraph.
    pub fn paragraph(&mut self, text: &str) {
        self.put(format_args!("<p>{}</p>", escape(text)));
    }

    /// A paragraph that stands out.
    pub fn advice(&mut self, text: &str, tone: Tone) {
        let class = match tone {
            Tone::Warning => "advice",
            Tone::Good => "advice good",
            Tone::Neutral => "advice neutral",
        };
        self.put(format_args!("<div class=\"{class}\">{}</div>", escape(text)));
    }

    /// What the colours of a scale mean, from `low` to `high`.
    pub fn scale(&mut self, low: &str, high: &str, colours: &[String]) {
        let (low, high, colours) = (escape(low), escape(high), colours.join(", "));
        let style = format!("background: linear-gradient(90deg, {colours})");
        self.put(format_args!("<p>{low} <span class=\"scale\" style=\"{style}\"></span> {high}</p>"));
    }

    /// A table. A column is set to the right if all its cells look like numbers.
    pub fn table(&mut self, headers: &[&str], rows: &[Vec<String>]) {
        let numeric: Vec<bool> = (0..headers.len())
            .map(|column| {
                let cells = || rows.iter().filter_map(|row| row.get(column)).filter(|cell| !cell.is_empty());
                cells().next().is_some() && cells().all(|cell| looks_like_a_number(cell))
            })
            .collect();
        let class = |column: usize| if numeric.get(column) == Some(&true) { " class=\"n\"" } else { "" };
        // On a phone each row of a wide table becomes a card, in which every cell stands behind its header.
        let titled = headers.iter().any(|header| !header.is_empty());
        self.body.push_str(if titled { "<table class=\"cards\">" } else { "<table>" });
        if titled {
            self.body.push_str("<tr>");
            for (column, header) in headers.iter().enumerate() {
                let _ = write!(self.body, "<th{}>{}</th>", class(column), escape(header));
            }
            self.body.push_str("</tr>");
        }
        for row in rows {
            self.body.push_str("\n<tr>");
            for (column, cell) in row.iter().enumerate() {
                // Short words stay whole, whatever the width.
                let short = cell.chars().count() <= SHORT && numeric.get(column) != Some(&true);
                let class = match cell.as_str() {
                    "" | "-" => " class=\"s none\"",
                    _ if short => " class=\"s\"",
                    _ => class(column),
                };
                let header = headers.get(column).filter(|header| !header.is_empty());
                let header = header.map_or(String::new(), |header| format!(" data-header=\"{}\"", escape(header)));
                // Long names break where their words end.
                let cell = escape(cell).replace('/', "/<wbr/>").replace('_', "_<wbr/>");
                let _ = write!(self.body, "<td{class}{header}>{cell}</td>");
            }
            self.body.push_str("</tr>");
        }
        self.body.push_str("</table>\n");
    }

    /// Drawings side by side, as far as there is room.
    pub fn drawings(&mut self, drawings: &[String]) {
        self.put(format_args!("<div class=\"row\">{}</div>", drawings.concat()));
    }

    /// Pictures in `columns` equal columns.
    pub fn figures(&mut self, columns: usize, figures: &[Figure]) {
        let _ = write!(self.body, "<div class=\"grid of{columns}\">");
        for Figure { source, caption, pixelated } in figures {
            let class = if *pixelated { " class=\"pixels\"" } else { "" };
            let alt = escape(&caption.replace('\n', "; "));
            let caption = escape(caption).replace('\n', "<br/>");
            let _ = writeln!(
                self.body,
                "<figure><img{class} src=\"{source}\" alt=\"{alt}\"/><figcaption>{caption}</figcaption></figure>"
            );
        }
        self.body.push_str("</div>\n");
    }

    /// Text as it is, folded away under `summary`.
    pub fn folded(&mut self, summary: &str, text: &str) {
        let (summary, text) = (escape(summary), escape(text));
        self.put(format_args!("<details><summary>{summary}</summary><pre>{text}</pre></details>"));
    }

    /// The page.
    pub fn finish(self) -> String {
        let title = escape(&self.title);
        let shares: Vec<f64> = (0..map::COLOURS).map(map::step_share).collect();
        let dark = palette::dark_rules(&shares);
        format!(
            "<!DOCTYPE html>\n<html lang=\"en\" xmlns=\"http://www.w3.org/1999/xhtml\">\n<head><meta \
             charset=\"utf-8\"/><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/><meta \
             name=\"color-scheme\" content=\"light dark\"/><title>{title}</title>\n<style>{STYLE}body {{ font-family: \
             {FONT}; }}\n@media (prefers-color-scheme: dark) {{\n{dark}}}\n</style></head>\n<body>\n{}<script>//<![CDATA[\n\
             {SCRIPT}//]]></script>\n</body>\n</html>\n",
            self.body
        )
    }

    fn put(&mut self, element: std::fmt::Arguments) {
        // Writing to a string cannot fail.
        let _ = writeln!(self.body, "{element}");
    }
}

fn looks_like_a_number(text: &str) -> bool {
    let first = text.trim_start_matches(['+', '-', '−', '~']);
    first.starts_with(|c: char| c.is_ascii_digit()) && text.chars().filter(|c| c.is_alphabetic()).count() <= 5
        || matches!(text, "-" | "–")
}

/// Checks that `text` is well-formed and that nothing in it makes a browser load something.
#[cfg(test)]
pub(super) fn assert_stands_alone(text: &str) {
    let options = roxmltree::ParsingOptions { allow_dtd: true, ..Default::default() };
    let document = roxmltree::Document::parse_with_options(text, options).unwrap();
    for node in document.descendants() {
        let name = node.tag_name().name();
        assert!(!["link", "iframe", "object", "embed"].contains(&name), "<{name}>");
        for attribute in node.attributes() {
            if ["src", "href", "srcset"].contains(&attribute.name()) {
                assert!(attribute.value().starts_with("data:"), "{name} loads {}", attribute.value());
            }
        }
    }
    assert!(!text.contains("url(") && !text.contains("@import"));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_page_is_well_formed_and_loads_nothing() {
        let mut page = Page::new("runs/<a> & b", "\u{7} lead");
        page.section("1 < 2");
        page.table(&["name", "MAE"], &[vec!["a<b".into(), "1.5 deg".into()], vec!["c".into(), "-".into()]]);
        page.figures(2, &[Figure { source: "data:,".into(), caption: "x\n\"y\"".into(), pixelated: true }]);
        page.folded("recipe", "[a]\nb = '<'");
        page.advice("do", Tone::Good);
        let text = page.finish();
        assert_stands_alone(&text);
        assert!(
            text.contains("<td class=\"n\" data-header=\"MAE\">1.5 deg</td>")
                && text.contains("<td class=\"s\" data-header=\"name\">a&lt;b</td>"),
            "{text}"
        );
        assert!(text.contains("x<br/>&quot;y&quot;"));
    }
}
