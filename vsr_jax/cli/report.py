"""Reports of a solved scene, as lines of text and as a record for JSON."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..solution.summary import Summary
from ..typing import VectorLike

_VALUES = ("tip", "stability", "forces", "lengths", "slack")
"""Quantities of a report besides those along the arm."""


Values = Mapping[str, Any]
"""Quantities of a report by name."""


def values(eq: Equilibrium) -> Values | None:
    """What `lines` needs; None for a solve that failed."""
    return {name: eq.value(name) for name in _VALUES} if bool(eq.converged) else None


def summary(eq: Equilibrium, stations: VectorLike) -> Summary | None:
    """What `record` needs, and with its `values` `lines`; None for a solve that failed.

    **Arguments:** `eq`: one equilibrium; `stations`: their number, or their abscissas [m].
    """
    return eq.summary(stations, _VALUES) if bool(eq.converged) else None


def lines(
    eq: Equilibrium, found: Values | None, title: str = "", *, error: bool = False
) -> list[str]:
    """A report of an equilibrium: status, tip, stability margin, and the input, force and length of
    each thread.

    **Arguments:** `eq`: one equilibrium, converged or not; `found`: its `values`; `title`: a first
    line; `error`: whether to report the distance of the tip from that of a finer solve.
    """
    text = [title, *eq.heading] if title else list(eq.heading)
    if found is None:
        return text
    tip = np.asarray(found["tip"])
    text.append(f"  tip        {_vector(tip[:3, 3])} m")
    if error:
        finer = solve(eq.given_scene, eq.inputs, model=eq.model.finer())
        far = float(np.linalg.norm(np.asarray(finer.tip)[:3, 3] - tip[:3, 3]))
        text.append(f"  error      {far:.2g} m of the tip from a finer solve, with {eq.model}")
    text += [
        f"  its {name} axis {_vector(axis)}"
        for name, axis in zip("xyz", tip[:3, :3].T, strict=True)
    ]
    text.append(
        f"  stability  {float(found['stability']):.4g} (1 without forces, 0 where the equilibrium "
        f"loses stability)"
    )
    return text + _threads(eq, found)


def record(eq: Equilibrium, found: Summary | None) -> dict[str, Any]:
    """An equilibrium as numbers, strings and lists, with None for quantities that a failed solve
    does not have.

    **Arguments:** `eq`: one equilibrium; `found`: its `summary`.

    **Returns:** `model`, `precision`, `inputs`, `status` as a message, `converged`, `steps`,
    `loosened`, `restarted`; `tip` (pose, 4 x 4); at the stations `X` [m] the `position` [m] and the
    `strain` (k [1/m], u [-]); for each thread the `force` [N] at its start, negative where it
    pulls, the `length` [m] and the `slack` [m]; `stability`.
    """
    solved: dict[str, Any] = dict.fromkeys(
        ("tip", "X", "position", "strain", "force", "length", "slack", "stability")
    )
    if found is not None:
        values = (
            found.tip,
            found.X,
            found.position,
            found.strain,
            found.forces,
            found.lengths,
            found.slack,
            found.stability,
        )
        solved = {
            name: np.asarray(value).tolist() for name, value in zip(solved, values, strict=True)
        }
    return {
        "model": type(eq.model).__name__,
        "precision": str(eq.inputs.dtype),
        "inputs": np.asarray(eq.inputs).tolist(),
        "status": eq.message,
        "converged": bool(eq.converged),
        "steps": int(eq.steps),
        "loosened": bool(eq.loosened),
        "restarted": bool(eq.restarted),
        **solved,
    }


def _threads(eq: Equilibrium, found: Values) -> list[str]:
    actuators, given = eq.scene.actuators, eq.given_scene.inputs
    values = [f"{_number(value)} {one.unit}" for one, value in zip(given, eq.inputs, strict=True)]
    columns = [
        ["", *map(str, range(len(actuators)))],
        ["actuator", *(type(actuator).__name__ for actuator in actuators)],
        ["input", *values[: len(actuators)]],
        ["force [N]", *map(_number, found["forces"])],
        ["length [m]", *map(_number, found["lengths"])],
    ]
    if eq.scene.length_driven:
        columns.append(["slack [m]", *map(_number, found["slack"])])
    table = _table(list(zip(*columns, strict=True))) if actuators else []
    driven = list(zip(given, values, strict=True))[len(actuators) :]
    return table + _table([("driven", "input")] * bool(driven) + [(x.name, y) for x, y in driven])


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  "
        + "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def _vector(values: Any) -> str:
    return "(" + ", ".join(map(_number, values)) + ")"


def _number(value: Any) -> str:
    return f"{float(value) + 0.0:.6g}"  # + 0.0 turns -0 into 0
