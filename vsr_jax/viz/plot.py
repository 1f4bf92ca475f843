"""Plots of solved arms with matplotlib; every function draws into given axes, or creates a figure.

The package does not import this module on its own; use `from vsr_jax import plot`.
"""

import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.typing import ColorType, LineStyleType
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.loads import Gravity
from ..arm.obstacles import Obstacle
from ..arm.rod import STRAINS
from ..assembly import AssemblyEquilibrium
from ..solution.equilibrium import Equilibrium
from ..solution.summary import Summary
from ..typing import ArrayLike, VectorLike
from ..validation import choice
from . import annotate
from .bodies import draw_bodies
from .body import body_of, draw_body, sample, thread_scales
from .obstacles import draw_obstacles, draw_outlines
from .space import (
    THINNEST_BOX,
    checked_space,
    equal_scale,
    fill,
    fit_height,
    label_axes,
    world_frame,
)
from .style import COLORS, ink, shade, theme
from .tendons import SLACK_DASHES, color_bars

__all__ = [
    "COLORS",
    "LABELS",
    "arm",
    "assembly",
    "equal_scale",
    "sample",
    "shade",
    "strains",
    "theme",
    "workspace",
]

LABELS: dict[str, str] = dict(
    zip(
        STRAINS,
        ("$k_x$ [1/m]", "$k_y$ [1/m]", "$k_z$ [1/m]", "$u_x$ [-]", "$u_y$ [-]", "$u_z$ [-]"),
        strict=True,
    )
)
"""Symbol and unit of each strain."""

_LEAST_SPAN = 0.02
_THINNEST = 0.2
"""Least side of the box of a figure of its own, relative to the longest."""
_AREA = (0.0, 0.0, 0.83, 0.9)
"""Rectangle of the box in the figure."""

_PAIRS = ((0, 1), (0, 2), (1, 2))
"""Horizontal and vertical axis of each projection of a workspace."""
_CELLS = (20, 60)
"""Least and greatest number of cells along the longest side of a workspace."""
_CLOUD, _CLOUD_BAR = (0.0, 0.5, 0.42, 0.48), (0.9, 0.25, 0.016, 0.5)
"""Rectangles of the 3D axes and of the colour bar of a workspace in its figure."""


def arm(
    eq: Equilibrium | Summary,
    ax: Axes3D | None = None,
    *,
    color: ColorType | None = None,
    label: str | None = None,
    linestyle: LineStyleType = "-",
    stations: VectorLike = 60,
    surface: bool = True,
    threads: bool = True,
    details: bool | None = None,
    **line: Any,
) -> Axes3D:
    """The deformed arm in 3D: its axis, its translucent outer wall or its discs, and its threads,
    at equal scale. The wall of rigid pieces is darker and more opaque.

    With details, threads have the colour of their tension and chambers that of their pressure, with
    a colour bar each (blue pushes, vermilion pulls); slack tendons are dashed; loads are arrows
    with a legend; obstacles are translucent; the axes of the world's frame and the direction of
    gravity are drawn. An arm too thin for its threads to be told apart is drawn wider; the legend
    says by what factor.

    Of a solve that failed, the arm at rest is drawn dimmed, with the message of the status.

    **Arguments:**
    - `eq`: an equilibrium, or the result of `sample`, which has no discs and no details.
    - `ax`: 3D axes; a new figure by default.
    - `color`, `label`, `linestyle`, `line`: matplotlib properties of the axis curve; the colour is
      that of the wall too, by default blue, and grey with details.
    - `stations`: number of stations, or their abscissas [m]; not used with a `Summary`.
    - `surface`, `threads`: whether to draw the wall with the discs, and the threads.
    - `details`: by default those of an equilibrium in a new figure.

    **Returns:** the axes.
    """
    own, ax = ax is None, checked_space(ax)
    body = body_of(eq, stations)
    details = isinstance(eq, Equilibrium) and (own if details is None else details)
    scales = thread_scales([body]) if details else None
    widening = body.widening if details else 1.0
    if body.failure is not None:
        label = textwrap.fill(f"{label or 'the arm'} at rest; no equilibrium: {body.failure}", 70)
    shown = color if color is not None else ink(0.5) if details else COLORS[0]
    style = {"color": shown, "linestyle": linestyle, "label": label, "scales": scales, **line}
    draw_body(ax, body.widened(widening), surface=surface, threads=threads, **style)
    if details and isinstance(eq, Equilibrium) and body.failure is None:
        annotate.loads(eq, ax, legend=False)
    if details and isinstance(eq, Equilibrium):
        draw_obstacles(ax, eq.scene.obstacles, body.points)
    label_axes(ax)
    equal_scale(ax, thinnest=_THINNEST if own else THINNEST_BOX)
    if own:
        fit_height(ax, _AREA)
    if details and isinstance(eq, Equilibrium):
        world_frame(ax, _gravity(eq))
    if details or body.failure is not None:
        loose = body.slack if threads and body.failure is None else None
        slack = loose is not None and bool(np.any(loose))
        _legend(ax, slack, widening, own)
    if own and threads and scales is not None:
        color_bars(ax, scales)
    return ax


