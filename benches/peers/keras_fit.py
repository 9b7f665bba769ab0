"""Images per second of Keras `model.fit`, the baseline of the training benchmark.

Batches of 128 random images that already lie in memory, mean squared error, Adam at 1e-3, two threads: the engine alone
is timed, without decoding. Needs the packages of tests/golden/requirements.txt.

    python keras_fit.py --network hyper|lenet|pilotnet [--epochs 10] [--steps-per-execution 8]
"""

import argparse
import os
import statistics
import time

os.environ["KERAS_BACKEND"] = "tensorflow"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import keras
import numpy as np
import tensorflow as tf
from keras import layers

BATCH = 128
WARM_UP_EPOCHS = 2


def hyper():
    def conv(filters):
        return [layers.Conv2D(filters, 3), layers.BatchNormalization()]

    return keras.Sequential([
        keras.Input((40, 160, 3)),
        *conv(8), layers.ReLU(),
        *conv(16), layers.ReLU(), layers.MaxPooling2D(2),
        *conv(24), layers.PReLU(), layers.MaxPooling2D(2),
        *conv(32), layers.PReLU(), layers.MaxPooling2D(2),
        *conv(64), layers.PReLU(), layers.Flatten(),
        layers.Dense(100), layers.BatchNormalization(), layers.Dropout(0.5), layers.PReLU(),
        layers.Dense(50), layers.PReLU(), layers.Dropout(0.5),
        layers.Dense(1),
    ])  # fmt: skip


def lenet():
    return keras.Sequential([
        keras.Input((64, 64, 1)),
        layers.Rescaling(1 / 255, -0.5),
        layers.Conv2D(6, 3, activation="elu"), layers.MaxPooling2D(4),
        layers.Conv2D(16, 3, activation="elu"), layers.MaxPooling2D(4), layers.Flatten(),
        layers.Dense(120, activation="elu"), layers.Dense(84, activation="elu"),
        layers.Dense(1),
    ])  # fmt: skip


def pilotnet():
    return keras.Sequential([
        keras.Input((66, 200, 3)),
        layers.Rescaling(1 / 127.5, -1),
        layers.Conv2D(24, 5, 2, activation="elu"), layers.Conv2D(36, 5, 2, activation="elu"),
        layers.Conv2D(48, 5, 2, activation="elu"), layers.Conv2D(64, 3, activation="elu"),
        layers.Conv2D(64, 3, activation="elu"), layers.Dropout(0.5), layers.Flatten(),
        layers.Dense(100, activation="elu"), layers.Dense(50, activation="elu"),
        layers.Dense(10, activation="elu"), layers.Dense(1),
    ])  # fmt: skip


NETWORKS = {"hyper": hyper, "lenet": lenet, "pilotnet": pilotnet}


class EpochTimes(keras.callbacks.Callback):
    def __init__(self):
        super().__init__()
        self.seconds = []

    def on_epoch_begin(self, epoch, logs=None):
        self.start = time.perf_counter()

    def on_epoch_end(self, epoch, logs=None):
        self.seconds.append(time.perf_counter() - self.start)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=NETWORKS, required=True)
    parser.add_argument("--batches", type=int, default=8, help="batches held in memory")
    parser.add_argument("--passes", type=int, default=4, help="passes over them that make an epoch")
    parser.add_argument("--steps-per-execution", type=int, default=1)
    parser.add_argument("--epochs", type=int, default=10, help="timed epochs")
    parser.add_argument("--jit", action="store_true", help="compile with XLA")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    tf.config.threading.set_intra_op_parallelism_threads(args.threads)
    tf.config.threading.set_inter_op_parallelism_threads(args.threads)

    model = NETWORKS[args.network]()
    model.compile(
        optimizer=keras.optimizers.Adam(1e-3),
        loss="mse",
        jit_compile=args.jit,
        steps_per_execution=args.steps_per_execution,
    )
    # Several passes make an epoch, so that what `fit` does between epochs counts for little.
    images = args.batches * BATCH
    rng = np.random.default_rng(0)
    x = rng.random((images, *model.input_shape[1:]), dtype=np.float32)
    y = rng.random((images, 1), dtype=np.float32)
    times = EpochTimes()
    data = tf.data.Dataset.from_tensor_slices((x, y)).batch(BATCH).cache().repeat(args.passes).prefetch(2)
    model.fit(data, epochs=WARM_UP_EPOCHS + args.epochs, verbose=0, callbacks=[times])
    rates = sorted(images * args.passes / s for s in times.seconds[WARM_UP_EPOCHS:])
    print(
        f"{args.network}: median {statistics.median(rates):.0f} images/s, from {rates[0]:.0f} to {rates[-1]:.0f}"
        f" in {args.epochs} epochs; first epoch {times.seconds[0]:.1f} s"
        f" (Keras {keras.__version__}, TensorFlow {tf.__version__}, {args.threads} threads)"
    )


if __name__ == "__main__":
    main()
