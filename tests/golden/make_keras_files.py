"""Small Keras files of every kind, with the outputs that Keras gives: `keras/*` and `keras/expected.json`. See README.md.

`keras3`, `functional`, `donkey` and `degrees` are written by Keras itself, in both of its formats. The styles of Keras 1 and 2 are written with h5py in
the layout, the names and the spelling that those versions used, from the weights of the model `plain`, and must give its outputs.
"""

import codecs
import json
import marshal
import pathlib
import sys

import h5py
import keras
import numpy as np
import tensorflow as tf
from formula import unit
from keras import layers

OUT = pathlib.Path(__file__).parent / "keras"
IMAGES = 4


def inputs(shape):
    """Grey levels, [n][h][w][c], from the formula in our layout, [n][c][h][w]."""
    h, w, c = shape
    grey = np.floor((unit("input", (IMAGES, c, h, w)) + 1) * 127.5 + 0.5)
    return grey.transpose(0, 2, 3, 1).astype(np.float32)


def randomise(model, seed):
    """Weights that leave no layer without effect; variances and scales stay positive."""
    rng = np.random.default_rng(seed)
    for layer in model.layers:
        values = []
        for variable in layer.weights:
            name = variable.path.split("/")[-1]
            if name in ("moving_variance", "gamma"):
                values.append(rng.uniform(0.5, 1.5, variable.shape))
            elif name == "kernel":
                limit = np.sqrt(6 / np.prod(variable.shape[:-1]))
                values.append(rng.uniform(-limit, limit, variable.shape))
            else:
                values.append(rng.uniform(-0.3, 0.3, variable.shape))
        if values and len(values) == len(layer.get_weights()):
            layer.set_weights([v.astype(np.float32) for v in values])


normalise = lambda x: x / 127.5 - 1.0
# Without the path of this script in the file.
normalise.__code__ = normalise.__code__.replace(co_filename="model.py")


def keras3():
    """Every kind of layer that has a counterpart."""
    return keras.Sequential([
        layers.Input((19, 24, 3)),
        layers.Lambda(normalise),
        layers.Cropping2D(((3, 1), (0, 2))),
        layers.ZeroPadding2D(((1, 0), (2, 1))),
        layers.Conv2D(5, (3, 5), strides=(2, 1), activation="elu"),
        layers.BatchNormalization(),
        layers.PReLU(),
        layers.MaxPooling2D((2, 2)),
        layers.Conv2D(4, 3, padding="same", use_bias=False, activation="tanh"),
        layers.LeakyReLU(0.1),
        layers.AveragePooling2D((1, 2)),
        layers.Conv2D(4, 1, activation="relu"),
        layers.PReLU(shared_axes=[1, 2]),
        layers.BatchNormalization(scale=False, epsilon=0.01),
        layers.Conv2D(6, (2, 2), strides=(1, 2), activation="softsign"),
        layers.SpatialDropout2D(0.1),
        layers.Flatten(),
        layers.BatchNormalization(center=False),
        layers.PReLU(),
        layers.Dropout(0.5),
        layers.Dense(9, activation="linear"),
        layers.ELU(0.7),
        layers.Dense(7, activation=keras.layers.LeakyReLU(0.3)),
        layers.Dense(6, activation="tanh"),
        layers.Dense(5, use_bias=False),
        layers.ReLU(),
        layers.Activation("softsign"),
        layers.Dense(1),
    ], name="keras3")


def functional():
    """A chain written as a graph; dense before flatten; pooling over the whole map."""
    image = keras.Input((20, 24, 1), name="image")
    x = layers.Rescaling(1 / 255.0, offset=-0.5)(image)
    x = layers.Conv2D(4, 3, strides=2, padding="same", name="eyes")(x)
    x = layers.LeakyReLU(negative_slope=0.2)(x)
    x = layers.MaxPooling2D(2, padding="same")(x)
    x = layers.Dense(6, activation="relu")(x)
    x = layers.ReLU(negative_slope=0.05)(x)
    x = layers.GaussianNoise(0.1)(x)
    x = layers.GlobalAveragePooling2D()(x)
    x = layers.Dense(5, activation="elu")(x)
    return keras.Model(image, layers.Dense(1, name="steering")(x), name="graph")


