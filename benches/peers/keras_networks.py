"""The three networks in Keras, with the input of `steersman bench`: random numbers, already scaled where the recipe scales."""

import keras
from common import INPUTS
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


NETWORKS = {"hyper": hyper, "lenet": lenet, "pilotnet": pilotnet}
