"""Driving, recording, evaluating, looking at what a model sees."""

from dataclasses import dataclass
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Tuple, Union

import numpy as np
from numpy.typing import NDArray

from steersman import _native
from steersman._native import Model, Recording
from steersman._paths import Path as PathLike
from steersman._paths import Paths, several
from steersman._progress import Progress, shown

Answer = Union[float, Tuple[float, float]]
"""Steering, or steering and throttle, each -1 to 1."""

Driver = Union[Model, str, Callable[[NDArray[np.uint8], float], Answer]]
"""Who drives: a model, ``"expert"``, ``"zero"`` (never steers), or a function of the image, uint8 ``(160, 320, 3)``, and the speed, mph."""


@dataclass(frozen=True)
class Trial:
    """One drive. The arrays have an entry for each frame, 20 a second."""

    seed: int
    """Draws start, direction, light, texture and noise."""
    assisted: bool
    """Whether the car was put back where it was more than 1 m from the line; otherwise a failure ended the drive."""
    laps_completed: int
    distance_m: float
    """Distance driven along the line, m."""
    duration_s: float
    """Simulated time, s."""
    failure: Optional[str]
    """Why it ended early: ``crash``, ``left_road`` or ``stood_still``; None if it did not."""
    interventions: int
    """Times the car was put back."""
    autonomy_percent: float
    """Share of the time without help, %, where 6 s are charged for each intervention."""
    time_s: NDArray[np.float64]
    """Time since the start, s."""
    x_m: NDArray[np.float64]
    """East, m."""
    y_m: NDArray[np.float64]
    """North, m."""
    heading_deg: NDArray[np.float64]
    """Where the car points: degrees, anticlockwise from east."""
    s_m: NDArray[np.float64]
    """Place along the line, m."""
    cte_m: NDArray[np.float64]
    """Cross-track error, m, positive to the right as driven."""
    steering: NDArray[np.float64]
    """What the driver asked for, -1 to 1, positive to the right."""
    throttle: NDArray[np.float64]
    """-1 to 1, negative to brake."""
    speed_mph: NDArray[np.float64]
    """Speed, mph."""
    intervention: NDArray[np.bool_]
    """Whether the car was just put back."""


@dataclass(frozen=True)
class Drive:
    """Drives of one driver on one track, each seed free and assisted."""

    summary: Dict[str, Any]
    """What ``drive --json`` prints: ``laps_completed``, ``autonomy_percent``, ``cte_mean_m`` and so on."""
    trials: List[Trial]
    """All trials: free and assisted of each seed, in the order of the seeds."""

    @property
    def free(self) -> List[Trial]:
        """The trials in which nobody helped."""
        return [trial for trial in self.trials if not trial.assisted]

    @property
    def assisted(self) -> List[Trial]:
        """The trials in which the car was put back."""
        return [trial for trial in self.trials if trial.assisted]


def _trial(raw: Dict[str, Any]) -> Trial:
    columns = dict(zip(_native.trajectory_columns(), raw.pop("trajectory").T.copy()))
    columns["intervention"] = columns["intervention"].astype(bool)
    return Trial(duration_s=raw.pop("time_s"), **raw, **columns)


def drive(
    driver: Union[Driver, PathLike],
    track: str,
    *,
    laps: int = 1,
    runs: int = 10,
    seed: int = 1,
    speed_mph: Union[float, str, None] = None,
    throttle: str = "hold",
    latency_ms: float = 0.0,
    noise: float = 0.0,
    out: Optional[PathLike] = None,
    threads: int = 0,
    progress: Progress = None,
) -> Drive:
    """Lets a driver drive in the simulator and measures how well, as ``steersman drive`` does, to the same bits.

    Args:
        driver: a model or the path of one, ``"expert"``, ``"zero"``, or a function of the image (uint8 ``(160, 320, 3)``) and the speed
            (mph) that returns the steering, or steering and throttle. A function is called from several threads, one at a time.
        track: ``lake``, ``mountain``, ``coast``, ``forest``, ``random:SEED``, or a track file.
        laps: laps of each run.
        runs: runs, each with a seed of its own, counted from ``seed``.
        speed_mph: speed to hold, mph, or ``"auto"``: 30 mph, less in bends; 20 by default. With ``throttle="model"`` the highest, 30 by
            default.
        throttle: ``"hold"``: a controller holds the speed; ``"model"``: the driver gives the throttle.
        latency_ms: time from a picture to the wheels, ms.
        noise: standard deviation of a disturbance of the steering.
        out: a new folder for the trajectories and a map of them.
        threads: 0 is one for each core.
        progress: as for :func:`train`.

    Raises:
        KeyboardInterrupt: at Ctrl-C; nothing is kept then.
    """
    if not (isinstance(driver, Model) or driver in ("expert", "zero") or callable(driver)):
        driver = Model.load(driver)
    settings = {
        "laps": laps,
        "runs": runs,
        "seed": seed,
        "speed_mph": speed_mph,
        "throttle": throttle,
        "latency_ms": latency_ms,
        "noise": noise,
        "out": out,
        "threads": threads,
    }
    with shown(progress, f"driving on {track}") as observer:
        summary, trials = _native.drive(driver, track, settings, observer)
    return Drive(summary, [_trial(trial) for trial in trials])


