//! 2-D convolution.

use serde::{Deserialize, Serialize};
use steersman_kernels::Backend;
use steersman_kernels::conv::{Conv, ConvShape};

use super::kind::{MAX_NUMBERS, check_first_value, check_sizes, pair, weight_and_bias};
use super::{
    ExportForm, Family, Grads, Layer, LayerKind, Linear, Packing, Pads, Pair, ParamSpec, Pass, ReceptiveField,
};
use crate::engine::tensor::{Fans, Initializer, Shape};

/// What the kernel sees beyond the border of the map.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Padding {
    /// Nothing: the kernel stays inside the image; output size ⌊(size − kernel) / stride⌋ + 1.
    #[default]
    Valid,
    /// Zeros, so that the output size is ⌈size / stride⌉. If their number is odd, one more stands below and to the right than
    /// above and to the left (as in TensorFlow).
    Same,
}

impl Padding {
    /// Zeros before and after, along one axis.
    pub(crate) fn amounts(self, size: usize, kernel: usize, stride: usize) -> (usize, usize) {
        match self {
            Padding::Valid => (0, 0),
            Padding::Same => {
                let total = ((size.div_ceil(stride) - 1) * stride + kernel).saturating_sub(size);
                (total / 2, total - total / 2)
            }
        }
    }
}

/// 2-D convolution with bias (a cross-correlation, as in every framework), for stride s and padding p.
///
/// - **Forward** `y[o][i][j] = bias[o] + Σ_{c,k,l} weight[o][c][k][l] · x[c][i·s + k − p][j·s + l − p]`; x is 0 outside the map.
/// - **Backward** of `y[o][i][j] = bias[o] + Σ weight[o][c][k][l] · x[c][i·s + k − p][j·s + l − p]`:
///   `dx[c][i·s + k − p][j·s + l − p] += weight[o][c][k][l] · dy[o][i][j]`,
///   `dweight[o][c][k][l] = Σ_{i,j} dy[o][i][j] · x[c][i·s + k − p][j·s + l − p]` and `dbias[o] = Σ_{i,j} dy[o][i][j]`. Needs x.
/// - **Training and evaluation** are the same.
/// - **Limits** Any kernel and stride; the padded input must hold the kernel once. At most 2²⁶ weights, and as many outputs an image.
///
/// # Shapes
///
/// x, dx: `[n][channels][h][w]`; y, dy: `[n][filters][out_h][out_w]`, see [`Padding`]. Parameters: `weight`
/// `[filters][channels][kernel height][kernel width]`, `bias` `[filters]`.
#[derive(Clone, Debug)]
pub struct Conv2d {
    conv: Conv,
    shape: ConvShape,
    init: Initializer,
}

impl Conv2d {
    /// A convolution of `filters` kernels of size `kernel` (height, width) over `input`.
    ///
    /// # Errors
    ///
    /// A sentence that says what does not fit.
    pub fn new(
        input: Shape,
        filters: usize,
        kernel: [usize; 2],
        stride: [usize; 2],
        padding: Padding,
        init: Initializer,
        backend: impl Into<Backend>,
    ) -> Result<Conv2d, String> {
        let [kh, kw] = kernel;
        let [stride_h, stride_w] = stride;
        if filters == 0 || kh == 0 || kw == 0 || stride_h == 0 || stride_w == 0 {
            return Err("filters, kernel and stride must be at least 1".into());
        }
        let (pad_top, pad_bottom) = padding.amounts(input.h, kh, stride_h);
        let (pad_left, pad_right) = padding.amounts(input.w, kw, stride_w);
        if input.h + pad_top + pad_bottom < kh || input.w + pad_left + pad_right < kw {
            return Err(format!("a {kh}x{kw} kernel does not fit into the {}x{} input", input.h, input.w));
        }
        let shape = ConvShape {
            c: input.c,
            h: input.h,
            w: input.w,
            oc: filters,
            kh,
            kw,
            stride_h,
            stride_w,
            pad_top,
            pad_bottom,
            pad_left,
            pad_right,
        };
        Ok(Conv2d { conv: Conv::new(shape, backend), shape, init })
    }

    /// The convolution kernel.
    pub(crate) fn kernel(&self) -> &Conv {
        &self.conv
    }

    /// `params` as weight and bias.
    pub(crate) fn split<'a>(&self, params: &'a [f32]) -> (&'a [f32], &'a [f32]) {
        params.split_at(self.weight_len())
    }

    /// Packed weights of the forward pass and of the input gradient; `None` if nothing is packed.
    fn split_packed<'a>(&self, packed: &'a [f32]) -> Option<(&'a [f32], &'a [f32])> {
        (!packed.is_empty()).then(|| packed.split_at(self.conv.packed_len()))
    }

    fn weight_len(&self) -> usize {
        self.shape.oc * self.shape.c * self.shape.kh * self.shape.kw
    }
}

