"""Channels of a body and the walls around them."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from .stations import MILLIMETRES, Stations

_ROWS = 32
"""Chords of one channel that are compared at a time with the nearby ones of another."""


@dataclass(frozen=True)
class Wall:
    """The thinnest place of the wall between a channel and something else.

    **Fields:** `thread`, the index of the channel; `other`, in words, such as `"the outside"` or
    `"the channel of thread 2"`; `X` [m]; `thickness` [m], negative where the two overlap.
    """

    thread: int
    other: str
    X: float
    thickness: float

    def __str__(self) -> str:
        return (
            f"the wall between the channel of thread {self.thread} and {self.other} is "
            f"{MILLIMETRES * self.thickness:.3g} mm at X = {self.X:.4g} m"
        )


def depths(stations: Stations) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] of each thread from the outer wall, positive inside, and from the central hole,
    positive outside of it and infinite where there is none; shape (stations, threads)."""
    outer = (
        np.stack(
            [depth(stations.outline, path) for path in np.moveaxis(stations.path, 1, 0)], axis=1
        )
        if stations.path.shape[1]
        else np.zeros((stations.X.size, 0))
    )
    radius = np.linalg.norm(stations.path, axis=-1)
    inner = stations.inner[:, None]
    return outer, np.where(inner > 0, radius - inner, np.inf)


def channels(stations: Stations) -> Bool[np.ndarray, "stations threads"]:
    """Where a thread runs in the material and has a channel: in every smooth piece of the arm that
    does not have it in the open from end to end, outside or in the central hole."""
    room = np.minimum(*depths(stations))
    found = stations.laid.copy()
    for piece in np.unique(stations.piece):
        rows = stations.piece == piece
        found[rows] &= np.any(room[rows] > 0, axis=0)
    return found


def default_bores(
    stations: Stations, given: Float[np.ndarray, " threads"], usual: float
) -> Float[np.ndarray, " threads"]:
    """Diameters [m]: those given where they are not NaN, else `usual`, or less where that would
    leave a wall thinner than half the distance to it: the least distance of the thread from a wall,
    half the least distance of two threads."""
    room, inside = np.minimum(*depths(stations)), channels(stations)
    least = np.min(np.where(inside, room, np.inf), axis=0, initial=np.inf)
    for i, j in _pairs(stations):
        distance, _ = _distance(stations, inside, i, j)
        least[[i, j]] = np.minimum(least[[i, j]], distance / 2)
    return np.where(np.isnan(given), np.minimum(usual, np.maximum(least, 0.0)), given)


def walls(stations: Stations, bores: Float[np.ndarray, " threads"]) -> list[Wall]:
    """The thinnest walls: of each channel to the outside and to the central hole, and of every two
    channels, between tubes of the given diameters [m] around the threads."""
    inside, found = channels(stations), []
    for room, other in zip(depths(stations), ("the outside", "the central hole"), strict=True):
        for i, bore in enumerate(bores):
            here = np.where(inside[:, i], room[:, i], np.inf)
            row = int(np.argmin(here))
            if np.isfinite(here[row]):
                X, thickness = float(stations.X[row]), float(here[row] - bore / 2)
                found.append(Wall(i, other, X, thickness))
    for i, j in _pairs(stations):
        distance, X = _distance(stations, inside, i, j)
        if np.isfinite(distance):
            thickness = float(distance - (bores[i] + bores[j]) / 2)
            found.append(Wall(i, f"the channel of thread {j}", X, thickness))
    return sorted(found, key=lambda wall: wall.thickness)


def _pairs(stations: Stations) -> Iterator[tuple[int, int]]:
    number = stations.path.shape[1]
    return ((i, j) for i in range(number) for j in range(i + 1, number))


def _distance(stations: Stations, inside: np.ndarray, i: int, j: int) -> tuple[float, float]:
    """Least distance [m] in space between the channels of two threads, and its X on the first.

    Only places near each other along X are compared: an arm that is bent onto itself has no wall
    there.
    """
    X = stations.X
    chords = []
    for thread in (i, j):
        rows = np.flatnonzero(inside[:-1, thread] & inside[1:, thread] & (np.diff(X) > 0))
        points = stations.threads[:, thread]
        chords.append((rows, points[rows], points[rows + 1] - points[rows]))
    (rows, a, along), (others, b, beside) = chords
    if not (rows.size and others.size):
        return np.inf, np.nan
    near = 2 * np.max(np.linalg.norm(stations.outline, axis=-1))
    least, place = np.inf, np.nan
    for block in np.array_split(np.arange(rows.size), -(-rows.size // _ROWS)):
        row = rows[block]
        low, high = X[row[0]] - near, X[row[-1] + 1] + near
        close = (X[others + 1] >= low) & (X[others] <= high)
        if not np.any(close):
            continue
        far, share = _between_segments(a[block, None], along[block, None], b[close], beside[close])
        nearest = np.unravel_index(np.argmin(far), far.shape)
        if far[nearest] < least:
            start, end = X[row[nearest[0]]], X[row[nearest[0]] + 1]
            least, place = float(far[nearest]), float(start + share[nearest] * (end - start))
    return least, place


def _between_segments(
    a: np.ndarray, along: np.ndarray, b: np.ndarray, beside: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of segments that start at `a` and `b`, and the share of the first at which it is:
    at an end of one of the two, or where the common perpendicular meets both."""
    far, share = _to_segments(b, a, along)
    candidates = [(far, share), _to_segments(b + beside, a, along)]
    for end in (0.0, 1.0):
        far, _ = _to_segments(a + end * along, b, beside)
        candidates.append((far, np.full_like(far, end)))
    product, between = np.sum(along * beside, axis=-1), a - b
    squares = np.sum(along**2, axis=-1), np.sum(beside**2, axis=-1)
    offsets = np.sum(along * between, axis=-1), np.sum(beside * between, axis=-1)
    determinant = squares[0] * squares[1] - product**2
    skew = determinant > 1e-12 * squares[0] * squares[1]
    divisor = np.where(skew, determinant, 1.0)
    s = (product * offsets[1] - squares[1] * offsets[0]) / divisor
    t = (squares[0] * offsets[1] - product * offsets[0]) / divisor
    meets = skew & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    across = np.linalg.norm(between + s[..., None] * along - t[..., None] * beside, axis=-1)
    candidates.append((np.where(meets, across, np.inf), s))
    fars, shares = (np.stack(part) for part in zip(*candidates, strict=True))
    best = np.argmin(fars, axis=0)[None]
    return np.take_along_axis(fars, best, 0)[0], np.take_along_axis(shares, best, 0)[0]


def depth(outline: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of points (stations, 2) from polygons (stations, corners, 2), positive inside."""
    edge = np.roll(outline, -1, axis=1) - outline
    far = np.min(_to_segments(points[:, None], outline, edge)[0], axis=1)
    corner = outline - points[:, None]
    following = np.roll(corner, -1, axis=1)
    cross = corner[..., 0] * following[..., 1] - corner[..., 1] * following[..., 0]
    turn = np.sum(np.arctan2(cross, np.sum(corner * following, axis=-1)), axis=1)
    return np.where(np.abs(turn) > np.pi, far, -far)


def _to_segments(
    points: np.ndarray, start: np.ndarray, along: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distance of points from segments, and the share of the segment at which it is."""
    square = np.sum(along**2, axis=-1)
    share = np.sum((points - start) * along, axis=-1) / np.where(square > 0, square, 1.0)
    share = np.clip(share, 0, 1)
    return np.linalg.norm(points - start - share[..., None] * along, axis=-1), share
