"""The networks in Keras, with the input of `steersman bench`: random numbers, already scaled where the recipe scales."""

import keras
import numpy as np
from common import INPUTS, OUTPUTS
from keras import layers


def hyper():
    def conv(filters):
        return [layers.Conv2D(filters, 3), layers.BatchNormalization()]

    return keras.Sequential([
        keras.Input(INPUTS["hyper"]),
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
        keras.Input(INPUTS["lenet"]),
        layers.Conv2D(6, 3, activation="elu"), layers.MaxPooling2D(4),
        layers.Conv2D(16, 3, activation="elu"), layers.MaxPooling2D(4), layers.Flatten(),
        layers.Dense(120, activation="elu"), layers.Dense(84, activation="elu"),
        layers.Dense(1),
    ])  # fmt: skip


def pilotnet():
    return keras.Sequential([
        keras.Input(INPUTS["pilotnet"]),
        layers.Conv2D(24, 5, 2, activation="elu"), layers.Conv2D(36, 5, 2, activation="elu"),
        layers.Conv2D(48, 5, 2, activation="elu"), layers.Conv2D(64, 3, activation="elu"),
        layers.Conv2D(64, 3, activation="elu"), layers.Dropout(0.5), layers.Flatten(),
        layers.Dense(100, activation="elu"), layers.Dense(50, activation="elu"),
        layers.Dense(10, activation="elu"), layers.Dense(1),
    ])  # fmt: skip


def default():
    def binomial(shape, dtype):
        row = np.array([1.0, 2.0, 1.0]) / 4
        return np.broadcast_to(np.outer(row, row)[..., None, None], shape).astype(dtype)

    def conv(filters, kernel):
        return [
            layers.DepthwiseConv2D(
                3, padding="same", use_bias=False, depthwise_initializer=binomial, trainable=False
            ),
            layers.Conv2D(filters, kernel, 2), layers.BatchNormalization(momentum=0.98), layers.ReLU(),
        ]  # fmt: skip

    return keras.Sequential([
        keras.Input(INPUTS["default"]),
        *conv(16, 5), *conv(24, 3), *conv(32, 3),
        layers.Conv2D(48, 3, activation="elu"), layers.Flatten(), layers.Dropout(0.1),
        layers.Dense(64, activation="elu"), layers.Dense(1),
    ])  # fmt: skip


def donkey():
    def conv(filters, kernel, strides):
        return [layers.Conv2D(filters, kernel, strides, activation="relu"), layers.Dropout(0.2)]

    return keras.Sequential([
        keras.Input(INPUTS["donkey"]),
        *conv(24, 5, 2), *conv(32, 5, 2), *conv(64, 5, 2), *conv(64, 3, 1), *conv(64, 3, 1), layers.Flatten(),
        layers.Dense(100, activation="relu"), layers.Dropout(0.2),
        layers.Dense(50, activation="relu"), layers.Dropout(0.2),
        layers.Dense(OUTPUTS["donkey"]),
    ])  # fmt: skip


NETWORKS = {network.__name__: network for network in (hyper, lenet, pilotnet, default, donkey)}
