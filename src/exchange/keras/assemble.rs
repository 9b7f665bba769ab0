//! Assembles translated layers and their tensors into a network with parameters: checks shapes, and permutes weights.
//!
//! Keras (with TensorFlow's order of axes) stores maps as height, width, channel, and its `Flatten` keeps that order. Here both
//! are channel, height, width. Kernels, and weights of layers after a flatten, are permuted accordingly.

use steersman_kernels::Isa;

use super::architecture::KerasLayer;
use super::file::Tensor;
use super::limits::check_size;
use super::messages::{Problem, shown};
use super::translate::{AxisOrder, KerasStep, KernelLayout, Operation};
use crate::engine::layers::{
    AveragePoolSpec, BatchNormSpec, Conv2dSpec, DenseSpec, FlattenSpec, MaxPoolSpec, PReluSpec, Padding,
    ReceptiveField, Slopes,
};
use crate::engine::network::{LayerSpec, Parameters};
use crate::engine::tensor::{Initializer, Shape};

/// Most parameters of an imported network: 256 MiB.
const MAX_NUMBERS: usize = 1 << 26;

/// Most slopes that are shared in the file and have to be repeated here: 16 MiB.
const MAX_REPEATED: usize = 1 << 22;

/// The result.
pub(super) struct Assembly {
    pub specs: Vec<LayerSpec>,
    pub parameters: Parameters,
    /// For each Keras layer, the number of `specs` that stand for it and for the layers before it.
    pub ends: Vec<usize>,
}

/// Properties of the whole file.
pub(super) struct Context {
    pub input: Shape,
    pub order: AxisOrder,
    /// Whether kernels are rotated by 180 degrees, as Theano's convolution needed them.
    pub flip_kernels: bool,
}

/// Puts the chain together; the last `heads` layers read the same one and become one dense layer with the outputs of all.
///
/// # Errors
///
/// The first layer that does not fit: those behind it depend on its output.
pub(super) fn assemble(
    context: &Context,
    layers: &[KerasLayer],
    steps: &[KerasStep],
    tensors: &[Vec<Tensor>],
    heads: usize,
) -> Result<Assembly, Problem> {
    let mut assembler = Assembler {
        context,
        shape: context.input,
        is_flat: false,
        interleaved: None,
        repeated: 0,
        specs: Vec::new(),
        parameters: Parameters { values: Vec::new(), statistics: Vec::new() },
    };
    let mut ends = Vec::new();
    let trunk = if heads > 1 { layers.len() - heads } else { layers.len() };
    for ((layer, step), tensors) in layers.iter().zip(steps).zip(tensors).take(trunk) {
        assembler.step(step, tensors).map_err(|reason| layer.problem(reason))?;
        ends.push(assembler.specs.len());
    }
    let mut of_heads = Vec::new();
    for ((layer, step), tensors) in layers.iter().zip(steps).zip(tensors).skip(trunk) {
        let head = assembler.head(step, tensors);
        of_heads.push(head.map_err(|reason| layer.problem(reason))?);
    }
    if let Some(first) = layers.get(trunk) {
        assembler.push_heads(&of_heads).map_err(|reason| first.problem(reason))?;
        ends.extend(vec![assembler.specs.len(); of_heads.len()]);
    }
    Ok(Assembly { specs: assembler.specs, parameters: assembler.parameters, ends })
}

struct Assembler<'a> {
    context: &'a Context,
    /// Output of the layers so far.
    shape: Shape,
    /// The output is a vector in Keras, too.
    is_flat: bool,
    /// The map whose numbers the vector has, in the order height, width, channel.
    interleaved: Option<Shape>,
    /// Number of slopes repeated so far.
    repeated: usize,
    specs: Vec<LayerSpec>,
    parameters: Parameters,
}

