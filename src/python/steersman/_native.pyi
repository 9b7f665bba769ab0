"""The extension module, written in Rust."""

import os
from pathlib import Path
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np
from numpy.typing import NDArray

VERSION: str

class Model:
    """A trained model, which steers: image in, steering out.

    Images are uint8, ``(height, width, 3)``, RGB, of any size; they are cropped and scaled as in training. Steering is a share of full
    lock, positive to the right, and not clamped. All threads may use the same model; calls of :meth:`steer` wait for each other.
    """

    path: Path
    """The model file."""
    outputs: Tuple[str, ...]
    """What the network gives, in the order of :meth:`predict_outputs`: ``("steering",)``, or ``"throttle"`` or ``"speed"`` behind it."""
    top_speed_mph: Optional[float]
    """The speed, mph, of which the output ``speed`` is a share; None without that output."""
    image_size: Tuple[int, int]
    """Height and width, pixels, of the images it was trained on. Images of another size are scaled."""
    full_lock_deg: float
    """Angle of the front wheels, degrees, at steering 1."""
    recipe: Dict[str, Any]
    """The recipe: preprocessing, layers, training."""
    training: Dict[str, Any]
    """The record of its training: recordings, seed, epochs, losses."""
    tensors: Tuple[str, ...]
    """Names of the tensors, as in ``conv1.weight``."""
    weights_hash: str
    """SHA-256 over all tensors: two models with the same hash have the same weights, bit for bit."""

    @staticmethod
    def load(path: Union[str, "os.PathLike[str]"]) -> "Model":
        """Reads a model file, or the model of the run whose folder is given.

        Raises DataError for a damaged file or one that is no model, FileError for one that cannot be read.
        """

    def steer(self, image: NDArray[np.uint8]) -> float:
        """Steering for an image, uint8 ``(height, width, 3)``: a share of full lock, positive to the right.

        The image is borrowed if it is contiguous, and copied once if not. Of a model with two outputs this is the first;
        :meth:`answer` gives both.
        """

    def answer(self, image: NDArray[np.uint8]) -> Dict[str, float]:
        """All outputs for an image, by their names: ``steering``, and ``throttle`` (-1 to 1) or ``speed`` (a share of
        ``top_speed_mph``) of models that give one."""

    def steer_file(self, path: Union[str, "os.PathLike[str]"]) -> float:
        """Steering for a JPEG or PNG file."""

    def predict(self, images: NDArray[np.uint8], *, threads: int = 0) -> NDArray[np.float32]:
        """Steering for each of a batch of images, uint8 ``(n, height, width, 3)``: float32 ``(n,)``.

        The bits are those of :meth:`steer`. The batch is borrowed as there; ``threads`` 0 is one for each core.
        """

    def predict_outputs(self, images: NDArray[np.uint8], *, threads: int = 0) -> NDArray[np.float32]:
        """All outputs for each image of a batch: float32 ``(n, outputs)``, in the order of ``outputs``."""

    def saliency(self, image: NDArray[np.uint8]) -> Tuple[float, NDArray[np.float32], NDArray[np.uint8]]:
        """Steering, the map of what excites the network, and the image with the map on it; see :func:`steersman.saliency`."""

    def export(
        self,
        file: Union[str, "os.PathLike[str]"],
        *,
        to: Optional[str] = None,
        with_preprocessing: bool = False,
        fold_batch_norm: bool = False,
        throttle: Optional[float] = None,
        force: bool = False,
    ) -> Dict[str, Any]:
        """Writes the model for other programs, as ``steersman export`` does; returns what ``export --json`` prints.

        ``to`` is ``"onnx"``, ``"tflite"`` (for donkeycar), ``"c"`` or ``"rust"``; by default what the name of the file ends with.
        ``with_preprocessing`` and ``fold_batch_norm`` are for ONNX, the others always do both: take the camera image, and merge batch
        normalisation. ``throttle`` is the constant throttle of a TensorFlow Lite file whose model gives none. ``force`` overwrites.
        """

    def summary(self) -> str:
        """The layer table, and how the model was trained."""

    def weights(self, name: str) -> NDArray[np.float32]:
        """A copy of a tensor: ``(out, in, kh, kw)`` for the weight of a convolution, ``(out, in)`` for that of a dense layer.

        Raises KeyError, which lists the names.
        """

