"""A model that steers: values, shapes, borrowing, errors."""

import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest

import steersman


@pytest.fixture(scope="module")
def images(lake):
    return steersman.Recording(lake).images(range(0, 40, 5))


def test_a_batch_has_the_bits_of_single_images_for_any_number_of_threads(model, images):
    single = np.array([model.steer(image) for image in images], dtype=np.float32)
    assert single.std() > 0
    for threads in (0, 1, 3):
        batch = model.predict(images, threads=threads)
        assert batch.dtype == np.float32 and batch.shape == (len(images),)
        assert np.array_equal(batch, single)
    assert np.array_equal(model.predict_outputs(images), single[:, None])
    assert [model.answer(image) for image in images] == [{"steering": float(value)} for value in single]


def test_strided_arrays_and_what_can_become_an_array_steer_alike(model, images):
    image = images[3]
    mirrored = image[:, ::-1]
    assert not mirrored.flags.c_contiguous
    assert model.steer(mirrored) == model.steer(np.ascontiguousarray(mirrored)) != model.steer(image)
    assert model.steer(np.asfortranarray(image)) == model.steer(image)
    assert np.array_equal(model.predict(images[::2]), model.predict(images)[::2])

    class Picture:
        """As Pillow's images, it is no array but can become one."""

        __array_interface__ = image.__array_interface__

    assert model.steer(Picture()) == model.steer(image)
    read_only = image.copy()
    read_only.flags.writeable = False
    assert model.steer(read_only) == model.steer(image)


def test_a_contiguous_image_is_not_copied(model, images):
    batch = np.repeat(images, 40, axis=0)
    code = (
        "import sys, numpy, resource, steersman\n"
        "model = steersman.Model.load(sys.argv[1])\n"
        "batch = numpy.zeros((1500, 160, 320, 3), dtype=numpy.uint8)\n"
        "batch[:] = 7\n"
        "model.predict(batch[:8])\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "model.predict(batch)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, batch.nbytes // 1024)\n"
    )
    grown, size = map(int, subprocess.check_output([sys.executable, "-c", code, str(model.path)], text=True).split())
    assert grown < size / 10, f"{grown} KiB more for a batch of {size} KiB"
    assert len(model.predict(batch)) == len(batch)


@pytest.mark.parametrize(
    ("image", "kind", "words"),
    [
        (np.zeros((160, 320, 3)), TypeError, "an array of uint8 is meant, (height, width, 3) with values 0 to 255, not float64"),
        (np.zeros((320, 3), np.uint8), ValueError, "an array (height, width, 3) is meant, not one of shape [320, 3]"),
        (np.zeros((160, 320, 4), np.uint8), steersman.UsageError, "(height, width, 3), not (160, 320, 4)"),
        (np.zeros((0, 320, 3), np.uint8), steersman.UsageError, "(height, width, 3), not (0, 320, 3)"),
        (None, TypeError, "an array of uint8 is meant"),
    ],
)
def test_what_is_no_image_is_an_error_that_says_what_is_meant(model, image, kind, words):
    with pytest.raises(kind, match=words.replace("(", r"\(").replace(")", r"\)").replace("[", r"\[")):
        model.steer(image)
    with pytest.raises((TypeError, ValueError)):
        model.predict(image)


