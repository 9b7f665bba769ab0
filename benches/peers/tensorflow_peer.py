"""TensorFlow and Keras: a hand-written `tf.function` loop, `model.fit`, and prediction. Prints one JSON object.

    python tensorflow_peer.py --network hyper --task train|fit|infer|latency
"""

import os

from common import arguments, latency, random_batches, report, throughput

os.environ["KERAS_BACKEND"] = "tensorflow"
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import keras
import tensorflow as tf
from keras_networks import NETWORKS

FIT_PASSES = 4  # passes over the batches that make an epoch, so that what `fit` does between epochs counts for little


def train(model, args):
    optimizer, loss = keras.optimizers.Adam(1e-3), keras.losses.MeanSquaredError()
    optimizer.build(model.trainable_variables)

    @tf.function(jit_compile=False)
    def step(x, y):
        with tf.GradientTape() as tape:
            value = loss(y, model(x, training=True))
        optimizer.apply_gradients(zip(tape.gradient(value, model.trainable_variables), model.trainable_variables))
        return value

    x, y = (list(map(tf.constant, arrays)) for arrays in random_batches(args.network, args.batch))
    return throughput(lambda i: step(x[i % len(x)], y[i % len(y)]).numpy(), args.batch, args.seconds)


def fit(model, args):
    import numpy as np

    model.compile(optimizer=keras.optimizers.Adam(1e-3), loss="mse", jit_compile=False)
    x, y = (np.concatenate(arrays) for arrays in random_batches(args.network, args.batch))
    data = tf.data.Dataset.from_tensor_slices((x, y)).batch(args.batch).cache().repeat(FIT_PASSES).prefetch(2)
    epoch = lambda _: model.fit(data, epochs=1, verbose=0)
    return throughput(epoch, len(x) * FIT_PASSES, args.seconds, warm_up=2)


def infer(model, args):
    predict = tf.function(lambda x: model(x, training=False), jit_compile=False)
    x = list(map(tf.constant, random_batches(args.network, args.batch)[0]))
    return throughput(lambda i: predict(x[i % len(x)]).numpy(), args.batch, args.seconds)


def one_image(model, args):
    predict = tf.function(lambda x: model(x, training=False), jit_compile=False)
    x = list(map(tf.constant, random_batches(args.network, 1)[0]))
    return latency(lambda i: predict(x[i % len(x)]).numpy(), args.seconds)


TASKS = {"train": train, "fit": fit, "infer": infer, "latency": one_image}


def main():
    args = arguments(TASKS)
    tf.config.threading.set_intra_op_parallelism_threads(args.threads)
    tf.config.threading.set_inter_op_parallelism_threads(args.threads)
    report(TASKS[args.task](NETWORKS[args.network](), args), f"TensorFlow {tf.__version__}, Keras {keras.__version__}")


if __name__ == "__main__":
    main()
