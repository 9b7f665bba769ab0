"""Driving, recording and evaluating: the bits of the command line, and functions as drivers."""

import os
import signal
import threading
import time

import numpy as np
import pytest

import steersman


def test_a_drive_is_that_of_the_command_line(model, driven, steersman_json):
    drive, folder = driven
    told = steersman_json("drive", model.path, "--track", "lake", "--runs", 1, "--seed", 5, "--speed", 30)
    # Of all figures this one alone is a matter of time.
    rest = {name: value for name, value in drive.summary.items() if name != "realtime_factor"}
    assert rest == {name: value for name, value in told.items() if name != "realtime_factor"}
    columns = np.genfromtxt(folder / "free_5.csv", delimiter=",", names=True)
    (trial,) = drive.free
    assert trial.seed == 5 and len(trial.time_s) == len(columns)
    for name in ("time_s", "x_m", "y_m", "heading_deg", "s_m", "cte_m", "steering", "throttle", "speed_mph", "intervention"):
        assert np.allclose(getattr(trial, name), columns[name], atol=1e-3), name


def test_the_expert_drives_a_lap_and_nobody_does_not():
    expert = steersman.drive("expert", "lake", runs=1, progress=False)
    (free,) = expert.free
    assert free.laps_completed == 1 and free.failure is None and not free.intervention.any()
    assert np.abs(free.cte_m[40:]).max() < 0.5 and abs(np.median(free.speed_mph) - 20) < 0.5
    assert np.allclose(np.diff(free.time_s).mean(), 0.05, atol=1e-3) and free.duration_s > free.time_s[-1]
    zero = steersman.drive("zero", "lake", runs=1, speed_mph=30, progress=False)
    assert zero.free[0].failure in ("crash", "left_road") and zero.assisted[0].interventions > 5
    assert zero.assisted[0].intervention.sum() >= zero.assisted[0].interventions - 1
    assert zero.summary["autonomy_percent"] < 50


def test_a_function_drives_as_the_model_it_asks(model, driven):
    calls = []

    def driver(image, speed_mph):
        assert image.shape == (160, 320, 3) and image.dtype == np.uint8
        calls.append(speed_mph)
        return model.steer(image)

    by_function = steersman.drive(driver, "lake", runs=1, seed=5, speed_mph=30, progress=False)
    assert calls[0] == pytest.approx(30, abs=0.1)
    for found, expected in zip(by_function.trials, driven[0].trials):
        assert np.array_equal(found.steering, expected.steering) and np.array_equal(found.x_m, expected.x_m)
    pedals = steersman.drive(lambda image, mph: (0.0, 1.0), "lake", runs=1, throttle="model", speed_mph=25, progress=False)
    assert pedals.free[0].throttle[0] == 1 and pedals.free[0].speed_mph.max() > 12


def test_the_exception_of_a_function_ends_the_drive():
    def driver(image, speed_mph):
        raise ZeroDivisionError("of the driver")

    with pytest.raises(ZeroDivisionError, match="of the driver"):
        steersman.drive(driver, "lake", runs=2, progress=False)
    with pytest.raises(TypeError):
        steersman.drive(lambda image, speed_mph: "left", "lake", runs=1, progress=False)


def test_ctrl_c_ends_a_long_drive(model):
    timer = threading.Timer(0.5, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        steersman.drive(model, "lake", laps=2, runs=200, progress=False)
    # All of it would take an hour.
    assert time.monotonic() - began < 300


def test_what_cannot_be_driven_is_an_error(model):
    with pytest.raises(steersman.UsageError, match="unknown track `lak`; did you mean `lake`"):
        steersman.drive(model, "lak", progress=False)
    with pytest.raises(steersman.UsageError, match="laps and runs must be at least 1"):
        steersman.drive(model, "lake", runs=0, progress=False)
    with pytest.raises(steersman.UsageError, match="gives the steering alone"):
        steersman.drive(model, "lake", throttle="model", progress=False)
    with pytest.raises(ValueError, match='a number of mph or "auto" is meant'):
        steersman.drive(model, "lake", speed_mph="fast", progress=False)


def test_a_recording_is_that_of_the_command_line(lake, steersman_program, tmp_path):
    assert steersman_program("record", "--track", "lake", "--laps", 0.12, "--out", tmp_path / "lake")[0] == 0
    for name in ("driving_log.csv", "recording.toml"):
        assert (lake / name).read_bytes() == (tmp_path / "lake" / name).read_bytes()
    with pytest.raises(steersman.Error, match="exists"):
        steersman.record("lake", lake, laps=0.1, progress=False)
    ahead = tmp_path / "ahead"
    assert steersman_program("record", "--track", "lake", "--laps", 0.12, "--label-ahead", 8, "--out", ahead)[0] == 0
    steersman.record("lake", tmp_path / "same", laps=0.12, label_ahead_m=8, progress=False)
    log = (ahead / "driving_log.csv").read_bytes()
    assert (tmp_path / "same" / "driving_log.csv").read_bytes() == log != (lake / "driving_log.csv").read_bytes()
    keys = steersman.record("lake", tmp_path / "keys", laps=0.1, style="keyboard", reverse=True, hz=5, progress=False)
    assert keys.rate_hz == 5 and (keys.steering == 0).mean() > 0.3


@pytest.mark.filterwarnings("ignore::steersman.Notice")
def test_an_evaluation_is_that_of_the_command_line(model, lake, sample, steersman_json):
    found = steersman.evaluate(model, [lake, sample], progress=False)
    assert found.metrics == steersman_json("evaluate", model.path, lake, sample)
    assert len(found.label) == found.metrics["rows"] and found.beside is None
    assert np.mean((found.steering - found.label) ** 2) == pytest.approx(found.metrics["mse"], rel=1e-5)
    recording = steersman.Recording(sample)
    of_sample = found.recording == 1
    assert np.array_equal(found.label[of_sample], recording.steering[found.row[of_sample]])
    assert found.steering[of_sample][0] == np.float32(model.steer(recording.image(0)))


def test_an_evaluation_on_rows_of_the_training_warns(model, lake):
    with pytest.warns(steersman.Notice, match="belong to the model's training split"):
        steersman.evaluate(model, lake, progress=False)