def plain():
    """What existed in Keras 1, 2 and 3 alike."""
    return keras.Sequential([
        layers.Input((20, 28, 3)),
        layers.Rescaling(1 / 127.5, offset=-1.0),
        layers.Conv2D(4, (3, 5), strides=(2, 2), activation="elu", name="conv"),
        layers.BatchNormalization(name="norm"),
        layers.PReLU(name="slopes"),
        layers.ZeroPadding2D((1, 2), name="pad"),
        layers.Cropping2D(((2, 1), (1, 0)), name="crop"),
        layers.Conv2D(5, (2, 3), padding="same", name="conv_b"),
        layers.LeakyReLU(0.2, name="leaky"),
        layers.AveragePooling2D((1, 2), name="pool"),
        layers.Dropout(0.5, name="dropout"),
        layers.Flatten(name="flatten"),
        layers.Dense(6, activation="relu", name="dense"),
        layers.Dense(1, name="steering"),
    ], name="plain")


def donkey():
    """As donkeycar's linear network: two outputs of one trunk."""
    image = keras.Input((22, 30, 3), name="img_in")
    x = layers.Rescaling(1 / 255.0)(image)
    x = layers.Conv2D(4, 5, strides=2, activation="relu", name="conv2d_1")(x)
    x = layers.Dropout(0.2)(x)
    x = layers.Conv2D(5, 3, activation="relu", name="conv2d_2")(x)
    x = layers.Flatten(name="flattened")(x)
    x = layers.Dense(7, activation="relu", name="dense_1")(x)
    x = layers.Dropout(0.2)(x)
    outputs = [layers.Dense(1, activation="linear", name=f"n_outputs{i}")(x) for i in range(2)]
    return keras.Model(image, outputs, name="linear")


def degrees():
    """What cars of students have in their models: no input layer, augmentation and resizing in the network, degrees."""
    model = keras.Sequential([
        layers.RandomFlip("horizontal"),
        layers.Resizing(24, 30),
        layers.RandomBrightness(0.2),
        layers.Lambda(normalise),
        layers.Conv2D(4, 5, strides=2, activation="relu"),
        layers.Resizing(5, 13, interpolation="nearest"),
        layers.Flatten(),
        layers.Dense(1),
    ], name="degrees")
    model.build((None, 48, 90, 3))
    return model


def resized():
    """Resizing by ratios that are not whole, down and up, of pictures and of maps."""
    return keras.Sequential([
        layers.Input((31, 43, 3)),
        layers.Resizing(20, 27),
        layers.Rescaling(1 / 127.5, offset=-1.0),
        layers.Conv2D(4, 5, strides=2, activation="elu"),
        layers.Resizing(5, 9, interpolation="nearest"),
        layers.Conv2D(5, 3, activation="tanh"),
        layers.Resizing(7, 4),
        layers.Flatten(),
        layers.Dense(1),
    ], name="resized")


def area():
    """Keras 2 resized by area, too; Keras 3 does not, but TensorFlow does."""
    return keras.Sequential([
        layers.Input((31, 43, 3)),
        layers.Lambda(lambda x: tf.image.resize(x, (20, 27), method="area"), name="resizing"),
        layers.Rescaling(1 / 127.5, offset=-1.0, name="rescaling"),
        layers.Conv2D(4, 5, strides=2, activation="elu", name="conv"),
        layers.Lambda(lambda x: tf.image.resize(x, (5, 9), method="area"), name="resizing_1"),
        layers.Flatten(name="flatten"),
        layers.Dense(1, name="steering"),
    ], name="area")


