"""Writes hyper.json, lenet.json and pilotnet.json: what Keras 3 computes for the three networks on formula numbers.

The formula values are rounded to float32 (the engine's precision) and then everything is computed in float64, so that
the files hold the exact answer rather than another engine's rounding. `--noise` repeats the work in float32 and prints
how far Keras' own float32 results lie from them: the floor under any tolerance.

    python make_networks.py [--noise] [hyper lenet pilotnet]
"""

import argparse
import json
import os
from pathlib import Path

os.environ["KERAS_BACKEND"] = "tensorflow"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import keras
import numpy as np
import tensorflow as tf
from keras import layers

from formula import unit

BATCH = 8
STEPS = 5
SAMPLES = 64
LEARNING_RATE, BETA_1, BETA_2, EPSILON = 1e-3, 0.9, 0.999, 1e-8
BN_MOMENTUM, BN_EPSILON = 0.99, 1e-3


def conv(filters, kernel, stride=1):
    return lambda name: layers.Conv2D(filters, kernel, strides=stride, padding="valid", name=name)


def dense(units):
    return lambda name: layers.Dense(units, name=name)


def batch_norm(name):
    return layers.BatchNormalization(momentum=BN_MOMENTUM, epsilon=BN_EPSILON, name=name)


def pool(size):
    return lambda name: layers.MaxPooling2D(size, strides=size, padding="valid", name=name)


def scale(divisor, offset):
    return lambda name: layers.Rescaling(1.0 / divisor, offset, name=name)


def relu(name):
    return layers.ReLU(name=name)


def elu(name):
    return layers.ELU(name=name)


def prelu(name):
    return layers.PReLU(name=name)


def dropout(name):
    return layers.Dropout(0.0, name=name)


def flatten(name):
    return layers.Flatten(name=name)


# name -> (input [c, h, w], {layer name: constructor}), in order from input to output.
NETWORKS = {
    "hyper": (
        (3, 40, 160),
        {
            "conv1": conv(8, 3), "bn1": batch_norm, "relu1": relu,
            "conv2": conv(16, 3), "bn2": batch_norm, "relu2": relu, "pool1": pool(2),
            "conv3": conv(24, 3), "bn3": batch_norm, "prelu1": prelu, "pool2": pool(2),
            "conv4": conv(32, 3), "bn4": batch_norm, "prelu2": prelu, "pool3": pool(2),
            "conv5": conv(64, 3), "bn5": batch_norm, "prelu3": prelu, "flatten": flatten,
            "dense1": dense(100), "bn6": batch_norm, "dropout1": dropout, "prelu4": prelu,
            "dense2": dense(50), "prelu5": prelu, "dropout2": dropout,
            "dense3": dense(1),
        },
    ),
    "lenet": (
        (1, 64, 64),
        {
            "scale": scale(255.0, -0.5),
            "conv1": conv(6, 3), "elu1": elu, "pool1": pool(4),
            "conv2": conv(16, 3), "elu2": elu, "pool2": pool(4), "flatten": flatten,
            "dense1": dense(120), "elu3": elu, "dense2": dense(84), "elu4": elu,
            "dense3": dense(1),
        },
    ),
    "pilotnet": (
        (3, 66, 200),
        {
            "scale": scale(127.5, -1.0),
            "conv1": conv(24, 5, 2), "elu1": elu, "conv2": conv(36, 5, 2), "elu2": elu,
            "conv3": conv(48, 5, 2), "elu3": elu, "conv4": conv(64, 3), "elu4": elu,
            "conv5": conv(64, 3), "elu5": elu, "dropout": dropout, "flatten": flatten,
            "dense1": dense(100), "elu6": elu, "dense2": dense(50), "elu7": elu,
            "dense3": dense(10), "elu8": elu, "dense4": dense(1),
        },
    ),
}

PARAMETER_COUNT = {"hyper": 176_159, "lenet": 28_589, "pilotnet": 252_219}


