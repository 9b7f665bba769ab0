"""Exports models to ONNX, has the official checker look at them and compares ONNX Runtime with the engine.

    python3 -m venv venv && venv/bin/pip install -r tests/exchange/requirements.txt
    venv/bin/python tests/exchange/check_onnx.py --steersman target/release/steersman RECORDING MODEL...

The pictures are the centre images of the recording (a folder with a driving_log.csv) and some of pure noise. They are written
as PNG files of the size that the recipe's `source` says, so that the engine and Python see the same pixels. The engine's
answers come from `steersman predict`. The graph that begins with the preprocessed picture gets the tensor that the graph with
preprocessing computes on its way: where both graphs agree with the engine, so do the pictures in between.

One line for each model and form; ends with 1 if a bound is broken.
"""

import argparse
import csv
import json
import pathlib
import re
import subprocess
import sys
import tempfile

import numpy as np
import onnx
import onnxruntime
from PIL import Image

# Largest difference of the outputs: from the preprocessed picture on; from the camera image on, on 99 % of the rows and on
# all. Outputs beyond 1, as untrained models give, are compared in relative terms.
NETWORK_BOUND = 1e-5
IMAGE_BOUND_99 = 1e-5
IMAGE_BOUND_ALL = 2e-3
IMAGES_A_CALL = 500


def center_images(recording, rows):
    log = recording / "driving_log.csv"
    with open(log, newline="") as lines:
        names = [row[0].strip() for row in csv.reader(lines) if row and row[0].strip().lower() not in ("center", "")]
    paths = [recording / "IMG" / re.split(r"[/\\]", name)[-1] for name in names]
    return [path for path in paths if path.is_file()][:rows]


def run(steersman, *args):
    done = subprocess.run([steersman, *args], capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"steersman {' '.join(args[:3])} failed: {done.stderr}")
    return done.stdout


class Pictures:
    """The pictures at a size, as PNG files and as an array."""

    def __init__(self, paths, noise, folder):
        self.paths, self.noise, self.folder, self.sizes = paths, noise, folder, {}

    def of_size(self, height, width):
        if (height, width) not in self.sizes:
            folder = pathlib.Path(self.folder) / f"{height}x{width}"
            folder.mkdir()
            random = np.random.default_rng(1)
            pixels = [np.asarray(Image.open(path).convert("RGB").resize((width, height))) for path in self.paths]
            pixels += [random.integers(0, 256, (height, width, 3), np.uint8) for _ in range(self.noise)]
            files = []
            for index, picture in enumerate(pixels):
                files.append(str(folder / f"{index}.png"))
                Image.fromarray(picture).save(files[-1], compress_level=1)
            self.sizes[height, width] = files, np.stack(pixels)
        return self.sizes[height, width]


def predictions(steersman, model, files, names):
    answers = []
    for start in range(0, len(files), IMAGES_A_CALL):
        text = run(steersman, "predict", model, *files[start : start + IMAGES_A_CALL], "--json")
        answers += [[answer[name] for name in names] for answer in json.loads(text.splitlines()[-1])]
    return np.array(answers, np.float64)


def export(steersman, model, folder, *flags):
    path = str(pathlib.Path(folder) / "model.onnx")
    run(steersman, "export", model, path, "--to", "onnx", "--force", *flags)
    proto = onnx.load(path)
    onnx.checker.check_model(proto, full_check=True)
    return proto


def session(proto):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(proto.SerializeToString(), options, providers=["CPUExecutionProvider"])


def in_batches(session, outputs, feed, batch):
    name = session.get_inputs()[0].name
    parts = [session.run(outputs, {name: feed[start : start + batch]}) for start in range(0, len(feed), batch)]
    return [np.concatenate(column) for column in zip(*parts)]


def check(steersman, model, pictures, folder):
    proto = export(steersman, model, folder, "--with-preprocessing")
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    missing = {"label", "full_lock_deg", "recipe"} - metadata.keys()
    assert not missing, f"{model}: no metadata {missing}"
    _, height, width, _ = (axis.dim_value for axis in proto.graph.input[0].type.tensor_type.shape.dim)
    files, pixels = pictures.of_size(height, width)
    names = [output.name for output in proto.graph.output]
    expected = predictions(steersman, model, files, names)
    scale = np.maximum(1.0, np.abs(expected))

    # The same graph, which also shows the preprocessed picture.
    shape = onnx.load_from_string(export(steersman, model, folder).SerializeToString()).graph.input[0]
    proto.graph.output.append(shape)
    *outputs, tensors = in_batches(session(proto), [*names, "input"], pixels, 7)
    forms = [("image", outputs, True)]
    folded = export(steersman, model, folder, "--with-preprocessing", "--fold-batch-norm")
    forms.append(("image, folded", in_batches(session(folded), names, pixels, 1), True))
    for name, flags in [("tensor", []), ("tensor, folded", ["--fold-batch-norm"])]:
        plain = export(steersman, model, folder, *flags)
        forms.append((name, in_batches(session(plain), names, tensors, 64), False))

    holds = True
    for name, outputs, from_image in forms:
        assert all(output.shape == (len(files), 1) for output in outputs), [output.shape for output in outputs]
        error = (np.abs(np.hstack(outputs) - expected) / scale).max(axis=1)
        if from_image:
            good = np.quantile(error, 0.99) <= IMAGE_BOUND_99 and error.max() <= IMAGE_BOUND_ALL
        else:
            good = error.max() <= NETWORK_BOUND
        holds &= bool(good)
        recipe = proto.graph.name
        print(
            f"{recipe:<12} from {name:<15} {len(error)} pictures  largest difference {error.max():.1e}"
            f"  99 %: {np.quantile(error, 0.99):.1e}  {'ok' if good else 'TOO MUCH'}"
        )
    return holds


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steersman", required=True, help="the program")
    parser.add_argument("--rows", type=int, default=None, help="at most so many rows of the recording")
    parser.add_argument("--noise", type=int, default=20, help="pictures of noise")
    parser.add_argument("recording", type=pathlib.Path)
    parser.add_argument("models", nargs="+")
    args = parser.parse_args()
    print(f"onnx {onnx.__version__}, onnxruntime {onnxruntime.__version__}")
    with tempfile.TemporaryDirectory() as folder:
        pictures = Pictures(center_images(args.recording, args.rows), args.noise, folder)
        holds = [check(args.steersman, model, pictures, folder) for model in args.models]
    sys.exit(0 if all(holds) else 1)


if __name__ == "__main__":
    main()
