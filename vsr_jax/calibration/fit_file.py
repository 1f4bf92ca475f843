"""Fits as TOML files, with measurements in a CSV file.

title = "A tentacle"
scene = "tentacle.toml"    # relative to this file; or a table [scene], as in a scene file

[data]
file = "holds.csv"         # relative to this file; an empty cell is missing
inputs = ["tension_1", "tension_2"]    # a column for each actuator
inputs_scale = 1.0         # factor to the units of the actuators, one number or one each
series = "series"          # a column; optional

[[observations]]           # arguments of the class, with columns in place of the measured values
type = "Markers"           # or Curvatures, Tensions, Reactions, ContactForces
columns = ["p1_x", "p1_y", "p1_z", "p2_x", "p2_y", "p2_z"]    # all of a row together
scale = 0.001              # factor to SI units
X = [0.1, 0.2]
sd = 2e-4

[free]
"rod.material.young" = [1e5, 1e6]
"rod.material.density" = { low = 900.0, high = 1300.0, prior = [1080.0, 30.0] }
"actuators[*].friction" = { low = 0.0, high = 0.5, shared = true }

[fit]                      # arguments of `fit`, all optional: loss, starts, steps, seed
loss = "huber"
"""

import csv
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..arm.scene import Scene
from ..files.scene_file import at, check_keys, construct, kind_of, load, parse_table
from ..typing import PathLike
from ..validation import instance
from .force_observations import ContactForces, Reactions, Tensions
from .measurements import Measurements
from .observation import Curvatures, Markers, Observation
from .unknowns import Free, Unknown

_KEYS = ("title", "scene", "data", "observations", "free", "fit")
_DATA_KEYS = ("file", "inputs", "inputs_scale", "series")
_OPTIONS = ("loss", "starts", "steps", "seed")
_KINDS: dict[str, tuple[type, str, int]] = {
    "Markers": (Markers, "position", 3),
    "Curvatures": (Curvatures, "curvature", 2),
    "Tensions": (Tensions, "tension", 1),
    "Reactions": (Reactions, "force", 3),
    "ContactForces": (ContactForces, "force", 3),
}
"""Class, name of the argument with the measured values, and columns per row."""


class FitFile(NamedTuple):
    """Contents of a file: its `title`, arguments of `fit`, and `options`, more of them by name."""

    title: str
    scene: Scene
    free: Free
    data: Measurements
    options: dict[str, Any]


def load_fit(path: PathLike) -> FitFile:
    """Reads a fit from a TOML file and the CSV file that it names.

    **Raises:** a one-line `ValueError` that begins with the file's name, as `load`.
    """
    file = Path(path)
    try:
        return _parsed(tomllib.loads(file.read_text(encoding="utf-8")), file.parent)
    except OSError as error:
        raise ValueError(f"{path}: {error.filename}: {error.strerror}") from None
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {error}") from None


def _known(table: dict[str, Any], path: str, keys: tuple[str, ...], needed: tuple = ()) -> None:
    known = ", ".join(sorted(keys))
    for key in table:
        if key not in keys:
            raise ValueError(at(path, f"unknown key {key!r}, known are {known}"))
    for key in needed:
        if key not in table:
            raise ValueError(at(path, f"missing key {key!r}, known are {known}"))


def _parsed(table: dict[str, Any], folder: Path) -> FitFile:
    _known(table, "", _KEYS, ("scene", "data", "observations", "free"))
    scene = instance("scene", table["scene"], str | dict, "a file or a table [scene]")
    file = load(folder / scene) if isinstance(scene, str) else parse_table(scene, "scene")
    options = instance("fit", table.get("fit", {}), dict, "a table [fit]")
    _known(options, "fit", _OPTIONS)
    free = instance("free", table["free"], dict, "a table [free] of bounds")
    return FitFile(
        str(table.get("title", "")),
        file.scene,
        {name: _unknown(name, value) for name, value in free.items()},
        _measurements(table, folder),
        options,
    )


def _unknown(name: str, value: Any) -> Any:
    if not isinstance(value, dict):
        return value
    check_keys(Unknown, value, f"free[{name!r}]")
    return Unknown(**value)


def _measurements(table: dict[str, Any], folder: Path) -> Measurements:
    data = instance("data", table["data"], dict, "a table [data]")
    _known(data, "data", _DATA_KEYS, ("file", "inputs"))
    name = instance("data.file", data["file"], str, "the name of a CSV file")
    rows = _read(folder / name)
    inputs = _numbers(rows, data["inputs"], "data.inputs", name)
    kinds = instance("observations", table["observations"], list, "tables [[observations]]")
    observations = [
        _observation(one, f"observations[{i}]", rows, name) for i, one in enumerate(kinds)
    ]
    series = data.get("series")
    if series is not None and series not in rows[0]:
        raise ValueError(f"data.series: {name} has no column {series!r}")
    return Measurements(
        inputs * np.asarray(data.get("inputs_scale", 1.0), float),
        observations,
        series=None if series is None else [row[series] for row in rows],
    )


def _observation(table: Any, path: str, rows: list[dict[str, str]], file: str) -> Observation:
    instance(path, table, dict, "a table under [[observations]]")
    kinds = {name: kind for name, (kind, _, _) in _KINDS.items()}
    kind, argument, size = _KINDS[kind_of(table, path, kinds).__name__]
    if "columns" not in table:
        raise ValueError(f"{path}: missing key 'columns', the columns of the measured values")
    values = _numbers(rows, table["columns"], f"{path}.columns", file)
    if values.shape[1] % size:
        raise ValueError(
            f"{path}.columns: got {values.shape[1]} columns, need {size} for each row of a "
            f"{kind.__name__}"
        )
    values = values * float(table.get("scale", 1.0))
    rest = {key: x for key, x in table.items() if key not in ("type", "columns", "scale")}
    shaped = values.reshape(len(rows), -1, size) if size > 1 else values
    return construct(kind, {argument: shaped, **rest}, path)


def _read(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    if not rows:
        raise ValueError(f"{path.name}: got no rows, need a row of names and one for each shape")
    return rows


def _numbers(rows: list[dict[str, str]], columns: Any, path: str, file: str) -> np.ndarray:
    """Columns of a CSV file as numbers, shape (rows, columns); an empty cell is NaN."""
    names = [columns] if isinstance(columns, str) else instance(path, columns, list, "columns")
    for name in names:
        if name not in rows[0]:
            raise ValueError(f"{path}: {file} has no column {name!r}, but {', '.join(rows[0])}")
    found = np.full((len(rows), len(names)), np.nan)
    for i, row in enumerate(rows):
        for j, name in enumerate(names):
            text = (row[name] or "").strip()
            try:
                found[i, j] = float(text) if text else np.nan
            except ValueError:
                raise ValueError(
                    f"{file}: got {text!r} in line {i + 2}, column {name!r}, need a number"
                ) from None
    return found
