//! Tables whose columns are as wide as they need to be.

/// `rows`, the first of which names the columns, with cells that end below each other, as numbers do.
pub(crate) fn right_aligned(rows: &[Vec<String>]) -> String {
    table(rows, |cell, width| format!("{cell:>width$}"))
}

/// The same with cells that begin below each other, as words do. The last cell of a row that has fewer than the first may be longer than
/// its column.
pub(crate) fn left_aligned(rows: &[Vec<String>]) -> String {
    table(rows, |cell, width| format!("{cell:<width$}"))
}

fn table(rows: &[Vec<String>], placed: impl Fn(&str, usize) -> String) -> String {
    let columns = rows.first().map_or(0, Vec::len);
    let width = |column: usize| {
        let whole = rows.iter().filter(|row| row.len() == columns);
        whole.map(|row| row[column].chars().count()).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let line = |row: &Vec<String>| {
        let cells: Vec<String> = row.iter().zip(&widths).map(|(cell, width)| placed(cell, *width)).collect();
        cells.join("  ").trim_end().to_string() + "\n"
    };
    rows.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_are_as_wide_as_their_cells_and_a_short_row_may_end_in_a_long_one() {
        let rows = [vec!["run", "at"], vec!["a", "10 ms"], vec!["no such thing"]];
        let rows = rows.map(|row| row.into_iter().map(String::from).collect());
        assert_eq!(left_aligned(&rows), "run  at\na    10 ms\nno such thing\n");
        assert_eq!(right_aligned(&rows[..2]), "run     at\n  a  10 ms\n");
    }
}
