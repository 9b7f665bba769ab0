//! The diagram of a network: one block for each layer that changes the shape, with what is done to its output written below.

use super::chart::NARROW;
use super::palette::{BLUE, GREEN, INK, ORANGE, PALE, QUIET_INK};
use super::svg::{Anchor, Svg, wrapped};
use crate::engine::layers::Family;
use crate::engine::network::{Network, group_digits};
use crate::engine::tensor::Shape;

/// Width of the drawing, pixels.
const WIDTH: f64 = 1120.0;
/// Room for a block and its text in a line, pixels.
const COLUMN: f64 = 116.0;
/// Height of the part of a line that holds the blocks.
const BLOCKS: f64 = 150.0;
/// Distance of text lines.
const LINE: f64 = 16.0;
/// Largest front of a block.
const LARGEST: f64 = 76.0;

/// A layer that changes the shape, and those after it that do not.
struct LayerGroup {
    name: String,
    colour: &'static str,
    shape: Shape,
    lines: Vec<String>,
    params: usize,
}

fn groups(network: &Network) -> Vec<LayerGroup> {
    let input = network.input();
    let mut groups =
        vec![LayerGroup { name: "input".into(), colour: PALE, shape: input, lines: Vec::new(), params: 0 }];
    for layer in network.layers() {
        let colour = match layer.spec.family() {
            Family::Convolution => Some(BLUE),
            Family::Pooling => Some(GREEN),
            Family::Dense => Some(ORANGE),
            Family::Rearrangement => Some(PALE),
            Family::Activation | Family::Normalization | Family::Regularization => None,
        };
        let (what, params) = (layer.spec.describe(), layer.params.len() + layer.statistics.len());
        match (colour, groups.last_mut()) {
            (None, Some(group)) => {
                group.lines.push(what);
                group.params += params;
            }
            (colour, _) => groups.push(LayerGroup {
                name: layer.name.clone(),
                colour: colour.unwrap_or(PALE),
                shape: layer.layer.output(),
                lines: vec![what],
                params,
            }),
        }
    }
    // Long descriptions, as `conv 5x5 stride 2x2`, take two lines.
    for group in &mut groups {
        let split = |line: &String| match line.split_once(" stride ") {
            Some((kind, stride)) => vec![kind.to_string(), format!("stride {stride}")],
            None if line.starts_with("x * ") => vec!["scaled".into()],
            None => vec![line.clone()],
        };
        group.lines = group.lines.iter().flat_map(split).collect();
    }
    groups
}

/// The diagram, headed `title`, for a page: on wide ground and on a phone.
pub(crate) fn figure(network: &Network, title: &str) -> String {
    let [wide, narrow] = [WIDTH, NARROW].map(|width| draw_at(network, title, width));
    format!("<figure><div class=\"wide\">{wide}</div><div class=\"narrow\">{narrow}</div></figure>\n")
}

/// The diagram, headed `title`.
pub fn draw(network: &Network, title: &str) -> String {
    draw_at(network, title, WIDTH)
}

fn draw_at(network: &Network, title: &str, width: f64) -> String {
    let groups = groups(network);
    let rows = groups.len().div_ceil((width / COLUMN) as usize);
    let across = groups.len().div_ceil(rows);
    let text_lines = groups.iter().map(|group| group.lines.len()).max().unwrap_or(0) as f64 + 3.0;
    let row_height = BLOCKS + LINE * text_lines + 16.0;
    let title_lines = wrapped(title, 17.0, width - 32.0);
    let above = 40.0 + 20.0 * title_lines.len().max(1) as f64;
    let mut svg = Svg::new(width, above + row_height * rows as f64);
    for (k, line) in title_lines.iter().enumerate() {
        svg.text([16.0, 26.0 + 20.0 * k as f64], 17.0, Anchor::Start, "font-weight=\"600\"", line);
    }
    let total = (network.count(true) + network.count(false)) as u64;
    let figures =
        format!("{} parameters, {} multiply-adds an image", group_digits(total), group_digits(network.multiply_adds()));
    svg.text([16.0, above - 14.0], 13.0, Anchor::Start, &format!("fill=\"{QUIET_INK}\""), &figures);

    let column = width / across as f64;
    let sizes = Sizes::of(&groups);
    for (i, group) in groups.iter().enumerate() {
        let (row, place) = (i / across, i % across);
        let top = above + row_height * row as f64;
        let middle = column * (place as f64 + 0.5);
        let centre = top + BLOCKS / 2.0;
        block(&mut svg, group, [middle, centre], sizes.block(group.shape));
        let half = |group: &LayerGroup| sizes.block(group.shape).half_width();
        if let Some(next) = groups.get(i + 1) {
            let last = place + 1 == across;
            let to = if last { width - 6.0 } else { middle + column - half(next) - 5.0 };
            arrow(&mut svg, [middle + half(group) + 5.0, centre], [to, centre]);
        }
        if place == 0 && i > 0 {
            arrow(&mut svg, [4.0, centre], [middle - half(group) - 5.0, centre]);
        }
        let mut y = top + BLOCKS + 4.0;
        let mut write = |text: &str, style: &str| {
            svg.text([middle, y], 12.5, Anchor::Middle, style, text);
            y += LINE;
        };
        write(&group.name, "font-weight=\"600\"");
        write(&group.shape.to_string(), "");
        group.lines.iter().for_each(|line| write(line, &format!("fill=\"{QUIET_INK}\"")));
        if group.params > 0 {
            write(&format!("{} par.", group_digits(group.params as u64)), &format!("fill=\"{INK}\""));
        }
    }
    svg.finish()
}

