"""Recordings as arrays."""

import csv

import numpy as np
import pytest

import steersman


def test_labels_are_those_of_the_log(lake):
    recording = steersman.Recording(lake)
    with open(lake / "driving_log.csv", newline="") as log:
        rows = list(csv.DictReader(log, skipinitialspace=True))
    assert len(recording) == len(rows) > 50
    for name, values in (("steering", recording.steering), ("throttle", recording.throttle), ("speed", recording.speed_mph)):
        assert values.dtype == np.float32
        assert np.array_equal(values, np.array([row[name] for row in rows], np.float32)), name
    assert np.array_equal(recording.line, np.arange(len(rows)) + 2)
    assert recording.time_s[0] == 0 and np.allclose(np.diff(recording.time_s), 0.1)
    assert not recording.session.any() and recording.rate_hz == 10 and recording.cameras == ["centre", "left", "right"]
    assert not recording.unusable


def test_path_labels_follow_the_driven_path(lake):
    recording = steersman.Recording(lake)
    labels = recording.path_labels()
    missing = np.isnan(labels)
    assert missing[-1] and not missing[:-10].any()
    # The expert follows the road: where it was and where it goes differ little.
    assert np.nanmax(np.abs(labels - recording.steering)) < 0.15
    assert np.isnan(recording.path_labels(2.0)).sum() > missing.sum()
    with pytest.raises(steersman.UsageError, match="0 to 10 s can be looked ahead"):
        recording.path_labels(11)


def test_images_are_decoded_on_demand(lake):
    recording = steersman.Recording(lake)
    image = recording.image(3)
    assert image.shape == (160, 320, 3) and image.dtype == np.uint8 and image.std() > 10
    batch = recording.images([3, -1])
    assert np.array_equal(batch[0], image) and np.array_equal(batch[1], recording.image(len(recording) - 1))
    assert not np.array_equal(recording.image(3, "left"), image)
    assert recording.image_path(3).name.startswith("center")
    assert recording.images([]).shape == (0, 0, 0, 3)
    for row in (len(recording), -len(recording) - 1):
        with pytest.raises(IndexError, match=f"row {row} of a recording of {len(recording)} rows"):
            recording.image(row)
    with pytest.raises(ValueError, match="there are centre, left and right"):
        recording.image(0, "rear")
    pillow = pytest.importorskip("PIL.Image")
    decoded = np.asarray(pillow.open(recording.image_path(3)))
    # Two decoders round differently.
    assert np.abs(decoded.astype(int) - image).max() <= 8


def test_what_is_said_of_a_recording_is_heeded(sample):
    plain = steersman.Recording(sample)
    degrees = steersman.Recording(sample, description={"unit": "degrees", "full_lock_deg": 50.0, "hz": 20})
    assert np.allclose(degrees.steering * 50, plain.steering, atol=1e-6) and degrees.rate_hz == 20
    with pytest.raises(steersman.UsageError, match="description: unknown field `units`"):
        steersman.Recording(sample, description={"units": "degrees"})
    with pytest.raises(steersman.UsageError, match="description: hz"):
        steersman.Recording(sample, description={"hz": 0})


def test_a_folder_without_a_recording_is_an_error(tmp_path):
    with pytest.raises(steersman.DataError, match="no recording here"):
        steersman.Recording(tmp_path)
