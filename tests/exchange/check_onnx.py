"""Exports models to ONNX, has the official checker look at them and compares ONNX Runtime with the engine.

    python3 -m venv venv && venv/bin/pip install -r tests/exchange/requirements.txt
    venv/bin/python tests/exchange/check_onnx.py --steersman target/release/steersman RECORDING MODEL...

The pictures are the centre images of the recording (a folder with a driving_log.csv) and some of pure noise. They are written
as PNG files of the size that the recipe's `source` says, so that the engine and Python see the same pixels. The engine's
answers come from `steersman predict`. The graph that begins with the preprocessed picture gets the tensor that the graph with
preprocessing computes on its way: where both graphs agree with the engine, so do the pictures in between.

One line for each model and form; ends with 1 if a bound is broken.
"""

import csv
import pathlib
import re

import numpy as np
import onnx
import onnxruntime
from exchange import answers, main, run

# Largest difference of the outputs: from the preprocessed picture on; from the camera image on, on 99 % of the rows and on
# all. Outputs beyond 1, as untrained models give, are compared in relative terms.
NETWORK_BOUND = 1e-5
IMAGE_BOUND_99 = 1e-5
IMAGE_BOUND_ALL = 2e-3


def center_images(recording, rows):
    log = recording / "driving_log.csv"
    with open(log, newline="") as lines:
        names = [row[0].strip() for row in csv.reader(lines) if row and row[0].strip().lower() not in ("center", "")]
    paths = [recording / "IMG" / re.split(r"[/\\]", name)[-1] for name in names]
    return [path for path in paths if path.is_file()][:rows]


def predictions(steersman, model, files, names):
    return np.array([[answer[name] for name in names] for answer in answers(steersman, model, files)], np.float64)


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


if __name__ == "__main__":
    print(f"onnx {onnx.__version__}, onnxruntime {onnxruntime.__version__}")
    main(__doc__, center_images, check, "rows")
