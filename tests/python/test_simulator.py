"""The simulator in Gymnasium's convention."""

import subprocess
import sys

import numpy as np
import pytest

import steersman


def test_an_episode_with_the_expert_is_the_drive_of_the_expert():
    simulator = steersman.Simulator("lake", speed_mph=30)
    image, info = simulator.reset(seed=3)
    assert image.shape == (160, 320, 3) and image.dtype == np.uint8
    track = [(info["x_m"], info["y_m"], info["speed_mph"])]
    total, over = 0.0, False
    while not over:
        image, reward, over, truncated, info = simulator.step([info["expert_steering"]])
        total += reward
        track.append((info["x_m"], info["y_m"], info["speed_mph"]))
    assert not truncated and info["failure"] is None and info["progress_m"] >= simulator.length_m
    assert total == pytest.approx(info["progress_m"])
    (free,) = steersman.drive("expert", "lake", runs=1, seed=3, speed_mph=30, progress=False).free
    assert np.array_equal(np.array(track[: len(free.x_m)]), np.stack([free.x_m, free.y_m, free.speed_mph], axis=1))


def test_a_model_steers_by_the_image_as_in_a_drive(model, driven):
    simulator = steersman.Simulator("lake", speed_mph=30)
    image, _ = simulator.reset(seed=5)
    (free,) = driven[0].free
    count = min(40, len(free.steering))
    steering = []
    for _ in range(count):
        steering.append(model.steer(image))
        image, *_ = simulator.step(steering[-1])
    assert count > 10 and np.array_equal(np.clip(steering, -1, 1), free.steering[:count])


def test_failures_end_an_episode_and_cost():
    simulator = steersman.Simulator("lake")
    simulator.reset(seed=1)
    rewards, over = [], False
    while not over:
        _, reward, over, truncated, info = simulator.step(1.0)
        rewards.append(reward)
    assert info["failure"] in ("crash", "left_road") and rewards[-1] < -8 and not truncated
    with pytest.raises(steersman.UsageError, match="call reset"):
        simulator.step(0.0)
    assert simulator.reset(seed=1)[1]["progress_m"] == 0
    helped = steersman.Simulator("lake", assisted=True)
    helped.reset(seed=1)
    for _ in range(200):
        _, _, over, _, info = helped.step(0.0)
    assert not over and info["interventions"] > 0


def test_seeds_repeat_and_without_one_the_next_is_drawn():
    simulator = steersman.Simulator("mountain")

    def begin(**arguments):
        image, info = simulator.reset(**arguments)
        return info["x_m"], info["y_m"], int(image.sum())

    first = begin(seed=7)
    drawn = [begin(), begin()]
    assert begin(seed=7) == first and [begin(), begin()] == drawn and len({first, *drawn}) == 3
    assert begin(seed=7, options={"speed_mph": 10.0}) == first
    assert simulator.step(0.0)[4]["speed_mph"] < 12
    with pytest.raises(ValueError, match="not \\['lap'\\]"):
        simulator.reset(options={"lap": 2})


def test_the_throttle_can_be_part_of_the_action():
    simulator = steersman.Simulator("lake", throttle="action", speed_mph=25)
    assert simulator.action_space.shape == (2,)
    _, info = simulator.reset(seed=4)
    for _ in range(60):
        *_, info = simulator.step([info["expert_steering"], 1.0])
    fast = info["speed_mph"]
    for _ in range(40):
        *_, info = simulator.step([info["expert_steering"], -0.5])
    assert 15 < fast < 25 and info["speed_mph"] < fast - 5
    with pytest.raises(ValueError, match="an action of 2 numbers is meant, not 1"):
        simulator.step(0.0)


def test_steps_before_a_reset_and_after_close_are_errors():
    simulator = steersman.Simulator("lake")
    with pytest.raises(steersman.UsageError, match="call reset"):
        simulator.step(0.0)
    simulator.close()
    with pytest.raises(ValueError, match="closed"):
        simulator.reset()
    with pytest.raises(steersman.UsageError, match="unknown track"):
        steersman.Simulator("lak")


def test_it_works_without_gymnasium():
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "import steersman\n"
        "simulator = steersman.Simulator('lake')\n"
        "image, info = simulator.reset(seed=1)\n"
        "assert simulator.observation_space.contains(image)\n"
        "simulator.action_space.seed(1)\n"
        "action = simulator.action_space.sample()\n"
        "assert simulator.action_space.contains(action) and action.shape == (1,)\n"
        "assert len(simulator.step(action)) == 5 and simulator.render() is not None\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_gymnasium_finds_nothing_wrong():
    pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env

    check_env(steersman.Simulator("lake", throttle="action"), skip_render_check=False)
