"""The surfaces of obstacles as polygons, and how they are drawn in space and in projections."""

from collections.abc import Sequence
from functools import singledispatch

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.obstacles import Box, Cylinder, Obstacle, Plane, Sphere
from ..arm.tube import Tube, curve_through
from ..numerics.compiling import program
from ..typing import Scalar
from .style import COLORS, ink, mixed

Polygons = list[Float[np.ndarray, "_ 3"]]
"""Convex polygons [m]."""

COLOR = COLORS[5]
_FILL = 0.3
"""Strength of the colour in projections."""
_ANGLES, _ALONG = 24, 48
"""Facets around an obstacle and along one."""
_CELLS, _PROJECTIONS = 64, 3
"""Cells along the longest side of the grid of a level set, and steps onto the surface."""
_ENDLESS, _FARTHEST = 0.25, 0.6
"""How far endless obstacles, and others, are drawn beyond the points of interest, relative to the
extent of these."""


class Region:
    """Where obstacles are drawn: around points [m], shape (points, 3)."""

    def __init__(self, points: Float[np.ndarray, "points 3"]):
        low, high = points.min(axis=0), points.max(axis=0)
        extent = float(np.max(high - low))
        self.low, self.high = low - _FARTHEST * extent, high + _FARTHEST * extent
        self.middle = (low + high) / 2
        near = np.stack([low - _ENDLESS * extent, high + _ENDLESS * extent])
        self._corners = np.array(np.meshgrid(*near.T, indexing="ij")).reshape(3, 8).T

    def along(self, axis: Float[np.ndarray, "3"]) -> np.ndarray:
        """Range [m] of the region of endless obstacles along a unit vector, from the origin."""
        along = self._corners @ axis
        return np.array([along.min(), along.max()])


def polygons_of(obstacle: Obstacle, points: Float[np.ndarray, "points 3"]) -> Polygons:
    """The surface of an obstacle near points [m], shape (points, 3)."""
    region = Region(points)
    return [
        clipped
        for polygon in _surface(obstacle, region)
        if len(clipped := _clipped(polygon, region.low, region.high)) > 2
    ]


def opacity(obstacle: Obstacle) -> float:
    """Opacity of its surface, less of one around the arm."""
    return 0.15 if obstacle.encloses else 0.28


def draw_obstacles(
    ax: Axes3D, obstacles: Sequence[Obstacle], points: Float[np.ndarray, "points 3"]
) -> None:
    """Translucent surfaces in space, near points [m]."""
    for obstacle in obstacles:
        polygons = polygons_of(obstacle, points)
        if polygons:
            style = {"linewidths": 0.0, "antialiaseds": False, "shade": True}
            faces = Poly3DCollection(polygons, facecolors=[COLOR], alpha=opacity(obstacle), **style)
            ax.add_collection3d(faces, autolim=False)
            ax.auto_scale_xyz(*np.concatenate(polygons).T, had_data=True)


def draw_outlines(
    ax: Axes,
    obstacles: Sequence[Obstacle],
    points: Float[np.ndarray, "points 3"],
    axes: tuple[int, int],
) -> None:
    """Areas that obstacles cover in a projection, whose horizontal and vertical axis are given; of
    planes the line where they are seen from the side, and the outline of what is drawn of them."""
    color = mixed(ink(0.0), COLOR, _FILL)
    for obstacle in obstacles:
        flat = [polygon[:, axes] for polygon in polygons_of(obstacle, points)]
        fill = "none" if isinstance(obstacle, Plane) else color
        ax.add_collection(PolyCollection(flat, facecolor=fill, edgecolor=color, zorder=0))