def keras2_area(model):
    """The file of `area` as Keras 2 wrote it."""
    conv = {"filters": 4, "kernel_size": [5, 5], "strides": [2, 2], "padding": "valid", "data_format": "channels_last",
            "dilation_rate": [1, 1], "activation": "elu", "use_bias": True}
    resizing = lambda height, width: {"height": height, "width": width, "interpolation": "area", "crop_to_aspect_ratio": False}
    config = [
        ("InputLayer", "input_1", {"batch_input_shape": [None, 31, 43, 3], "dtype": "float32", "sparse": False}),
        ("Resizing", "resizing", resizing(20, 27)),
        ("Rescaling", "rescaling", {"scale": 1 / 127.5, "offset": -1.0}),
        ("Conv2D", "conv", conv),
        ("Resizing", "resizing_1", resizing(5, 9)),
        ("Flatten", "flatten", {"data_format": "channels_last"}),
        ("Dense", "steering", {"units": 1, "activation": "linear", "use_bias": True}),
    ]
    with h5py.File(OUT / "keras2-area.h5", "w") as f:
        f.attrs["keras_version"] = b"2.11.0"
        f.attrs["backend"] = b"tensorflow"
        f.attrs["model_config"] = json.dumps(chain(config)).encode()
        write_layers(f.create_group("model_weights"), model, [name for _, name, _ in config], keras2_name)


def lambda_code(base64):
    """The code of x / 127.5 - 1 as Keras 1 wrote it, or as Keras 2 did."""
    code = marshal.dumps(normalise.__code__)
    return codecs.encode(code, "base64").decode("ascii") if base64 else code.decode("raw_unicode_escape")


def keras1_config(th):
    """The architecture in Keras 1's spelling; with Theano's order of the axes, or TensorFlow's."""
    order = "th" if th else "tf"
    shape = [None, 3, 20, 28] if th else [None, 20, 28, 3]
    conv = {"init": "glorot_uniform", "dim_ordering": order, "bias": True, "trainable": True}
    return [
        ("Lambda", "normalise", {"batch_input_shape": shape, "function": [lambda_code(False), None, None],
                                 "function_type": "lambda", "arguments": {}, "output_shape": None,
                                 "output_shape_type": "raw", "input_dtype": "float32", "trainable": True}),
        ("Convolution2D", "conv", {"nb_filter": 4, "nb_row": 3, "nb_col": 5, "subsample": [2, 2], "border_mode": "valid",
                                   "activation": "elu", **conv}),
        ("BatchNormalization", "norm", {"axis": 1 if th else -1, "mode": 0, "epsilon": 0.001, "momentum": 0.99}),
        ("PReLU", "slopes", {"init": "zero"}),
        ("ZeroPadding2D", "pad", {"padding": [1, 2], "dim_ordering": order}),
        ("Cropping2D", "crop", {"cropping": [[2, 1], [1, 0]], "dim_ordering": order}),
        ("Convolution2D", "conv_b", {"nb_filter": 5, "nb_row": 2, "nb_col": 3, "subsample": [1, 1], "border_mode": "same",
                                     "activation": "linear", **conv}),
        ("LeakyReLU", "leaky", {"alpha": 0.2}),
        ("AveragePooling2D", "pool", {"pool_size": [1, 2], "strides": None, "border_mode": "valid", "dim_ordering": order}),
        ("Dropout", "dropout", {"p": 0.5}),
        ("Flatten", "flatten", {}),
        ("Dense", "dense", {"output_dim": 6, "activation": "relu", "bias": True, "init": "glorot_uniform"}),
        ("Dense", "steering", {"output_dim": 1, "activation": "linear", "bias": True, "init": "glorot_uniform"}),
    ]


def keras2_config():
    """The architecture in Keras 2's spelling, a functional model."""
    conv = {"data_format": "channels_last", "dilation_rate": [1, 1], "use_bias": True}
    return [
        ("InputLayer", "input_1", {"batch_input_shape": [None, 20, 28, 3], "dtype": "float32", "sparse": False}),
        ("Lambda", "normalise", {"function": [lambda_code(True), None, None], "function_type": "lambda", "arguments": {},
                                 "output_shape": None, "output_shape_type": "raw"}),
        ("Conv2D", "conv", {"filters": 4, "kernel_size": [3, 5], "strides": [2, 2], "padding": "valid", "activation": "elu", **conv}),
        ("BatchNormalization", "norm", {"axis": -1, "momentum": 0.99, "epsilon": 0.001, "center": True, "scale": True}),
        ("PReLU", "slopes", {"shared_axes": None}),
        ("ZeroPadding2D", "pad", {"padding": [[1, 1], [2, 2]], "data_format": "channels_last"}),
        ("Cropping2D", "crop", {"cropping": [[2, 1], [1, 0]], "data_format": "channels_last"}),
        ("Conv2D", "conv_b", {"filters": 5, "kernel_size": [2, 3], "strides": [1, 1], "padding": "same", "activation": "linear", **conv}),
        ("LeakyReLU", "leaky", {"alpha": 0.20000000298023224}),
        ("AveragePooling2D", "pool", {"pool_size": [1, 2], "strides": [1, 2], "padding": "valid", "data_format": "channels_last"}),
        ("Dropout", "dropout", {"rate": 0.5, "noise_shape": None, "seed": None}),
        ("Flatten", "flatten", {"data_format": "channels_last"}),
        ("Dense", "dense", {"units": 6, "activation": "relu", "use_bias": True}),
        ("Dense", "steering", {"units": 1, "activation": "linear", "use_bias": True}),
    ]