def record(
    track: str,
    out: PathLike,
    *,
    laps: float = 1.0,
    reverse: bool = False,
    recovery: bool = False,
    style: str = "smooth",
    seed: int = 1,
    speed_mph: float = 20.0,
    slower_in_bends_mps2: Optional[float] = None,
    label_ahead_m: Optional[float] = None,
    noise: float = 0.0,
    hz: int = 10,
    format: str = "sample",
    threads: int = 0,
    progress: Progress = None,
) -> Recording:
    """Records the simulator's expert in the format of Udacity's simulator, as ``steersman record`` does.

    Args:
        track: as for :func:`drive`.
        out: folder of the recording, which must not exist.
        laps: laps to drive; with ``recovery`` laps along which the car is put off its line.
        reverse: drive the other way round.
        recovery: put the car off its line again and again, and record only the ways back.
        style: ``"smooth"``, or ``"keyboard"``: labels are often zero, with spikes between.
        seed: draws where the drive begins, its light and its texture.
        speed_mph: speed to hold, mph.
        slower_in_bends_mps2: drive slower in bends, so that the car is pushed sideways by at most this, m/s².
        label_ahead_m: label with the steering towards the point of the line so many metres ahead of the rear axle (3 to 30), as the recipes
            ``default`` (8) and ``calm`` (10) want it, while the car drives as ever (6.13 m at 20 mph). The driven path, which is reckoned
            from the labels, is none then. Without it the labels are what the car drives.
        noise: standard deviation of a disturbance of the steering that the labels do not show.
        hz: rows of the log for each second: 1, 2, 5, 10, 25 or 50.
        format: ``"sample"``: as Udacity's sample data; ``"v2"``: as version 2 of the simulator, without header.
        threads: 0 is one for each core.
        progress: as for :func:`train`.

    Raises:
        KeyboardInterrupt: at Ctrl-C; nothing is left behind then.
    """
    settings = {
        "laps": laps,
        "reverse": reverse,
        "recovery": recovery,
        "style": style,
        "seed": seed,
        "speed_mph": speed_mph,
        "slower_in_bends_mps2": slower_in_bends_mps2,
        "label_ahead_m": label_ahead_m,
        "noise": noise,
        "hz": hz,
        "format": format,
        "threads": threads,
    }
    with shown(progress, f"recording {track}") as observer:
        _native.record(track, out, settings, observer)
    return Recording(out)


@dataclass(frozen=True)
class Evaluation:
    """A model against recordings. The arrays have an entry for each image of the centre camera that could be decoded."""

    metrics: Dict[str, Any]
    """What ``evaluate --json`` prints: ``mse``, ``mae_deg``, ``correlation``, ``path_mae_deg`` and so on; angles are degrees of the
    front wheels."""
    recording: NDArray[np.int64]
    """Index of the recording."""
    row: NDArray[np.int64]
    """Index of the row in it."""
    label: NDArray[np.float32]
    """Recorded steering."""
    steering: NDArray[np.float32]
    """Predicted steering."""
    beside: Optional[NDArray[np.float32]]
    """Predicted throttle, or speed as a share of the top speed, of models that give one."""


def evaluate(
    model: Union[Model, PathLike],
    recordings: Paths,
    *,
    look_ahead_s: float = 0.7,
    description: Optional[Mapping[str, Any]] = None,
    threads: int = 0,
    progress: Progress = None,
) -> Evaluation:
    """Compares a model's steering with what was recorded, as ``steersman evaluate`` does: centre camera, every usable row.

    Args:
        model: a model, or the path of one.
        recordings: one recording or several.
        look_ahead_s: how far ahead the driven path is aimed at for the ``path_*`` measures, s.
        description: as for :func:`train`.
        threads: 0 is one for each core.
        progress: as for :func:`train`.
    """
    if not isinstance(model, Model):
        model = Model.load(model)
    said = None if description is None else dict(description)
    with shown(progress, "evaluating") as observer:
        metrics, rows = _native.evaluate(model, several(recordings), look_ahead_s, said, threads, observer)
    recording, row, label, steering, beside = rows.T
    several_outputs = len(model.outputs) > 1
    return Evaluation(
        metrics=metrics,
        recording=recording.astype(np.int64),
        row=row.astype(np.int64),
        label=label.astype(np.float32),
        steering=steering.astype(np.float32),
        beside=beside.astype(np.float32) if several_outputs else None,
    )


class Saliency(NamedTuple):
    """What excites a network."""

    steering: float
    map: NDArray[np.float32]
    """0 to 1, ``(h, w)`` of the network's input: the image after cropping and scaling."""
    overlay: NDArray[np.uint8]
    """The image with the map on it, ``(height, width, 3)``; rows that are cut off keep their colours."""


def saliency(model: Union[Model, PathLike], image: NDArray[np.uint8]) -> Saliency:
    """Shows which parts of an image, uint8 ``(height, width, 3)``, excite the network (VisualBackProp, Bojarski et al. 2016)."""
    if not isinstance(model, Model):
        model = Model.load(model)
    return Saliency(*model.saliency(image))
