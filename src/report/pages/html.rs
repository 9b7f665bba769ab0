//! Pages that stand alone: inline drawings, images as `data:` addresses, no script, nothing to load. They are written as
//! well-formed XML too, so that any XML reader can check them.

use std::fmt::Write as _;

use crate::report::charts::svg::{FONT, escape};

const STYLE: &str = "
body { margin: 0 auto; padding: 24px 32px 64px; max-width: 1136px; background: #fff; color: #1a1a1a; line-height: 1.5;
  font-size: 16px; }
h1 { font-size: 28px; margin: 8px 0 0; overflow-wrap: anywhere; }
h2 { font-size: 21px; margin: 40px 0 8px; border-bottom: 2px solid #0072B2; padding-bottom: 4px; }
h3 { font-size: 17px; margin: 24px 0 4px; }
.lead { color: #5a5a5a; margin: 4px 0 20px; overflow-wrap: anywhere; }
p { max-width: 860px; margin: 8px 0; }
table { border-collapse: collapse; margin: 12px 0; font-size: 14px; }
th { text-align: left; border-bottom: 2px solid #1a1a1a; padding: 4px 14px 4px 0; vertical-align: bottom; }
td { border-bottom: 1px solid #ddd; padding: 4px 14px 4px 0; vertical-align: top; overflow-wrap: anywhere; }
td.s { white-space: nowrap; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; }
td.n { white-space: nowrap; }
.row { display: flex; flex-wrap: wrap; gap: 16px; align-items: flex-start; margin: 12px 0; }
.grid { display: grid; gap: 14px 12px; margin: 12px 0; }
figure { margin: 0; }
figcaption { font-size: 13px; color: #3a3a3a; line-height: 1.35; margin-top: 3px; overflow-wrap: anywhere; }
img { display: block; width: 100%; height: auto; }
img.pixels { image-rendering: pixelated; }
svg { display: block; max-width: 100%; height: auto; }
.advice { background: #fff6e5; border-left: 5px solid #E69F00; padding: 8px 16px; margin: 10px 0; max-width: 860px; }
.good { background: #e8f6f1; border-left-color: #009E73; }
pre { background: #f5f5f5; padding: 12px 16px; overflow-x: auto; font-size: 13px; line-height: 1.4; }
details summary { cursor: pointer; font-weight: 600; margin: 8px 0; }
";

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

    /// A paragraph that stands out: something to do, or with `good` something to be content with.
    pub fn advice(&mut self, text: &str, good: bool) {
        let class = if good { "advice good" } else { "advice" };
        self.put(format_args!("<div class=\"{class}\">{}</div>", escape(text)));
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
        self.body.push_str("<table>");
        if headers.iter().any(|header| !header.is_empty()) {
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
                let class = if short { " class=\"s\"" } else { class(column) };
                let _ = write!(self.body, "<td{class}>{}</td>", escape(cell));
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
        let _ = write!(self.body, "<div class=\"grid\" style=\"grid-template-columns: repeat({columns}, 1fr)\">");
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
        format!(
            "<!DOCTYPE html>\n<html lang=\"en\" xmlns=\"http://www.w3.org/1999/xhtml\">\n<head><meta \
             charset=\"utf-8\"/><meta name=\"viewport\" content=\"width=device-width\"/><title>{title}</title>\n\
             <style>{STYLE}body {{ font-family: {FONT}; }}</style></head>\n<body>\n{}</body>\n</html>\n",
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
        assert!(!["script", "link", "iframe", "object", "embed"].contains(&name), "<{name}>");
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
        page.advice("do", true);
        let text = page.finish();
        assert_stands_alone(&text);
        assert!(
            text.contains("<td class=\"n\">1.5 deg</td>") && text.contains("<td class=\"s\">a&lt;b</td>"),
            "{text}"
        );
        assert!(text.contains("x<br/>&quot;y&quot;"));
    }
}
