"""Pictures of a design: how it went, and the arm before and after."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from ..arm.scene import Scene
from ..models.base import Model
from ..optimization.design_search import Design
from ..solution.solver import solve
from . import plot
from .plot import COLORS


def history(design: Design, ax: Any = None) -> Any:
    """The best feasible objective so far over the steps, a line for each start, the one that was
    chosen in colour.

    **Arguments:** `ax`: axes, new ones by default.

    **Returns:** the axes; logarithmic where all values are positive.
    """
    ax = plt.subplots(figsize=(5, 3.2), layout="constrained")[1] if ax is None else ax
    kept = np.where(design.history.violation <= 0, design.history.objective, np.inf)
    so_far = np.minimum.accumulate(np.where(np.isnan(kept), np.inf, kept), axis=0)
    so_far[np.isinf(so_far)] = np.nan
    best = min(
        range(len(design.starts)),
        key=lambda i: (design.starts[i].violation, design.starts[i].objective),
    )
    for i in [*(i for i in range(so_far.shape[1]) if i != best), best]:
        chosen = (
            {"color": COLORS[0], "linewidth": 2.0, "label": "chosen"}
            if i == best
            else {"color": "0.7", "linewidth": 0.9}
        )
        ax.plot(np.arange(1, len(so_far) + 1), so_far[:, i], **chosen)
    if np.nanmin(so_far, initial=np.inf) > 0:
        ax.set_yscale("log")
    ax.set(xlabel="step", ylabel="best feasible objective")
    ax.legend(frameon=False)
    return ax


def before_after(
    scene: Scene, design: Design, inputs: Any, ax: Any = None, *, model: Model | None = None
) -> Any:
    """The arm of a scene and that of the design under inputs of its own: the first of
    `design.inputs`.

    **Arguments:** `scene`, `inputs`: before; `ax`: 3D axes, new ones by default; `model`: as for
    `solve`.

    **Returns:** the axes.
    """
    ax = plot.arm(
        solve(scene, inputs, model=model), ax, color=COLORS[1], label="before", linestyle="--"
    )
    plot.arm(solve(design.scene, design.inputs[0], model=model), ax, label="after")
    ax.legend(frameon=False)
    return ax
