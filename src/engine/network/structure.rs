//! The description of a network: named layers in order, and the layout of their tensors.

use std::fmt::Write as _;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::ops::Range;

use ndarray::{ArrayView4, Axis};
use steersman_kernels::{Backend, Isa};

use super::LayerSpec;
use crate::engine::layers::Layer;
use crate::engine::parameters::{Parameters, Tensor};
use crate::engine::random::{Purpose, rng};
use crate::engine::tensor::Shape;
use crate::error::{Error, Result};
use crate::suggestion::did_you_mean;

/// Layers in order, each knowing its input shape.
#[derive(Debug)]
pub struct Network {
    input: Shape,
    layers: Vec<NamedLayer>,
    tensors: Vec<Tensor>,
    backend: Backend,
    fingerprint: u64,
}

/// A layer and where its tensors lie in [`Parameters`].
#[derive(Debug)]
pub struct NamedLayer {
    /// Name, unique in the network.
    pub name: String,
    /// The entry of the recipe.
    pub spec: LayerSpec,
    /// The layer itself.
    pub layer: Box<dyn Layer>,
    /// Where its parameters lie in [`Parameters::values`].
    pub params: Range<usize>,
    /// Where its running statistics lie in [`Parameters::statistics`].
    pub statistics: Range<usize>,
    /// Whether training leaves its parameters and statistics as they are.
    pub frozen: bool,
}

/// Largest number of parameters of a network: 400 MB, and several times that in training. A recipe or a model file cannot ask
/// for more memory than that.
pub const MAX_PARAMETERS: usize = 100_000_000;

impl Network {
    /// The network of `specs` over images of `input`, computed with `backend`: an [`Isa`], or one with a convolution algorithm.
    ///
    /// # Errors
    ///
    /// [`Error::Network`] names the first layer that does not fit and says why.
    pub fn new(input: Shape, specs: &[LayerSpec], backend: impl Into<Backend>) -> Result<Network> {
        let backend = backend.into();
        let mut network = Network { input, layers: Vec::new(), tensors: Vec::new(), backend, fingerprint: 0 };
        let (mut params_end, mut statistics_end) = (0, 0);
        for (index, spec) in specs.iter().enumerate() {
            let same_kind = specs[..index].iter().filter(|other| other.base_name() == spec.base_name()).count();
            let name = format!("{}{}", spec.base_name(), same_kind + 1);
            let layer = spec
                .build(network.output(), backend)
                .map_err(|message| Error::Network { layer: name.clone(), message })?;
            let (params_start, statistics_start) = (params_end, statistics_end);
            for (specs, end, trainable) in
                [(layer.params(), &mut params_end, true), (layer.statistics(), &mut statistics_end, false)]
            {
                for spec in specs {
                    let len = spec.shape.iter().try_fold(1usize, |len, n| len.checked_mul(*n));
                    let Some(len) = len.filter(|len| *len <= MAX_PARAMETERS - *end) else {
                        let message = format!(
                            "the network has more than {MAX_PARAMETERS} parameters; take fewer units or channels"
                        );
                        return Err(Error::Network { layer: name.clone(), message });
                    };
                    let range = *end..*end + len;
                    *end = range.end;
                    let name = format!("{name}.{}", spec.name);
                    network.tensors.push(Tensor { name, spec, trainable, range, frozen: false });
                }
            }
            network.layers.push(NamedLayer {
                name,
                spec: spec.clone(),
                layer,
                params: params_start..params_end,
                statistics: statistics_start..statistics_end,
                frozen: false,
            });
        }
        if network.layers.is_empty() {
            return Err(Error::Network {
                layer: "(none)".into(),
                message: "a network needs at least one layer".into(),
            });
        }
        network.fingerprint = network.hash_structure();
        Ok(network)
    }

    /// A hash over everything that a plan depends on: input shape, layers and their options, frozen layers, backend.
    /// Networks that are built alike have the same.
    pub(crate) fn fingerprint(&self) -> u64 {
        self.fingerprint
    }

