"""Arguments that are one path or several."""

import os
from typing import Iterable, List, Union

Path = Union[str, "os.PathLike[str]"]
Paths = Union[Path, Iterable[Path]]


def several(paths: Paths) -> List[str]:
    """The paths as strings; one alone is a list of it."""
    if isinstance(paths, (str, os.PathLike)):
        return [os.fspath(paths)]
    return [os.fspath(path) for path in paths]
