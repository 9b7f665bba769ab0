//! A convolution and the 4x4 max pooling behind it, in one pass: the maps of the convolution are never written.
//!
//! The convolution is computed place by place of the windows, and each place replaces the maxima that it exceeds. Vectors run along
//! the windows ([`windows`]) or along the channels ([`channels`]), whichever leaves fewer lanes empty. Each sum is one chain of
//! multiply-adds in the order of the taps, so both give the same bits.
//!
//! Behind the pooling 15 of 16 output gradients are 0, so the gradients are those of [`sparse`].

mod channels;
mod windows;

use super::sparse;
use crate::Isa;
use crate::backend::Backend;
use crate::conv_algorithm::ConvAlgorithm;
use crate::conv_shape::ConvShape;
use channels::Channels;
use windows::Windows;

/// Height and width of a window of the pooling, and the distance between windows.
const WINDOW: usize = 4;
/// Elements of a window.
const PLACES: usize = WINDOW * WINDOW;

/// Indices up to here are exact in `f32`, in which the pass keeps them.
const MAX_PLANE: usize = 1 << 24;

/// A convolution of one shape and the maximum of each 4x4 block of its output; the last rows and columns that fill no block are left
/// out.
///
/// # NaN
/// A NaN in the upper left place of a window makes its maximum NaN; in the other places it is skipped.
#[derive(Clone, Debug)]
pub struct PooledConv {
    shape: ConvShape,
    isa: Isa,
    vectors: Vectors,
}

/// What the vectors run along.
#[derive(Clone, Debug)]
enum Vectors {
    Windows(Windows),
    Channels(Channels),
}

/// Where the pass writes: the maxima, and their positions unless the slice is empty.
struct Output<'a> {
    y: &'a mut [f32],
    argmax: &'a mut [u32],
}

impl PooledConv {
    /// `None` where there is no such pass: it takes 3x3 and 5x5 kernels with strides of 1 and without padding, and
    /// [`ConvAlgorithm::Auto`].
    pub fn new(shape: ConvShape, backend: impl Into<Backend>) -> Option<PooledConv> {
        let Backend { isa, conv } = backend.into();
        let fits = shape.out_h() >= WINDOW && shape.out_w() >= WINDOW && shape.h * shape.w <= MAX_PLANE;
        if conv != ConvAlgorithm::Auto || !sparse::supports(&shape) || !fits {
            return None;
        }
        let (windows, channels) = (Windows::new(shape, isa), Channels::new(shape, isa));
        let vectors = if windows.lanes_used() >= channels.lanes_used() {
            Vectors::Windows(windows)
        } else {
            Vectors::Channels(channels)
        };
        Some(PooledConv { shape, isa, vectors })
    }

    /// Length of an image's output, `[oc][h / 4][w / 4]` of the convolution's, rounded down.
    pub fn y_len(&self) -> usize {
        self.shape.oc * (self.shape.out_h() / WINDOW) * (self.shape.out_w() / WINDOW)
    }

    /// Length of the scratch of [`PooledConv::forward`].
    pub fn scratch_len(&self) -> usize {
        match &self.vectors {
            Vectors::Windows(windows) => windows.scratch_len(),
            Vectors::Channels(_) => 0,
        }
    }

    /// Length of the packed weights and bias.
    pub fn packed_len(&self) -> usize {
        match &self.vectors {
            Vectors::Windows(windows) => windows.packed_len(),
            Vectors::Channels(channels) => channels.packed_len(),
        }
    }