def assembly(
    eq: AssemblyEquilibrium,
    ax: Axes3D | None = None,
    *,
    color: ColorType = COLORS[0],
    stations: int = 60,
    surface: bool = True,
) -> Axes3D:
    """The arms of a solved assembly, each as by `arm` without details, and its bodies: each a
    translucent plate between its joints, with its axes.

    **Arguments:** `eq`: one solved assembly; `ax`: 3D axes, by default a new figure; `color`: of
    the arms; `stations`, `surface`: as for `arm`.

    **Returns:** the axes.

    **Raises:** `ValueError` for a solve that failed.
    """
    if not bool(eq.converged):
        raise ValueError(f"eq: got a solve that failed, {eq.message}; need an equilibrium to draw")
    own, ax = ax is None, checked_space(ax)
    for one in eq.arms:
        arm(one, ax, color=color, stations=stations, surface=surface)
    draw_bodies(ax, eq, ink(0.5))
    equal_scale(ax, thinnest=_THINNEST if own else THINNEST_BOX)
    if own:
        fit_height(ax, _AREA)
    return ax


def _gravity(eq: Equilibrium) -> np.ndarray | None:
    """Sum of the accelerations of gravity [m/s^2], None without gravity."""
    found = [load.acceleration for load in eq.scene.loads if isinstance(load, Gravity)]
    return np.sum(np.asarray(found), axis=0) if found else None


