"""Triangles and segments of an arm: its wall as a closed tube, discs, threads, loads."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from ..viz.annotate import Row

ARROW = 0.16
"""Length of the arrow of a load of reference size, relative to the arm."""
_LONGEST = 2.5
"""Longest arrow, relative to that of reference size."""


class Mesh(NamedTuple):
    """Vertices [m], shape (vertices, 3), and triangles, counterclockwise seen from outside."""

    vertices: np.ndarray
    triangles: np.ndarray


def tube(wall: Float[np.ndarray, "stations angles 3"]) -> Mesh:
    """The closed surface of a wall whose last angle is the first one again."""
    rings = wall[:, :-1]
    stations, angles = rings.shape[:2]
    index = np.arange(stations * angles).reshape(stations, angles)
    following = np.roll(index, -1, axis=1)
    a, b, c, d = index[:-1], following[:-1], following[1:], index[1:]
    skin = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)  # two for each quadrilateral
    base, tip = stations * angles, stations * angles + 1
    ends = [
        np.stack([np.full(angles, base), following[0], index[0]], axis=-1),
        np.stack([np.full(angles, tip), index[-1], following[-1]], axis=-1),
    ]
    middles = rings[[0, -1]].mean(axis=1)
    return Mesh(np.concatenate([rings.reshape(-1, 3), middles]), np.concatenate([skin, *ends]))


def tube_values(
    values: Float[np.ndarray, "stations angles"],
) -> Float[np.ndarray, " triangles"]:
    """Values at the wall as values of the triangles of its `tube`: the mean of each quadrilateral,
    and at the ends of each edge."""
    edges = (values[:, :-1] + values[:, 1:]) / 2
    skin = np.repeat(((edges[:-1] + edges[1:]) / 2).reshape(-1), 2)
    return np.concatenate([skin, edges[0], edges[-1]])


def tube_parts(parts: Bool[np.ndarray, " between"], angles: int) -> Bool[np.ndarray, " triangles"]:
    """A property of the parts between stations as that of the triangles of a `tube`.

    **Arguments:** `angles`: number of points of each ring of the wall, the last of which is the
    first one again.
    """
    skin = np.repeat(parts, 2 * (angles - 1))
    return np.concatenate([skin, *(np.repeat(end, angles - 1) for end in parts[[0, -1]])])


def bands(mesh: Mesh, level: Int[np.ndarray, " triangles"], count: int) -> list[Mesh]:
    """The parts of a mesh whose triangles have the levels 0 to `count` - 1, each with its own
    vertices."""
    parts = []
    for i in range(count):
        triangles = mesh.triangles[level == i]
        used, compact = np.unique(triangles, return_inverse=True)
        parts.append(Mesh(mesh.vertices[used], compact.reshape(-1, 3)))
    return parts


def discs(rims: Float[np.ndarray, "discs angles 3"]) -> Mesh:
    """Flat discs from their rims, whose last angle is the first one again."""
    rims = rims[:, :-1]
    count, angles = rims.shape[:2]
    index = np.arange(count * angles).reshape(count, angles)
    middle = np.broadcast_to(count * angles + np.arange(count)[:, None], index.shape)
    triangles = np.stack([middle, index, np.roll(index, -1, axis=1)], axis=-1).reshape(-1, 3)
    return Mesh(np.concatenate([rims.reshape(-1, 3), rims.mean(axis=1)]), triangles)


def polygons(corners: Sequence[Float[np.ndarray, "_ 3"]]) -> Mesh:
    """Convex polygons, each as triangles that share its first corner."""
    first = np.cumsum([0, *(len(polygon) for polygon in corners)])
    fans = [
        start + np.stack([0 * (i := np.arange(1, len(polygon) - 1)), i, i + 1], axis=-1)
        for start, polygon in zip(first, corners, strict=False)
    ]
    none = np.zeros((0, 3))
    return Mesh(np.concatenate([none, *corners]), np.concatenate([none.astype(int), *fans]))


def segments(
    threads: Float[np.ndarray, "threads stations 3"], slack: Bool[np.ndarray, " threads"]
) -> tuple[Float[np.ndarray, "segments 2 3"], Int[np.ndarray, " segments"]]:
    """Segments of the threads and the thread of each; slack ones are dashed, and none goes beyond
    the ends of its thread."""
    pairs = np.stack([threads[:, :-1], threads[:, 1:]], axis=2)
    there = np.all(np.isfinite(pairs), axis=(2, 3))
    gap = np.arange(pairs.shape[1]) % 2 == 1
    there &= ~(slack[:, None] & gap)
    return pairs[there], np.nonzero(there)[0]


class ArrowScale:
    """Lengths of arrows, one scale per unit: the first load that is not zero has an arrow of
    `ARROW` of the arm's length; the scale only changes for loads that are far larger."""

    def __init__(self) -> None:
        self._references: dict[str, float] = {}

    def arrows(self, rows: Sequence[Row], length: float) -> list[Float[np.ndarray, "arrows 2 3"]]:
        """Start and end of the arrows of each row [m], for an arm of a length [m]."""
        found = []
        for row in rows:
            known = self._references.get(row.unit, row.greatest)
            known = self._references[row.unit] = max(known, row.greatest / _LONGEST)
            along = ARROW * length / known * row.vectors
            found.append(np.stack([row.places, row.places + along], axis=1))
        return found
