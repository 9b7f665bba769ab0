"""The package as a package: stubs, docstrings, types."""

import ast
import inspect
from pathlib import Path

import pytest

import steersman
from steersman import _native

FOLDER = Path(steersman.__file__).parent


def test_types_are_shipped():
    assert (FOLDER / "py.typed").is_file() and (FOLDER / "_native.pyi").is_file()


def test_the_stubs_name_what_there_is():
    stubs = ast.parse((FOLDER / "_native.pyi").read_text())
    for item in stubs.body:
        if isinstance(item, ast.FunctionDef):
            parameters = [*item.args.args, *item.args.kwonlyargs]
            assert [p.arg for p in parameters] == list(inspect.signature(getattr(_native, item.name)).parameters), item.name
        if isinstance(item, ast.ClassDef):
            there = {name for name in vars(getattr(_native, item.name)) if not name.startswith("_")}
            named = set()
            for entry in item.body:
                if isinstance(entry, ast.FunctionDef):
                    named.add(entry.name)
                elif isinstance(entry, ast.AnnAssign):
                    named.add(entry.target.id)
            assert there == {name for name in named if not name.startswith("_")}, item.name


def test_everything_has_a_docstring():
    for name in steersman.__all__:
        thing = getattr(steersman, name)
        if inspect.isfunction(thing) or inspect.isclass(thing) and thing.__module__.startswith("steersman._"):
            assert inspect.getdoc(thing), name
    stubs = ast.parse((FOLDER / "_native.pyi").read_text())
    for item in stubs.body:
        if isinstance(item, ast.ClassDef) and item.name in ("Model", "Recording"):
            for entry in item.body:
                if isinstance(entry, ast.FunctionDef) and not entry.name.startswith("__"):
                    assert ast.get_docstring(entry), f"{item.name}.{entry.name}"


def test_types_are_consistent(tmp_path):
    api = pytest.importorskip("mypy.api")
    (tmp_path / "user.py").write_text(
        "import numpy as np\n"
        "import steersman\n"
        "model = steersman.Model.load('m.safetensors')\n"
        "steering: float = model.steer(np.zeros((160, 320, 3), dtype=np.uint8))\n"
        "run: steersman.Run = steersman.train('data/sample', set={'epochs': 1})\n"
        "drive: steersman.Drive = steersman.drive(model, 'lake')\n"
        "env = steersman.Simulator('lake')\n"
    )
    out, err, code = api.run(["--strict", "--ignore-missing-imports", "--cache-dir", str(tmp_path), str(tmp_path / "user.py")])
    assert code == 0, out + err