impl Layer for Conv2d {
    fn input(&self) -> Shape {
        Shape::new(self.shape.c, self.shape.h, self.shape.w)
    }

    fn output(&self) -> Shape {
        Shape::new(self.shape.oc, self.shape.out_h(), self.shape.out_w())
    }

    fn params(&self) -> Vec<ParamSpec> {
        let ConvShape { c, oc, kh, kw, .. } = self.shape;
        let fans = Fans { fan_in: c * kh * kw, fan_out: oc * kh * kw };
        vec![ParamSpec::weight(vec![oc, c, kh, kw], self.init, fans), ParamSpec::constant("bias", vec![oc], 0.0)]
    }

    fn multiply_adds(&self) -> u64 {
        self.shape.multiply_adds()
    }

    fn scratch_len(&self, _n: usize) -> usize {
        self.conv.scratch_len()
    }

    fn infer(&self, params: &[f32], _statistics: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        let (weight, bias) = self.split(params);
        self.conv.forward(n, x, weight, bias, y, scratch);
    }

    fn forward(&self, params: &[f32], pass: &Pass, n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        match self.split_packed(pass.packed) {
            Some((packed, _)) => self.conv.forward_packed(n, x, packed, y, scratch),
            None => self.infer(params, &[], n, x, y, scratch),
        }
    }

    fn backward(&self, params: &[f32], pass: &Pass, n: usize, pair: Pair, dx: Option<&mut [f32]>, grads: Grads) {
        let (dweight, dbias) = grads.dparams.split_at_mut(self.weight_len());
        self.conv.backward_weight(n, pair.x, pair.dy, dweight, dbias, grads.scratch);
        if let Some(dx) = dx {
            self.backward_input(params, pass, n, pair.dy, dx, grads.scratch);
        }
    }

    fn packing(&self) -> Option<&dyn Packing> {
        Some(self)
    }

    fn linear(&self) -> Option<&dyn Linear> {
        Some(self)
    }
}

impl Packing for Conv2d {
    fn packed_len(&self) -> usize {
        self.conv.packed_len()
    }

    fn pack(&self, params: &[f32], packed: &mut [f32]) {
        let (weight, bias) = self.split(params);
        self.conv.pack(weight, bias, packed);
    }

    fn training_packed_len(&self) -> usize {
        self.conv.packed_len() + self.conv.packed_gradient_len()
    }

    fn pack_for_training(&self, params: &[f32], packed: &mut [f32]) {
        let (forward, gradient) = packed.split_at_mut(self.conv.packed_len());
        let (weight, bias) = self.split(params);
        self.conv.pack(weight, bias, forward);
        self.conv.pack_gradient(weight, gradient);
    }

    fn infer_packed(&self, packed: &[f32], n: usize, x: &[f32], y: &mut [f32], scratch: &mut [f32]) {
        self.conv.forward_packed(n, x, packed, y, scratch);
    }
}

impl Linear for Conv2d {
    fn backward_input(&self, params: &[f32], pass: &Pass, n: usize, dy: &[f32], dx: &mut [f32], scratch: &mut [f32]) {
        match self.split_packed(pass.packed) {
            Some((_, packed)) => self.conv.backward_input_packed(n, dy, packed, dx, scratch),
            None => self.conv.backward_input(n, dy, &params[..self.weight_len()], dx, scratch),
        }
    }
}

/// Options of [`Conv2d`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conv2dSpec {
    /// Output channels.
    pub filters: usize,
    /// Height and width of the kernel.
    pub kernel: [usize; 2],
    /// Rows and columns from one window to the next.
    #[serde(default = "one_by_one", skip_serializing_if = "is_one_by_one")]
    pub stride: [usize; 2],
    /// `valid` (default) or `same`.
    #[serde(default)]
    pub padding: Padding,
    /// First weights: `glorot_uniform` (default), `he_normal` or `{ constant = … }`.
    #[serde(default)]
    pub init: Initializer,
}

fn one_by_one() -> [usize; 2] {
    [1, 1]
}

fn is_one_by_one(stride: &[usize; 2]) -> bool {
    *stride == [1, 1]
}