def sequential(config):
    return [{"class_name": kind, "config": {"name": name, **entries}} for kind, name, entries in config]


def chain(config):
    """The graph of a functional model."""
    entries = sequential(config)
    for place, entry in enumerate(entries):
        entry["name"] = entry["config"]["name"]
        before = entries[place - 1]["config"]["name"] if place else None
        entry["inbound_nodes"] = [[[before, 0, 0, {}]]] if place else []
    first, last = entries[0]["name"], entries[-1]["name"]
    config = {"name": "model_1", "layers": entries, "input_layers": [[first, 0, 0]], "output_layers": [[last, 0, 0]]}
    return {"class_name": "Model", "config": config}


KERAS1_NAMES = {"kernel": "W", "bias": "b", "gamma": "gamma", "beta": "beta", "moving_mean": "running_mean",
                "moving_variance": "running_std", "alpha": "alphas"}


def tensors(model, th=False, flip=False):
    """The tensors of each layer with Keras 3's names, laid out as `th` or `tf` want them."""
    for layer in model.layers:
        values = {v.path.split("/")[-1]: np.asarray(v) for v in layer.weights}
        if th:
            if "kernel" in values and values["kernel"].ndim == 4:
                kernel = values["kernel"].transpose(3, 2, 0, 1)
                values["kernel"] = kernel[:, :, ::-1, ::-1] if flip else kernel
            if "alpha" in values and values["alpha"].ndim == 3:
                values["alpha"] = values["alpha"].transpose(2, 0, 1)
            if layer.name == "dense":
                h, w, c = model.get_layer("pool").output.shape[1:]
                kernel = values["kernel"].reshape(h, w, c, -1)
                values["kernel"] = kernel.transpose(2, 0, 1, 3).reshape(h * w * c, -1)
        yield layer.name, values


def write_layers(group, model, order, names, **layout):
    """Keras' `save_weights`: a group a layer, with `weight_names` in order."""
    values = dict(tensors(model, **layout))
    values.update({name: values[name.split("/")[-1]] for name in order if "/" in name})
    group.attrs["layer_names"] = [name.encode() for name in order]
    for layer in order:
        inner = group.create_group(layer)
        tensor_names = [names(layer, name) for name in values.get(layer, {})]
        inner.attrs["weight_names"] = [name.encode() for name in tensor_names]
        for name, tensor in zip(tensor_names, values.get(layer, {}).values()):
            inner.create_dataset(name, data=tensor.astype(np.float32))


def keras1_name(layer, tensor):
    return f"{layer}_{KERAS1_NAMES[tensor]}" + (":0" if tensor in ("kernel", "bias") else "")


def keras2_name(layer, tensor):
    return f"{layer}/{tensor}:0"


