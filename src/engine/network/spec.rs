//! The entries of a recipe's `layers`.

use std::ops::Deref;

use serde::{Deserialize, Serialize};

use crate::engine::layers::{
    AveragePoolSpec, BatchNormSpec, BlurSpec, Conv2dSpec, CropSpec, DenseSpec, DropoutSpec, EluSpec, FlattenSpec,
    LayerKind, LeakyReluSpec, MaxPoolSpec, PReluSpec, ReluSpec, ResizeSpec, ScaleSpec, SoftsignSpec, SwishSpec,
    TanhSpec, ZeroPadSpec,
};

/// Makes [`LayerSpec`] from lines `"kind in recipes" Variant(Options) "example";`.
macro_rules! layer_specs {
    ($($kind:literal $variant:ident($options:ident) $example:literal;)+) => {
        /// One entry of a recipe's `layers`: `{ kind = "conv2d", filters = 8, kernel = [3, 3] }`.
        ///
        /// Pairs are (height, width). Layers are named by their kind and a number from 1: `conv1`, `bn1`, `conv2`. An entry answers
        /// the questions of [`LayerKind`] as its options do: `spec.describe()`, `spec.build(input, isa)`.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(tag = "kind")]
        pub enum LayerSpec {
            $(
                #[doc = concat!("`", $example, "`")]
                #[serde(rename = $kind)]
                $variant($options),
            )+
        }

        impl LayerSpec {
            /// Kind and an example, as in a recipe, of every entry there is.
            pub const EXAMPLES: &[(&str, &str)] = &[$(($kind, $example)),+];
        }

        impl Deref for LayerSpec {
            type Target = dyn LayerKind;

            fn deref(&self) -> &(dyn LayerKind + 'static) {
                match self {
                    $(LayerSpec::$variant(options) => options,)+
                }
            }
        }

        $(
            impl From<$options> for LayerSpec {
                fn from(options: $options) -> LayerSpec {
                    LayerSpec::$variant(options)
                }
            }
        )+
    };
}

layer_specs! {
    "conv2d" Conv2d(Conv2dSpec) "{ kind = 'conv2d', filters = 5, kernel = [3, 2], stride = [2, 1], padding = 'same' }";
    "batch_norm" BatchNorm(BatchNormSpec) "{ kind = 'batch_norm' }";
    "relu" Relu(ReluSpec) "{ kind = 'relu' }";
    "elu" Elu(EluSpec) "{ kind = 'elu', alpha = 0.5 }";
    "leaky_relu" LeakyRelu(LeakyReluSpec) "{ kind = 'leaky_relu', slope = 0.1 }";
    "tanh" Tanh(TanhSpec) "{ kind = 'tanh' }";
    "softsign" Softsign(SoftsignSpec) "{ kind = 'softsign' }";
    "swish" Swish(SwishSpec) "{ kind = 'swish' }";
    "prelu" PRelu(PReluSpec) "{ kind = 'prelu', slopes = 'per_channel' }";
    "max_pool" MaxPool(MaxPoolSpec) "{ kind = 'max_pool', window = [2, 2] }";
    "average_pool" AveragePool(AveragePoolSpec) "{ kind = 'average_pool', window = [3, 2], stride = [1, 2] }";
    "blur" Blur(BlurSpec) "{ kind = 'blur', window = [2, 3], padding = [0, 1] }";
    "dropout" Dropout(DropoutSpec) "{ kind = 'dropout', drop_probability = 0.5 }";
    "flatten" Flatten(FlattenSpec) "{ kind = 'flatten' }";
    "dense" Dense(DenseSpec) "{ kind = 'dense', units = 3 }";
    "scale" Scale(ScaleSpec) "{ kind = 'scale', factor = 0.5, offset = -1.0 }";
    "crop" Crop(CropSpec) "{ kind = 'crop', rows = [2, 1], columns = [0, 1] }";
    "resize" Resize(ResizeSpec) "{ kind = 'resize', to = [17, 14], method = 'area' }";
    "zero_pad" ZeroPad(ZeroPadSpec) "{ kind = 'zero_pad', rows = [1, 0], columns = [2, 1] }";
}

#[cfg(test)]
mod tests {
    use steersman_kernels::Isa;

    use super::*;
    use crate::engine::layers::check_kind;
    use crate::engine::layers::gradcheck::check_layer;
    use crate::engine::network::Network;
    use crate::engine::tensor::Shape;

    const INPUT: Shape = Shape::new(2, 7, 6);

    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Layers {
        layers: Vec<LayerSpec>,
    }

    fn parse(example: &str) -> LayerSpec {
        let mut layers = toml::from_str::<Layers>(&format!("layers = [{example}]")).unwrap().layers;
        assert_eq!(layers.len(), 1);
        layers.remove(0)
    }

    #[test]
    fn every_kind_answers_truly() {
        for (_, example) in LayerSpec::EXAMPLES {
            check_kind(&*parse(example), INPUT);
        }
    }

    #[test]
    fn the_gradients_of_every_kind_hold() {
        for (_, example) in LayerSpec::EXAMPLES {
            for isa in Isa::available() {
                check_layer(&*parse(example).build(INPUT, isa).unwrap(), 3);
            }
        }
    }

    #[test]
    fn every_kind_is_written_as_it_was_read_and_makes_a_network() {
        for (kind, example) in LayerSpec::EXAMPLES {
            let layers = Layers { layers: vec![parse(example)] };
            let text = toml::to_string(&layers).unwrap();
            assert_eq!(toml::from_str::<Layers>(&text).unwrap(), layers, "{text}");
            let table: toml::Table = text.parse().unwrap();
            assert_eq!(table["layers"][0]["kind"].as_str(), Some(*kind));
            let network = Network::new(INPUT, &layers.layers, Isa::PORTABLE).unwrap();
            assert_eq!(network.layers()[0].name, format!("{}1", layers.layers[0].base_name()));
        }
    }

    #[test]
    fn every_kind_refuses_an_option_that_it_does_not_know_and_names_it() {
        for (kind, example) in LayerSpec::EXAMPLES {
            let spoilt = example.replace(" }", ", colour = 1 }");
            let error = toml::from_str::<Layers>(&format!("layers = [{spoilt}]")).unwrap_err().to_string();
            assert!(error.contains("unknown field `colour`"), "{kind}: {error}");
        }
    }

    #[test]
    fn every_kind_stands_in_the_documentation_of_recipes() {
        let page = include_str!("../../../data/README.md");
        let entry = page.lines().find(|line| line.starts_with("| `layers` |")).unwrap();
        for (kind, _) in LayerSpec::EXAMPLES {
            assert!(entry.contains(&format!("`{kind}`")), "data/README.md does not name {kind}");
        }
    }
}
