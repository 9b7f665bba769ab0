"""The simulator as an environment in Gymnasium's convention, with or without Gymnasium."""

from typing import Any, Dict, Optional, Tuple

import numpy as np
from numpy.typing import NDArray

from steersman import _native

try:
    from gymnasium import Env as _Base
    from gymnasium.spaces import Box
except ImportError:  # The convention is followed all the same.
    _Base = object  # type: ignore[assignment, misc]

    class Box:  # type: ignore[no-redef]
        """What of ``gymnasium.spaces.Box`` an agent needs."""

        def __init__(self, low: Any, high: Any, shape: Tuple[int, ...], dtype: Any) -> None:
            self.shape, self.dtype = shape, np.dtype(dtype)
            self.low, self.high = np.full(shape, low, dtype), np.full(shape, high, dtype)
            self._random = np.random.default_rng()

        def seed(self, seed: Optional[int] = None) -> None:
            """Draws of :meth:`sample` begin anew."""
            self._random = np.random.default_rng(seed)

        def sample(self) -> NDArray[Any]:
            """A random element."""
            return self._random.uniform(self.low, self.high).astype(self.dtype)

        def contains(self, x: Any) -> bool:
            """Whether ``x`` is an element."""
            x = np.asarray(x)
            return x.shape == self.shape and bool(np.all(x >= self.low) and np.all(x <= self.high))


HZ = 20
"""Frames a second."""


class Simulator(_Base):  # type: ignore[misc, valid-type]
    """A car on a track, in Gymnasium's convention.

    - Observation: what the front camera sees, uint8 ``(160, 320, 3)``, RGB, after JPEG as a real one.
    - Action: steering, -1 to 1, positive to the right, float32 ``(1,)``; with ``throttle="action"`` steering and throttle, ``(2,)``.
    - Reward: metres driven along the line since the last frame; 10 less for a failure.
    - ``terminated``: all laps are driven, or the drive failed (``info["failure"]``: ``crash``, ``left_road``, ``stood_still``).
    - ``truncated``: it took far longer than a slow car needs.
    - ``info``: ``time_s``, ``x_m``, ``y_m``, ``heading_deg``, ``s_m``, ``cte_m``, ``speed_mph``, ``progress_m``, ``expert_steering``,
      ``interventions``, ``failure``; units as in :class:`steersman.Trial`.

    A step is one frame, 1/20 s. With the same seed and options the drive is that of :func:`steersman.drive`, bit for bit.

    >>> simulator = steersman.Simulator("lake")  # doctest: +SKIP
    >>> image, info = simulator.reset(seed=1)  # doctest: +SKIP
    >>> image, reward, terminated, truncated, info = simulator.step([info["expert_steering"]])  # doctest: +SKIP
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": HZ}

    def __init__(
        self,
        track: str = "lake",
        *,
        laps: int = 1,
        speed_mph: Optional[float] = None,
        throttle: str = "hold",
        latency_ms: float = 0.0,
        noise: float = 0.0,
        assisted: bool = False,
        render_mode: Optional[str] = "rgb_array",
    ) -> None:
        """
        Args:
            track: ``lake``, ``mountain``, ``coast``, ``forest``, ``random:SEED``, or a track file.
            laps: laps of an episode.
            speed_mph: speed to hold, mph, 20 by default; with ``throttle="action"`` the highest, 30 by default.
            throttle: ``"hold"``: a controller holds the speed; ``"action"``: the action's second number is the throttle.
            latency_ms: time from a picture to the wheels, ms.
            noise: standard deviation of a disturbance of the steering.
            assisted: put the car back where it is more than 1 m from the line, instead of ending the episode when it fails.
            render_mode: ``"rgb_array"`` or None.
        """
        if throttle not in ("hold", "action"):
            raise ValueError(f'throttle {throttle!r}: "hold" or "action" is meant')
        if render_mode not in (None, "rgb_array"):
            raise ValueError(f'render_mode {render_mode!r}: "rgb_array" or None is meant')
        self._own_throttle = throttle == "action"
        self._options = {
            "laps": laps,
            "speed_mph": float(speed_mph if speed_mph is not None else 30.0 if self._own_throttle else 20.0),
            "driver_throttle": self._own_throttle,
            "latency_ms": latency_ms,
            "noise": noise,
            "assisted": assisted,
        }
        self.render_mode = render_mode
        self.observation_space = Box(0, 255, shape=(160, 320, 3), dtype=np.uint8)
        self.action_space = Box(-1.0, 1.0, shape=(2 if self._own_throttle else 1,), dtype=np.float32)
        self._simulation: Optional[_native.Simulation] = _native.Simulation(track)
        self._random = np.random.default_rng()
        self._image: Optional[NDArray[np.uint8]] = None
        self._progress_m = 0.0

    def reset(
        self, *, seed: Optional[int] = None, options: Optional[Dict[str, Any]] = None
    ) -> Tuple[NDArray[np.uint8], Dict[str, Any]]:
        """Begins an episode; returns the first image and ``info``.

        Args:
            seed: draws start, direction, light, texture and noise, as the seed of :func:`steersman.drive` does; without one the next
                is drawn from what the last seed began.
            options: other values for this episode of ``laps``, ``speed_mph``, ``latency_ms``, ``noise`` and ``assisted``.
        """
        if _Base is not object:
            super().reset(seed=seed)
        if seed is None:
            seed = int(self._random.integers(1 << 32))
        else:
            self._random = np.random.default_rng(seed)
        chosen = dict(options or {})
        unknown = set(chosen) - {"laps", "speed_mph", "latency_ms", "noise", "assisted"}
        if unknown:
            raise ValueError(f"options: there are laps, speed_mph, latency_ms, noise and assisted, not {sorted(unknown)}")
        return self._seen(self._open().reset(seed, **{**self._options, **chosen}))[:2]

    def step(self, action: Any) -> Tuple[NDArray[np.uint8], float, bool, bool, Dict[str, Any]]:
        """Drives on to the next frame; returns image, reward, terminated, truncated and ``info``.

        Raises UsageError before :meth:`reset` and after the end of an episode.
        """
        action = np.asarray(action, dtype=np.float32).reshape(-1)
        if action.shape != self.action_space.shape:
            raise ValueError(f"an action of {self.action_space.shape[0]} numbers is meant, not {action.shape[0]}")
        before_m = self._progress_m
        frame = self._open().step(*action.tolist())
        over, too_slow = not frame["goes_on"], frame["too_slow"]
        image, info, progress_m = self._seen(frame)
        reward = progress_m - before_m - (10.0 if info["failure"] else 0.0)
        return image, reward, over and not too_slow, too_slow, info

    def render(self) -> Optional[NDArray[np.uint8]]:
        """The last image; None without a render mode."""
        return None if self.render_mode is None else self._image

    def close(self) -> None:
        """Ends the simulator and gives its memory back."""
        self._simulation = None

    @property
    def track(self) -> str:
        """Name of the track."""
        return self._open().track

    @property
    def length_m(self) -> float:
        """Length of a lap, m."""
        return self._open().length_m

    def _open(self) -> _native.Simulation:
        if self._simulation is None:
            raise ValueError("the simulator is closed")
        return self._simulation

    def _seen(self, frame: Dict[str, Any]) -> Tuple[NDArray[np.uint8], Dict[str, Any], float]:
        self._image = frame.pop("image")
        del frame["goes_on"], frame["too_slow"]
        self._progress_m = frame["progress_m"]
        return self._image, frame, self._progress_m
