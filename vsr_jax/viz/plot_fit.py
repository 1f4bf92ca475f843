"""Figures of a fit: measured and fitted shapes, residuals, unknowns in pairs."""

from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.lines import Line2D

from ..arm.scene import Scene
from ..calibration.observation import Markers
from ..calibration.result import Fit
from ..models.base import Model
from ..numerics.compiling import program
from ..solution.solver import solve
from .plot import COLORS

_LARGEST_CORNER = 6
"""Most unknowns that are drawn in pairs."""
_TWO_SD = 2.4477
"""Radius of the ellipse that holds 95 % of a normal distribution of two numbers."""
_MOST_NAMED = 5
"""Most failed shapes that the legend names."""
_TEXT = 8
"""Size of the small texts [pt]."""
_PREDICTED: dict[str, Any] = {"marker": "o", "linestyle": "none", "markersize": 2.5}
_MEASURED = _PREDICTED | {"markersize": 6, "fillstyle": "none", "markeredgewidth": 0.7}
"""Rings around points, so that both are seen where they agree."""
_WIDTH, _HEIGHT, _RESIDUALS = 13.0, 8.0, 2.5
"""Size of the overview, and height of its residuals [in]."""
_FLATTEST = 0.15
"""Least extent of a panel of shapes, as a fraction of the arm's."""


def shapes(fit: Fit, ax: Axes | None = None, *, axes: str = "xz") -> Axes:
    """Fitted arms as lines, measured markers as rings, each joined to where the fit predicts it (a
    point), in a plane of the world. Markers of shapes that failed are crosses; the legend names the
    shapes.

    **Arguments:** `axes`: the two axes of the world that are drawn.

    **Returns:** the axes.
    """
    ax = plt.subplots(layout="constrained")[1] if ax is None else ax
    _draw_shapes(fit, ax, axes)
    ax.legend(handles=_handles(ax), frameon=False, fontsize=_TEXT)
    return ax


def _draw_shapes(fit: Fit, ax: Axes, axes: str) -> None:
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
    ax.set(xlabel=f"{axes[0]} [m]", ylabel=f"{axes[1]} [m]", aspect="equal")


def _axis(fit: Fit, group: str, rows: np.ndarray) -> np.ndarray:
    """Positions on the axis of the fitted arms of some shapes, shape (shapes, stations, 3)."""
    scene, model = fit.scene_of(group), fit.problem.predictor.model
    X = np.linspace(0, float(scene.rod.length), 41)
    if not rows.any():
        return np.zeros((0, X.size, 3))
    inputs = fit.inputs(fit.problem.data.inputs[rows])
    return np.asarray(_positions(scene, inputs, model, X))


@program("plot_fit")
def _positions(scene: Scene, inputs: Array, model: Model | None, X: Array) -> Array:
    return jax.vmap(lambda u: solve(scene, u, model=model).position(X))(inputs)


def _markers(
    fit: Fit, one: Markers, rows: np.ndarray, ax: Axes, plane: list[int], color: str
) -> None:
    """Measured and predicted positions of some shapes."""
    seen = np.asarray(one.value, float)[rows]
    gap = np.stack([fit.residuals[label][rows] for label in one.labels], axis=1)
    ends = np.stack([seen, seen + gap]).reshape(2, -1, 3)[..., plane]
    ax.plot(ends[..., 0], ends[..., 1], color=color, linewidth=0.5)
    ax.plot(*ends[0].T, color=color, **_MEASURED)
    ax.plot(*ends[1].T, color=color, **_PREDICTED)


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


def _handles(ax: Axes) -> list[Artist]:
    """Series and failed shapes, and what the two kinds of points are."""
    points = [
        Line2D([], [], color="0.4", label="measured", **_MEASURED),
        Line2D([], [], color="0.4", label="predicted", **_PREDICTED),
    ]
    return [*ax.get_legend_handles_labels()[0], *points]


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
    ax.set_xticks(range(len(fit.residuals)), list(fit.residuals), rotation=30, ha="right")
    units = {unit for one in fit.problem.data.observations for unit in one.units}
    unit = units.pop() if len(units) == 1 else "unit of the measurement"
    ax.set(ylabel=f"residual [{unit or '-'}]", ylim=(0, None))
    ax.set_xlim(-0.5, len(fit.residuals) - 0.5)
    if len(fit.problem.data.groups) > 1:
        ax.legend(frameon=False)
    return ax