    /// Packs weights and bias for [`PooledConv::forward`]: puts them in the order in which it reads them.
    ///
    /// # Panics
    /// If a slice has another length; that of `packed` is [`PooledConv::packed_len`].
    pub fn pack(&self, weight: &[f32], bias: &[f32], packed: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(weight.len(), shape.oc * shape.taps(), "pooled conv pack: length of the weights of {shape:?}");
        assert_eq!(bias.len(), shape.oc, "pooled conv pack: length of the bias of {shape:?}");
        assert_eq!(packed.len(), self.packed_len(), "pooled conv pack: length of the packed weights of {shape:?}");
        match &self.vectors {
            Vectors::Windows(windows) => windows.pack(weight, bias, packed),
            Vectors::Channels(channels) => channels.pack(weight, bias, packed),
        }
    }

    /// The maximum of each window, and for each the position of the first element that has it, for `n` images. `y` and `argmax` are
    /// overwritten.
    ///
    /// # Shapes
    /// `x`: `[n][c][h][w]`, `y` and `argmax`: `[n]` times [`PooledConv::y_len`]. `argmax` holds where the kernel lies for that
    /// element, as an index in a plane of the input: `oy * w + ox`. An empty `argmax` asks for none.
    ///
    /// # Panics
    /// If a slice has another length, or `scratch` is shorter than [`PooledConv::scratch_len`].
    pub fn forward(&self, n: usize, x: &[f32], packed: &[f32], y: &mut [f32], argmax: &mut [u32], scratch: &mut [f32]) {
        let shape = &self.shape;
        assert_eq!(x.len(), n * shape.x_len(), "pooled conv: length of the {n} inputs of {shape:?}");
        assert_eq!(y.len(), n * self.y_len(), "pooled conv: length of the {n} outputs of {shape:?}");
        assert_eq!(packed.len(), self.packed_len(), "pooled conv: length of the packed weights of {shape:?}");
        assert!(argmax.is_empty() || argmax.len() == y.len(), "pooled conv: y and argmax differ in length");
        assert!(scratch.len() >= self.scratch_len(), "pooled conv: scratch must have {} elements", self.scratch_len());
        let output = Output { y, argmax };
        match &self.vectors {
            Vectors::Windows(windows) => windows.forward(x, packed, output, scratch),
            Vectors::Channels(channels) => channels.forward(x, packed, output),
        }
    }

    /// Adds the gradients with respect to weight and bias to `dweight` and `dbias`: `dy` is that of the maxima, `argmax` their
    /// positions from [`PooledConv::forward`].
    ///
    /// # Panics
    /// If a slice has another length, or a position lies outside the plane.
    pub fn backward_weight(
        &self,
        n: usize,
        x: &[f32],
        argmax: &[u32],
        dy: &[f32],
        dweight: &mut [f32],
        dbias: &mut [f32],
    ) {
        self.check_gradient(n, x.len(), argmax.len(), dy.len(), dweight.len());
        assert_eq!(dbias.len(), self.shape.oc, "pooled conv gradient: length of the bias of {:?}", self.shape);
        sparse::weight_gradient(self.isa, &self.shape, x, argmax, dy, dweight, dbias);
    }

    /// The gradient with respect to the input; `dx` is overwritten.
    ///
    /// # Panics
    /// As [`PooledConv::backward_weight`].
    pub fn backward_input(&self, n: usize, argmax: &[u32], dy: &[f32], weight: &[f32], dx: &mut [f32]) {
        self.check_gradient(n, dx.len(), argmax.len(), dy.len(), weight.len());
        sparse::input_gradient(self.isa, &self.shape, argmax, dy, weight, dx);
    }

    fn check_gradient(&self, n: usize, x_len: usize, argmax: usize, dy: usize, weight: usize) {
        let shape = &self.shape;
        assert_eq!(x_len, n * shape.x_len(), "pooled conv gradient: length of the {n} inputs of {shape:?}");
        assert_eq!(weight, shape.oc * shape.taps(), "pooled conv gradient: length of the weights of {shape:?}");
        assert_eq!(argmax, n * self.y_len(), "pooled conv gradient: number of positions of {shape:?}");
        assert_eq!(dy, argmax, "pooled conv gradient: number of gradients of {shape:?}");
    }
}
