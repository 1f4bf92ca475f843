"""Figures of a fit: measured and fitted shapes, residuals, unknowns in pairs."""

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase

from ..calibration.observation import Markers
from ..calibration.result import Fit
from ..solution.solver import solve
from .plot import COLORS

_LARGEST_CORNER = 6
"""Most unknowns that are drawn in pairs."""
_TWO_SD = 2.4477
"""Radius of the ellipse that holds 95 % of a normal distribution of two numbers."""


def shapes(fit: Fit, ax: Axes | None = None, *, axes: str = "xz") -> Axes:
    """Fitted arms as lines and measured markers as points, in a plane of the world.

    **Arguments:** `axes`: the two axes of the world that are drawn.

    **Returns:** the axes.
    """
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    i, j = ("xyz".index(letter) for letter in axes)
    data, problem = fit.problem.data, fit.problem
    X = np.linspace(0, float(problem.predictor.scene.rod.length), 41)
    for g, group in enumerate(data.groups):
        rows = np.array([one == group for one in data.series])
        scene, color = fit.scene_of(group), COLORS[g % len(COLORS)]
        inputs = fit.inputs(data.inputs[rows])
        model = problem.predictor.model
        places = jax.vmap(
            lambda u, scene=scene, model=model: solve(scene, u, model=model).position(X)
        )(inputs)
        for k, place in enumerate(np.asarray(places)):
            label = (group or "fitted") if k == 0 else None
            ax.plot(place[:, i], place[:, j], color=color, linewidth=0.9, label=label)
        for one in data.observations:
            if isinstance(one, Markers):
                seen = np.asarray(one.value)[rows].reshape(-1, 3)
                ax.plot(seen[:, i], seen[:, j], ".", color=color, markersize=4)
    ax.set(xlabel=f"{axes[0]} [m]", ylabel=f"{axes[1]} [m]", aspect="equal")
    ax.legend(frameon=False)
    return ax


def residuals(fit: Fit, ax: Axes | None = None) -> Axes:
    """Length of the residual of each shape by label, in the unit of the measurement.

    **Returns:** the axes.
    """
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    series = fit.problem.data.series
    for g, group in enumerate(fit.problem.data.groups):
        here = np.array([one == group for one in series])
        for k, one in enumerate(fit.residuals.values()):
            size = np.linalg.norm(one[here], axis=1)
            shift = 0.15 * (g - (len(fit.problem.data.groups) - 1) / 2)
            label = (group or None) if k == 0 else None
            ax.plot(
                np.full(size.size, k + shift),
                size,
                "o",
                color=COLORS[g % len(COLORS)],
                markersize=3,
                alpha=0.7,
                label=label,
            )
    ax.set_xticks(range(len(fit.residuals)), list(fit.residuals), rotation=30)
    ax.set(ylabel="residual [unit of the measurement]")
    if len(fit.problem.data.groups) > 1:
        ax.legend(frameon=False)
    return ax


def corner(
    fit: Fit, figure: FigureBase | None = None, *, names: list[str] | None = None
) -> FigureBase:
    """Unknowns in pairs: the ellipse of 95 % of their normal distribution; on the diagonal their
    densities.

    **Arguments:** `names`: labels of the unknowns; by default the first six with a standard error.

    **Returns:** the figure.
    """
    known = [name for name, one in fit.numbers.items() if np.isfinite(one.error)]
    chosen = known[:_LARGEST_CORNER] if names is None else names
    index = [fit.names.index(name) for name in chosen]
    figure = plt.figure(figsize=(7, 7), layout="constrained") if figure is None else figure
    grid = figure.subplots(len(index), len(index), squeeze=False)
    around = np.linspace(0, 2 * np.pi, 100)
    circle = _TWO_SD * np.stack([np.cos(around), np.sin(around)])
    for row, i in enumerate(index):
        for column, j in enumerate(index):
            ax = grid[row, column]
            if column > row:
                ax.set_axis_off()
                continue
            if row == column:
                t = np.linspace(-3, 3, 100)
                ax.plot(fit.x[i] + t * np.sqrt(fit.covariance[i, i]), np.exp(-(t**2) / 2))
                ax.set_yticks([])
            else:
                block = fit.covariance[np.ix_([j, i], [j, i])]
                values, vectors = np.linalg.eigh(block / np.sqrt(np.outer(*[np.diag(block)] * 2)))
                size = np.sqrt(np.diag(block))[:, None]
                line = size * (vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * circle))
                ax.plot(fit.x[j] + line[0], fit.x[i] + line[1])
            ax.tick_params(labelsize=5)
            if row == len(index) - 1:
                ax.set_xlabel(chosen[column], fontsize=5)
            if column == 0 and row:
                ax.set_ylabel(chosen[row], fontsize=5)
    return figure


def overview(fit: Fit) -> Figure:
    """Shapes in two planes, residuals, and the unknowns in pairs, in one figure."""
    figure = plt.figure(figsize=(13, 8), layout="constrained")
    sides = figure.subfigures(1, 2, squeeze=False)
    left = sides[0, 0].subplots(2, 2)
    for ax, axes in zip(left[0], ("xz", "yz"), strict=True):
        shapes(fit, ax, axes=axes)
    left[1, 1].set_axis_off()
    residuals(fit, left[1, 0])
    corner(fit, sides[0, 1])
    return figure
