"""What every peer's measurement shares: arguments, timing, and one JSON object as the result.

A measurement is a process of its own, `python X_peer.py --network hyper --task train`, so that start-up and peak memory
are those of that task alone. Batches are random float32 arrays that already lie in memory; eight of them, as in
`steersman bench`.
"""

import argparse
import json
import statistics
import time

STARTED = time.perf_counter()

BATCHES = 8
INPUTS = {
    "hyper": (40, 160, 3),
    "lenet": (64, 64, 1),
    "pilotnet": (66, 200, 3),
    "default": (40, 160, 3),
    "donkey": (120, 160, 3),
}
# donkeycar's network gives steering and throttle, the others steering alone.
OUTPUTS = {network: 2 if network == "donkey" else 1 for network in INPUTS}


def arguments(tasks):
    parser = argparse.ArgumentParser(formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--network", choices=INPUTS, required=True)
    parser.add_argument("--task", choices=tasks, required=True)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=4.0, help="timed seconds, after warming up")
    parser.add_argument("--onnx", help="model file, for ONNX Runtime")
    return parser.parse_args()


def peak_rss_mb():
    """Largest resident memory of this process so far, in millions of bytes (Linux)."""
    with open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024 / 1e6
    return None


def random_batches(network, batch, channels_first=False):
    import numpy as np

    height, width, channels = INPUTS[network]
    shape = (channels, height, width) if channels_first else (height, width, channels)
    rng = np.random.default_rng(0)
    x = [rng.random((batch, *shape), dtype=np.float32) for _ in range(BATCHES)]
    y = [rng.random((batch, OUTPUTS[network]), dtype=np.float32) for _ in range(BATCHES)]
    return x, y


def throughput(step, batch, seconds, warm_up=10):
    """Images a second of `step(number)`, and when the first step ended, in seconds after the start of the process.

    The rate is the median over the steps, so a disturbance by other processes weighs little.
    """
    step(0)
    first_step_s = time.perf_counter() - STARTED
    for number in range(1, warm_up):
        step(number)
    times, until = [], time.perf_counter() + seconds
    while time.perf_counter() < until:
        before = time.perf_counter()
        step(len(times))
        times.append(time.perf_counter() - before)
    return {"images_per_second": batch / statistics.median(times), "first_step_s": first_step_s}


def latency(predict, seconds, warm_up=50):
    """Median and 99th percentile of the time of `predict(number)`, in microseconds."""
    for number in range(warm_up):
        predict(number)
    times, until = [], time.perf_counter() + seconds
    while time.perf_counter() < until:
        before = time.perf_counter()
        predict(len(times))
        times.append((time.perf_counter() - before) * 1e6)
    times.sort()
    return {"p50_us": times[(len(times) - 1) // 2], "p99_us": times[(len(times) - 1) * 99 // 100]}


def report(result, version):
    print(json.dumps(result | {"peak_rss_mb": peak_rss_mb(), "version": version}))