impl Assembler<'_> {
    fn step(&mut self, step: &KerasStep, tensors: &[Tensor]) -> Result<(), String> {
        match &step.operation {
            Operation::Nothing | Operation::Input => {}
            Operation::Plain(spec) => {
                if matches!(spec.receptive_field(self.shape), ReceptiveField::Window { .. }) {
                    self.needs_map()?;
                }
                self.push(spec.clone(), Vec::new(), Vec::new())?;
            }
            Operation::Conv { spec, kernel, bias } => self.conv(spec, *kernel, *bias, tensors)?,
            Operation::Dense { units, bias } => self.dense(*units, *bias, tensors)?,
            Operation::BatchNorm { spec, axis, center, scale } => {
                self.batch_norm(spec, *axis, [*scale, *center], tensors)?;
            }
            Operation::PRelu => self.prelu(tensors)?,
            Operation::Pool { max, window, stride, same } => self.pool(*max, *window, *stride, *same)?,
            Operation::GlobalPool { max } => {
                self.needs_map()?;
                self.pool(*max, [self.shape.h, self.shape.w], [1, 1], false)?;
                self.is_flat = true;
            }
            Operation::Resize(spec) => {
                self.needs_map()?;
                if spec.to != [self.shape.h, self.shape.w] {
                    self.push(spec.clone().into(), Vec::new(), Vec::new())?;
                }
            }
            Operation::Flatten => self.flatten(step.order)?,
        }
        match &step.activation {
            Some(activation) => self.push(activation.clone(), Vec::new(), Vec::new()),
            None => Ok(()),
        }
    }

    fn push(&mut self, spec: LayerSpec, values: Vec<f32>, statistics: Vec<f32>) -> Result<(), String> {
        let layer = spec.build(self.shape, Isa::PORTABLE)?;
        let count = |specs: Vec<crate::engine::layers::ParamSpec>| specs.iter().map(|spec| spec.len()).sum::<usize>();
        debug_assert_eq!((count(layer.params()), count(layer.statistics())), (values.len(), statistics.len()));
        if self.parameters.values.len() + values.len() > MAX_NUMBERS {
            return Err(format!("the network would have more than {MAX_NUMBERS} parameters"));
        }
        check_size(layer.output())?;
        self.parameters.values.extend(values);
        self.parameters.statistics.extend(statistics);
        self.shape = layer.output();
        self.specs.push(spec);
        Ok(())
    }

    fn needs_map(&self) -> Result<(), String> {
        if self.is_flat { Err("needs a map, but comes behind a flattened one".into()) } else { Ok(()) }
    }

    fn conv(&mut self, spec: &Conv2dSpec, layout: KernelLayout, bias: bool, tensors: &[Tensor]) -> Result<(), String> {
        self.needs_map()?;
        let Conv2dSpec { filters: oc, kernel: [kh, kw], .. } = *spec;
        let ic = self.shape.c;
        let kernel_shape = match layout {
            KernelLayout::HeightWidthInOut => [kh, kw, ic, oc],
            KernelLayout::OutInHeightWidth => [oc, ic, kh, kw],
        };
        // Before the layer is built: the file has as many numbers then, and tables of a kernel's size are no larger than it.
        let mut read = expect(tensors, &[Some(&kernel_shape), bias.then_some(&[oc])])?.into_iter();
        let (kernel, bias) = (read.next().flatten().unwrap_or_default(), read.next().flatten());
        let mut values = Vec::with_capacity(kernel.len() + oc);
        for o in 0..oc {
            for i in 0..ic {
                for y in 0..kh {
                    for x in 0..kw {
                        let (y, x) = if self.context.flip_kernels { (kh - 1 - y, kw - 1 - x) } else { (y, x) };
                        values.push(match layout {
                            KernelLayout::HeightWidthInOut => kernel[((y * kw + x) * ic + i) * oc + o],
                            KernelLayout::OutInHeightWidth => kernel[((o * ic + i) * kh + y) * kw + x],
                        });
                    }
                }
            }
        }
        values.extend(bias.unwrap_or_else(|| vec![0.0; oc]));
        self.push(spec.clone().into(), values, Vec::new())
    }

    /// Weights and biases of a layer that gives outputs of its own.
    fn head(&self, step: &KerasStep, tensors: &[Tensor]) -> Result<(Vec<f32>, Vec<f32>), String> {
        let Operation::Dense { units, bias } = step.operation else {
            return Err("is one of several outputs, and no dense layer".into());
        };
        if step.activation.is_some() {
            return Err("is one of several outputs with an activation of its own, which has no counterpart".into());
        }
        if !self.is_flat && self.shape.positions() > 1 {
            return Err("is one of several outputs and reads a map; a flatten has to stand before it".into());
        }
        let inputs = self.shape.len();
        let mut read = expect(tensors, &[Some(&[inputs, units]), bias.then_some(&[units])])?.into_iter();
        let (kernel, bias) = (read.next().flatten().unwrap_or_default(), read.next().flatten());
        let places = self.interleaved.map_or_else(|| (0..inputs).collect(), interleaved_places);
        let of_unit = |unit: usize| places.iter().map(move |place| place * units + unit);
        let weights = (0..units).flat_map(of_unit).map(|at| kernel[at]).collect();
        Ok((weights, bias.unwrap_or_else(|| vec![0.0; units])))
    }

    /// One dense layer with the units of all `heads`.
    fn push_heads(&mut self, heads: &[(Vec<f32>, Vec<f32>)]) -> Result<(), String> {
        self.interleaved = None;
        let weights = heads.iter().flat_map(|(weights, _)| weights);
        let biases: Vec<f32> = heads.iter().flat_map(|(_, biases)| biases).copied().collect();
        let units = biases.len();
        let values = weights.copied().chain(biases).collect();
        self.push(DenseSpec { units, init: Initializer::default() }.into(), values, Vec::new())
    }

    fn dense(&mut self, units: usize, bias: bool, tensors: &[Tensor]) -> Result<(), String> {
        let init = Initializer::default();
        // Keras' dense layer works on the last axis: on a map it is a convolution with a kernel of one position.
        let on_map = !self.is_flat && self.shape.positions() > 1;
        if on_map && self.context.order == AxisOrder::ChannelsFirst {
            return Err("works on the columns of a map, which has no counterpart".into());
        }
        let spec: LayerSpec = match on_map {
            true => {
                let padding = Padding::default();
                Conv2dSpec { filters: units, kernel: [1, 1], stride: [1, 1], padding, init }.into()
            }
            false => DenseSpec { units, init }.into(),
        };
        spec.build(self.shape, Isa::PORTABLE)?;
        let inputs = if on_map { self.shape.c } else { self.shape.len() };
        let mut read = expect(tensors, &[Some(&[inputs, units]), bias.then_some(&[units])])?.into_iter();
        let (kernel, bias) = (read.next().flatten().unwrap_or_default(), read.next().flatten());
        let places = self.interleaved.take().map_or_else(|| (0..inputs).collect(), interleaved_places);
        let mut values = Vec::with_capacity(kernel.len() + units);
        for unit in 0..units {
            values.extend(places.iter().map(|place| kernel[place * units + unit]));
        }
        values.extend(bias.unwrap_or_else(|| vec![0.0; units]));
        self.push(spec, values, Vec::new())
    }

    fn batch_norm(
        &mut self,
        spec: &BatchNormSpec,
        axis: i64,
        [scale, center]: [bool; 2],
        tensors: &[Tensor],
    ) -> Result<(), String> {
        let axes = if self.is_flat { 2 } else { 4 };
        let channels = if self.is_flat || self.context.order == AxisOrder::ChannelsFirst { 1 } else { 3 };
        if axis != channels && axis != channels - axes {
            return Err(format!("normalises axis {axis}, which is not that of the channels"));
        }
        let c: &[usize] = &[self.shape.c];
        let read = expect(tensors, &[scale.then_some(c), center.then_some(c), Some(c), Some(c)])?;
        let permute = |values: Vec<f32>| match self.interleaved {
            Some(map) => interleaved_places(map).into_iter().map(|place| values[place]).collect(),
            None => values,
        };
        let mut read = read.into_iter().map(|values| values.map(permute));
        let mut next = |default: f32| read.next().flatten().unwrap_or_else(|| vec![default; c[0]]);
        let (gamma, beta, mean, variance) = (next(1.0), next(0.0), next(0.0), next(1.0));
        if variance.iter().any(|variance| variance + spec.epsilon <= 0.0) {
            return Err("a running variance is negative".into());
        }
        self.push(spec.clone().into(), [gamma, beta].concat(), [mean, variance].concat())
    }

    fn prelu(&mut self, tensors: &[Tensor]) -> Result<(), String> {
        let Shape { c, h, w } = self.shape;
        let [tensor] = tensors else {
            return Err(format!("has {} tensors in the file, not 1", tensors.len()));
        };
        let found = tensor.shape();
        let full = match (self.is_flat, self.context.order) {
            (true, _) => vec![c],
            (false, AxisOrder::ChannelsLast) => vec![h, w, c],
            (false, AxisOrder::ChannelsFirst) => vec![c, h, w],
        };
        let fits =
            found.len() == full.len() && found.iter().zip(&full).all(|(found, full)| found == full || *found == 1);
        if !fits {
            return Err(unfitting(&tensor.name, &found, &full));
        }
        let slopes = tensor.read()?;
        let [_, rows, columns] = self.extents(&found);
        let shared_by_positions = !self.is_flat && h * w > 1 && rows == 1 && columns == 1;
        let count = if shared_by_positions { c } else { c * h * w };
        if slopes.len() < count {
            self.repeated += count;
            if self.repeated > MAX_REPEATED {
                return Err(format!("its {} shared slopes stand for {count}, which is too many", slopes.len()));
            }
        }
        if shared_by_positions {
            let values = if slopes.len() == c { slopes } else { vec![slopes[0]; c] };
            let spec = PReluSpec { slopes: Slopes::PerChannel, initial_slope: 0.0 };
            return self.push(spec.into(), values, Vec::new());
        }
        let values = match self.interleaved {
            Some(map) if slopes.len() == c => interleaved_places(map).into_iter().map(|place| slopes[place]).collect(),
            _ => {
                let [of_channel, of_row, of_column] = self.strides(&found);
                let place = |i: usize| i / (h * w) * of_channel + i / w % h * of_row + i % w * of_column;
                (0..count).map(|i| slopes[place(i)]).collect()
            }
        };
        self.push(PReluSpec { slopes: Slopes::PerPosition, initial_slope: 0.0 }.into(), values, Vec::new())
    }

    /// `found`, extents in the order of the file, as those of channels, rows and columns.
    fn extents(&self, found: &[usize]) -> [usize; 3] {
        match (found, self.context.order) {
            (&[h, w, c], AxisOrder::ChannelsLast) => [c, h, w],
            (&[c, h, w], AxisOrder::ChannelsFirst) => [c, h, w],
            _ => [found[0], 1, 1],
        }
    }

    /// Strides along channels, rows and columns in a tensor of extents `found`; 0 along a shared axis.
    fn strides(&self, found: &[usize]) -> [usize; 3] {
        let [c, h, w] = self.extents(found);
        let steps = match self.context.order {
            AxisOrder::ChannelsLast => [1, w * c, c],
            AxisOrder::ChannelsFirst => [h * w, w, 1],
        };
        std::array::from_fn(|axis| if [c, h, w][axis] == 1 { 0 } else { steps[axis] })
    }

    fn pool(&mut self, max: bool, window: [usize; 2], stride: [usize; 2], same: bool) -> Result<(), String> {
        self.needs_map()?;
        let needs_padding = |size: usize, window: usize, stride: usize| {
            stride > 0 && (size.div_ceil(stride) - 1).saturating_mul(stride).saturating_add(window) > size
        };
        let Shape { h, w, .. } = self.shape;
        if same && (needs_padding(h, window[0], stride[0]) || needs_padding(w, window[1], stride[1])) {
            return Err(format!("pads the border of its {h}x{w} input, which has no counterpart in pooling"));
        }
        let stride = (stride != window).then_some(stride);
        let spec = if max { MaxPoolSpec { window, stride }.into() } else { AveragePoolSpec { window, stride }.into() };
        self.push(spec, Vec::new(), Vec::new())
    }

    fn flatten(&mut self, order: Option<AxisOrder>) -> Result<(), String> {
        if self.is_flat {
            return Ok(());
        }
        let interleaves = match (self.context.order, order) {
            (AxisOrder::ChannelsLast, None | Some(AxisOrder::ChannelsLast)) => true,
            // With its own `data_format`, it moves the channels behind before it flattens.
            (AxisOrder::ChannelsFirst, Some(AxisOrder::ChannelsFirst)) => true,
            (AxisOrder::ChannelsFirst, _) => false,
            (AxisOrder::ChannelsLast, _) => return Err("flattens in another order of axes than the maps have".into()),
        };
        self.interleaved = Some(self.shape).filter(|map| interleaves && map.positions() > 1);
        self.is_flat = true;
        self.push(FlattenSpec {}.into(), Vec::new(), Vec::new())
    }
}

