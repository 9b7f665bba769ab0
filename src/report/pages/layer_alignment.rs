//! Layers of several networks side by side, so that what corresponds stands in one line.

/// A layer of a recipe.
#[derive(Clone, Debug, PartialEq)]
pub struct LayerEntry {
    /// As in `conv2d`.
    pub kind: String,
    /// All of its entry.
    pub text: String,
}

/// How well two layers correspond: 0 for not at all.
fn likeness(a: &LayerEntry, b: &LayerEntry) -> usize {
    match (a.kind == b.kind, a.text == b.text) {
        (_, true) => 3,
        (true, false) => 2,
        (false, false) => 0,
    }
}

/// Lines with one cell for each network: its layer, if it has one there. The layers of a network keep their order; layers that stand
/// in one line are of one kind, and as many as possible do (Needleman and Wunsch 1970, one network after the other).
pub fn align(networks: &[Vec<LayerEntry>]) -> Vec<Vec<Option<String>>> {
    // Each line is led by the first layer that was put there.
    let mut lines: Vec<(LayerEntry, Vec<Option<String>>)> = Vec::new();
    for (index, layers) in networks.iter().enumerate() {
        let (height, width) = (lines.len(), layers.len());
        // best[i][j]: likeness that can be reached from line i and layer j on.
        let mut best = vec![vec![0; width + 1]; height + 1];
        for i in (0..height).rev() {
            for j in (0..width).rev() {
                let together = match likeness(&lines[i].0, &layers[j]) {
                    0 => 0,
                    likeness => likeness + best[i + 1][j + 1],
                };
                best[i][j] = together.max(best[i + 1][j]).max(best[i][j + 1]);
            }
        }
        let mut merged = Vec::with_capacity(height + width);
        let mut old = lines.into_iter().peekable();
        let (mut i, mut j) = (0, 0);
        loop {
            let like = old.peek().zip(layers.get(j)).map_or(0, |((leader, _), layer)| likeness(leader, layer));
            let together = like > 0 && best[i][j] == like + best[i + 1][j + 1];
            let skips_line = !together && i < height && best[i][j] == best[i + 1][j];
            let (mut line, layer) = match (together, skips_line || j == width) {
                (true, _) => (old.next(), layers.get(j)),
                (false, true) => (old.next(), None),
                (false, false) => (None, layers.get(j)),
            };
            if line.is_none() && layer.is_none() {
                break;
            }
            i += usize::from(line.is_some());
            j += usize::from(layer.is_some());
            let (leader, mut cells) = match (line.take(), layer) {
                (Some(line), _) => line,
                (None, Some(layer)) => (layer.clone(), vec![None; index]),
                (None, None) => break,
            };
            cells.push(layer.map(|layer| layer.text.clone()));
            merged.push((leader, cells));
        }
        lines = merged;
    }
    lines.into_iter().map(|(_, cells)| cells).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network(layers: &str) -> Vec<LayerEntry> {
        let layer = |text: &str| LayerEntry { kind: text.trim_end_matches(char::is_numeric).into(), text: text.into() };
        layers.split_whitespace().map(layer).collect()
    }

    /// The lines as text, `-` where a network has no layer.
    fn aligned(networks: &[&str]) -> Vec<String> {
        let networks: Vec<_> = networks.iter().map(|layers| network(layers)).collect();
        let line = |cells: Vec<Option<String>>| {
            let cells: Vec<String> = cells.into_iter().map(|cell| cell.unwrap_or_else(|| "-".into())).collect();
            cells.join(" ")
        };
        align(&networks).into_iter().map(line).collect()
    }

    #[test]
    fn a_layer_that_one_network_has_more_shifts_nothing() {
        assert_eq!(
            aligned(&["conv8 relu conv16 relu dense1", "conv8 norm relu conv32 norm relu dense1"]),
            ["conv8 conv8", "- norm", "relu relu", "conv16 conv32", "- norm", "relu relu", "dense1 dense1"]
        );
        assert_eq!(
            aligned(&["conv8 dense1", "dense1", "pool conv8 dense1"]),
            ["- - pool", "conv8 - conv8", "dense1 dense1 dense1"]
        );
        assert_eq!(aligned(&["a b", ""]), ["a -", "b -"]);
        assert_eq!(aligned(&["", "a b"]), ["- a", "- b"]);
        assert!(aligned(&["", ""]).is_empty());
    }

    #[test]
    fn every_layer_stands_once_and_in_order() {
        let networks = ["a1 b c a2 b c d", "b c a2 b d d", "d a1 a1 c"].map(network);
        let lines = align(&networks);
        for (index, layers) in networks.iter().enumerate() {
            let texts: Vec<&String> = lines.iter().filter_map(|line| line[index].as_ref()).collect();
            assert_eq!(texts, layers.iter().map(|layer| &layer.text).collect::<Vec<_>>());
        }
        assert!(lines.iter().all(|line| line.len() == 3));
    }
}