@singledispatch
def _surface(obstacle: Obstacle, region: Region) -> Polygons:
    """Polygons of the surface, by default of the level set of the distance on a grid: one corner in
    each cell that it passes, and a quadrilateral around each edge of the grid that it crosses
    (surface nets, Gibson 1998)."""
    low, high = region.low, region.high
    step = np.max(high - low) / _CELLS
    number = np.ceil((high - low) / step).astype(int) + 1
    nodes = np.stack(np.meshgrid(*map(np.arange, number), indexing="ij"), axis=-1)
    points = jnp.asarray((low + step * nodes).reshape(-1, 3))
    inside = np.asarray(_distances(obstacle, points)).reshape(number) < 0
    quads = []
    for axis in range(3):
        crossed = np.diff(inside, axis=axis)
        across = [i for i in range(3) if i != axis]
        cells = np.argwhere(crossed)
        cells = cells[np.all((cells[:, across] > 0) & (cells < number - 1)[:, across], axis=1)]
        around = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ np.eye(3, dtype=int)[across]
        quads.append(cells[:, None] - around)
    middles = jnp.asarray(low + step * (np.concatenate(quads).reshape(-1, 3) + 0.5))
    corners = _projected(obstacle, middles, jnp.asarray(step))
    return list(np.asarray(corners, float).reshape(-1, 4, 3))


@program("plot")
def _distances(obstacle: Obstacle, points: Array) -> Array:
    return jax.vmap(obstacle.distance)(points)


@program("plot")
def _projected(obstacle: Obstacle, points: Array, step: Scalar) -> Array:
    """Points moved to the surface along its normal, at most by a step [m] at a time."""

    def moved(point: Array) -> Array:
        distance, normal = jax.value_and_grad(obstacle.distance)(point)
        square = jnp.sum(normal**2)
        shift = distance / jnp.where(square > 0, square, 1.0)
        return point - jnp.clip(shift, -step, step) * normal

    for _ in range(_PROJECTIONS):
        points = jax.vmap(moved)(points)
    return points


@_surface.register
def _(obstacle: Plane, region: Region) -> Polygons:
    normal = np.asarray(obstacle.normal, float)
    normal = normal / np.linalg.norm(normal)
    # in the plane, one side along an axis of the world where possible
    first = np.cross(np.eye(3)[np.argmin(np.abs(normal))], normal)
    first = first / np.linalg.norm(first)
    second = np.cross(normal, first)
    height = float(normal @ np.asarray(obstacle.point, float))
    (a, b), (c, d) = region.along(first), region.along(second)
    corners = np.array([[a, c], [b, c], [b, d], [a, d]])
    return [height * normal + corners @ np.stack([first, second])]


