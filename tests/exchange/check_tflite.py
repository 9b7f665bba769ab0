"""Exports models to TensorFlow Lite, drives donkeycar's own linear pilot with them and compares its answers with the engine.

    python3.11 -m venv venv && venv/bin/pip install -r tests/exchange/requirements-donkeycar.txt
    venv/bin/python tests/exchange/check_tflite.py --steersman target/release/steersman RECORDING MODEL...

The recording is a tub of donkeycar (format 2), or any folder with JPEG files in it. Its pictures and some of pure noise are
written as PNG files of the size that the recipe's `source` says, so that both sides see the same pixels. The engine's answers
come from `steersman predict`, donkeycar's from `KerasLinear.run`, with its interpreter `TfLite` on LiteRT, as
`donkeycar.utils.get_model_by_type("tflite_linear", …)` makes them.

A model that gives no throttle is exported with the constant one of CONSTANT_THROTTLE. One line for each model; ends with 1 if a
bound is broken.
"""

import json
import pathlib
import subprocess
import time

import numpy as np
from donkeycar.parts.interpreter import TfLite
from donkeycar.parts.keras import KerasLinear
from exchange import answers, main, run

# Largest difference of an output, on 99 % of the pictures and on all; relative where the output is beyond 1, as untrained models
# give. Pictures whose colours or sizes are changed may round a grey level the other way.
BOUND = 1e-5
BOUND_ALL_PREPROCESSED = 2e-3
CONSTANT_THROTTLE = -0.375


def recorded(recording, rows):
    """Paths of the recording's pictures, of a tub in the order of its records."""
    manifest = recording / "manifest.json"
    if not manifest.is_file():
        return sorted(recording.rglob("*.jpg"))[:rows]
    catalogs = json.loads(manifest.read_text().splitlines()[4])["paths"]
    lines = [line for catalog in catalogs for line in (recording / catalog).read_text().splitlines()]
    names = [json.loads(line).get("cam/image_array") for line in lines if line.strip()]
    paths = [recording / "images" / name for name in names if name]
    return [path for path in paths if path.is_file()][:rows]


def predictions(steersman, model, files):
    found = answers(steersman, model, files)
    throttles = [np.float32(answer.get("throttle", CONSTANT_THROTTLE)) for answer in found]
    return np.array([[answer["steering"], throttle] for answer, throttle in zip(found, throttles)], np.float64)


def export(steersman, model, folder):
    """The path of the export, and whether the model gives its own throttle."""
    path = str(pathlib.Path(folder) / "pilot.tflite")
    to = ["export", model, path, "--to", "tflite", "--force", "--json"]
    done = subprocess.run([steersman, *to], capture_output=True, text=True)
    if done.returncode != 0:
        assert "--throttle" in done.stderr, done.stderr
        return path, json.loads(run(steersman, *to, "--throttle", str(CONSTANT_THROTTLE)).splitlines()[-1])
    return path, json.loads(done.stdout.splitlines()[-1])


def check(steersman, model, pictures, folder):
    path, exported = export(steersman, model, folder)
    height, width, _ = exported["input"]
    files, pixels = pictures.of_size(height, width)
    interpreter = TfLite()
    pilot = KerasLinear(interpreter=interpreter, input_shape=(height, width, 3))
    pilot.load(path)
    signatures = interpreter.interpreter.get_signature_list()
    assert signatures == {"serving_default": {"inputs": ["img_in"], "outputs": ["n_outputs0", "n_outputs1"]}}, signatures
    details = interpreter.interpreter.get_input_details()[0]
    assert details["name"] == "serving_default_img_in:0" and details["dtype"] == np.float32, details
    assert all(list(output["shape"]) == [1, 1] for output in interpreter.interpreter.get_output_details())

    expected = predictions(steersman, model, files)
    seconds, given = [], []
    for picture in pixels:
        start = time.perf_counter()
        given.append(pilot.run(picture))
        seconds.append(time.perf_counter() - start)
    given = np.array(given, np.float64)
    apart = np.abs(expected[:, 0] - expected[:, 1]).max()
    assert apart > 1e-3, "steering and throttle that are alike do not show their order"
    error = np.abs(given - expected) / np.maximum(1.0, np.abs(expected))
    good = (np.quantile(error, 0.99, axis=0) <= BOUND).all() and error.max() <= BOUND_ALL_PREPROCESSED
    steering, throttle = error.max(axis=0)
    above = int((error.max(axis=1) > BOUND).sum())
    print(
        f"{pathlib.Path(model).stem:<24} {len(error)} pictures  largest difference: steering {steering:.1e}"
        f"  throttle {throttle:.1e}  above {BOUND:.0e}: {above}"
        f"  {np.median(seconds) * 1e6:.0f} us a picture in donkeycar  {'ok' if good else 'TOO MUCH'}"
    )
    return good


if __name__ == "__main__":
    main(__doc__, recorded, check, "pictures")
