"""Reports of a solved scene and of the health of a solve, as lines of text and as records for
JSON."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..analysis.health import MOST_FACTOR, Health, Limit
from ..models.base import Status
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..solution.summary import Summary


def lines(eq: Equilibrium, title: str = "", *, error: bool = False) -> list[str]:
    """A report of an equilibrium: status, tip, stability margin, and the input, force and length of
    each thread.

    **Arguments:** `eq`: one equilibrium, converged or not; `title`: a first line; `error`: whether
    to report the distance of the tip from that of a finer solve.
    """
    method = f"{type(eq.model).__name__}, {eq.inputs.dtype}, {int(eq.steps)} steps"
    text = [title] if title else []
    text.append(f"  status     {eq.message} ({method})")
    text.append(f"  effects    {', '.join(eq.scene.effects) or 'none'}")
    if not bool(eq.converged):
        return text
    tip = np.asarray(eq.tip)
    text.append(f"  tip        {_vector(tip[:3, 3])} m")
    if error:
        finer = solve(eq.scene, eq.inputs, model=eq.model.finer())
        far = float(np.linalg.norm(np.asarray(finer.tip)[:3, 3] - tip[:3, 3]))
        text.append(f"  error      {far:.2g} m of the tip from a finer solve, with {eq.model}")
    text += [
        f"  its {name} axis {_vector(axis)}"
        for name, axis in zip("xyz", tip[:3, :3].T, strict=True)
    ]
    text.append(
        f"  stability  {float(eq.stability):.4g} (1 without forces, 0 where the equilibrium "
        f"loses stability)"
    )
    return text + _threads(eq)


def record(eq: Equilibrium, samples: Summary | None) -> dict[str, Any]:
    """An equilibrium as numbers, strings and lists, with None for quantities that a failed solve
    does not have.

    **Arguments:** `eq`: one equilibrium; `samples`: its summary at the stations to report, None for
    a failed solve.

    **Returns:** `model`, `precision`, `inputs`, `status` as a message, `converged`, `steps`; `tip`
    (pose, 4 x 4); at the stations `X` [m] the `position` [m] and the `strain` (k [1/m], u [-]); for
    each thread the `force` [N] at its start, negative where it pulls, the `length` [m] and the
    `slack` [m]; `stability`.
    """
    solved: dict[str, Any] = dict.fromkeys(
        ("tip", "X", "position", "strain", "force", "length", "slack", "stability")
    )
    if samples is not None:
        values = (
            eq.tip,
            samples.X,
            samples.position,
            samples.strain,
            eq.forces,
            eq.lengths,
            eq.slack,
            eq.stability,
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
        **solved,
    }


def health_lines(health: Health, title: str = "") -> list[str]:
    """A report of the health of a solve, with warnings and advice at the end."""
    eq, length = health.equilibrium, float(health.equilibrium.scene.rod.length)
    text = lines(eq, title)[: 3 if title else 2]
    if bool(eq.converged):
        digits = -np.log10(float(np.finfo(eq.inputs.dtype).eps) * float(eq.condition))
        text.append(
            f"  margin       {float(eq.stability):.4g} (1 without forces, 0 where the equilibrium "
            f"loses stability)"
        )
        text.append(
            f"  condition    {float(eq.condition):.3g}: about {max(0, int(digits))} digits of the "
            f"strains are accurate"
        )
        moved = float(health.tip_change)
        told = (
            f"move the tip by {moved:.2g} m, {moved / length:.1g} of the length"
            if np.isfinite(moved)
            else "do not converge"
        )
        text.append(f"  resolution   finer steps {told}")
    text += [
        f"  {name:12} {_reach(limit)}"
        for name, limit in (("inputs", health.inputs), ("loads", health.loads))
        if limit is not None
    ]
    if health.independence is not None:
        text.append(
            f"  independence {float(health.independence):.2g} of the threads (0: some are "
            f"redundant, 1: all independent)"
        )
    text += [f"  warning      {sentence}" for sentence in health.warnings]
    return text + [f"  advice       {sentence}" for sentence in _advice(health)]


def health_record(health: Health) -> dict[str, Any]:
    """The health of a solve as numbers and strings, with None for unknown quantities.

    **Returns:** `status` as a message, `converged`, `margin`, `condition`, `independence`; `inputs`
    and `loads`, each with the largest `factor` by which they may grow and the message of the status
    beyond it, `then`; `tip_change` [m] by finer steps; `warnings` and `advice`, lists of sentences.
    """
    eq = health.equilibrium

    def known(value: Any) -> float | None:
        return None if value is None or not np.isfinite(value) else float(value)

    def limit(found: Limit | None) -> dict[str, Any] | None:
        return (
            None
            if found is None
            else {"factor": float(found.factor), "then": Status(int(found.status)).message}
        )

    return {
        "status": eq.message,
        "converged": bool(eq.converged),
        "margin": known(eq.stability),
        "condition": known(eq.condition),
        "independence": known(health.independence),
        "inputs": limit(health.inputs),
        "loads": limit(health.loads),
        "tip_change": known(health.tip_change),
        "warnings": list(health.warnings),
        "advice": _advice(health),
    }


def _reach(limit: Limit) -> str:
    if int(limit.status) == Status.CONVERGED:
        return f"may grow together to at least {MOST_FACTOR:g} times"
    return (
        f"may grow together to {float(limit.factor):.4g} times; "
        f"then {Status(int(limit.status)).message}"
    )


def _advice(health: Health) -> list[str]:
    """Advice, the most urgent first; one sentence that says so if there is none."""
    eq, length = health.equilibrium, float(health.equilibrium.scene.rod.length)
    if not bool(eq.converged):
        return [_REMEDIES[Status(int(eq.status))].format(eq.model.finer())]
    near = [
        f"close to failure: {name} may grow by {100 * (float(limit.factor) - 1):.2g} % at most"
        for name, limit in (("inputs", health.inputs), ("loads", health.loads))
        if limit is not None and 1 <= limit.factor < 1.25
    ]
    advice = near + [
        "the equilibrium is nearly unstable: small model errors cause large displacements"
    ] * (float(eq.stability) < 0.1)
    if not float(health.tip_change) < 1e-3 * length:
        advice.append(f"take more steps: {eq.model.finer()!r}")
    if health.independence is not None and health.independence < 1e-9:
        advice.append(
            "some threads are redundant: their forces cannot be inferred from the shape (the solve "
            "is not affected)"
        )
    return advice or ["no problems found"]


_REMEDIES = {
    Status.NOT_CONVERGED: "increase the inputs gradually with vsr.follow_branch, "
    "or check that loads and inputs are in SI units",
    Status.UNSTABLE: "the arm would snap: follow the branch with vsr.follow_branch, "
    "or lower inputs or loads to the factor above",
    Status.COLLAPSED: "lower the tensions to the factor above, or stiffen the rod: "
    "its axial stiffness limits the tensions",
    Status.NOT_FINITE: "check the scene and the inputs for NaN and infinities",
    Status.INADMISSIBLE: "tensions and pressures must not be negative; "
    "use a Thread where the force may have either sign",
    Status.UNDER_RESOLVED: "take more steps: {!r}, or still more",
}
"""Advice for a solve that failed."""


def _threads(eq: Equilibrium) -> list[str]:
    actuators = eq.scene.actuators
    columns = [
        ["", *map(str, range(len(actuators)))],
        ["actuator", *(type(actuator).__name__ for actuator in actuators)],
        [
            "input",
            *(
                f"{_number(value)} {actuator.unit}"
                for actuator, value in zip(actuators, eq.inputs, strict=True)
            ),
        ],
        ["force [N]", *map(_number, eq.forces)],
        ["length [m]", *map(_number, eq.lengths)],
    ]
    if eq.scene.length_driven:
        columns.append(["slack [m]", *map(_number, eq.slack)])
    return _table(list(zip(*columns, strict=True))) if actuators else []


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
