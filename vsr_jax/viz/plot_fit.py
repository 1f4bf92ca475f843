"""Figures of a fit: measured and fitted shapes, residuals, unknowns in pairs."""

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D

from ..calibration.observation import Markers
from ..calibration.result import Fit
from ..solution.solver import solve
from .plot import COLORS

_LARGEST_CORNER = 6
"""Most unknowns that are drawn in pairs."""
_TWO_SD = 2.4477
"""Radius of the ellipse that holds 95 % of a normal distribution of two numbers."""
_MOST_NAMED = 5
"""Most failed shapes that the legend names."""


def shapes(fit: Fit, ax: Axes | None = None, *, axes: str = "xz") -> Axes:
    """Fitted arms as lines, measured markers as points, each joined to where the fit predicts it (a
    ring), in a plane of the world. Markers of shapes that failed are crosses; the legend names the
    shapes.

    **Arguments:** `axes`: the two axes of the world that are drawn.

    **Returns:** the axes.
    """
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    plane = ["xyz".index(letter) for letter in axes]
    groups = fit.problem.data.groups
    for g, group in enumerate(groups):
        rows = np.array([one == group for one in fit.problem.data.series])
        rows[list(fit.failed)] = False
        color = COLORS[g % len(COLORS)]
        for k, place in enumerate(_axis(fit, group, rows)[..., plane]):
            label = (group or "fitted") if k == 0 else None
            ax.plot(*place.T, color=color, linewidth=0.9, label=label)
        for one in fit.problem.data.observations:
            if isinstance(one, Markers):
                _markers(fit, one, rows, ax, plane, color)
    _failed(fit, ax, plane)
    _legend(ax)
    ax.set(xlabel=f"{axes[0]} [m]", ylabel=f"{axes[1]} [m]", aspect="equal")
    return ax


def _axis(fit: Fit, group: str, rows: np.ndarray) -> np.ndarray:
    """Positions on the axis of the fitted arms of some shapes, shape (shapes, stations, 3)."""
    scene, model = fit.scene_of(group), fit.problem.predictor.model
    X = np.linspace(0, float(scene.rod.length), 41)
    if not rows.any():
        return np.zeros((0, X.size, 3))
    inputs = fit.inputs(fit.problem.data.inputs[rows])
    return np.asarray(jax.vmap(lambda u: solve(scene, u, model=model).position(X))(inputs))


def _markers(
    fit: Fit, one: Markers, rows: np.ndarray, ax: Axes, plane: list[int], color: str
) -> None:
    """Measured and predicted positions of some shapes."""
    seen = np.asarray(one.value, float)[rows]
    gap = np.stack([fit.residuals[label][rows] for label in one.labels], axis=1)
    ends = np.stack([seen, seen + gap]).reshape(2, -1, 3)[..., plane]
    ax.plot(ends[..., 0], ends[..., 1], color=color, linewidth=0.5)
    ax.plot(*ends[0].T, ".", color=color, markersize=4)
    ax.plot(*ends[1].T, "o", color=color, markersize=4, fillstyle="none", markeredgewidth=0.6)


def _failed(fit: Fit, ax: Axes, plane: list[int]) -> None:
    """Markers of the shapes that failed, with their numbers in the legend."""
    failed = list(fit.failed)
    if not failed:
        return
    some = ", ".join(map(str, failed[:_MOST_NAMED]))
    more = f" and {len(failed) - _MOST_NAMED} more" if len(failed) > _MOST_NAMED else ""
    seen = [
        np.asarray(one.value, float)[failed].reshape(-1, 3)
        for one in fit.problem.data.observations
        if isinstance(one, Markers)
    ]
    places = np.concatenate([*seen, np.full((1, 3), np.nan)])[:, plane]
    ax.plot(*places.T, "x", color="0.4", markersize=5, label=f"no equilibrium: {some}{more}")


def _legend(ax: Axes) -> None:
    """Series and failed shapes, and what the two kinds of points are."""
    style = {"color": "0.4", "linestyle": "none", "markersize": 4}
    points = [
        Line2D([], [], marker=".", label="measured", **style),
        Line2D([], [], marker="o", fillstyle="none", label="predicted", **style),
    ]
    ax.legend(handles=[*ax.get_legend_handles_labels()[0], *points], frameon=False, fontsize=8)


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
    units = {unit for one in fit.problem.data.observations for unit in one.units}
    unit = units.pop() if len(units) == 1 else "unit of the measurement"
    ax.set(ylabel=f"residual [{unit or '-'}]", ylim=(0, None))
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
