"""Figures of a design: history of the objective, the arm before and after."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from mpl_toolkits.mplot3d import Axes3D

from ..arm.scene import Scene
from ..models.base import Model
from ..optimization.design_search import Design
from ..solution.solver import solve
from . import plot
from .plot import COLORS


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
            else {"color": "0.7", "linewidth": 0.9}
        )
        ax.plot(np.arange(1, len(so_far) + 1), so_far[:, i], **style)
    if np.nanmin(so_far, initial=np.inf) > 0:
        ax.set_yscale("log")
    ax.set(xlabel="step", ylabel="best feasible objective")
    ax.legend(frameon=False)
    return ax


def before_after(
    scene: Scene,
    design: Design,
    inputs: ArrayLike | Sequence,
    ax: Axes3D | None = None,
    *,
    model: Model | None = None,
) -> Axes3D:
    """The arm of the initial scene, if it has an equilibrium, and the arm of the design for its
    first set of inputs.

    **Arguments:** `scene`, `inputs`: before the design; `ax`: 3D axes, new ones by default;
    `model`: as for `solve`.

    **Returns:** the axes.
    """
    before = solve(scene, inputs, model=model)
    if bool(before.converged):
        ax = plot.arm(before, ax, color=COLORS[1], label="before", linestyle="--")
    space = plot.arm(solve(design.scene, design.inputs[0], model=model), ax, label="after")
    space.legend(frameon=False)
    return space
