"""What Python costs: one image through `Model.steer` beside the same loop in the library, and training beside the command line.

    python benches/python.py RECORDING [--steersman target/release/steersman] [--recipe default] [--rounds 5]

Both sides run in turns, so that a busy machine is busy for both. Printed are the fastest round of an image, which others disturb least,
and the median of the training runs.
"""

import argparse
import json
import statistics
import subprocess
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

import steersman


def latency_us(model, image, rounds, count=100):
    """Time of an image in the fastest round, microseconds: called from Python, and looped over in the library on one thread."""
    # An axis of stride 0: a batch that takes the memory of one image.
    batch = np.broadcast_to(image, (count, *image.shape))
    python, native = [], []
    for _ in range(rounds):
        began = time.perf_counter()
        for _ in range(count):
            model.steer(image)
        python.append((time.perf_counter() - began) / count * 1e6)
        began = time.perf_counter()
        model.predict(batch, threads=1)
        native.append((time.perf_counter() - began) / count * 1e6)
    return min(python), min(native)


def images_per_second(recording, recipe, epochs, binary, rounds):
    """Median speed of training, images a second: from Python, and of the command line."""
    python, native = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(rounds):
            out = Path(folder) / f"python-{number}"
            run = steersman.train(recording, recipe=recipe, set={"epochs": epochs}, out=out, progress=False)
            python.append(run.result["images_per_second"])
            out = Path(folder) / f"native-{number}"
            command = [binary, "train", recording, "--recipe", recipe, "--set", f"epochs={epochs}", "--out", out, "--json"]
            told = subprocess.run(list(map(str, command)), check=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
            result = json.loads(told.stdout.splitlines()[-1])
            assert result["weights_hash"] == run.result["weights_hash"]
            native.append(result["images_per_second"])
    return statistics.median(python), statistics.median(native), statistics.median(np.divide(python, native))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording")
    parser.add_argument("--steersman", help="the program; without it training is not measured")
    parser.add_argument("--recipe", default="default")
    parser.add_argument("--epochs", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    warnings.simplefilter("ignore", steersman.Notice)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        run = steersman.train(args.recording, recipe=args.recipe, set={"epochs": 1}, out=out, progress=False)
        model = run.load()
    image = steersman.Recording(args.recording).image(0)
    python, native = latency_us(model, image, 20 * args.rounds)
    print(f"one image   {python:.1f} us from Python, {native:.1f} us in the library; {python - native:+.1f} us")
    if args.steersman:
        python, native, ratio = images_per_second(args.recording, args.recipe, args.epochs, args.steersman, args.rounds)
        print(f"training    {python:.0f} images/s from Python, {native:.0f} of the command line; ratio {ratio:.3f}")


if __name__ == "__main__":
    main()