    fn hash_structure(&self) -> u64 {
        let mut hasher = DefaultHasher::new();
        (self.input, format!("{:?}", self.backend)).hash(&mut hasher);
        for layer in &self.layers {
            // The text of a specification has all of its options, numbers to the last bit.
            (format!("{:?}", layer.spec), &layer.params, &layer.statistics, layer.frozen).hash(&mut hasher);
        }
        hasher.finish()
    }

    /// The images `x`, `(n, c, h, w)`, as a slice.
    ///
    /// # Panics
    ///
    /// Panics if they are not of the network's input shape, or not contiguous in standard order.
    pub(super) fn image_slice<'a>(&self, x: ArrayView4<'a, f32>) -> &'a [f32] {
        let n = x.len_of(Axis(0));
        assert_eq!(x.dim(), self.input().batch(n), "images (n, c, h, w) of another shape than the network's input");
        x.to_slice().expect("images must be contiguous in standard order")
    }

    /// Panics if `parameters` have other lengths than those of this network.
    pub(super) fn check_parameters(&self, parameters: &Parameters) {
        let end = |range: fn(&NamedLayer) -> &Range<usize>| self.layers.last().map_or(0, |last| range(last).end);
        let lengths = (end(|layer| &layer.params), end(|layer| &layer.statistics));
        let found = (parameters.values.len(), parameters.statistics.len());
        assert_eq!(found, lengths, "parameters (values, statistics) of another network");
    }

    /// The tensor called `name`, as in `conv1.weight`.
    pub fn tensor(&self, name: &str) -> Option<&Tensor> {
        self.tensors.iter().find(|tensor| tensor.name == name)
    }

    /// Shape of one input image.
    pub fn input(&self) -> Shape {
        self.input
    }

    /// Shape of one output.
    pub fn output(&self) -> Shape {
        self.layers.last().map_or(self.input, |last| last.layer.output())
    }

    /// The layers in order.
    pub fn layers(&self) -> &[NamedLayer] {
        &self.layers
    }

    /// All tensors in their fixed order: layer by layer, parameters before statistics.
    pub fn tensors(&self) -> &[Tensor] {
        &self.tensors
    }

    /// The vector code the network runs on.
    pub fn isa(&self) -> Isa {
        self.backend.isa
    }

    /// What the network is computed with.
    pub fn backend(&self) -> Backend {
        self.backend
    }

    /// Freezes the layers called `names`: training changes neither their parameters nor their running statistics, and their batch
    /// normalisation takes the running statistics in training too. Plans made before refuse the network afterwards.
    ///
    /// # Errors
    ///
    /// [`Error::Usage`] if there is no such layer, it has no parameters, or nothing would be left to train.
    pub fn freeze(&mut self, names: &[String]) -> Result<()> {
        let with_parameters = |layer: &&NamedLayer| !layer.params.is_empty();
        for name in names {
            let Some(layer) = self.layers.iter_mut().find(|layer| layer.name == *name) else {
                let known: Vec<&str> =
                    self.layers.iter().filter(with_parameters).map(|layer| layer.name.as_str()).collect();
                let hint = did_you_mean(name, &known);
                let known = known.join(", ");
                return Err(Error::Usage(format!(
                    "there is no layer `{name}` to freeze{hint}; with weights are {known}"
                )));
            };
            if layer.params.is_empty() {
                return Err(Error::Usage(format!("layer `{name}` has no weights that could be frozen")));
            }
            layer.frozen = true;
            let of_layer = |tensor: &&mut Tensor| tensor.name.split_once('.').is_some_and(|(layer, _)| layer == name);
            self.tensors.iter_mut().filter(of_layer).for_each(|tensor| tensor.frozen = true);
        }
        if self.layers.iter().filter(with_parameters).all(|layer| layer.frozen) {
            return Err(Error::Usage("every layer with weights is frozen; nothing is left to train".into()));
        }
        self.fingerprint = self.hash_structure();
        Ok(())
    }

    /// Freshly drawn parameters. Each tensor has a random stream of its own, so the draw of one does not depend on the
    /// others.
    pub fn initialize(&self, seed: u64) -> Parameters {
        let mut parameters =
            Parameters { values: vec![0.0; self.count(true)], statistics: vec![0.0; self.count(false)] };
        for (index, tensor) in self.tensors.iter().enumerate() {
            let mut random = rng(seed, Purpose::Initialise, 0, index as u64);
            tensor.spec.init.fill(tensor.spec.fans, &mut random, parameters.tensor_mut(tensor));
        }
        parameters
    }

    /// Number of trainable parameters, or of running statistics.
    pub fn count(&self, trainable: bool) -> usize {
        self.tensors.iter().filter(|t| t.trainable == trainable).map(|t| t.range.len()).sum()
    }

    /// Multiply-adds of one image's forward pass.
    pub fn multiply_adds(&self) -> u64 {
        self.layers.iter().map(|l| l.layer.multiply_adds()).sum()
    }

    /// The layer table: name, kind, output shape (height x width x channels), parameters, multiply-adds; then the totals.
    pub fn summary(&self) -> String {
        let rule = "-".repeat(76);
        let mut text = String::new();
        // Writing to a String cannot fail.
        let _ = writeln!(text, "{:<10} {:<24} {:<14} {:>10} {:>14}", "layer", "kind", "output", "params", "mult-adds");
        let _ = writeln!(text, "{rule}\n{:<35} {}", "input", self.input);
        for NamedLayer { name, spec, layer, params, statistics, .. } in &self.layers {
            let count = group_digits((params.len() + statistics.len()) as u64);
            let multiply_adds = match layer.multiply_adds() {
                0 => String::new(),
                number => group_digits(number),
            };
            let output = layer.output().to_string();
            let line = format!("{name:<10} {:<24} {output:<14} {count:>10} {multiply_adds:>14}", spec.describe());
            let _ = writeln!(text, "{}", line.trim_end());
        }
        let (trainable, fixed) = (self.count(true) as u64, self.count(false) as u64);
        let _ = writeln!(text, "{rule}\nTotal params: {}", group_digits(trainable + fixed));
        let _ = writeln!(text, "Trainable params: {}", group_digits(trainable));
        let _ = writeln!(text, "Non-trainable params: {}", group_digits(fixed));
        let _ = writeln!(text, "Multiply-adds per image: {}", group_digits(self.multiply_adds()));
        text
    }
}

