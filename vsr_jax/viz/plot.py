"""Plots of solved arms with matplotlib; every function draws into given axes, or creates a figure.

The package does not import this module on its own; use `from vsr_jax import plot`.
"""

from collections.abc import Sequence
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.ticker import MaxNLocator
from matplotlib.typing import ColorType, LineStyleType
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.rod import STRAINS
from ..solution.equilibrium import Equilibrium
from ..solution.summary import Summary, stations as checked_stations
from ..typing import VectorLike
from ..validation import choice

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""The palette of Okabe and Ito, which colour-blind readers can distinguish."""

LABELS: dict[str, str] = dict(
    zip(
        STRAINS,
        ("$k_x$ [1/m]", "$k_y$ [1/m]", "$k_z$ [1/m]", "$u_x$ [-]", "$u_y$ [-]", "$u_z$ [-]"),
        strict=True,
    )
)
"""Symbol and unit of each strain."""

_LEAST_SPAN = 0.02
_THINNEST_BOX = 0.35


def sample(eq: Equilibrium, stations: VectorLike = 60) -> Summary:
    """The summary of an equilibrium in NumPy arrays; `arm` and `strains` take it in place of `eq`.

    **Arguments:** `stations`: number of stations, evenly spaced on the arm, or their abscissas [m].

    **Raises:** `ValueError` for a batch of equilibria, for one that did not converge and for
    stations beyond the arm.
    """
    if np.ndim(eq.status) > 0:
        raise ValueError(f"eq: got a batch of shape {np.shape(eq.status)}, need one equilibrium")
    if not bool(eq.converged):
        raise ValueError(f"eq: got a solve that failed ({eq.message}), need a converged one")
    return jax.tree.map(np.asarray, eq.summary(checked_stations(eq, stations, "stations")))


def arm(
    eq: Equilibrium | Summary,
    ax: Axes3D | None = None,
    *,
    color: ColorType = COLORS[0],
    label: str | None = None,
    linestyle: LineStyleType = "-",
    stations: VectorLike = 60,
    surface: bool = True,
    threads: bool = True,
    **line: Any,
) -> Axes3D:
    """The deformed arm in 3D: its axis, its translucent outer wall and its threads, at equal scale.

    **Arguments:**
    - `eq`: an equilibrium, or the result of `sample`.
    - `ax`: 3D axes; a new figure by default.
    - `color`, `label`, `linestyle`, `line`: matplotlib properties of the axis curve.
    - `stations`: number of stations, or their abscissas [m]; not used with a `Summary`.
    - `surface`, `threads`: whether to draw the wall and the threads.

    **Returns:** the axes.
    """
    samples = eq if isinstance(eq, Summary) else sample(eq, stations)
    ax = plt.figure(figsize=(6, 5)).add_subplot(projection="3d") if ax is None else ax
    if not isinstance(ax, Axes3D):
        raise ValueError(
            f"ax: got {type(ax).__name__}, need 3D axes, as from "
            f"figure.add_subplot(projection='3d')"
        )
    if surface:
        x, y, z = np.moveaxis(np.asarray(samples.wall), -1, 0)
        ax.plot_surface(
            x,
            y,
            z,
            color=color,
            alpha=0.18,
            linewidth=0,
            rstride=1,
            cstride=1,
            rasterized=True,
        )
    if threads:
        for thread in samples.threads:
            ax.plot(*thread.T, color=shade(color), linewidth=0.8)
    ax.plot(*samples.position.T, color=color, label=label, linestyle=linestyle, **line)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    equal_scale(ax)
    return ax


def equal_scale(ax: Axes3D, *, zoom: float = 1.1) -> None:
    """Sets one scale for x, y and z: the box has the proportions of the data, with no side shorter
    than about a third of the longest.

    **Arguments:** `ax`: 3D axes; `zoom`: size of the box in them.
    """
    low = np.array([*ax.xy_dataLim.min, ax.zz_dataLim.x0])
    high = np.array([*ax.xy_dataLim.max, ax.zz_dataLim.x1])
    span = np.maximum(high - low, _THINNEST_BOX * np.max(high - low)) * 1.04
    sides = zip(
        *_around((low + high) / 2, span),
        span / span.max(),
        (ax.xaxis, ax.yaxis, ax.zaxis),
        ("x", "y", "z"),
        strict=True,
    )
    for start, end, width, axis, name in sides:
        ticks = MaxNLocator(4 if width > 0.6 else 2, steps=[1, 2, 2.5, 4, 5, 10]).tick_values(
            start, end
        )
        margin = 0.06 * (end - start)  # ticks at a corner would overlap those of the next side
        axis.set_ticks(ticks[(ticks > start + margin) & (ticks < end - margin)])
        ax.set(**{f"{name}lim": (start, end)})
    ax.set_box_aspect(span, zoom=zoom)  # pyright: ignore[reportArgumentType] (its default is an int)


def _around(middle: np.ndarray, span: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return middle - span / 2, middle + span / 2


def strains(
    eq: Equilibrium | Summary,
    ax: Sequence[Axes] | np.ndarray | None = None,
    *,
    names: Sequence[str] = STRAINS,
    color: ColorType = COLORS[0],
    label: str | None = None,
    linestyle: LineStyleType = "-",
    stations: VectorLike = 60,
    **line: Any,
) -> np.ndarray:
    """The strains over X, one panel per strain; no panel spans less than 0.02, so that rounding
    does not look like a signal.

    **Arguments:**
    - `eq`: an equilibrium, or the result of `sample`.
    - `ax`: one axes per name, in a row or a grid; a new figure by default, of 2 x 3 panels for all
      six strains.
    - `names`: names from `vsr_jax.arm.rod.STRAINS`.
    - `color`, `label`, `linestyle`, `line`: matplotlib properties of the curves.
    - `stations`: number of stations, or their abscissas [m]; not used with a `Summary`.

    **Returns:** the axes, one per name.
    """
    indices = [STRAINS.index(choice("names", name, STRAINS)) for name in names]
    samples = eq if isinstance(eq, Summary) else sample(eq, stations)
    axes = _panels(len(indices)) if ax is None else np.asarray(ax, dtype=object).reshape(-1)
    if len(axes) != len(indices):
        raise ValueError(f"ax: got {len(axes)} axes, need {len(indices)}, one per name")
    for panel, name, index in zip(axes, names, indices, strict=True):
        panel.plot(
            samples.X,
            samples.strain[:, index],
            color=color,
            label=label,
            linestyle=linestyle,
            **line,
        )
        panel.set(xlabel="X [m]", ylabel=LABELS[name], xlim=(samples.X.min(), samples.X.max()))
        panel.ticklabel_format(axis="y", useOffset=False)
        low, high = panel.dataLim.intervaly
        panel.set_ylim(*_around((low + high) / 2, max(1.12 * (high - low), _LEAST_SPAN)))
    return axes


def _panels(number: int) -> np.ndarray:
    columns = min(number, 3)
    rows = -(-number // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.6 * columns, 2.5 * rows), squeeze=False, layout="constrained"
    )
    for unused in axes.flat[number:]:
        figure.delaxes(unused)
    return axes.reshape(-1)[:number]


def workspace(
    positions: ArrayLike,
    ax: Sequence[Axes] | np.ndarray | None = None,
    *,
    values: ArrayLike | None = None,
    label: str = "",
    color: ColorType = COLORS[0],
    most: int = 20_000,
) -> np.ndarray:
    """The workspace of the tip: its positions in 3D, and projected along each axis.

    **Arguments:**
    - `positions`: shape (samples, 3) [m]; rows with a NaN are left out.
    - `ax`: four axes, the first one 3D; a new figure by default.
    - `values`, `label`: one number per point that sets its colour, and the label of the colour bar;
      without `values` all points have the colour `color`.
    - `most`: maximum number of points drawn; larger sets are subsampled evenly.

    **Returns:** the axes: 3D, then y over x, z over x, z over y.
    """
    positions = np.asarray(positions)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions: got shape {positions.shape}, need (samples, 3)")
    shown = np.flatnonzero(np.all(np.isfinite(positions), axis=1))
    shown = shown[:: -(-len(shown) // most) or 1]
    axes = _corner() if ax is None else np.asarray(ax, dtype=object).reshape(-1)
    points = positions[shown].T
    style: dict[str, Any] = {"s": 2, "linewidths": 0, "rasterized": True}
    style |= {"c": color} if values is None else {"c": np.asarray(values)[shown], "cmap": "viridis"}
    cloud = axes[0].scatter(*points, alpha=0.5, **style)
    axes[0].set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    equal_scale(axes[0])
    for panel, (i, j) in zip(axes[1:], ((0, 1), (0, 2), (1, 2)), strict=True):
        panel.scatter(points[i], points[j], **style)
        panel.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")
        panel.set_aspect("equal", adjustable="box")
    if values is not None:
        axes[0].figure.colorbar(cloud, ax=list(axes), label=label, shrink=0.6).solids.set_alpha(1)
    return axes


def _corner() -> np.ndarray:
    figure = plt.figure(figsize=(9, 7), layout="constrained")
    return np.array(
        [figure.add_subplot(2, 2, i + 1, projection="3d" if i == 0 else None) for i in range(4)],
        dtype=object,
    )


def shade(color: ColorType) -> tuple[float, ...]:
    """A darker shade of a colour, for lines drawn over it."""
    return tuple(0.55 * part for part in to_rgb(color))