def corner(
    fit: Fit, figure: FigureBase | None = None, *, names: list[str] | None = None
) -> FigureBase:
    """Unknowns in pairs: the ellipse of 95 % of their normal distribution, above the diagonal their
    correlation, on it their densities; at the top their names and values.

    **Arguments:** `names`: labels of the unknowns; by default the first six with a standard error.

    **Returns:** the figure.
    """
    known = [name for name, one in fit.numbers.items() if np.isfinite(one.error)]
    chosen = known[:_LARGEST_CORNER] if names is None else names
    index = [fit.names.index(name) for name in chosen]
    figure = plt.figure(figsize=(7, 7), layout="constrained") if figure is None else figure
    if not index:
        return figure
    block = fit.covariance[np.ix_(index, index)]
    size = np.sqrt(np.diag(block))
    units = _powers(np.maximum(np.abs(fit.x[index]), np.where(np.isfinite(size), size, 0.0)))
    x, covariance = fit.x[index] / units, block / np.outer(units, units)
    error = size / units
    grid = figure.subplots(len(index), len(index), squeeze=False, sharex="col")
    for (row, column), ax in np.ndenumerate(grid):
        pair = [column, row]
        if column > row:
            ratio = covariance[row, column] / (error[row] * error[column])
            ax.text(0.5, 0.5, f"{ratio:.2f}", ha="center", va="center", transform=ax.transAxes)
            ax.set_axis_off()
        elif column < row:
            ax.plot(*(x[pair][:, None] + _ellipse(covariance[np.ix_(pair, pair)])))
        else:
            t = np.linspace(-3, 3, 100)
            ax.plot(x[row] + t * error[row], np.exp(-(t**2) / 2))
        _corner_axes(ax, row, column, len(index))
    lines = [
        f"({i + 1}) {name} = {x[i]:.4g} +- {error[i]:.2g} {_unit(units[i], fit.numbers[name].unit)}"
        for i, name in enumerate(chosen)
    ]
    if names is None and len(known) > len(chosen):
        lines.append(f"and {len(known) - len(chosen)} more")
    if len(chosen) > 1:
        lines.append("below the diagonal: ellipses of 95 %; above it: correlations")
    figure.suptitle("\n".join(lines), x=0.01, ha="left", fontsize=_TEXT)
    return figure


def _powers(sizes: np.ndarray) -> np.ndarray:
    """Powers of a thousand by which numbers are divided to be readable, 1 for those that are."""
    readable = (sizes == 0) | ((sizes >= 1e-2) & (sizes < 1e4))
    return 10.0 ** (3 * np.floor(np.log10(np.where(readable, 1.0, sizes)) / 3))


def _unit(power: float, unit: str) -> str:
    """The unit of a number that was divided by a power of ten."""
    factor = "" if power == 1 else f"1e{round(np.log10(power))} "
    known = (factor + unit.strip("-")).strip()
    return f"[{known or '-'}]"


def _ellipse(covariance: np.ndarray) -> np.ndarray:
    """Points (2, n) of the ellipse of 95 %, from its middle."""
    size = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(size, size))
    around = np.linspace(0, 2 * np.pi, 100)
    circle = _TWO_SD * np.stack([np.cos(around), np.sin(around)])
    return size[:, None] * (vectors @ (np.sqrt(np.maximum(values, 0))[:, None] * circle))


def _corner_axes(ax: Axes, row: int, column: int, number: int) -> None:
    """Ticks at the outer sides, and the numbers of the unknowns."""
    ax.locator_params(nbins=3)
    ax.tick_params(axis="x", labelrotation=45)
    ax.tick_params(labelsize=_TEXT, labelbottom=row == number - 1, labelleft=column == 0)
    if row == column:
        ax.set_yticks([])
    if row == number - 1:
        ax.set_xlabel(f"({column + 1})", fontsize=_TEXT)
    if column == 0 and row:
        ax.set_ylabel(f"({row + 1})", fontsize=_TEXT)


def overview(fit: Fit) -> Figure:
    """Shapes in the two planes of the world along the arm, residuals, and the unknowns in pairs, in
    one figure."""
    known = sum(np.isfinite(one.error) for one in fit.numbers.values())
    share = [min(1.0, 0.3 + 0.15 * known)] if known else []
    figure = plt.figure(figsize=(_WIDTH, _HEIGHT), layout="constrained")
    sides = figure.subfigures(1, 1 + len(share), squeeze=False, width_ratios=[1.0, *share])[0]
    _shapes_over_residuals(fit, sides[0], _WIDTH / (1 + sum(share)))
    if known:
        corner(fit, sides[1])
    return figure


def _shapes_over_residuals(fit: Fit, figure: SubFigure, width: float) -> None:
    """Shapes beside or above each other, whichever is larger at a width [in]."""
    along, sizes = _extents(fit)
    across = [i for i in range(3) if i != along]
    planes = [(i, along) if along == 2 else (along, i) for i in across]
    right, up = sizes[planes].T
    height = _HEIGHT - _RESIDUALS
    beside = min(width / right.sum(), height / up.max())
    above = min(width / right.max(), height / up.sum())
    places: list[Any] = [[0, 1], [2, 2]] if beside > above else [[0], [1], [2]]
    heights = [height] if beside > above else list(height * up / up.sum())
    panels = figure.subplot_mosaic(
        places,
        width_ratios=right if beside > above else None,
        height_ratios=[*heights, _RESIDUALS],
    )
    for i, plane in enumerate(planes):
        _draw_shapes(fit, panels[i], "".join("xyz"[j] for j in plane))
        panels[i].set_aspect("equal", adjustable="datalim")
    residuals(fit, panels[2])
    figure.legend(
        handles=_handles(panels[0]),
        loc="outside upper left",
        ncols=4,
        frameon=False,
        fontsize=_TEXT,
    )


def _extents(fit: Fit) -> tuple[int, np.ndarray]:
    """The axis of the world along which the arm starts, and extents of base and markers."""
    base = fit.scene.rod.base
    pose = np.eye(4) if base is None else np.asarray(base)
    seen = [one.value for one in fit.problem.data.observations if isinstance(one, Markers)]
    points = [pose[None, :3, 3], *(np.asarray(value, float).reshape(-1, 3) for value in seen)]
    every = np.concatenate(points)
    sizes = np.nanmax(every, axis=0) - np.nanmin(every, axis=0)
    sizes = np.maximum(sizes, _FLATTEST * sizes.max()) if sizes.any() else np.ones(3)
    return int(np.argmax(np.abs(pose[:3, 0]))), sizes
