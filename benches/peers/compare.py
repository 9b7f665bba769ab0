"""steersman beside its peers on the same machine: training and prediction of five networks, interleaved.

Every measurement is a process of its own. In each round every contender is measured once, one after the other, so that a
disturbance hits all of them alike; the table has the medians over the rounds, the spread, and ours ÷ the best peer as the
median of the rounds' ratios. `compare.sh` installs what is needed into a throw-away environment and runs this.

    python compare.py [--networks hyper lenet pilotnet default donkey] [--rounds 5] [--seconds 4] [--markdown FILE]
"""

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

from common import INPUTS

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
NETWORKS = list(INPUTS)


def run(command, **environment):
    """The JSON object on the last line of what `command` prints."""
    environment = {**os.environ, **environment}
    done = subprocess.run([str(part) for part in command], stdout=subprocess.PIPE, text=True, env=environment)
    if done.returncode != 0:
        sys.exit(f"{' '.join(map(str, command))} failed with code {done.returncode}")
    return json.loads(done.stdout.strip().splitlines()[-1])


class Ours:
    def __init__(self, binary, args):
        self.binary, self.args = binary, args

    def bench(self, network, threads):
        return run([
            self.binary, "bench", "--recipe", network, "--batch", self.args.batch, "--threads", threads,
            "--seconds", self.args.seconds, "--json",
        ])  # fmt: skip

    def export(self, folder, network):
        """A model of `network` after one short epoch on the sample log, as ONNX from the preprocessed tensor on."""
        trained, file = folder / network, folder / f"{network}.onnx"
        subprocess.run(
            [self.binary, "train", ROOT / "data/sample", "--recipe", network, "--set", "epochs=1", "--out", trained],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        subprocess.run(
            [self.binary, "export", trained / "model.safetensors", "--to", "onnx", file],
            check=True, stdout=subprocess.DEVNULL,
        )  # fmt: skip
        return file


def peer(script, network, task, args, threads, *more):
    command = [sys.executable, HERE / f"{script}_peer.py", "--network", network, "--task", task]
    # Reserved memory and thread pools of other libraries stay as their users get them.
    return run([*command, "--batch", args.batch, "--threads", threads, "--seconds", args.seconds, *more])


def measure_round(ours, network, onnx, args):
    """Everything about one network once: {row: {contender: value}}."""
    two, one = ours.bench(network, args.threads), ours.bench(network, 1)
    tensorflow = {task: peer("tensorflow", network, task, args, args.threads) for task in ("train", "fit", "infer")}
    torch = {task: peer("torch", network, task, args, args.threads) for task in ("train", "infer")}
    runtime = peer("onnxruntime", network, "infer", args, args.threads, "--onnx", onnx)
    single = {
        "TensorFlow": peer("tensorflow", network, "latency", args, 1),
        "PyTorch": peer("torch", network, "latency", args, 1),
        "ONNX Runtime": peer("onnxruntime", network, "latency", args, 1, "--onnx", onnx),
    }

    def rates(values):
        return {name: value["images_per_second"] for name, value in values.items()}

    training = {"TensorFlow": tensorflow["train"], "Keras fit": tensorflow["fit"], "PyTorch": torch["train"]}
    predicting = {"TensorFlow": tensorflow["infer"], "PyTorch": torch["infer"], "ONNX Runtime": runtime}
    scaling = two["train_images_per_second"] / one["train_images_per_second"]
    return {
        "training, images/s": {"steersman": two["train_images_per_second"], **rates(training)},
        "prediction, images/s": {"steersman": two["infer_images_per_second"], **rates(predicting)},
        "one image, median us": {"steersman": one["infer_us_p50"], **{k: v["p50_us"] for k, v in single.items()}},
        "one image, p99 us": {"steersman": one["infer_us_p99"], **{k: v["p99_us"] for k, v in single.items()}},
        "peak memory while training, MB": {
            "steersman": two["peak_rss_mb"],
            **{name: value["peak_rss_mb"] for name, value in training.items()},
        },
        "end of the first step, s": {
            "steersman": two["first_step_s"],
            **{name: value["first_step_s"] for name, value in training.items()},
        },
        "training, 1 -> 2 threads": {"steersman": scaling, "multiply-adds": two["peak_gflops"] / one["peak_gflops"]},
        "share of the multiply-add peak, %": {
            "training": 100.0 * two["train_gflops"] / two["peak_gflops"],
            "GFLOP/s": two["peak_gflops"],
        },
    }, [tensorflow["train"]["version"], torch["train"]["version"], runtime["version"]]


def summarise(rounds, row):
    """One line of the table: each contender's median and spread, and ours against the best peer."""
    names = rounds[0][row]
    cells = []
    for name in names:
        values = sorted(r[row][name] for r in rounds)
        digits = 0 if values[0] >= 100 else 2
        low, middle, high = (f"{v:.{digits}f}" for v in (values[0], statistics.median(values), values[-1]))
        cells.append(f"{name} {middle} ({low}-{high})")
    peers = [name for name in names if name != "steersman"]
    if "steersman" not in names or peers == ["multiply-adds"]:
        return cells, ""
    more_is_better = "images/s" in row
    best = max if more_is_better else min
    ratios = []
    for r in rounds:
        rival = best(r[row][name] for name in peers)
        ratios.append(r[row]["steersman"] / rival if more_is_better else rival / r[row]["steersman"])
    return cells, f"{statistics.median(ratios):.2f} x"


def table(results, versions, args, rounds_done):
    """The table as Markdown, of the rounds that are done."""
    lines = [f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores; {', '.join(versions)}; "
             f"batch {args.batch}, {args.threads} threads, one image on 1 thread; {rounds_done} rounds", ""]  # fmt: skip
    lines += ["| | | median (lowest-highest) | against the best peer |", "|---|---|---|---|"]
    for network, rounds in results.items():
        for row in rounds[0]:
            cells, ratio = summarise(rounds, row)
            lines.append(f"| {network} | {row} | {', '.join(cells)} | {ratio} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", nargs="+", choices=NETWORKS, default=NETWORKS)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0, help="timed seconds of each measurement")
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--binary", type=Path, default=ROOT / "target/release/steersman")
    parser.add_argument("--markdown", type=Path, help="write the table to this file as well")
    args = parser.parse_args()

    ours = Ours(args.binary.resolve(), args)
    results, versions = {}, []
    with tempfile.TemporaryDirectory() as folder:
        onnx = {network: ours.export(Path(folder), network) for network in args.networks}
        for number in range(args.rounds):
            for network in args.networks:
                print(f"round {number + 1}/{args.rounds}: {network}", file=sys.stderr, flush=True)
                measured, versions = measure_round(ours, network, onnx[network], args)
                results.setdefault(network, []).append(measured)
            text = table(results, versions, args, number + 1)
            if args.markdown:
                # Kept after every round, in case there is no time for all of them.
                args.markdown.write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
