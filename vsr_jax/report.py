"""A solved scene for people and for programs: lines of text, and a record that goes into JSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from .equilibrium import Equilibrium
from .plot import Samples


def lines(eq: Equilibrium, title: str = "") -> list[str]:
    """An equilibrium in a few lines: status, tip, margin of stability, and of each thread its input, force and length.

    **Arguments:** `eq`: one equilibrium, solved or not; `title`: a first line.
    """
    method = f"{type(eq.model).__name__}, {eq.inputs.dtype}, {int(eq.steps)} steps"
    text = [title] if title else []
    text.append(f"  status     {eq.message} ({method})")
    text.append(f"  effects    {', '.join(eq.scene.effects) or 'none'}")
    if not bool(eq.converged):
        return text
    tip = np.asarray(eq.tip)
    text.append(f"  tip        {_vector(tip[:3, 3])} m")
    text += [f"  its {name} axis {_vector(axis)}" for name, axis in zip("xyz", tip[:3, :3].T, strict=True)]
    text.append(f"  stability  {float(eq.stability):.4g} (1 without forces, 0 where the equilibrium ceases to be stable)")
    return text + _threads(eq)


def record(eq: Equilibrium, samples: Samples | None) -> dict[str, Any]:
    """An equilibrium as numbers, texts and lists, with None for what a failed solve does not know.

    **Arguments:** `eq`: one equilibrium; `samples`: the same at the stations to tell of, None for a failed solve.

    **Returns:** `model`, `precision`, `inputs`, `status` in words, `converged`, `steps`; `tip` (pose, 4 x 4); at the
    stations `X` [m] the `position` [m] and the `strain` (k [1/m], u [-]); of each thread the `force` [N] at its start, negative
    where it pulls, the `length` [m] and the `slack` [m]; `stability`.
    """
    solved: dict[str, Any] = dict.fromkeys(("tip", "X", "position", "strain", "force", "length", "slack", "stability"))
    if samples is not None:
        values = (eq.tip, samples.X, samples.position, samples.strain, eq.forces, eq.lengths, eq.slack, eq.stability)
        solved = {name: np.asarray(value).tolist() for name, value in zip(solved, values, strict=True)}
    return {
        "model": type(eq.model).__name__,
        "precision": str(eq.inputs.dtype),
        "inputs": np.asarray(eq.inputs).tolist(),
        "status": eq.message,
        "converged": bool(eq.converged),
        "steps": int(eq.steps),
        **solved,
    }


def _threads(eq: Equilibrium) -> list[str]:
    actuators = eq.scene.actuators
    columns = [
        ["", *map(str, range(len(actuators)))],
        ["actuator", *(type(actuator).__name__ for actuator in actuators)],
        ["input", *(f"{_number(value)} {actuator.unit}" for actuator, value in zip(actuators, eq.inputs, strict=True))],
        ["force [N]", *map(_number, eq.forces)],
        ["length [m]", *map(_number, eq.lengths)],
    ]
    if eq.scene.length_driven:
        columns.append(["slack [m]", *map(_number, eq.slack)])
    return _table(list(zip(*columns, strict=True))) if actuators else []


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  " + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _vector(values: Any) -> str:
    return "(" + ", ".join(map(_number, values)) + ")"


def _number(value: Any) -> str:
    return f"{float(value) + 0.0:.6g}"  # + 0.0 makes -0 a plain 0