def _legend(ax: Axes3D, slack: bool, widening: float, own: bool) -> None:
    """Legend of what is drawn, slack tendons and the factor of the section, in the corner of the
    figure or of the axes."""
    handles = list(ax.get_legend_handles_labels()[0])
    if slack:
        handles.append(Line2D([], [], color=ink(0.6), linestyle=SLACK_DASHES, label="slack tendon"))
    if widening > 1:
        text = f"section drawn {widening:g} times as wide"
        handles.append(Line2D([], [], linestyle="none", label=text))
    if handles:
        corner = {"bbox_to_anchor": (0.01, 0.99), "bbox_transform": ax.figure.transFigure}
        ax.legend(
            handles=handles,
            loc="upper left",
            ncols=1 + (len(handles) > 2),
            **(corner if own else {}),
        )


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
    own = ax is None
    axes = _panels(len(indices)) if own else np.asarray(ax, dtype=object).reshape(-1)
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
        if own:
            panel.set_title(name.replace("_", " about " if "bending" in name else " along "))
        low, high = panel.dataLim.intervaly
        middle, half = (low + high) / 2, max(1.12 * (high - low), _LEAST_SPAN) / 2
        panel.set_ylim(middle - half, middle + half)
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
    values: VectorLike | None = None,
    label: str = "",
    color: ColorType = COLORS[0],
    most: int = 20_000,
    obstacles: Sequence[Obstacle] = (),
) -> np.ndarray:
    """The workspace of the tip: its positions in 3D, and projected along each axis.

    **Arguments:**
    - `positions`: shape (samples, 3) [m]; rows with a NaN are left out.
    - `ax`: four axes, the first one 3D; a new figure by default.
    - `values`, `label`: one number per point that sets its colour, and the label of the colour bar;
      without `values` the projections show the density: the number of tips in each cell, of all
      points.
    - `color`: of the points in space without `values`.
    - `most`: maximum number of points drawn; larger sets are subsampled evenly.
    - `obstacles`: drawn in space, and as areas in the projections.

    **Returns:** the axes: 3D, then y over x, z over x, z over y.

    **Raises:** `ValueError` for positions of another shape, and without any finite one.
    """
    positions = np.asarray(positions)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise ValueError(f"positions: got shape {positions.shape}, need (samples, 3)")
    finite = np.flatnonzero(np.all(np.isfinite(positions), axis=1))
    if not finite.size:
        raise ValueError("positions: got no finite row, need at least one")
    shown = finite[:: -(-len(finite) // most)]
    axes = _corner() if ax is None else np.asarray(ax, dtype=object).reshape(-1)
    style: dict[str, Any] = {"s": 3, "linewidths": 0, "rasterized": True}
    style |= {"c": color} if values is None else {"c": np.asarray(values)[shown]}
    points = axes[0].scatter(*positions[shown].T, alpha=0.5, **style)
    draw_obstacles(axes[0], obstacles, positions[finite])
    label_axes(axes[0])
    equal_scale(axes[0])
    if ax is None:
        fill(axes[0], _CLOUD)
    for panel, (i, j) in zip(axes[1:], _PAIRS, strict=True):
        draw_outlines(panel, obstacles, positions[finite], (i, j))
        if values is not None:
            panel.scatter(positions[shown, i], positions[shown, j], **style)
        panel.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")
        panel.set_aspect("equal", adjustable="datalim" if ax is None else "box")
        panel.use_sticky_edges = False
        panel.margins(0.05)
        panel.locator_params(nbins=5)
    if values is None:
        points = _draw_density(axes[1:], positions[finite])
    figure, text = axes[0].figure, "tips per cell" if values is None else label
    place = (
        {"cax": figure.add_axes(_CLOUD_BAR)} if ax is None else {"ax": list(axes), "shrink": 0.6}
    )
    figure.colorbar(points, label=text, **place).solids.set_alpha(1)
    return axes


def _corner() -> np.ndarray:
    figure = plt.figure(figsize=(8.6, 6.8))
    grid = figure.add_gridspec(2, 2, left=0.09, right=0.86, bottom=0.08, top=0.96, wspace=0.28)
    space = figure.add_subplot(grid[0], projection="3d")
    space.view_init(22, -60)
    panels = [figure.add_subplot(grid[i]) for i in (1, 2, 3)]
    return np.array([space, *panels], dtype=object)


def _draw_density(panels: Sequence[Axes] | np.ndarray, tips: np.ndarray) -> QuadMesh:
    """Number of tips in each cell of the projections, on one logarithmic scale."""
    cells = np.clip(np.sqrt(len(tips)) / 2, *_CELLS)
    cell = np.max(np.ptp(tips, axis=0)) / cells or 1.0
    ends = zip(tips.min(axis=0), tips.max(axis=0), strict=True)
    # the outermost tips lie in the middle of a cell, where rounding does not move them to another
    edges = [np.arange(low - cell / 2, high + cell, cell) for low, high in ends]
    counts = [
        np.histogram2d(tips[:, i], tips[:, j], bins=[edges[i], edges[j]])[0] for i, j in _PAIRS
    ]
    scale = LogNorm(1, max(2, *(np.max(count) for count in counts)))
    meshes = [
        panel.pcolormesh(
            edges[i], edges[j], np.ma.masked_equal(count.T, 0), norm=scale, rasterized=True
        )
        for panel, (i, j), count in zip(panels, _PAIRS, counts, strict=True)
    ]
    return meshes[0]