class Network:
    """A Keras model together with the mapping of every tensor between Keras' layout and ours."""

    def __init__(self, name):
        self.name = name
        (c, h, w), table = NETWORKS[name]
        source = keras.Input((h, w, c))
        x, outputs = source, {}
        self.chw_before_flatten = None
        for layer_name, constructor in table.items():
            if layer_name == "flatten":
                _, fh, fw, fc = x.shape
                self.chw_before_flatten = (fc, fh, fw)
            x = constructor(layer_name)(x)
            outputs[layer_name] = x
        self.model = keras.Model(source, outputs)
        self.last = layer_name
        self.input_shape = (BATCH, c, h, w)
        # Our parameter name -> Keras variable, layer by layer; the running statistics are kept apart.
        self.trainable, self.running = {}, {}
        for layer_name in table:
            layer = self.model.get_layer(layer_name)
            if isinstance(layer, (layers.Conv2D, layers.Dense)):
                self.trainable[f"{layer_name}.weight"] = layer.kernel
                self.trainable[f"{layer_name}.bias"] = layer.bias
            elif isinstance(layer, layers.BatchNormalization):
                self.trainable[f"{layer_name}.gamma"] = layer.gamma
                self.trainable[f"{layer_name}.beta"] = layer.beta
                self.running[f"{layer_name}.running_mean"] = layer.moving_mean
                self.running[f"{layer_name}.running_variance"] = layer.moving_variance
            elif isinstance(layer, layers.PReLU):
                self.trainable[f"{layer_name}.slope"] = layer.alpha
        assert self.model.count_params() == PARAMETER_COUNT[name]

    def parameter_to_ours(self, name, value):
        """Keras -> ours: convolution [kh,kw,ic,oc] -> [oc,ic,kh,kw]; dense [in,out] -> [out,in]; slopes HWC -> CHW."""
        value = np.asarray(value)
        if name.endswith(".weight") and value.ndim == 4:
            return value.transpose(3, 2, 0, 1)
        if name == "dense1.weight":
            c, h, w = self.chw_before_flatten
            return value.reshape(h, w, c, -1).transpose(3, 2, 0, 1).reshape(value.shape[1], value.shape[0])
        if name.endswith(".weight"):
            return value.T
        if name.endswith(".slope") and value.ndim == 3:
            return value.transpose(2, 0, 1)
        return value

    def parameter_to_keras(self, name, value):
        """The inverse of `parameter_to_ours`."""
        if name.endswith(".weight") and value.ndim == 4:
            return value.transpose(2, 3, 1, 0)
        if name == "dense1.weight":
            c, h, w = self.chw_before_flatten
            return value.reshape(-1, c, h, w).transpose(2, 3, 1, 0).reshape(value.shape[1], value.shape[0])
        if name.endswith(".weight"):
            return value.T
        if name.endswith(".slope") and value.ndim == 3:
            return value.transpose(1, 2, 0)
        return value

    def activation_to_ours(self, layer_name, value):
        """NHWC -> NCHW; the flattened vector from H,W,C order to C,H,W order."""
        value = np.asarray(value)
        if layer_name == "flatten":
            c, h, w = self.chw_before_flatten
            return value.reshape(-1, h, w, c).transpose(0, 3, 1, 2).reshape(value.shape)
        return value.transpose(0, 3, 1, 2) if value.ndim == 4 else value

    def formula_parameter(self, name, shape):
        u = unit(name, shape)
        kind = name.split(".")[1]
        if kind == "weight":
            area = int(np.prod(shape[2:]))
            u = u * np.sqrt(6.0 / ((shape[0] + shape[1]) * area))
        else:
            u = {
                "bias": lambda: 0.1 * u,
                "gamma": lambda: 1.0 + 0.1 * u,
                "beta": lambda: 0.1 * u,
                "running_mean": lambda: 0.1 * u,
                "running_variance": lambda: 1.0 + 0.2 * u,
                "slope": lambda: 0.25 * u,
            }[kind]()
        return u.astype(np.float32)

    def formula_input(self):
        u = unit("input", self.input_shape)
        u = 0.5 * u if self.name == "hyper" else np.floor((u + 1.0) * 127.5 + 0.5)
        return u.astype(np.float32)

    def load_formula(self):
        for name, variable in (self.trainable | self.running).items():
            shape = self.parameter_to_ours(name, variable.numpy()).shape
            variable.assign(self.parameter_to_keras(name, self.formula_parameter(name, shape)))


def compute(name, dtype):
    """All tensors of one network, name -> array in our layout, and its losses after 0, 1, ... STEPS steps."""
    keras.backend.clear_session()
    keras.backend.set_floatx(dtype)
    net = Network(name)
    tensors = {}
    x = tf.constant(net.formula_input().transpose(0, 2, 3, 1).astype(dtype))
    y = tf.constant((0.5 * unit("labels", (BATCH,))).astype(np.float32).astype(dtype).reshape(BATCH, 1))
    variables = list(net.trainable.values())

    def gradients():
        with tf.GradientTape() as tape:
            tape.watch(x)
            outputs = net.model(x, training=True)
            loss = tf.reduce_mean(tf.square(outputs[net.last] - y))
        return outputs, loss, tape.gradient(loss, [x] + [v.value for v in variables])

    net.load_formula()
    tensors[f"infer/{net.last}"] = net.model(x, training=False)[net.last].numpy()

    outputs, loss, (dx, *grads) = gradients()
    losses = [float(loss)]
    for layer_name, value in outputs.items():
        tensors[f"forward/{layer_name}"] = net.activation_to_ours(layer_name, value)
    tensors["grad/input"] = net.activation_to_ours("input", dx)
    for param, grad in zip(net.trainable, grads):
        tensors[f"grad/{param}"] = net.parameter_to_ours(param, grad)
    for param, variable in net.running.items():
        tensors[f"running/{param}"] = variable.numpy()

    net.load_formula()
    before = {param: v.numpy() for param, v in net.trainable.items()}
    adam = keras.optimizers.Adam(LEARNING_RATE, beta_1=BETA_1, beta_2=BETA_2, epsilon=EPSILON)
    model = AdamByHand(before)
    for _ in range(STEPS):
        _, _, (_, *grads) = gradients()
        adam.apply(grads, variables)
        model.step(dict(zip(net.trainable, grads)))
        losses.append(float(gradients()[1]))
    for param, variable in net.trainable.items():
        change = variable.numpy() - before[param]
        tensors[f"change/{param}"] = net.parameter_to_ours(param, change)
        if dtype == "float64":
            # Keras rounds beta_2 to float32 in the bias correction even here: 7e-6 of every change.
            assert np.linalg.norm(model.moved[param] - change) <= 2e-5 * np.linalg.norm(change) + 1e-12, param
    if dtype == "float64":
        check_running_statistics(net, tensors)
    return tensors, losses