impl LayerKind for Conv2dSpec {
    fn base_name(&self) -> &'static str {
        "conv"
    }

    fn describe(&self) -> String {
        let stride = if self.stride == [1, 1] { String::new() } else { format!(" stride {}", pair(self.stride)) };
        let padding = if self.padding == Padding::Same { " same" } else { "" };
        format!("conv {}{stride}{padding}", pair(self.kernel))
    }

    fn family(&self) -> Family {
        Family::Convolution
    }

    fn receptive_field(&self, input: Shape) -> ReceptiveField {
        let Conv2dSpec { kernel, stride, padding, .. } = *self;
        let before = |size, axis: usize| padding.amounts(size, kernel[axis], stride[axis]).0 as isize;
        ReceptiveField::Window { size: kernel, stride, before: [before(input.h, 0), before(input.w, 1)] }
    }

    fn check(&self, input: Shape) -> Result<(), String> {
        let Conv2dSpec { filters, kernel: [kh, kw], stride: [sh, sw], init, .. } = *self;
        let weights = filters.saturating_mul(input.c).saturating_mul(kh).saturating_mul(kw);
        let outputs = filters.saturating_mul(input.positions());
        if weights.max(outputs) > MAX_NUMBERS {
            return Err(format!("weights or outputs would be more than {MAX_NUMBERS} numbers"));
        }
        check_sizes(&[("filters", filters), ("kernel", kh), ("kernel", kw), ("stride", sh), ("stride", sw)])?;
        match init {
            Initializer::Constant(value) => check_first_value(value),
            Initializer::GlorotUniform | Initializer::HeNormal => Ok(()),
        }
    }

    fn layer(&self, input: Shape, backend: Backend) -> Result<Box<dyn Layer>, String> {
        let Conv2dSpec { filters, kernel, stride, padding, init } = *self;
        Ok(Box::new(Conv2d::new(input, filters, kernel, stride, padding, init, backend)?))
    }

    fn export_form(&self, input: Shape, params: &[f32], _statistics: &[f32]) -> ExportForm {
        let Conv2dSpec { filters, kernel, stride, padding, .. } = *self;
        let (top, bottom) = padding.amounts(input.h, kernel[0], stride[0]);
        let (left, right) = padding.amounts(input.w, kernel[1], stride[1]);
        let (weight, bias) = weight_and_bias(params, filters);
        let pads = Pads { top, left, bottom, right };
        ExportForm::Conv { depthwise: false, kernel, stride, pads, weight, bias }
    }
}

#[cfg(test)]
mod tests {
    use steersman_kernels::conv::ConvAlgorithm;
    use steersman_kernels::{Backend, Isa};

    use super::super::gradcheck::check_layer;
    use super::*;

    fn conv(
        [c, h, w]: [usize; 3],
        filters: usize,
        kernel: [usize; 2],
        stride: [usize; 2],
        padding: Padding,
        backend: impl Into<Backend>,
    ) -> Conv2d {
        Conv2d::new(Shape::new(c, h, w), filters, kernel, stride, padding, Initializer::GlorotUniform, backend).unwrap()
    }

    #[test]
    fn gradients_hold_for_odd_sizes_strides_and_paddings() {
        let auto = Isa::available().into_iter().map(Backend::from);
        let im2col = Backend { isa: Isa::PORTABLE, conv: ConvAlgorithm::Im2col };
        for backend in auto.chain([im2col]) {
            for padding in [Padding::Valid, Padding::Same] {
                for (n, input, filters, kernel, stride) in [
                    (1, [1, 3, 3], 1, [3, 3], [1, 1]),
                    (2, [3, 7, 9], 5, [3, 3], [1, 1]),
                    (3, [2, 6, 21], 9, [3, 3], [1, 1]),
                    (2, [3, 9, 11], 4, [5, 5], [2, 2]),
                    (1, [2, 8, 7], 3, [5, 3], [3, 2]),
                    (2, [4, 5, 6], 2, [1, 1], [1, 1]),
                    (2, [2, 5, 6], 3, [2, 4], [1, 3]),
                    (1, [2, 3, 40], 8, [3, 3], [1, 1]),
                ] {
                    check_layer(&conv(input, filters, kernel, stride, padding, backend), n);
                }
            }
        }
    }

    #[test]
    fn same_padding_keeps_the_size_and_puts_the_odd_zero_last() {
        let layer = conv([1, 5, 6], 1, [2, 3], [1, 2], Padding::Same, Isa::best());
        assert_eq!(layer.output(), Shape::new(1, 5, 3));
        let (s, x) = (layer.shape, 1.0);
        assert_eq!((s.pad_top, s.pad_bottom, s.pad_left, s.pad_right), (0, 1, 0, 1));
        let mut y = [f32::NAN; 15];
        let mut scratch = vec![f32::NAN; layer.scratch_len(1)];
        let params = [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0];
        layer.infer(&params, &[], 1, &[x; 30], &mut y, &mut scratch);
        assert_eq!(y, [6., 6., 4., 6., 6., 4., 6., 6., 4., 6., 6., 4., 3., 3., 2.]);
    }

    #[test]
    fn a_kernel_larger_than_the_image_is_refused() {
        let error = Conv2d::new(
            Shape::new(1, 4, 4),
            1,
            [5, 5],
            [1, 1],
            Padding::Valid,
            Initializer::GlorotUniform,
            Isa::PORTABLE,
        )
        .unwrap_err();
        assert_eq!(error, "a 5x5 kernel does not fit into the 4x4 input");
    }
}
