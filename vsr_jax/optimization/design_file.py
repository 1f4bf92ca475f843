"""Design problems as TOML files.

title = "A helix that reaches out"
scene = "helix.toml"    # relative to this file; or a table [scene], as in a scene file
inputs = [[5.0]]        # one row per set of inputs

[free]
"actuators[0].routing.radius" = [0.002, 0.009]
inputs = [0.0, 12.0]

[uncertain]
"rod.material.young" = 0.1

[[objectives]]
type = "TipError"
weight = 1.0
targets = [[0.5, 0.1, 0.2]]

[[constraints]]
type = "Inside"
wall = 0.001

[search]                # the arguments of `Search`, all optional, without `optimizer`
starts = 8
steps = 400
learning_rate = 0.05
"""

import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from ..analysis import constraint
from ..analysis.constraint import Constraint
from ..arm.scene import Scene
from ..files.scene_file import build, kind_of, load, parse_table
from ..typing import PathLike
from ..validation import instance
from . import objective
from .objective import Objective
from .problem import Bounds
from .search import Search


def _by_name(*kinds: type) -> dict[str, type]:
    return {kind.__name__: kind for kind in kinds}


_OBJECTIVES = _by_name(
    objective.TipError,
    objective.CurveError,
    objective.Workspace,
    objective.TipCompliance,
    objective.Tension,
)
_CONSTRAINTS = _by_name(
    constraint.Inside,
    constraint.MinSpacing,
    constraint.MaxTension,
    constraint.BendRadius,
    constraint.StabilityMargin,
    constraint.Clearance,
    constraint.MaxContactForce,
)
_KEYS = ("title", "scene", "inputs", "free", "uncertain", "objectives", "constraints", "search")


class DesignFile(NamedTuple):
    """Contents of a file: its `title`, and arguments of `design` by name."""

    title: str
    scene: Scene
    free: dict[str, Bounds]
    objective: Objective
    inputs: list[list[float]]
    constraints: list[Constraint]
    uncertain: dict[str, float]
    search: Search


def load_design(path: PathLike) -> DesignFile:
    """Reads a design problem from a TOML file.

    **Raises:** a one-line `ValueError` that begins with the file's name, as `load`.
    """
    file = Path(path)
    try:
        return _parsed(tomllib.loads(file.read_text(encoding="utf-8")), file.parent)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{path}: {error}") from None


def _parsed(table: dict[str, Any], folder: Path) -> DesignFile:
    known = ", ".join(sorted(_KEYS))
    unknown = [key for key in table if key not in _KEYS]
    if unknown:
        raise ValueError(f"unknown key {unknown[0]!r}, known are {known}")
    missing = [key for key in ("scene", "free", "objectives") if key not in table]
    if missing:
        raise ValueError(f"missing key {missing[0]!r}, known are {known}")
    scene = instance("scene", table["scene"], str | dict, "a file or a table [scene]")
    file = load(folder / scene) if isinstance(scene, str) else parse_table(scene, "scene")
    inputs = table.get("inputs", None if file.inputs is None else [file.inputs.tolist()])
    if inputs is None:
        raise ValueError("missing key 'inputs', and the scene has none")
    return DesignFile(
        str(table.get("title", "")),
        file.scene,
        instance("free", table["free"], dict, "a table [free] of bounds"),
        _objective(_tables(table, "objectives")),
        inputs,
        [
            _constraint(one, f"constraints[{i}]")
            for i, one in enumerate(_tables(table, "constraints"))
        ],
        instance("uncertain", table.get("uncertain", {}), dict, "a table [uncertain] of numbers"),
        _search(table.get("search", {})),
    )


def _tables(table: dict[str, Any], key: str) -> list[dict[str, Any]]:
    value = table.get(key, [])
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise ValueError(f"{key}: got {value!r}, need tables, each under [[{key}]]")
    return value


def _objective(tables: list[dict[str, Any]]) -> Objective:
    if not tables:
        raise ValueError("objectives: got none, need at least one table under [[objectives]]")
    parts = []
    for i, table in enumerate(tables):
        rest = {key: value for key, value in table.items() if key != "weight"}
        part = _made(rest, f"objectives[{i}]", _OBJECTIVES)
        parts.append(table["weight"] * part if "weight" in table else part)
    return parts[0] if len(parts) == 1 else objective.Sum(tuple(parts))


def _constraint(table: dict[str, Any], path: str) -> Constraint:
    return _made(table, path, _CONSTRAINTS)


def _search(table: dict[str, Any]) -> Search:
    if not isinstance(table, dict) or "optimizer" in table:
        raise ValueError(f"search: got {table!r}, need a table of numbers")
    return _made({"type": "Search", **table}, "search", _by_name(Search))


def _made(table: dict[str, Any], path: str, group: dict[str, type]) -> Any:
    kind = kind_of(table, path, group)
    arguments = {key: value for key, value in table.items() if key != "type"}
    return build(kind, arguments, path)
