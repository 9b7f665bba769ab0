"""steersman learns to steer a car from its front camera, and drives with what it learned: a from-scratch CNN engine in Rust.

Images are arrays of uint8, ``(height, width, 3)``, RGB; a contiguous one is read where it lies, any other is copied once.
Steering is a share of full lock: roughly -1 to 1, positive to the right.

>>> import steersman
>>> drive = steersman.record("lake", "recordings/lake", laps=0.5)  # doctest: +SKIP
>>> run = steersman.train("recordings/lake", set={"epochs": 6})  # doctest: +SKIP
>>> model = run.load()  # doctest: +SKIP
>>> model.steer(drive.image(0))  # doctest: +SKIP
>>> steersman.drive(model, "lake", runs=3).summary["autonomy_percent"]  # doctest: +SKIP

Long calls let other Python threads run, show their progress, and stop on Ctrl-C. What the user should know is a warning of the
category :class:`Notice`; what goes wrong is an :class:`Error`.
"""

from typing import TYPE_CHECKING, Any

from steersman._driving import Drive, Evaluation, Saliency, Trial, drive, evaluate, record, saliency
from steersman._errors import DataError, Error, FileError, Notice, UsageError
from steersman._native import VERSION as __version__
from steersman._native import Model, Recording
from steersman._progress import Event, Progress
from steersman._training import Run, resume, train

if TYPE_CHECKING:
    from steersman._simulator import Simulator

__all__ = [
    "DataError",
    "Drive",
    "Error",
    "Evaluation",
    "Event",
    "FileError",
    "Model",
    "Notice",
    "Progress",
    "Recording",
    "Run",
    "Saliency",
    "Simulator",
    "Trial",
    "UsageError",
    "__version__",
    "drive",
    "evaluate",
    "record",
    "resume",
    "saliency",
    "train",
]


def __getattr__(name: str) -> Any:
    # Its base class is Gymnasium's where that is installed, which takes long to import.
    if name == "Simulator":
        from steersman._simulator import Simulator

        return Simulator
    raise AttributeError(f"module 'steersman' has no attribute {name!r}")
