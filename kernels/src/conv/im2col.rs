//! The textbook algorithm: each pass is one matrix product with the columns of the image.
//!
//! Let `X [C*KH*KW, OH*OW]` be the columns of one image ([`im2col`]), `W [OC, C*KH*KW]` the weights, `b [OC]` the bias
//! and `Y [OC, OH*OW]` the output. Then
//!
//! | pass | matrix product | sizes |
//! |---|---|---|
//! | forward | `Y = W X + b` | `[OC, taps] [taps, pixels]` |
//! | weight gradient, of `Y = W X + b` with respect to `W` and `b` | `dW += dY X'`, `db += sum over pixels of dY` | `[OC, pixels] [pixels, taps]` |
//! | input gradient, of `Y = W X + b` with respect to `X` | `dX = W' dY`, then `dx = col2im(dX)` | `[taps, OC] [OC, pixels]` |
//!
//! where `taps = C*KH*KW`, `pixels = OH*OW` and `'` transposes. [`col2im`] is the transpose of [`im2col`]: an element of the image
//! that was copied into several columns receives the sum of their gradients.
//!
//! Images come one after the other, so the columns of one image are all the scratch that is needed, and the result of an
//! image does not depend on the batch. A 1x1 kernel of stride 1 without padding needs no columns: there the image *is* `X`.

use crate::Isa;
use crate::conv_shape::ConvShape;
use crate::gemm::{gemm, gemm_scratch_len};
use crate::im2col::{col2im, im2col};
use crate::matrix::{Matrix, MatrixMut};
use crate::sgemm::sgemm;

/// The three passes of one shape.
#[derive(Clone, Debug)]
pub(super) struct Im2col {
    shape: ConvShape,
    product: Product,
}

/// The function that computes the matrix products.
#[derive(Clone, Copy, Debug)]
enum Product {
    /// `matrixmultiply`, for [`ConvAlgorithm::Im2col`](super::ConvAlgorithm).
    MatrixMultiply,
    /// [`gemm`], which allocates nothing and keeps to its instruction set, where the default algorithms choose im2col.
    Gemm(Isa),
}

impl Im2col {
    /// The textbook algorithm, with `matrixmultiply`.
    pub fn textbook(shape: ConvShape) -> Im2col {
        Im2col { shape, product: Product::MatrixMultiply }
    }

    /// The same with [`gemm`].
    pub fn with_gemm(shape: ConvShape, isa: Isa) -> Im2col {
        Im2col { shape, product: Product::Gemm(isa) }
    }

    /// `C = A B + beta C`.
    fn multiply(&self, a: Matrix, b: Matrix, beta: f32, c: MatrixMut, scratch: &mut [f32]) {
        match self.product {
            Product::MatrixMultiply => sgemm(a, b, beta, c),
            Product::Gemm(isa) => gemm(isa, 1.0, a, b, beta, c, scratch),
        }
    }

    /// Length of the columns of one image, if they are needed.
    fn columns_len(&self) -> usize {
        if self.is_pointwise() { 0 } else { self.shape.taps() * self.shape.out_pixels() }
    }

    /// Whether the image is its own matrix of columns.
    fn is_pointwise(&self) -> bool {
        let ConvShape { kh, kw, stride_h, stride_w, .. } = self.shape;
        [kh, kw, stride_h, stride_w] == [1; 4] && !self.shape.is_padded()
    }

    /// Length of the scratch of each pass: the columns of one image, and the scratch of a product.
    pub fn scratch_len(&self) -> usize {
        let (oc, taps, pixels) = (self.shape.oc, self.shape.taps(), self.shape.out_pixels());
        let products = [(oc, taps, pixels), (oc, pixels, taps), (taps, oc, pixels)];
        let product = match self.product {
            Product::MatrixMultiply => 0,
            Product::Gemm(_) => products.map(|(m, k, n)| gemm_scratch_len(m, k, n)).into_iter().max().unwrap_or(0),
        };
        self.columns_len() + product
    }

    /// The columns of `x`, built in `columns` unless `x` itself will do.
    fn columns<'a>(&self, x: &'a [f32], columns: &'a mut [f32]) -> &'a [f32] {
        if self.is_pointwise() {
            return x;
        }
        im2col(&self.shape, x, columns);
        columns
    }

    /// `Y = W X + b` for each image in `x`; `y` is overwritten.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let (oc, taps, pixels) = (self.shape.oc, self.shape.taps(), self.shape.out_pixels());
        let (columns, scratch) = scratch.split_at_mut(self.columns_len());
        let weight = Matrix::new(weight, oc, taps);
        for (x, y) in x.chunks_exact(self.shape.x_len()).zip(y.chunks_exact_mut(self.shape.y_len())) {
            for (y, &bias) in y.chunks_exact_mut(pixels).zip(bias) {
                y.fill(bias);
            }
            let columns = Matrix::new(self.columns(x, columns), taps, pixels);
            self.multiply(weight, columns, 1.0, MatrixMut::new(y, oc, pixels), scratch);
        }
    }

    /// `dW += dY X'` and `db += sum over pixels of dY`, summed over the images; forward was `Y = W X + b`.
    pub fn backward_weight(&self, x: &[f32], dy: &[f32], dweight: &mut [f32], dbias: &mut [f32], scratch: &mut [f32]) {
        let (oc, taps, pixels) = (self.shape.oc, self.shape.taps(), self.shape.out_pixels());
        let (columns, scratch) = scratch.split_at_mut(self.columns_len());
        for (x, dy) in x.chunks_exact(self.shape.x_len()).zip(dy.chunks_exact(self.shape.y_len())) {
            for (dbias, dy) in dbias.iter_mut().zip(dy.chunks_exact(pixels)) {
                *dbias += sum(dy);
            }
            let (dy, columns) = (Matrix::new(dy, oc, pixels), Matrix::new(self.columns(x, columns), taps, pixels));
            self.multiply(dy, columns.transposed(), 1.0, MatrixMut::new(dweight, oc, taps), scratch);
        }
    }

    /// `dX = W' dY`, then `dx = col2im(dX)`, for each image; `dx` is overwritten. Forward was `Y = W X + b`.
    pub fn backward_input(&self, dy: &[f32], weight: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        let (oc, taps, pixels) = (self.shape.oc, self.shape.taps(), self.shape.out_pixels());
        let (dcolumns, scratch) = scratch.split_at_mut(self.columns_len());
        let weight = Matrix::new(weight, oc, taps).transposed();
        for (dy, dx) in dy.chunks_exact(self.shape.y_len()).zip(dx.chunks_exact_mut(self.shape.x_len())) {
            let dy = Matrix::new(dy, oc, pixels);
            if self.is_pointwise() {
                self.multiply(weight, dy, 0.0, MatrixMut::new(dx, taps, pixels), scratch);
                continue;
            }
            self.multiply(weight, dy, 0.0, MatrixMut::new(dcolumns, taps, pixels), scratch);
            dx.fill(0.0);
            col2im(&self.shape, dcolumns, dx);
        }
    }
}

/// The sum of a plane, taken in 16 interleaved parts so that it vectorises.
fn sum(plane: &[f32]) -> f32 {
    let (blocks, rest) = plane.as_chunks::<16>();
    let mut sums = [0.0f32; 16];
    for block in blocks {
        (0..16).for_each(|i| sums[i] += block[i]);
    }
    sums.iter().sum::<f32>() + rest.iter().sum::<f32>()
}
