"""Figures of a design: history of the objective, the arm before and after."""

from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D

from ..optimization.design_search import Design
from ..optimization.objective import CurveError, Objective, TipError
from ..solution.solver import solve
from ..typing import ArrayLike
from . import annotate, plot
from .space import checked_space, equal_scale, fit_height
from .style import COLORS, ink


def history(design: Design, ax: Axes | None = None) -> Axes:
    """Best feasible objective so far against the steps, one line per start, the best start in
    colour.

    **Arguments:** `ax`: axes, new ones by default.

    **Returns:** the axes, logarithmic if all values are positive.
    """
    ax = plt.subplots(figsize=(5, 3.2), layout="constrained")[1] if ax is None else ax
    feasible = np.where(design.history.violation <= 0, design.history.objective, np.inf)
    so_far = np.minimum.accumulate(np.where(np.isnan(feasible), np.inf, feasible), axis=0)
    so_far[np.isinf(so_far)] = np.nan
    best = design.best
    for i in [*(i for i in range(so_far.shape[1]) if i != best), best]:
        style = (
            {"color": COLORS[0], "linewidth": 2.0, "label": "best start"}
            if i == best
            else {"color": ink(0.35), "linewidth": 0.9}
        )
        ax.plot(np.arange(1, len(so_far) + 1), so_far[:, i], **style)
    if np.nanmin(so_far, initial=np.inf) > 0:
        ax.set_yscale("log")
    ax.set(xlabel="step", ylabel="best feasible objective")
    ax.legend(frameon=False)
    return ax


def before_after(
    design: Design, ax: Axes3D | None = None, *, targets: ArrayLike | None = None
) -> Axes3D:
    """The arms of the initial scene that have an equilibrium (dashed) and the arms of the design,
    one for each set of inputs.

    **Arguments:** `ax`: 3D axes, new ones by default; `targets`: positions [m] drawn as crosses,
    shape (..., 3), by default those of the objective.

    **Returns:** the axes.
    """
    own, ax = ax is None, checked_space(ax)
    problem = design.problem
    before, after = (
        [solve(what.scene, row, model=problem.model) for row in what.inputs]
        for what in (problem, design)
    )
    for name, arms, color, line in (
        ("before", before, COLORS[1], "--"),
        ("after", after, COLORS[0], "-"),
    ):
        solved = [eq for eq in arms if bool(eq.converged)]
        for i, eq in enumerate(solved):
            label = None if i else name
            style: dict[str, Any] = {"color": color, "label": label, "linestyle": line}
            plot.arm(eq, ax, stations=40, **style)
    if after and bool(after[0].converged):
        annotate.obstacles(after[0], ax)
    points = np.asarray(_targets(problem.objective) if targets is None else targets)
    if points.size:
        cross: dict[str, Any] = {"color": ink(), "marker": "x", "s": 28, "linewidths": 1.6}
        crosses: Any = points.reshape(-1, 3).T
        ax.scatter(*crosses, label="target", depthshade=False, **cross)
    equal_scale(ax, thinnest=0.2)
    if own:
        fit_height(ax, (0.0, 0.0, 0.95, 0.92))
    corner = {"bbox_to_anchor": (0.01, 0.99), "bbox_transform": ax.figure.transFigure}
    ax.legend(loc="upper left", ncols=3, **(corner if own else {}))
    return ax


def _targets(objective: Objective) -> np.ndarray:
    """Positions [m] that an objective asks for, those of its terms too, shape (points, 3)."""
    found = []
    for part in jax.tree.leaves(objective, is_leaf=lambda x: isinstance(x, TipError | CurveError)):
        if isinstance(part, TipError):
            poses = np.asarray(part.targets)
            found.append(poses if poses.ndim == 2 else poses[:, :3, 3])
        elif isinstance(part, CurveError):
            found.append(np.asarray(part.points).reshape(-1, 3))
    return np.concatenate([np.zeros((0, 3)), *found])
