"""The part for donkeycar's vehicle loop."""

import numpy as np
import pytest

import steersman
from steersman.donkey import Pilot


@pytest.fixture(scope="module")
def both(lake, tmp_path_factory):
    """A model that gives steering and throttle."""
    outputs = '[{ name = "steering" }, { name = "throttle", loss_weight = 0.3 }]'
    settings = [f"outputs={outputs}", "layers.last.units=2", "epochs=1"]
    out = tmp_path_factory.mktemp("runs") / "both"
    with pytest.warns(steersman.Notice):
        return steersman.train(lake, recipe="lenet", set=settings, out=out, progress=False).load()


def test_angle_and_throttle_are_those_of_the_model(both, lake):
    pilot = Pilot(both)
    for image in steersman.Recording(lake).images([0, 20, 40]):
        answer = both.answer(image)
        assert set(answer) == {"steering", "throttle"} and answer["steering"] != answer["throttle"]
        expected = np.clip([answer["steering"], answer["throttle"]], -1, 1)
        assert pilot.run(image) == tuple(expected)
        assert both.predict_outputs(image[None])[0].tolist() == [answer["steering"], answer["throttle"]]
        assert Pilot(both, throttle=0.25).run(image) == (expected[0], 0.25)
    assert pilot.run(None) == (0.0, 0.0)
    assert both.outputs == ("steering", "throttle")


def test_a_model_without_a_throttle_needs_a_constant_one(model, both, lake):
    with pytest.raises(steersman.UsageError, match="gives the steering alone; give a constant one"):
        Pilot(model)
    with pytest.raises(steersman.UsageError, match="-1 to 1 is meant"):
        Pilot(model, throttle=2)
    pilot = Pilot(model.path, throttle=0.3)
    image = steersman.Recording(lake).image(10)
    assert pilot.run(image) == (np.clip(model.steer(image), -1, 1), 0.3)
    pilot.load(both.path)
    assert pilot.run(image)[0] == np.clip(both.steer(image), -1, 1)


def test_it_drives_in_a_vehicle(both, lake):
    vehicle = pytest.importorskip("donkeycar.vehicle", reason="donkeycar is not installed")
    recording = steersman.Recording(lake)

    class Camera:
        """Nothing in the first loop, then a drive."""

        row = -1

        def run(self):
            self.row += 1
            return recording.image(self.row - 1) if self.row > 0 else None

    class Wheels:
        seen = []

        def run(self, angle, throttle):
            self.seen.append((angle, throttle))

    car = vehicle.Vehicle()
    car.add(Camera(), outputs=["cam/image_array"])
    car.mem["run_pilot"] = True
    car.add(Pilot(both), inputs=["cam/image_array"], outputs=["pilot/angle", "pilot/throttle"], run_condition="run_pilot")
    car.add(Wheels(), inputs=["pilot/angle", "pilot/throttle"])
    car.start(rate_hz=200, max_loop_count=12)
    assert len(Wheels.seen) >= 11 and Wheels.seen[0] == (0.0, 0.0)
    rows = len(Wheels.seen) - 1
    expected = np.clip(both.predict_outputs(recording.images(range(rows))), -1, 1)
    assert np.array_equal(np.array(Wheels.seen[1:], np.float32), expected)
