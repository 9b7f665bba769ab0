"""Training, and what is in the folder of a run."""

import json
import os
from pathlib import Path
from typing import Any, Dict, Iterable, List, Mapping, Optional, Union

import numpy as np
from numpy.typing import NDArray

from steersman import _native
from steersman._native import Model
from steersman._paths import Path as PathLike
from steersman._paths import Paths, several
from steersman._progress import Progress, shown


class Run:
    """A training run: the folder with its history, its model and its report.

    >>> run = steersman.Run("runs/recording-1")  # doctest: +SKIP
    >>> run.history["val_mse"].min()  # doctest: +SKIP
    """

    def __init__(self, folder: PathLike) -> None:
        """Reads the run in ``folder``, finished or not. Raises UsageError if it is no run."""
        self.folder = Path(folder)
        content = _native.read_run(self.folder)
        self.result: Optional[Dict[str, Any]] = content["result"]
        """What ``train --json`` prints: errors of the best epoch, times, ``weights_hash``; None while the run is not finished."""
        self.replay: Optional[Dict[str, Any]] = content["replay"]
        """What the model is worth on its recordings: errors, and drives on their pictures; None if it was not judged."""
        self.recipe: Dict[str, Any] = content["recipe"]
        """The recipe with every entry resolved."""
        self.info: Dict[str, Any] = content["info"]
        """How it was begun: recordings, seed, version."""
        self._epochs: List[Dict[str, Any]] = content["history"]

    @property
    def history(self) -> Dict[str, NDArray[Any]]:
        """An array for each figure, with one entry an epoch: ``epoch`` and ``images`` (int64), the others float64, NaN where there
        is none. ``train_loss`` and ``val_mse`` are of normalised steering, ``val_mae_deg`` is in degrees of the front wheels,
        ``seconds`` in seconds."""
        names = list(dict.fromkeys(name for epoch in self._epochs for name in epoch))
        arrays: Dict[str, NDArray[Any]] = {}
        for name in names or ["epoch", "train_loss", "val_mse"]:
            values = [epoch.get(name) for epoch in self._epochs]
            if name in ("epoch", "images"):
                arrays[name] = np.array(values, dtype=np.int64)
            else:
                arrays[name] = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
        return arrays

    @property
    def model(self) -> Path:
        """Path of the model: the weights of the best epoch."""
        return self.folder / "model.safetensors"

    @property
    def report(self) -> Optional[Path]:
        """Path of the page about the run, if there is one."""
        page = self.folder / "report.html"
        return page if page.is_file() else None

    def load(self) -> Model:
        """The model."""
        return Model.load(self.folder)

    def __repr__(self) -> str:
        state = "finished" if self.result else "not finished"
        return f"<steersman.Run {str(self.folder)!r}, {len(self._epochs)} epochs, {state}>"


def _override(key: str, value: object) -> str:
    """An entry as ``--set`` takes it. What JSON and TOML write alike is written so."""
    return f"{key}={value if isinstance(value, str) else json.dumps(value)}"


def train(
    recordings: Paths,
    *,
    recipe: Optional[PathLike] = None,
    set: Union[Mapping[str, object], Iterable[str], None] = None,
    out: Optional[PathLike] = None,
    validate: Paths = (),
    with_simulator: Union[bool, float] = False,
    from_model: Optional[PathLike] = None,
    freeze: Iterable[str] = (),
    description: Optional[Mapping[str, Any]] = None,
    seed: int = 1,
    threads: int = 0,
    cache_mib: int = 1024,
    force_held_out: bool = False,
    progress: Progress = None,
) -> Run:
    """Trains a network on recordings, as ``steersman train`` does: the same seed gives the same weights, bit for bit.

    Args:
        recordings: one recording or several: folders, logs, or ``.zip`` and ``.tar.gz`` archives of them.
        recipe: a built-in recipe (``recording``, ``default``, ``calm``, ``lenet``, ``pilotnet``, ``hyper``, ``hyper-prelu``, ``donkey``) or a
            recipe file; ``recording`` by default, with ``from_model`` that of the model.
        set: entries of the recipe to change, as in ``{"epochs": 3, "optimizer.learning_rate": 1e-4}``.
        out: run folder, which must not exist or be empty; a new one under ``runs/`` by default.
        validate: recordings to validate on, whole, instead of a share of the rows.
        with_simulator: train on the simulator's set as well; a number is its share of each epoch's images.
        from_model: begin with the weights of this model where layers have the same name and shape.
        freeze: layers that keep the weights they were given, as in ``["conv1", "bn1"]``.
        description: what would stand in ``steersman.toml`` beside a log, as in ``{"unit": "degrees", "hz": 30}``.
        seed: seed of all random choices.
        threads: 0 is one for each core.
        cache_mib: memory for decoded images, MiB; what does not fit goes to a temporary file.
        force_held_out: train on recordings of held-out tracks all the same.
        progress: None shows it, False does not, a function gets each event (see :data:`steersman.Progress`).

    Returns:
        The finished run; its model was judged on the recordings, and ``report.html`` written.

    Raises:
        KeyboardInterrupt: at Ctrl-C, or when a notebook's cell is interrupted: after the current batch, with all saved;
            :func:`resume` goes on from there.
        UsageError, DataError, FileError: with the text of the command line.
    """
    overrides = [_override(key, value) for key, value in set.items()] if isinstance(set, Mapping) else list(set or ())
    if with_simulator is False:
        share = None
    else:
        share = (None,) if with_simulator is True else (float(with_simulator),)
    settings = {
        "recipe": None if recipe is None else os.fspath(recipe),
        "overrides": overrides,
        "out": out,
        "validate": several(validate),
        "with_simulator": share,
        "begin_with": from_model,
        "freeze": list(freeze),
        "description": None if description is None else dict(description),
        "seed": seed,
        "threads": threads,
        "cache_mib": cache_mib,
        "force_held_out": force_held_out,
    }
    with shown(progress, "training") as observer:
        folder = _native.train(several(recordings), settings, observer)
    return Run(folder)


def resume(run: Union[Run, PathLike], *, threads: int = 0, progress: Progress = None) -> Run:
    """Goes on with a run that was stopped, as if it had never stopped; judges a finished one again.

    Raises as :func:`train`.
    """
    folder = run.folder if isinstance(run, Run) else Path(run)
    with shown(progress, "training") as observer:
        _native.resume(folder, threads, observer)
    return Run(folder)
