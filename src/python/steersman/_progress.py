"""How long calls show what they do: a bar of tqdm in terminal and notebook where that is installed, else lines on standard error."""

import sys
import time
import warnings
from typing import Any, Callable, Dict, Optional, Union

Event = Dict[str, Any]
"""What happens, for a function that is given as ``progress``: ``{"share": 0 to 1}``; ``{"begin": what}``; ``{"folder": of the run}``; a batch ``{"epoch", "epochs",
"images", "of", "loss"}``; the end of an epoch ``{"epochs", "record": {...}}``. Batches are told at most 20 times a second."""

Progress = Union[None, bool, Callable[[Event], Any]]
"""None or True: shown; False: silent; a function: called with each :data:`Event`. What it raises ends the work."""

_INTERVAL_S = 10.0
"""Time between plain lines."""


def _tqdm() -> Optional[Any]:
    try:
        with warnings.catch_warnings():
            # In a notebook without ipywidgets tqdm warns and falls back to text.
            warnings.simplefilter("ignore")
            from tqdm.auto import tqdm
    except ImportError:
        return None
    return tqdm


class Display:
    """Shows events; ends with :meth:`close`."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._tqdm = _tqdm()
        self._bar: Any = None
        self._epoch = 0
        self._last_line_s = time.monotonic()

    def __call__(self, event: Event) -> None:
        if "share" in event:
            self._show(self._what, 100.0 * event["share"], 100.0, "%")
        elif "begin" in event:
            self.close()
            self._what = event["begin"]
        elif "images" in event:
            if event["epoch"] != self._epoch:
                self.close()
                self._epoch = event["epoch"]
            what = f"epoch {event['epoch']}/{event['epochs']}"
            self._show(what, event["images"], event["of"], "image", f"loss {event['loss']:.4f}")
        elif "record" in event:
            self.close()
            self._print(self._line(event["record"], event["epochs"]))

    @staticmethod
    def _line(record: Dict[str, Any], epochs: int) -> str:
        def number(name: str, decimals: int) -> str:
            value = record.get(name)
            return "-" if value is None else f"{value:.{decimals}f}"

        rate = record["images"] / max(record["train_seconds"], 1e-9)
        return (
            f"epoch {record['epoch']:>2}/{epochs}  loss {record['train_loss']:.4f}  val {number('val_mse', 4)}  "
            f"MAE {number('val_mae_deg', 2)} deg  {number('relative_to_zero', 2)} of zero's  {rate:.0f} images/s  "
            f"{record['seconds']:.1f} s"
        )

    def _show(self, what: str, done: float, of: float, unit: str, postfix: str = "") -> None:
        if self._tqdm is None:
            if time.monotonic() - self._last_line_s >= _INTERVAL_S:
                self._print(f"{what}: {done:.0f}/{of:.0f} {unit} {postfix}".rstrip())
            return
        if self._bar is None:
            shape = "{l_bar}{bar}| {n:.0f}/{total:.0f} [{elapsed}<{remaining}{postfix}]"
            self._bar = self._tqdm(total=of, desc=what, unit=unit, bar_format=shape, leave=False)
        if postfix:
            self._bar.set_postfix_str(postfix, refresh=False)
        # Threads may report out of order; the bar never runs backwards.
        self._bar.update(max(0.0, done - self._bar.n))

    def _print(self, line: str) -> None:
        self._last_line_s = time.monotonic()
        if self._tqdm is None:
            print(line, file=sys.stderr, flush=True)
        else:
            self._tqdm.write(line, file=sys.stderr)

    def close(self) -> None:
        """Takes the bar away."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None


class shown:
    """Context with the function that a native call tells its progress, or None."""

    def __init__(self, progress: Progress, what: str) -> None:
        self._display = Display(what) if progress is None or progress is True else None
        self._function = progress if callable(progress) else self._display

    def __enter__(self) -> Optional[Callable[[Event], Any]]:
        return self._function

    def __exit__(self, *_: object) -> None:
        if self._display is not None:
            self._display.close()
