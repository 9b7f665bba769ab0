"""A whole training run of a recipe in Keras, files to model: the baseline for wall time and validation loss.

`lenet` as its author ran it: rows with throttle > 0, 40 % of the rows that steer exactly 0, three cameras with +-0.25, the S
channel of HSV, rows 40 to 138, 64x64 by area, Adam at 1e-3, batches of 128, 10 epochs; 10 % of the *images* are held out.
`hyper` likewise: all rows, three cameras with +-0.15, each plain and mirrored, rows 60 to 140, 160x40, Adam at 2e-3, batches
of 384, 7 epochs; 20 % of the *rows* are held out. Both hold out at random, so neighbouring frames leak and the loss
flatters. Images are decoded by two threads and held in memory as 8-bit numbers; `tf.data` makes batches of them. Each seed is
a process of its own, so that its seconds are those of a whole run.

    python keras_recipe.py lenet|hyper path/to/recording [--seeds 1 2 3]

Needs the packages of requirements.txt.
"""

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PureWindowsPath

THREADS = 2


def read_log(recording):
    """Rows of driving_log.csv (with its header line): [(centre, left, right, steering, throttle)]."""
    with open(recording / "driving_log.csv", newline="", encoding="utf-8") as file:
        rows = [{k: v.strip() for k, v in row.items()} for row in csv.DictReader(file, skipinitialspace=True)]
    return [(r["center"], r["left"], r["right"], float(r["steering"]), float(r["throttle"])) for r in rows]


def three_cameras(recording, rows, correction):
    """Paths and labels, three in a row."""
    paths, labels = [], []
    for centre, left, right, steering, _ in rows:
        for path, turn in ((centre, 0.0), (left, correction), (right, -correction)):
            paths.append(recording / "IMG" / PureWindowsPath(path).name)
            labels.append(steering + turn)
    return paths, labels


def lenet_image(path):
    import cv2

    image = cv2.imread(str(path))[40:138]
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_BGR2HSV)[..., 1], (64, 64), interpolation=cv2.INTER_AREA)[..., None]


def hyper_image(path):
    import cv2

    return cv2.resize(cv2.cvtColor(cv2.imread(str(path))[60:140], cv2.COLOR_BGR2RGB), (160, 40))


def decode(paths, image):
    import numpy as np

    with ThreadPoolExecutor(THREADS) as pool:
        return np.stack(list(pool.map(image, paths, chunksize=64)))


def lenet(recording, rng):
    """Images, labels and which images are held out, the model, batch and epochs."""
    import numpy as np
    from keras import Input, Sequential, initializers, layers, optimizers

    rows = [row for row in read_log(recording) if row[4] > 0.0]
    straight = [i for i, row in enumerate(rows) if row[3] == 0.0]
    kept = set(rng.choice(straight, round(0.40 * len(straight)), replace=False).tolist())
    rows = [row for i, row in enumerate(rows) if row[3] != 0.0 or i in kept]
    paths, labels = three_cameras(recording, rows, 0.25)
    x, y = decode(paths, lenet_image), np.array(labels, np.float32)
    order = rng.permutation(len(x))
    held_out = -(-len(x) // 10)

    def he(fan_in):
        # The He normal of Keras 1, not truncated.
        return initializers.RandomNormal(stddev=(2.0 / fan_in) ** 0.5)

    model = Sequential([
        Input((64, 64, 1)),
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
    model.compile(optimizer=optimizers.Adam(1e-3, epsilon=1e-8), loss="mse", jit_compile=False)
    return x, y, order[:held_out], order[held_out:], model, 128, 10


def hyper(recording, rng):
    """As [`lenet`]; each camera's image is followed by its mirror image."""
    import numpy as np
    from keras import Sequential, layers, optimizers
    from keras_networks import hyper as network

    paths, labels = three_cameras(recording, read_log(recording), 0.15)
    plain = decode(paths, hyper_image)
    x = np.stack([plain, plain[:, :, ::-1]], axis=1).reshape(-1, *plain.shape[1:])
    y = np.array([[label, -label] for label in labels], np.float32).reshape(-1)
    order = rng.permutation(len(x) // 6)
    images = (order[:, None] * 6 + np.arange(6)).reshape(-1)
    held_out = -(-len(order) // 5) * 6
    model = Sequential([layers.Rescaling(1 / 255, -0.5), network()])
    model.compile(optimizer=optimizers.Adam(2e-3, epsilon=1e-8), loss="mse", jit_compile=False)
    return x, y, images[:held_out], images[held_out:], model, 384, 7


def run(recipe, recording, seed):
    start = time.perf_counter()
    os.environ["KERAS_BACKEND"] = "tensorflow"
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    import cv2
    import keras
    import numpy as np
    import tensorflow as tf

    cv2.setNumThreads(1)
    tf.config.threading.set_intra_op_parallelism_threads(THREADS)
    tf.config.threading.set_inter_op_parallelism_threads(THREADS)
    keras.utils.set_random_seed(seed)
    started = time.perf_counter()
    x, y, validation, training, model, batch, epochs = RECIPES[recipe](recording, np.random.default_rng(seed))
    decoded = time.perf_counter()

    def batches(images, shuffle):
        data = tf.data.Dataset.from_tensor_slices((x[images], y[images]))
        data = data.shuffle(len(images), seed=seed) if shuffle else data
        return data.batch(batch).map(lambda x, y: (tf.cast(x, tf.float32), y), THREADS).prefetch(tf.data.AUTOTUNE)

    history = model.fit(
        batches(training, True), validation_data=batches(validation, False), epochs=epochs, verbose=0
    ).history
    with tempfile.TemporaryDirectory() as folder:
        model.save(Path(folder) / "model.keras")
    fitted = time.perf_counter()
    print(
        f"seed {seed}: {len(training)} + {len(validation)} images, label variance {y[validation].var():.4f};"
        f" start {started - start:.1f} s, decoding {decoded - started:.1f} s, fit {fitted - decoded:.1f} s"
    )
    print("  validation MSE " + " ".join(f"{v:.4f}" for v in history["val_loss"]))
    print("  training MSE   " + " ".join(f"{v:.4f}" for v in history["loss"]), flush=True)


RECIPES = {"lenet": lenet, "hyper": hyper}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", choices=RECIPES)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    args = parser.parse_args()
    if len(args.seeds) == 1:
        run(args.recipe, args.recording, args.seeds[0])
        return
    for seed in args.seeds:
        start = time.perf_counter()
        subprocess.run([sys.executable, __file__, args.recipe, args.recording, "--seeds", str(seed)], check=True)
        print(f"  whole run {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    main()
