"""Axes in space: one scale, a view that fits the data, the world's frame."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import proj3d
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from .style import COLORS, ink

THINNEST_BOX = 0.35
FRAME_COLORS = (COLORS[1], COLORS[2], COLORS[0])
"""Colours of the axes x, y and z of a frame."""

_LABEL_ROOM = 0.62
"""Room for ticks and labels around a box [inches]."""
_TICK_DISTANCES, _LABEL_DISTANCES, _TICK_ROOM = (11.0, 13.0, 18.0), (34.0, 38.0, 46.0), 38.0
"""Distances of tick labels and axis labels from the axes x, y, z, and between ticks [points]."""
_TICK_OFFSET, _LABEL_OFFSET, _PAD_UNIT = 8.0, 21.0, 0.08 * 48
"""Matplotlib's: a pad p moves a label by (p + offset) unit sides / points of the axes."""


def new_space(figsize: tuple[float, float] = (6.4, 4.8)) -> Axes3D:
    """3D axes in a new figure."""
    ax = plt.figure(figsize=figsize).add_subplot(projection="3d")
    ax.view_init(22, -60)
    label_axes(ax)
    return ax


def checked_space(ax: Axes3D | None) -> Axes3D:
    """The axes given, or new ones.

    **Raises:** `ValueError` for axes that are not 3D.
    """
    if ax is None:
        return new_space()
    if not isinstance(ax, Axes3D):
        raise ValueError(
            f"ax: got {type(ax).__name__}, need 3D axes, as from "
            f"figure.add_subplot(projection='3d')"
        )
    return ax


def label_axes(ax: Axes3D) -> None:
    """Labels of a position in space, upright."""
    axes: tuple[Any, ...] = (ax.xaxis, ax.yaxis, ax.zaxis)
    for axis in axes:
        axis.set_rotate_label(False)
        axis.label.set_rotation(0)
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")


def equal_scale(ax: Axes3D, *, zoom: float = 1.1, thinnest: float = THINNEST_BOX) -> None:
    """Sets one scale for x, y and z: the box has the proportions of the data.

    **Arguments:** `ax`: 3D axes; `zoom`: size of the box in them; `thinnest`: least side of the box
    relative to the longest.
    """
    low = np.array([*ax.xy_dataLim.min, ax.zz_dataLim.x0])
    high = np.array([*ax.xy_dataLim.max, ax.zz_dataLim.x1])
    span = np.maximum(high - low, thinnest * np.max(high - low)) * 1.04
    start, end = (low + high - span) / 2, (low + high + span) / 2
    ax.set(**{f"{name}lim": ends for name, *ends in zip("xyz", start, end, strict=True)})
    ax.set_box_aspect(span, zoom=zoom)  # pyright: ignore[reportArgumentType] (its default is an int)
    _set_ticks(ax)


