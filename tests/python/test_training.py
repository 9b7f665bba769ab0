"""Training from Python: the bits of the command line, progress, interruption."""

import os
import signal
import threading

import numpy as np
import pytest

import steersman

pytestmark = pytest.mark.filterwarnings("ignore::steersman.Notice")


def test_a_run_has_its_history_as_arrays(run):
    history = run.history
    assert history["epoch"].tolist() == [1, 2] and history["images"].dtype == np.int64
    for name in ("train_loss", "val_mse", "val_mae_deg", "seconds"):
        assert history[name].dtype == np.float64 and np.isfinite(history[name]).all(), name
    assert history["train_loss"][1] < history["train_loss"][0]
    assert run.result["epochs"] == 2 and run.result["val_mse"] == history["val_mse"][run.result["best_epoch"] - 1]
    assert run.recipe["epochs"] == 2 and run.recipe["batch"] == 32
    assert run.report.read_text().startswith("<!DOCTYPE html>")
    assert {side["side"] for side in run.replay["sides"]} == {"training", "validation"}
    again = steersman.Run(run.folder)
    assert again.result == run.result and np.array_equal(again.history["val_mse"], history["val_mse"])


def test_the_weights_are_those_of_the_command_line(run, lake, steersman_json, tmp_path):
    settings = ["--recipe", "default", "--set", "epochs=2", "--set", "batch=32", "--out", tmp_path / "run"]
    assert steersman_json("train", lake, *settings)["weights_hash"] == run.result["weights_hash"]


def test_progress_is_told_to_a_function(lake, tmp_path):
    events = []
    settings = {"epochs": 2, "split.mode": "random", "optimizer.learning_rate": 1e-4}
    run = steersman.train(lake, recipe="lenet", set=settings, out=tmp_path / "run", progress=events.append)
    records = [event["record"] for event in events if "record" in event]
    assert [record["epoch"] for record in records] == [1, 2]
    assert [record["train_loss"] for record in records] == run.history["train_loss"].tolist()
    batches = [event for event in events if "images" in event]
    assert batches and all(0 < batch["images"] <= batch["of"] and batch["loss"] > 0 for batch in batches)
    assert run.recipe["optimizer"]["learning_rate"] == 1e-4 and run.recipe["split"]["mode"] == "random"


def test_progress_is_shown_and_can_be_silent(lake, tmp_path, capfd):
    steersman.train(lake, recipe="lenet", set={"epochs": 1}, out=tmp_path / "loud")
    assert "epoch  1/1  loss" in capfd.readouterr().err
    steersman.train(lake, recipe="lenet", set=["epochs=1"], out=tmp_path / "silent", progress=False)
    assert capfd.readouterr() == ("", "")


def test_an_interrupt_saves_and_resume_goes_on_to_the_same_bits(lake, tmp_path):
    settings = {"recipe": "lenet", "set": {"epochs": 3}}
    whole = steersman.train(lake, out=tmp_path / "whole", progress=False, **settings)
    seen = []

    def interrupt(event):
        seen.append(event)
        if "record" in event and event["record"]["epoch"] == 1:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="stopped and saved; go on with: steersman.resume"):
        steersman.train(lake, out=tmp_path / "parts", progress=interrupt, **settings)
    stopped = steersman.Run(tmp_path / "parts")
    assert stopped.result is None and 1 <= len(stopped.history["epoch"]) < 3
    assert stopped.load().training["epochs"] >= 1
    finished = steersman.resume(stopped, progress=False)
    assert finished.result["weights_hash"] == whole.result["weights_hash"]
    assert finished.history["train_loss"].tolist() == whole.history["train_loss"].tolist()


def test_an_exception_of_the_function_stops_the_run_and_is_raised(lake, tmp_path):
    class Enough(Exception):
        pass

    def stop(event):
        if "images" in event:
            raise Enough(f"after {event['images']} images")

    with pytest.raises(Enough, match="after [1-9]"):
        steersman.train(lake, recipe="lenet", set={"epochs": 50}, out=tmp_path / "run", progress=stop)
    assert steersman.Run(tmp_path / "run").result is None


def test_other_threads_run_while_a_network_is_trained(lake, tmp_path):
    counted = []
    done = threading.Event()

    def count():
        while not done.wait(0.005):
            counted.append(1)

    thread = threading.Thread(target=count)
    thread.start()
    run = steersman.train(lake, recipe="lenet", set={"epochs": 2}, out=tmp_path / "run", progress=False)
    done.set()
    thread.join()
    # With the lock held it would have come to a turn before and after.
    assert run.result["epochs"] == 2 and len(counted) >= 10


def test_training_can_begin_with_a_model(run, lake, tmp_path):
    second = steersman.train(
        lake, from_model=run.folder, freeze=["conv1"], set={"epochs": 1}, out=tmp_path / "run", progress=False
    )
    assert second.recipe["name"] == "default"
    assert np.array_equal(second.load().weights("conv1.weight"), run.load().weights("conv1.weight"))
    assert not np.array_equal(second.load().weights("conv2.weight"), run.load().weights("conv2.weight"))


@pytest.mark.parametrize(
    ("args", "settings"),
    [
        (["--set", "epoch=3"], {"set": {"epoch": 3}}),
        (["--recipe", "lente"], {"recipe": "lente"}),
        (["--recipe", "lenet", "--set", "optimizer.learning_rate=-1"], {"recipe": "lenet", "set": {"optimizer.learning_rate": -1}}),
    ],
)
def test_errors_have_the_text_of_the_command_line(args, settings, sample, steersman_program, tmp_path):
    code, _, err = steersman_program("train", sample, *args, "--out", tmp_path / "run")
    with pytest.raises(steersman.UsageError) as caught:
        steersman.train(sample, out=tmp_path / "run", progress=False, **settings)
    assert code == 1 and err.strip().splitlines()[-1] == f"error: {caught.value}"
    assert not (tmp_path / "run").exists()


def test_a_folder_in_use_stays_as_it_is(run, lake):
    with pytest.raises(steersman.UsageError, match="is not empty and stays as it is"):
        steersman.train(lake, out=run.folder, progress=False)
    with pytest.raises(steersman.UsageError, match="is no run folder"):
        steersman.Run(lake)


def test_held_out_tracks_are_not_trained_on(tmp_path):
    steersman.record("coast", tmp_path / "coast", laps=0.05, progress=False)
    with pytest.raises(steersman.UsageError, match="held out to test what was learned elsewhere"):
        steersman.train(tmp_path / "coast", out=tmp_path / "run", progress=False)