def hand_made(model):
    names = lambda config: [name for _, name, _ in config]
    tf, th = keras1_config(False), keras1_config(True)
    with h5py.File(OUT / "keras1.h5", "w") as f:
        f.attrs["keras_version"] = "1.2.1"
        f.attrs["model_config"] = json.dumps({"class_name": "Sequential", "config": sequential(tf)})
        f.attrs["training_config"] = json.dumps({"loss": "mse", "optimizer_config": {"class_name": "Adam", "config": {}}})
        write_layers(f.create_group("model_weights"), model, names(tf), keras1_name)
        f.create_group("optimizer_weights").create_dataset("Variable:0", data=np.float32(7))
    # Weights alone, with Theano's axes and kernels; the architecture beside it, as JSON inside a JSON string, without a shape.
    with h5py.File(OUT / "keras1-theano-weights.h5", "w") as f:
        write_layers(f, model, names(th), keras1_name, th=True, flip=True)
    config = sequential(th)
    del config[0]["config"]["batch_input_shape"]
    text = json.dumps(json.dumps({"class_name": "Sequential", "keras_version": "1.1.0", "config": config}))
    (OUT / "keras1-theano.json").write_text(text + "\n")
    config = keras2_config()
    with h5py.File(OUT / "keras2.h5", "w", libver="latest") as f:
        f.attrs["keras_version"] = b"2.1.2"
        f.attrs["backend"] = b"tensorflow"
        f.attrs["model_config"] = json.dumps(chain(config)).encode()
        write_layers(f.create_group("model_weights"), model, names(config), keras2_name)


def with_slashes(model):
    """Keras 2 had slashes in the names of layers."""
    config = [(kind, f"eyes/{name}" if name.startswith("conv") else name, entries) for kind, name, entries in keras2_config()]
    with h5py.File(OUT / "keras2-slashes.h5", "w") as f:
        f.attrs["keras_version"] = b"2.1.2"
        f.attrs["model_config"] = json.dumps(chain(config)).encode()
        write_layers(f.create_group("model_weights"), model, [name for _, name, _ in config], keras2_name)


def hostile():
    """Files that are valid HDF5 and mean harm."""
    dense = ("Dense", "dense", {"output_dim": 1, "bias": False, "batch_input_shape": [None, 2, 2, 1]})
    wide = ("Dense", "dense", {"output_dim": 50_000, "bias": False})
    flatten = ("Flatten", "flatten", {"batch_input_shape": [None, 30, 40, 1]})

    def begin(name, config):
        f = h5py.File(OUT / f"hostile-{name}.h5", "w")
        f.attrs["model_config"] = json.dumps({"class_name": "Sequential", "config": sequential(config)})
        f.attrs["layer_names"] = [b"dense"]
        return f

    # A group that contains itself, and a tensor a thousand turns deep in it.
    with begin("cycle", [dense]) as f:
        group = f.create_group("dense")
        group["dense"] = group
        f["model_weights"] = f["/"]
        group.attrs["weight_names"] = [b"dense/" * 1000 + b"kernel"]
        group["kernel"] = h5py.SoftLink("/dense/kernel")
    # A tensor of 240 MB in a file of some kilobytes: chunks that were never written.
    with begin("huge", [flatten, wide]) as f:
        group = f.create_group("dense")
        group.attrs["weight_names"] = [b"kernel"]
        group.create_dataset("kernel", shape=(1200, 50_000), chunks=(1200, 50_000), dtype="f4")
    # A tensor in another file.
    with begin("elsewhere", [dense]) as f:
        group = f.create_group("dense")
        group.attrs["weight_names"] = [b"kernel"]
        group["kernel"] = h5py.ExternalLink("keras1.h5", "/model_weights/dense/dense_W:0")


def main():
    OUT.mkdir(exist_ok=True)
    expected = {"keras": keras.__version__, "images": IMAGES}
    for seed, build in enumerate([keras3, functional, plain, donkey, degrees, resized, area]):
        model = build()
        randomise(model, seed)
        shape = model.input_shape[1:]
        y = model.predict(inputs(shape), verbose=0)
        y = np.concatenate(y if isinstance(y, list) else [y], axis=1).ravel()
        expected[build.__name__] = {"input": [int(n) for n in shape], "outputs": [float(v) for v in y]}
        if build is plain:
            hand_made(model)
            with_slashes(model)
        elif build is area:
            keras2_area(model)
        else:
            model.save(OUT / f"{build.__name__}.keras")
            # Keras 3.15 cannot write random layers into HDF5.
            if build is not degrees:
                model.save(OUT / f"{build.__name__}.h5")
        print(build.__name__, y, model.count_params(), file=sys.stderr)
    hostile()
    (OUT / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


main()
