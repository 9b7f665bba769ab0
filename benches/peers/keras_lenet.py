"""A whole training run of the `lenet` recipe in Keras, the baseline for validation loss and time.

The recipe as its author ran it: rows with throttle > 0, 40 % of the rows that steer exactly 0, three cameras with
+-0.25, the S channel of HSV, rows 40 to 138, 64x64 by area, Adam at 1e-3, batches of 128, 10 epochs; 10 % of the
*images* are held out at random, so neighbouring frames leak and the loss flatters. Images are decoded by two threads
and held in memory. Each seed is a process of its own, so that its seconds are those of a whole run.

    python keras_lenet.py path/to/recording [--seeds 1 2 3 4 5]

Needs the packages of requirements.txt.
"""

import argparse
import csv
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PureWindowsPath

CORRECTION = 0.25
KEEP_STRAIGHT = 0.40
HELD_OUT = 0.10
BATCH, EPOCHS, THREADS = 128, 10, 2


def read_log(recording):
    """Rows of driving_log.csv (with its header line) that move forwards: [(centre, left, right, steering)]."""
    with open(recording / "driving_log.csv", newline="", encoding="utf-8") as file:
        rows = [{k: v.strip() for k, v in row.items()} for row in csv.DictReader(file, skipinitialspace=True)]
    return [
        (row["center"], row["left"], row["right"], float(row["steering"]))
        for row in rows
        if float(row["throttle"]) > 0.0
    ]


def load_image(path):
    import cv2

    image = cv2.imread(str(path))[40:138]
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2HSV)[..., 1], (64, 64), interpolation=cv2.INTER_AREA)


def run(recording, seed):
    start = time.perf_counter()
    os.environ["KERAS_BACKEND"] = "tensorflow"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    import cv2
    import keras
    import numpy as np
    import tensorflow as tf
    from keras import layers

    cv2.setNumThreads(1)
    tf.config.threading.set_intra_op_parallelism_threads(THREADS)
    tf.config.threading.set_inter_op_parallelism_threads(THREADS)
    keras.utils.set_random_seed(seed)
    rng = np.random.default_rng(seed)
    started = time.perf_counter()

    rows = read_log(recording)
    straight = [i for i, row in enumerate(rows) if row[3] == 0.0]
    kept = set(rng.choice(straight, round(KEEP_STRAIGHT * len(straight)), replace=False).tolist())
    rows = [row for i, row in enumerate(rows) if row[3] != 0.0 or i in kept]
    paths, labels = [], []
    for centre, left, right, steering in rows:
        for path, correction in ((centre, 0.0), (left, CORRECTION), (right, -CORRECTION)):
            paths.append(recording / "IMG" / PureWindowsPath(path).name)
            labels.append(steering + correction)
    with ThreadPoolExecutor(THREADS) as pool:
        x = np.stack(list(pool.map(load_image, paths, chunksize=64)))[..., None].astype(np.float32)
    y = np.array(labels, np.float32)
    decoded = time.perf_counter()

    order = rng.permutation(len(x))
    held_out = -(-len(x) // round(1 / HELD_OUT))
    validation, training = order[:held_out], order[held_out:]

    def he(fan_in):
        # The He normal of Keras 1, not truncated.
        return keras.initializers.RandomNormal(stddev=(2.0 / fan_in) ** 0.5)

    model = keras.Sequential([
        keras.Input((64, 64, 1)),
        layers.Rescaling(1 / 255, -0.5),
        layers.Conv2D(6, 3, activation="elu", kernel_initializer=he(9)),
        layers.MaxPooling2D(4),
        layers.Conv2D(16, 3, activation="elu", kernel_initializer=he(54)),
        layers.MaxPooling2D(4),
        layers.Flatten(),
        layers.Dense(120, activation="elu", kernel_initializer=he(144)),
        layers.Dense(84, activation="elu", kernel_initializer=he(120)),
        layers.Dense(1, kernel_initializer=he(84)),
    ])
    model.compile(optimizer=keras.optimizers.Adam(1e-3, epsilon=1e-8), loss="mse", jit_compile=False)
    history = model.fit(
        x[training],
        y[training],
        validation_data=(x[validation], y[validation]),
        batch_size=BATCH,
        epochs=EPOCHS,
        verbose=0,
    ).history
    fitted = time.perf_counter()
    print(
        f"seed {seed}: {len(rows)} rows, {len(training)} + {len(validation)} images,"
        f" label variance {y[validation].var():.4f}; start {started - start:.1f} s,"
        f" decoding {decoded - started:.1f} s, fit {fitted - decoded:.1f} s"
    )
    print("  validation MSE " + " ".join(f"{v:.4f}" for v in history["val_loss"]))
    print("  training MSE   " + " ".join(f"{v:.4f}" for v in history["loss"]), flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3, 4, 5])
    args = parser.parse_args()
    if len(args.seeds) == 1:
        run(args.recording, args.seeds[0])
        return
    for seed in args.seeds:
        start = time.perf_counter()
        subprocess.run([sys.executable, __file__, args.recording, "--seeds", str(seed)], check=True)
        print(f"  whole run {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
