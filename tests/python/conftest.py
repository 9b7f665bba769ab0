"""What the tests of the Python package share: a drive that is recorded once, and a model that is trained on it once.

The program to compare with is named by STEERSMAN_BINARY; tests that need it are skipped without.
"""

import json
import os
import signal
import subprocess
import warnings
from pathlib import Path

import pytest

import steersman

ROOT = Path(__file__).resolve().parents[2]

# A shell that starts the tests in the background lets them ignore Ctrl-C, which some of them press.
signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session")
def sample():
    """A short recording of Udacity's simulator, which comes with the sources."""
    return ROOT / "data" / "sample"


@pytest.fixture(scope="session")
def lake(tmp_path_factory):
    """A recording of a part of the lake's lap."""
    folder = tmp_path_factory.mktemp("recordings") / "lake"
    steersman.record("lake", folder, laps=0.12, progress=False)
    return folder


@pytest.fixture(scope="session")
def run(lake, tmp_path_factory):
    """A short training on it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", steersman.Notice)
        out = tmp_path_factory.mktemp("runs") / "lake"
        return steersman.train(lake, recipe="default", set={"epochs": 2, "batch": 32}, out=out, progress=False)


@pytest.fixture(scope="session")
def model(run):
    return run.load()


@pytest.fixture(scope="session")
def driven(model, tmp_path_factory):
    """A drive of the model on the lake, seed 5 at 30 mph, and the folder with its trajectories."""
    folder = tmp_path_factory.mktemp("drives") / "lake"
    return steersman.drive(model, "lake", runs=1, seed=5, speed_mph=30, out=folder, progress=False), folder


@pytest.fixture(scope="session")
def steersman_program():
    """Runs the command line: arguments in, (exit code, standard output, standard error) out."""
    binary = os.environ.get("STEERSMAN_BINARY")
    if not binary:
        pytest.skip("STEERSMAN_BINARY does not name the program")

    def call(*args):
        done = subprocess.run([binary, *map(str, args)], capture_output=True, text=True, check=False)
        return done.returncode, done.stdout, done.stderr

    return call


@pytest.fixture(scope="session")
def steersman_json(steersman_program):
    """Runs the command line with --json and returns the value."""

    def call(*args):
        code, out, err = steersman_program(*args, "--json")
        assert code == 0, err
        return json.loads(out.splitlines()[-1])

    return call