def test_threads_share_a_model(model, images):
    expected = model.predict(images)
    found = {}

    def steer(number):
        found[number] = [model.steer(image) for image in images]

    threads = [threading.Thread(target=steer, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(np.array(values, np.float32), expected) for values in found.values()) and len(found) == 4


def test_the_model_tells_what_it_is(model, run):
    assert model.outputs == ("steering",) and model.top_speed_mph is None
    assert model.image_size == (160, 320) and model.full_lock_deg == 25.0
    assert model.recipe["name"] == "default" and model.training["epochs"] in (1, 2)
    assert model.path == run.model
    kernel = model.weights("conv1.weight")
    assert kernel.ndim == 4 and kernel.shape[1] == 3 and kernel.dtype == np.float32
    assert "conv1.weight" in model.tensors
    with pytest.raises(KeyError, match="there is no `conv9.weight`; there are conv1.weight"):
        model.weights("conv9.weight")
    assert "Multiply-adds per image" in model.summary()


def test_saliency_is_a_map_of_the_networks_input(model, images):
    steering, heat, overlay = steersman.saliency(model, images[0])
    assert abs(steering - model.steer(images[0])) < 1e-5
    assert heat.ndim == 2 and heat.min() == 0 and heat.max() == 1
    assert overlay.shape == images[0].shape and overlay.dtype == np.uint8
    first = model.recipe["preprocessing"]["rows"][0]
    assert first > 0 and np.array_equal(overlay[:first], images[0][:first])
    assert not np.array_equal(overlay, images[0])


def test_errors_have_the_text_of_the_command_line(steersman_program, sample, tmp_path):
    empty = tmp_path / "empty.safetensors"
    empty.write_bytes(b"")
    escape = tmp_path / "red\x1b[31m.safetensors"
    escape.write_bytes(b"\x08\0\0\0\0\0\0\0{}")
    for given in (tmp_path / "nowhere", sample, "lake", "default", empty, escape):
        code, _, err = steersman_program("summary", given)
        assert code == 1
        with pytest.raises(steersman.Error) as caught:
            steersman.Model.load(given)
        assert err.strip() == f"error: {caught.value}"
        assert "\x1b" not in str(caught.value)


def test_summary_is_that_of_the_command_line(steersman_program, model):
    assert steersman_program("summary", model.path)[1].strip() == model.summary().strip()


@pytest.mark.parametrize(
    ("name", "settings", "args"),
    [
        ("model.onnx", {"with_preprocessing": True}, ["--to", "onnx", "--with-preprocessing"]),
        ("model.onnx", {"to": "onnx", "fold_batch_norm": True}, ["--to", "onnx", "--fold-batch-norm"]),
        ("model.c", {}, ["--to", "c"]),
        ("model.rs", {}, ["--to", "rust"]),
        ("model.tflite", {"throttle": 0.2}, ["--to", "tflite", "--throttle", "0.2"]),
    ],
)
def test_exports_are_those_of_the_command_line(model, name, settings, args, steersman_program, tmp_path):
    exported = model.export(tmp_path / name, **settings)
    code, _, err = steersman_program("export", model.path, tmp_path / f"other.{name}", *args)
    assert code == 0, err
    assert (tmp_path / name).read_bytes() == (tmp_path / f"other.{name}").read_bytes()
    assert exported["bytes"] == (tmp_path / name).stat().st_size
    with pytest.raises(steersman.UsageError, match="exists and stays as it is"):
        model.export(tmp_path / name, **settings)
    model.export(tmp_path / name, force=True, **settings)


def test_formats_that_are_not_known_are_an_error(model, tmp_path):
    with pytest.raises(steersman.UsageError, match="formats are onnx, c, rust, tflite"):
        model.export(tmp_path / "model.pt")


def test_exceptions_can_be_caught_as_those_of_python():
    assert issubclass(steersman.FileError, OSError) and issubclass(steersman.DataError, ValueError)
    assert issubclass(steersman.UsageError, ValueError)
    for kind in (steersman.FileError, steersman.DataError, steersman.UsageError):
        assert issubclass(kind, steersman.Error)
    with pytest.raises(OSError, match="check the name"):
        steersman.Model.load("nowhere")


def test_predicting_works_in_a_forked_process(model, images):
    import multiprocessing

    expected = model.predict(images)
    with warnings.catch_warnings():
        # That several threads are there is what is tested.
        warnings.simplefilter("ignore", DeprecationWarning)
        context = multiprocessing.get_context("fork")
        queue = context.SimpleQueue()
        process = context.Process(target=lambda: queue.put(model.predict(images)))
        process.start()
    process.join(300)
    assert process.exitcode == 0 and np.array_equal(queue.get(), expected)