/// `1234567` as `1,234,567`.
pub fn group_digits(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Vec<LayerSpec> {
        #[derive(serde::Deserialize)]
        struct Layers {
            layers: Vec<LayerSpec>,
        }
        toml::from_str::<Layers>(text).unwrap().layers
    }

    #[test]
    fn layers_are_named_by_kind_and_number() {
        let specs = parse("layers = [{kind='dense', units=3}, {kind='relu'}, {kind='dense', units=1}]");
        let network = Network::new(Shape::vector(2), &specs, Isa::PORTABLE).unwrap();
        let names: Vec<_> = network.tensors().iter().map(|t| t.name.as_str()).collect();
        assert_eq!(names, ["dense1.weight", "dense1.bias", "dense2.weight", "dense2.bias"]);
        assert_eq!((network.count(true), network.count(false)), (2 * 3 + 3 + 3 + 1, 0));
    }

    #[test]
    fn a_layer_that_does_not_fit_is_named() {
        let specs = parse("layers = [{kind='max_pool', window=[2, 2]}, {kind='conv2d', filters=1, kernel=[3, 3]}]");
        let error = Network::new(Shape::new(1, 4, 4), &specs, Isa::PORTABLE).unwrap_err();
        assert_eq!(error.to_string(), "layer `conv1`: a 3x3 kernel does not fit into the 2x2 input");
    }

    #[test]
    fn digits_are_grouped_by_three() {
        assert_eq!(group_digits(7), "7");
        assert_eq!(group_digits(176_159), "176,159");
        assert_eq!(group_digits(13_864_346), "13,864,346");
    }
}