/// For each element of a map in the order channel, row, column: its index in the order row, column, channel.
fn interleaved_places(Shape { c, h, w }: Shape) -> Vec<usize> {
    (0..c * h * w).map(|i| (i % (h * w)) * c + i / (h * w)).collect()
}

/// Reads the tensors of a layer, which must have the shapes that are given; `None` in `shapes` is a tensor that it goes without.
fn expect(tensors: &[Tensor], shapes: &[Option<&[usize]>]) -> Result<Vec<Option<Vec<f32>>>, String> {
    let count = shapes.iter().flatten().count();
    if tensors.len() != count {
        return Err(format!("has {} tensors in the file, not {count}", tensors.len()));
    }
    let mut tensors = tensors.iter();
    let mut read = |shape: &Option<&[usize]>| -> Result<Option<Vec<f32>>, String> {
        let Some(shape) = shape else { return Ok(None) };
        let Some(tensor) = tensors.next() else { return Ok(None) };
        let found = tensor.shape();
        if found != *shape {
            return Err(unfitting(&tensor.name, &found, shape));
        }
        tensor.read().map(Some)
    };
    shapes.iter().map(&mut read).collect()
}

fn unfitting(name: &str, found: &[usize], expected: &[usize]) -> String {
    let name = shown(name);
    format!("tensor `{name}` has shape {found:?}; the architecture says {expected:?}")
}
