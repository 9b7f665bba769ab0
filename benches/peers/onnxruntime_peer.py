"""ONNX Runtime on a model that `steersman export --to onnx` wrote. Prints one JSON object.

    python onnxruntime_peer.py --network hyper --onnx hyper.onnx --task infer|latency
"""

import numpy as np
import onnxruntime
from common import arguments, latency, random_batches, report, throughput


def infer(predict, args):
    x, _ = random_batches(args.network, args.batch, channels_first=True)
    return throughput(lambda i: predict(x[i % len(x)]), args.batch, args.seconds)


def one_image(predict, args):
    x, _ = random_batches(args.network, 1, channels_first=True)
    return latency(lambda i: predict(np.ascontiguousarray(x[i % len(x)])), args.seconds)


TASKS = {"infer": infer, "latency": one_image}


def main():
    args = arguments(TASKS)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = args.threads
    options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(args.onnx, options, providers=["CPUExecutionProvider"])
    name = session.get_inputs()[0].name
    report(
        TASKS[args.task](lambda x: session.run(None, {name: x}), args),
        f"ONNX Runtime {onnxruntime.__version__}",
    )


if __name__ == "__main__":
    main()
