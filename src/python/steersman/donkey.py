"""A part for the vehicle loop of donkeycar.

In a ``manage.py`` made from donkeycar's template ``complete``, before the part ``DriveMode``::

    from steersman.donkey import Pilot

    V.add(Pilot("pilot.safetensors"), inputs=["cam/image_array"], outputs=["pilot/angle", "pilot/throttle"],
          run_condition="run_pilot")

donkeycar itself is not needed to import this module.
"""

import math
from typing import Any, Optional, Tuple, Union

import numpy as np
from numpy.typing import NDArray

from steersman._errors import UsageError
from steersman._native import Model
from steersman._paths import Path


class Pilot:
    """Steers and gives the throttle for what the camera sees.

    Angles are shares of full lock, -1 left to 1 right, as donkeycar has them; a throttle is -1 to 1. Both are clamped, and what is
    not finite is 0.
    """

    def __init__(self, model: Union[Model, Path], throttle: Optional[float] = None) -> None:
        """
        Args:
            model: a model, or the path of one.
            throttle: a constant throttle, -1 to 1; needed for a model that does not give one, and instead of that of one that does.
        """
        self._throttle = throttle
        if throttle is not None and not -1.0 <= throttle <= 1.0:
            raise UsageError(f"throttle {throttle}: -1 to 1 is meant")
        self._take(model if isinstance(model, Model) else Model.load(model))

    def load(self, path: Path) -> None:
        """Drives with the model in ``path`` from now on."""
        self._take(Model.load(path))

    def run(self, image: Optional[NDArray[np.uint8]], *_: Any) -> Tuple[float, float]:
        """Angle and throttle for an image, uint8 ``(height, width, 3)``, RGB; 0 and 0 while there is none. Further inputs are ignored."""
        if image is None:
            return 0.0, 0.0
        if self._throttle is not None:
            return _sane(self._model.steer(image)), float(self._throttle)
        answer = self._model.answer(image)
        return _sane(answer["steering"]), _sane(answer["throttle"])

    def shutdown(self) -> None:
        """Nothing is left to do when the vehicle stops."""

    def _take(self, model: Model) -> None:
        if self._throttle is None and "throttle" not in model.outputs:
            if "speed" in model.outputs:
                what = "gives a speed, which needs a controller and a measured speed"
            else:
                what = "gives the steering alone"
            raise UsageError(
                f"{model.path}: {what}; give a constant one, as in Pilot(model, throttle=0.3), or train a recipe whose `outputs` "
                "have `throttle`"
            )
        self._model = model


def _sane(command: float) -> float:
    return min(1.0, max(-1.0, command)) if math.isfinite(command) else 0.0