class Recording:
    """A recording: a folder, a log, or a ``.zip`` or ``.tar.gz`` archive of one; labels as arrays, images decoded on demand.

    Rows that cannot be used are left out and counted in ``unusable``. Arrays are copies with an entry for each row.
    """

    path: Path
    kind: str
    """Name of the format."""
    steering: NDArray[np.float32]
    """Recorded steering, -1 to 1, positive to the right."""
    throttle: NDArray[np.float32]
    """0 to 1, -1 to 1 in tubs; NaN where it was not recorded."""
    brake: NDArray[np.float32]
    """0 to 1; NaN where it was not recorded."""
    speed_mph: NDArray[np.float32]
    """Miles per hour; NaN where it was not recorded."""
    time_s: NDArray[np.float64]
    """Seconds since the first row."""
    line: NDArray[np.uint32]
    """Line of the log, from 1."""
    session: NDArray[np.uint32]
    """Number, from 0, of the session, an unbroken drive."""
    cameras: List[str]
    """Of ``centre``, ``left`` and ``right`` those that there are."""
    rate_hz: Optional[float]
    """Median number of rows a second."""
    driven_s: float
    """Seconds driven, breaks left out."""
    unusable: Dict[str, Any]
    """Rows left out, by reason, with examples."""

    def __init__(self, path: Union[str, "os.PathLike[str]"], *, description: Optional[Dict[str, Any]] = None) -> None:
        """Reads a recording.

        ``description`` says what would stand in ``steersman.toml`` beside the log, as in ``{"unit": "degrees", "hz": 30}``.
        Raises DataError, FileError or UsageError.
        """

    def __len__(self) -> int: ...
    def path_labels(self, look_ahead_s: float = 0.7) -> NDArray[np.float32]:
        """The steering that follows the driven path, aimed at ``look_ahead_s`` seconds ahead: float32 ``(n,)``, smoother than a
        person's wheel. NaN near the end of a session and where the car stands."""

    def image(self, row: int, camera: str = "centre") -> NDArray[np.uint8]:
        """The image of a camera at a row: uint8 ``(height, width, 3)``, RGB."""

    def images(self, rows: Optional[Sequence[int]] = None, camera: str = "centre", *, threads: int = 0) -> NDArray[np.uint8]:
        """The images at ``rows``, of all rows by default: uint8 ``(n, height, width, 3)``. They must have the same size. A row of
        320x160 pixels takes 150 KiB."""

    def image_path(self, row: int, camera: str = "centre") -> Optional[Path]:
        """Path of the image file, if there is one."""

class Simulation:
    """The simulator behind :class:`steersman.Simulator`."""

    track: str
    length_m: float
    held_out: bool

    def __init__(self, track: str) -> None: ...
    def reset(
        self,
        seed: int,
        *,
        laps: int,
        speed_mph: float,
        driver_throttle: bool,
        latency_ms: float,
        noise: float,
        assisted: bool,
    ) -> Dict[str, Any]: ...
    def step(self, steering: float, throttle: Optional[float] = None) -> Dict[str, Any]: ...

_Progress = Optional[Callable[[Dict[str, Any]], Any]]
_Path = Union[str, "os.PathLike[str]"]

def train(recordings: Sequence[_Path], settings: Dict[str, Any], progress: _Progress = None) -> Path: ...
def resume(folder: _Path, threads: int = 0, progress: _Progress = None) -> None: ...
def read_run(folder: _Path) -> Dict[str, Any]: ...
def trajectory_columns() -> List[str]: ...
def drive(
    driver: Any, track: str, settings: Dict[str, Any], progress: _Progress = None
) -> Tuple[Dict[str, Any], List[Dict[str, Any]]]: ...
def record(track: str, out: _Path, settings: Dict[str, Any], progress: _Progress = None) -> None: ...
def evaluate(
    model: Model,
    recordings: Sequence[_Path],
    look_ahead_s: float,
    description: Optional[Dict[str, Any]],
    threads: int,
    progress: _Progress = None,
) -> Tuple[Dict[str, Any], NDArray[np.float64]]: ...