/// The largest sizes of a network, which blocks are drawn in relation to.
struct Sizes {
    side: f64,
    channels: f64,
    units: f64,
}

/// Front and depth of a block; vectors have no depth.
struct Cuboid {
    width: f64,
    height: f64,
    depth: f64,
}

impl Sizes {
    fn of(groups: &[LayerGroup]) -> Sizes {
        let (maps, vectors): (Vec<Shape>, Vec<Shape>) =
            groups.iter().map(|group| group.shape).partition(|shape| shape.positions() > 1);
        let largest = |values: &mut dyn Iterator<Item = usize>| values.max().unwrap_or(1) as f64;
        Sizes {
            side: largest(&mut maps.iter().map(|shape| shape.h.max(shape.w))),
            channels: largest(&mut maps.iter().map(|shape| shape.c)),
            units: largest(&mut vectors.iter().map(|shape| shape.c)),
        }
    }

    /// Sides go with the square root of the sizes, so that small maps stay visible.
    fn block(&self, shape: Shape) -> Cuboid {
        if shape.positions() == 1 {
            return Cuboid { width: 14.0, height: 8.0 + 100.0 * (shape.c as f64 / self.units).sqrt(), depth: 0.0 };
        }
        let side = |extent: usize| (LARGEST * (extent as f64 / self.side).sqrt()).max(4.0);
        let depth = 3.0 + 24.0 * (shape.c as f64 / self.channels).sqrt();
        Cuboid { width: side(shape.w), height: side(shape.h), depth }
    }
}

impl Cuboid {
    fn half_width(&self) -> f64 {
        (self.width + self.depth) / 2.0
    }
}

/// Draws a group around `centre`.
fn block(svg: &mut Svg, group: &LayerGroup, centre: [f64; 2], Cuboid { width, height, depth }: Cuboid) {
    let edge = format!("stroke=\"{INK}\" stroke-width=\"0.8\" stroke-linejoin=\"round\"");
    let light = |opacity: f64| format!("fill=\"{}\" fill-opacity=\"{opacity}\" {edge}", group.colour);
    let (left, top) = (centre[0] - (width + depth) / 2.0, centre[1] - (height - depth) / 2.0);
    let (right, bottom) = (left + width, top + height);
    if depth > 0.0 {
        let lid = [[left, top], [left + depth, top - depth], [right + depth, top - depth], [right, top]];
        let side = [[right, top], [right + depth, top - depth], [right + depth, bottom - depth], [right, bottom]];
        svg.polygon(&lid, &light(0.55));
        svg.polygon(&side, &light(0.35));
    }
    svg.rect([left, top], [width, height], &light(0.85));
}

fn arrow(svg: &mut Svg, from: [f64; 2], to: [f64; 2]) {
    svg.line(from, to, &format!("stroke=\"{QUIET_INK}\" stroke-width=\"1.2\""));
    let tip = [[to[0], to[1]], [to[0] - 6.0, to[1] - 3.5], [to[0] - 6.0, to[1] + 3.5]];
    svg.polygon(&tip, &format!("fill=\"{QUIET_INK}\""));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recipe::{Recipe, SHIPPED};
    use steersman_kernels::Isa;

    #[test]
    fn every_recipe_has_a_diagram_with_all_its_layers() {
        for (name, _) in SHIPPED {
            let network = Recipe::find(name, &[]).unwrap().network(Isa::PORTABLE).unwrap();
            let text = draw(&network, name);
            assert!(roxmltree::Document::parse(&text).is_ok());
            for layer in network.layers() {
                let output = layer.layer.output().to_string();
                assert!(text.contains(&format!(">{output}</text>")), "{name}: {} of {output}", layer.name);
            }
            let counted: usize = groups(&network).iter().map(|group| group.params).sum();
            assert_eq!(counted, network.count(true) + network.count(false), "{name}");
        }
    }
}
