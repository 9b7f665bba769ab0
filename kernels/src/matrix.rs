//! Matrices that lie in slices: the operands of [`gemm`](crate::gemm) and [`sgemm`](crate::sgemm).

/// A matrix to read: element `(i, j)` is `values[i * strides.0 + j * strides.1]`.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    /// The slice that holds the elements.
    pub values: &'a [f32],
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
    /// Distance between two rows and between two columns, in elements.
    pub strides: (usize, usize),
}

impl<'a> Matrix<'a> {
    /// The row-major matrix in `values`.
    pub fn new(values: &'a [f32], rows: usize, columns: usize) -> Matrix<'a> {
        Matrix { values, rows, columns, strides: (columns, 1) }
    }

    /// The same values with rows and columns swapped.
    pub fn transposed(self) -> Matrix<'a> {
        let (row, column) = self.strides;
        Matrix { rows: self.columns, columns: self.rows, strides: (column, row), ..self }
    }

    /// Whether every element lies in the slice.
    pub(crate) fn fits(&self) -> bool {
        fits(self.values.len(), self.rows, self.columns, self.strides)
    }
}

/// A matrix to write: element `(i, j)` is `values[i * strides.0 + j * strides.1]`.
#[derive(Debug)]
pub struct MatrixMut<'a> {
    /// The slice that holds the elements.
    pub values: &'a mut [f32],
    /// Number of rows.
    pub rows: usize,
    /// Number of columns.
    pub columns: usize,
    /// Distance between two rows and between two columns, in elements.
    pub strides: (usize, usize),
}

impl<'a> MatrixMut<'a> {
    /// The row-major matrix in `values`.
    pub fn new(values: &'a mut [f32], rows: usize, columns: usize) -> MatrixMut<'a> {
        MatrixMut { values, rows, columns, strides: (columns, 1) }
    }

    /// Whether every element lies in the slice.
    pub(crate) fn fits(&self) -> bool {
        fits(self.values.len(), self.rows, self.columns, self.strides)
    }

    /// Whether no two elements share a place of the slice.
    pub(crate) fn is_disjoint(&self) -> bool {
        let (row, column) = self.strides;
        let (rows, columns) = (self.rows, self.columns);
        let apart = (row >= 1 || rows <= 1) && (column >= 1 || columns <= 1);
        let ordered = row > columns.saturating_sub(1) * column || column > rows.saturating_sub(1) * row;
        rows == 0 || columns == 0 || (apart && ordered)
    }
}

fn fits(len: usize, rows: usize, columns: usize, (row, column): (usize, usize)) -> bool {
    rows == 0 || columns == 0 || (rows - 1) * row + (columns - 1) * column < len
}

/// Panics unless `c` can hold the product of `a` and `b`.
pub(crate) fn check_product(kernel: &str, a: &Matrix, b: &Matrix, c: &MatrixMut) {
    assert!(
        a.columns == b.rows && a.rows == c.rows && b.columns == c.columns,
        "{kernel}: A is {} x {}, B {} x {}, C {} x {}",
        a.rows,
        a.columns,
        b.rows,
        b.columns,
        c.rows,
        c.columns
    );
    assert!(a.fits(), "{kernel}: A has only {} elements", a.values.len());
    assert!(b.fits(), "{kernel}: B has only {} elements", b.values.len());
    assert!(c.fits(), "{kernel}: C has only {} elements", c.values.len());
    assert!(c.is_disjoint(), "{kernel}: elements of C share a place");
}