def _set_ticks(ax: Axes3D) -> None:
    """Ticks as many as there is room for, none at a corner, and labels beside them.

    Matplotlib measures the distances of tick labels and axis labels from an axis in sides of the
    box: in a thin box they would lie on each other. The distances set here are those of a cube.
    """
    low, high = limits(ax)
    azimuth, elevation = np.radians([ax.azim, ax.elev])
    x, y = np.where(np.array([np.cos(azimuth), np.sin(azimuth)]) < 0, -1.0, 1.0)
    z = -1.0 if elevation >= 0 else 1.0
    outward = np.array([[0, y, z], [x, 0, z], [x, -y, 0]])  # from the centre to each axis
    points_per_pixel = 72 / ax.figure.dpi
    axes: tuple[Any, ...] = (ax.xaxis, ax.yaxis, ax.zaxis)
    for i, axis in enumerate(axes):
        middle = (low + high + outward[i] * (high - low)) / 2
        along = 0.5 * np.eye(3)[i] * (high - low)
        unit = outward[i] * (high - low) * _PAD_UNIT / _points(ax)
        ends = _pixels(ax, np.stack([middle - along, middle + along, middle, middle + unit]))
        length, step = (points_per_pixel * np.linalg.norm(ends[j + 1] - ends[j]) for j in (0, 2))
        number = int(np.clip(length / _TICK_ROOM, 1, 4))
        locator = MaxNLocator(number, steps=[1, 2, 2.5, 4, 5, 10])
        ticks, margin = locator.tick_values(low[i], high[i]), 0.06 * (high[i] - low[i])
        ticks = ticks[(ticks > low[i] + margin) & (ticks < high[i] - margin)]
        axis.set_ticks(ticks[len(ticks) // 2 :][:1] if number == 1 else ticks)
        axis.set_tick_params(pad=_TICK_DISTANCES[i] / step - _TICK_OFFSET)
        axis.labelpad = _LABEL_DISTANCES[i] / step - _LABEL_OFFSET


def _pixels(ax: Axes3D, points: np.ndarray) -> np.ndarray:
    """Points [m] as pixels of the figure, shape (points, 2)."""
    x, y, _ = proj3d.proj_transform(points[:, 0], points[:, 1], points[:, 2], ax.get_proj())
    return ax.transData.transform(np.transpose([x, y]))


def _points(ax: Axes3D) -> float:
    """Half the circumference of the axes [points]."""
    return 72.0 / ax.figure.dpi * float(np.sum(ax.bbox.size))


def limits(ax: Any) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest corner of the box [m]."""
    low, high = np.transpose([ax.get_xlim3d(), ax.get_ylim3d(), ax.get_zlim3d()])
    return low, high


def fill(ax: Axes3D, rectangle: tuple[float, float, float, float]) -> None:
    """Makes the box as large as a rectangle of the figure admits, with room for its labels.

    Matplotlib draws 3D axes into a square with much empty space around a long box.

    **Arguments:** `ax`: 3D axes after `equal_scale`; `rectangle`: left, bottom, width and height in
    the figure.
    """
    low, high = limits(ax)
    corners = np.array(np.meshgrid(*np.transpose([low, high]), indexing="ij")).reshape(3, 8).T
    figure = ax.figure
    size = np.array(figure.get_size_inches())  # pyright: ignore[reportAttributeAccessIssue]
    corner, extent = np.array(rectangle[:2]), np.array(rectangle[2:])
    middle, room = (corner + extent / 2) * size, extent * size - 2 * _LABEL_ROOM
    side, zoom, centre = np.max(extent * size), 1.0, middle
    for _ in range(4):
        ax.set_position((*((centre - side / 2) / size), *(side / size)))
        ax.set_box_aspect(high - low, zoom=zoom)  # pyright: ignore[reportArgumentType]
        drawn = _pixels(ax, corners) / figure.dpi
        least, most = drawn.min(axis=0), drawn.max(axis=0)
        centre = centre + middle - (least + most) / 2
        zoom *= float(np.min(room / (most - least)))
    _set_ticks(ax)


def fit_height(ax: Axes3D, rectangle: tuple[float, float, float, float]) -> None:
    """`fill`, in a figure as high as the box needs, between half its width and its width."""
    fill(ax, rectangle)
    low, high = limits(ax)
    corners = np.array(np.meshgrid(*np.transpose([low, high]), indexing="ij")).reshape(3, 8).T
    figure = ax.figure
    drawn = np.ptp(_pixels(ax, corners), axis=0) / figure.dpi
    width = figure.get_size_inches()[0]  # pyright: ignore[reportAttributeAccessIssue]
    wide = rectangle[2] * width - 2 * _LABEL_ROOM
    needed = (drawn[1] * wide / drawn[0] + 2 * _LABEL_ROOM) / rectangle[3]
    figure.set_size_inches(width, np.clip(needed, 0.5 * width, 0.8 * width))  # pyright: ignore[reportAttributeAccessIssue]
    fill(ax, rectangle)


def world_frame(ax: Axes3D, gravity: np.ndarray | None = None) -> None:
    """The axes of the world's frame at the lower corner of the box, and from its upper corner an
    arrow in the direction of gravity.

    **Arguments:** `ax`: 3D axes with final limits; `gravity`: acceleration [m/s^2].
    """
    low, high = limits(ax)
    arm = 0.13 * np.max(high - low)
    for axis, name, color in zip(np.eye(3), "xyz", FRAME_COLORS, strict=True):
        _arrow(ax, low, arm * axis, color, name)
    if gravity is not None and np.any(gravity):
        start = np.array([low[0], low[1], high[2]])
        _arrow(ax, start, arm * gravity / np.linalg.norm(gravity), ink(0.7), "g")


def _arrow(ax: Axes3D, start: np.ndarray, along: np.ndarray, color: object, name: str) -> None:
    """A line with a head and a name, which leaves the limits as they are."""
    across = np.cross(along, (0.3, 0.5, 0.8)) * 0.12
    tip = start + along
    head = [[tip, tip - 0.25 * along + sign * across] for sign in (-1, 1)]
    lines = Line3DCollection([[start, tip], *head], colors=[color], linewidths=1.4)
    ax.add_artist(lines)
    x, y, z = start + 1.5 * along
    ax.text(x, y, z, name, color=color, ha="center", va="center", fontsize=8)