class AdamByHand:
    """Adam in the form of Keras 1 (epsilon outside the root, not bias-corrected), to show that Keras 3 has it too."""

    def __init__(self, params):
        self.moved = {k: np.zeros_like(v) for k, v in params.items()}
        self.m = {k: np.zeros_like(v) for k, v in params.items()}
        self.v = {k: np.zeros_like(v) for k, v in params.items()}
        self.t = 0

    def step(self, grads):
        self.t += 1
        rate = LEARNING_RATE * np.sqrt(1.0 - BETA_2**self.t) / (1.0 - BETA_1**self.t)
        for k, g in grads.items():
            g = np.asarray(g)
            self.m[k] = BETA_1 * self.m[k] + (1.0 - BETA_1) * g
            self.v[k] = BETA_2 * self.v[k] + (1.0 - BETA_2) * g * g
            self.moved[k] -= rate * self.m[k] / (np.sqrt(self.v[k]) + EPSILON)


def check_running_statistics(net, tensors):
    """Running statistics must follow r = 0.99 r + 0.01 batch with the population variance, as in Keras 1."""
    order = list(NETWORKS[net.name][1])
    for param in net.running:
        layer_name, kind = param.split(".")
        source = tensors[f"forward/{order[order.index(layer_name) - 1]}"]
        axes = (0, 2, 3) if source.ndim == 4 else (0,)
        batch = source.mean(axes) if kind == "running_mean" else source.var(axes)
        old = net.formula_parameter(param, batch.shape).astype(np.float64)
        expected = BN_MOMENTUM * old + (1.0 - BN_MOMENTUM) * batch
        np.testing.assert_allclose(tensors[f"running/{param}"], expected, rtol=1e-9, atol=1e-12)


def summarise(name, value):
    flat = np.asarray(value, dtype=np.float64).ravel()
    probe = unit(f"probe/{name}", flat.shape).astype(np.float32).astype(np.float64)
    count = min(SAMPLES, flat.size)
    places = np.arange(count) * flat.size // count
    return {
        "name": name,
        "shape": list(value.shape),
        "norm": rounded(np.sqrt(np.sum(flat * flat))),
        "dot": rounded(np.dot(flat, probe)),
        "samples": [rounded(v) for v in flat[places]],
    }


def rounded(value):
    """Eight significant digits, as a JSON number."""
    return float(f"{float(value):.7e}")


def write(name, tensors, losses):
    head = {
        "network": name,
        "made_by": f"make_networks.py, Keras {keras.__version__}, TensorFlow {tf.__version__}, computed in float64",
        "batch": BATCH,
        "steps": STEPS,
        "loss": rounded(losses[0]),
        "loss_after_steps": [rounded(v) for v in losses[1:]],
    }
    lines = [f"  {json.dumps(k)}: {json.dumps(v)}," for k, v in head.items()]
    rows = [json.dumps(summarise(k, v), separators=(",", ":")) for k, v in tensors.items()]
    text = "{\n" + "\n".join(lines) + '\n  "tensors": [\n' + ",\n".join(rows) + "\n  ]\n}\n"
    path = Path(__file__).with_name(f"{name}.json")
    path.write_text(text, encoding="utf-8", newline="\n")
    print(f"{path.name}: {len(tensors)} tensors, {len(text)} bytes, losses {losses}")


def print_noise(name, exact):
    single, losses = compute(name, "float32")
    worst = {}
    for key, value in exact.items():
        norm = np.linalg.norm(value)
        error = np.linalg.norm(single[key].astype(np.float64) - value) / max(norm, 1e-300)
        kind = key.split("/")[0]
        worst.setdefault(kind, []).append((error, norm, key))
    print(f"  {name} in float32: losses {losses}")
    for kind, errors in worst.items():
        for error, norm, key in sorted(errors, reverse=True)[:8]:
            print(f"  {kind:8} relative L2 error {error:9.2e}  norm {norm:9.2e}  {key}")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("networks", nargs="*", default=list(NETWORKS))
    parser.add_argument("--noise", action="store_true", help="also compute in float32 and print the difference")
    args = parser.parse_args()
    for name in args.networks:
        tensors, losses = compute(name, "float64")
        write(name, tensors, losses)
        if args.noise:
            print_noise(name, tensors)


if __name__ == "__main__":
    main()