@_surface.register
def _(obstacle: Sphere, region: Region) -> Polygons:
    centre, radius = np.asarray(obstacle.centre, float), float(obstacle.radius)
    towards = _unit(region.middle - centre)
    # of a large sphere only the cap near the points
    reach = np.linalg.norm(region.high - region.low) / radius
    latitude = np.linspace(0.0, min(np.pi, reach), _ANGLES // 2 + 1)
    frame = np.stack([*_across(towards), towards])
    rings = _ring(_ANGLES) * np.sin(latitude)[:, None, None]
    return _facets(centre + radius * _with_third(rings, np.cos(latitude)) @ frame)


@_surface.register
def _(obstacle: Cylinder, region: Region) -> Polygons:
    R, r = _frame(obstacle.pose)
    half = None if obstacle.length is None else float(obstacle.length) / 2
    low, high = region.along(R[:, 0]) - r @ R[:, 0] if half is None else (-half, half)
    radius = np.array([float(obstacle.radius)] * 2)
    x = np.array([low, high])
    if half is not None:
        radius, x = np.array([0.0, *radius, 0.0]), np.array([low, low, high, high])
    rings = _ring(_ANGLES) * radius[:, None, None]
    return _facets(r + _with_third(rings, x) @ R[:, [1, 2, 0]].T)


@_surface.register
def _(obstacle: Box, region: Region) -> Polygons:
    R, r = _frame(obstacle.pose)
    rounding = float(obstacle.rounding)
    inner = np.asarray(obstacle.size, float) / 2 - rounding
    steps = 5 if rounding > 0 else 1
    quarter = np.linspace(0.0, np.pi / 2, steps)
    around = np.concatenate([quarter + i * np.pi / 2 for i in range(4)])
    corner = np.repeat([[1, 1], [-1, 1], [-1, -1], [1, -1]], steps, axis=0) * inner[:2]
    up = np.concatenate([quarter - np.pi / 2, quarter])
    top = np.repeat([-1.0, 1.0], steps)
    ring = np.stack([np.cos(around), np.sin(around)], axis=-1)
    rings = corner + rounding * np.cos(up)[:, None, None] * ring
    rings = np.concatenate([rings, rings[:, :1]], axis=1)
    height = top * inner[2] + rounding * np.sin(up)
    # the first and the last ring bound the lower and the upper side
    rings = np.concatenate([0 * rings[:1], rings, 0 * rings[:1]])
    height = np.concatenate([height[:1], height, height[-1:]])
    return _facets(r + _with_third(rings, height) @ R.T)


@_surface.register
def _(obstacle: Tube, region: Region) -> Polygons:
    R, r = _frame(obstacle.pose)
    if obstacle.line is None:
        x = region.along(R[:, 0]) - r @ R[:, 0]
        rings = _ring(_ANGLES) * float(obstacle.radii[0])
        return _facets(r + _with_third(np.stack([rings, rings]), x) @ R[:, [1, 2, 0]].T)
    curve = curve_through(obstacle.line, obstacle.radius)
    s = jnp.linspace(0.0, 1.0, _ALONG + 1, dtype=curve.knots.dtype) * curve.knots[-1]
    centre, tangent, _ = (np.asarray(x, float) for x in jax.vmap(curve.at)(s))
    radius = jax.vmap(lambda x: jax.jvp(lambda y: curve.radius(y, s[-1]), (x,), (0 * x + 1,)))
    width, widening = (np.asarray(x, float) for x in radius(s))
    slope = np.clip(widening / np.linalg.norm(tangent, axis=1), -1.0, 1.0)
    tangent = tangent / np.linalg.norm(tangent, axis=1, keepdims=True)
    across = _transported(tangent)
    rim = np.einsum("ja,sak->sjk", _ring(_ANGLES), across)
    # the balls touch their envelope ahead of the centre where they become smaller
    rings = np.sqrt(1 - slope**2)[:, None, None] * rim - (slope[:, None] * tangent)[:, None]
    return _facets(r + (centre[:, None] + width[:, None, None] * rings) @ R.T)


def _transported(tangent: Float[np.ndarray, "stations 3"]) -> Float[np.ndarray, "stations 2 3"]:
    """Two unit vectors across a curve at each of its stations, without rotation about it."""
    first = [_across(tangent[0])[0]]
    for t in tangent[1:]:
        first.append(_unit(first[-1] - (first[-1] @ t) * t))
    return np.stack([np.array(first), np.cross(tangent, first)], axis=1)


def _frame(pose: object) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and position of a pose, the identity for None."""
    g = np.eye(4) if pose is None else np.asarray(pose, float)
    return g[:3, :3], g[:3, 3]


def _unit(v: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(v)
    return v / size if size > 0 else np.array([0.0, 0.0, 1.0])


def _across(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors that form a right-handed frame with a unit vector, which is the third."""
    first = _unit(np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis))
    return first, np.cross(axis, first)


def _ring(angles: int) -> Float[np.ndarray, "angles 2"]:
    """The unit circle, whose last point is the first one again."""
    angle = np.linspace(0.0, 2 * np.pi, angles + 1)
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def _with_third(rings: np.ndarray, third: np.ndarray) -> Float[np.ndarray, "rings angles 3"]:
    """Rings of two coordinates with a third one, which is that of each ring."""
    third = np.broadcast_to(np.asarray(third)[:, None, None], (*rings.shape[:2], 1))
    return np.concatenate([rings, third], axis=-1)


def _facets(rings: Float[np.ndarray, "rings angles 3"]) -> Polygons:
    """Quadrilaterals between neighbouring points of a grid."""
    a, b, c, d = rings[:-1, :-1], rings[:-1, 1:], rings[1:, 1:], rings[1:, :-1]
    return list(np.stack([a, b, c, d], axis=2).reshape(-1, 4, 3))


def _clipped(polygon: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The part of a convex polygon in a box, side by side (Sutherland and Hodgman 1974)."""
    for axis in range(3):
        for sign, bound in ((1.0, high[axis]), (-1.0, -low[axis])):
            room = bound - sign * polygon[:, axis]
            if np.all(room >= 0):
                continue
            corners = []
            for p, q, a, b in zip(
                polygon, np.roll(polygon, -1, axis=0), room, np.roll(room, -1), strict=True
            ):
                corners += [p] if a >= 0 else []
                corners += [p + a / (a - b) * (q - p)] if (a >= 0) != (b >= 0) else []
            polygon = np.array(corners).reshape(-1, 3)
    return polygon
