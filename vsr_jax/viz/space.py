"""Axes in space: one scale, a view that fits the data, the world's frame."""

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
    """Labels of a position in space."""
    ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")


def equal_scale(ax: Axes3D, *, zoom: float = 1.1, thinnest: float = THINNEST_BOX) -> None:
    """Sets one scale for x, y and z: the box has the proportions of the data.

    **Arguments:** `ax`: 3D axes; `zoom`: size of the box in them; `thinnest`: least side of the box
    relative to the longest.
    """
    low = np.array([*ax.xy_dataLim.min, ax.zz_dataLim.x0])
    high = np.array([*ax.xy_dataLim.max, ax.zz_dataLim.x1])
    span = np.maximum(high - low, thinnest * np.max(high - low)) * 1.04
    middle = (low + high) / 2
    sides = zip(
        middle - span / 2,
        middle + span / 2,
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


def limits(ax: Axes3D) -> tuple[np.ndarray, np.ndarray]:
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
    corners = np.array(np.meshgrid(*np.transpose([low, high]), indexing="ij")).reshape(3, 8)
    size = np.array(ax.figure.get_size_inches())  # pyright: ignore[reportAttributeAccessIssue]
    corner, extent = np.array(rectangle[:2]), np.array(rectangle[2:])
    middle, room = (corner + extent / 2) * size, extent * size - 2 * _LABEL_ROOM
    side, zoom = np.max(extent * size), 1.0
    centre = middle
    for _ in range(3):
        ax.set_position((*((centre - side / 2) / size), *(side / size)))
        ax.set_box_aspect(high - low, zoom=zoom)  # pyright: ignore[reportArgumentType]
        x, y, _ = proj3d.proj_transform(*corners, ax.get_proj())
        drawn = ax.transData.transform(np.transpose([x, y])) / ax.figure.dpi
        least, most = drawn.min(axis=0), drawn.max(axis=0)
        centre = centre + middle - (least + most) / 2
        zoom *= float(np.min(room / (most - least)))
    ax.set_position((*((centre - side / 2) / size), *(side / size)))


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
    ax.text(*(start + 1.25 * along), name, color=color, ha="center", va="center", fontsize=8)
