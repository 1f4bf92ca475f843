"""The body of an arm as a closed surface of triangles, its channels as holes.

The surface is built ring by ring from the stations, not by boolean operations: every vertex lies on
the outline or on a channel, and the surface is closed by construction. That needs channels that
stay in the material and apart from each other, which is checked. Faces at the ends of the arm and
at steps of the outline are polygons with holes; manifold3d triangulates them.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..arm.scene import Scene
from ..files.output import replacing
from ..typing import PathLike
from .channels import channel_rings
from .libraries import library
from .stations import MILLIMETRES, Stations
from .walls import Wall, channels, depth

_EQUAL = 1e-9


class Body(NamedTuple):
    """A closed surface; its triangles are counterclockwise seen from outside.

    **Fields:** `vertices` [mm], in single precision as an STL file has them, shape (vertices, 3);
    `triangles`, the indices of their corners, shape (triangles, 3).
    """

    vertices: Float[np.ndarray, "vertices 3"]
    triangles: Int[np.ndarray, "triangles 3"]

    @property
    def volume(self) -> float:
        r"""Volume [mm^3], $\frac16 \sum a \cdot (b \times c)$ over the triangles."""
        corners = self.vertices.astype(float) - np.mean(self.vertices, axis=0, dtype=float)
        a, b, c = np.moveaxis(corners[self.triangles], 1, 0)
        return float(np.sum(a * np.cross(b, c)) / 6)


class _Tube(NamedTuple):
    """Rings (y, z) [m] at the stations where the tube is `there`, shape (stations, corners, 2), and
    the indices of their vertices, shape (stations, corners)."""

    rings: np.ndarray
    there: np.ndarray
    vertices: np.ndarray


class _Step(NamedTuple):
    """A step of the outline between the stations `row` and `row + 1`, with one ring inside the
    other: the `wide` station of the two, the `narrow` one, and the tubes that end on the step."""

    row: int
    wide: int
    narrow: int
    opened: list[_Tube]


def body_of(
    scene: Scene,
    stations: Stations,
    bores: Float[np.ndarray, " threads"],
    walls: Sequence[Wall],
    tolerance: float,
) -> Body:
    """The body at its stations, with a channel of diameter `bores` [m] around each thread where it
    runs in the material. A channel ends flat where its thread is tied.

    **Raises:** `ValueError` if a channel meets another one, the outside or the central hole, or
    winds too steeply; `ImportError` without manifold3d.
    """
    for wall in walls:
        if not wall.thickness > 0:
            raise ValueError(
                f"bore: got {MILLIMETRES * bores[wall.thread]:.4g} mm, with which {wall}; need "
                f"channels that stay in the material and apart from each other"
            )
    stations = _without_rounding(stations)
    outer, *holes = _tubes(stations, _channels(scene, stations, bores, tolerance))
    steps = [
        step
        for row in _jumps(stations.outline, stations).tolist()
        for step in _step(row, stations, outer, holes)
    ]
    last = stations.X.size - 1
    joined = np.ones(last, bool)
    joined[[step.row for step in steps]] = False
    triangles = [
        _skin(outer, joined),
        *(_reversed(_skin(tube, tube.there[:-1] & tube.there[1:])) for tube in holes),
        _reversed(_face(_ring(outer, 0), [_ring(tube, 0) for tube in holes if tube.there[0]])),
        _face(_ring(outer, last), [_ring(tube, last) for tube in holes if tube.there[last]]),
        *(_step_face(step, outer) for step in steps),
        *(face for tube in holes for face in _bottoms(tube, steps)),
    ]
    points = [stations.place(tube.rings).reshape(-1, 3) for tube in (outer, *holes)]
    return _closed(MILLIMETRES * np.concatenate(points), np.concatenate(triangles))


def write_stl(path: PathLike, body: Body) -> None:
    """Writes a body as a binary STL file, in millimetres.

    **Raises:** `ImportError` without trimesh.
    """
    mesh = library("trimesh").Trimesh(body.vertices, body.triangles, process=False)
    content = mesh.export(file_type="stl")
    with replacing(path) as part:
        part.write_bytes(content)


def folds(stations: Stations) -> float | None:
    """The first X [m] where the arm is bent so sharply that sections cross each other, so that no
    body has this shape; None if there is none."""
    step = np.diff(stations.place(stations.outline), axis=0)
    ahead = np.einsum("spi,si->sp", step, stations.pose[:-1, :3, 0])
    crossed = (np.diff(stations.X) > 0) & np.any(ahead <= 0, axis=1)
    return float(stations.X[np.argmax(crossed)]) if np.any(crossed) else None


def _without_rounding(stations: Stations) -> Stations:
    """Stations with the same pose on both sides of a breakpoint."""
    pose = stations.pose.copy()
    double = np.flatnonzero(np.diff(stations.X) == 0)
    pose[double] = pose[double + 1]
    return stations._replace(pose=pose)


Rings = tuple[np.ndarray, np.ndarray]
"""Rings (y, z) [m] at the stations, and where they are there."""


def _tubes(stations: Stations, channel_tubes: Iterable[Rings]) -> Iterator[_Tube]:
    """The outer wall, then the central hole and the channels, where there are some."""
    count = 0
    for rings, there in (*_walls(stations), *channel_tubes):
        jumps = _jumps(rings, stations)
        equal = np.setdiff1d(np.flatnonzero(np.diff(stations.X) == 0), jumps)
        rings[equal] = rings[equal + 1]
        vertices = count + np.arange(rings.shape[0] * rings.shape[1]).reshape(rings.shape[:2])
        count += vertices.size
        yield _Tube(rings, there, vertices)


def _walls(stations: Stations) -> Iterator[Rings]:
    """The outline and, if there is one, the central hole. It has as many corners as the outline, so
    that the wall of a thin tube keeps its share of the area."""
    yield stations.outline.copy(), np.ones(stations.X.size, bool)
    hollow = stations.inner > 0
    if np.any(hollow):
        corners = stations.outline.shape[1]
        angle = 2 * np.pi * np.arange(corners) / corners
        circle = np.stack((np.cos(angle), np.sin(angle)), axis=-1)
        yield stations.inner[:, None, None] * circle, hollow


def _channels(
    scene: Scene, stations: Stations, bores: Float[np.ndarray, " threads"], tolerance: float
) -> Iterator[Rings]:
    inside = channels(stations)
    rings, off = channel_rings(scene, stations, bores, tolerance)
    for i, there in enumerate(inside.T):
        lost = there & ~(off[:, i] < tolerance)
        if np.any(lost):
            raise ValueError(
                f"bore: got {MILLIMETRES * bores[i]:.4g} mm for thread {i}, which winds too "
                f"steeply for a channel of this size at X = {stations.X[np.argmax(lost)]:.4g} m; "
                f"need a smaller bore or a longer pitch"
            )
        if np.any(there):
            yield rings[i], there


def _jumps(rings: np.ndarray, stations: Stations) -> np.ndarray:
    """Rows after which a ring jumps, at a breakpoint."""
    double = np.flatnonzero(np.diff(stations.X) == 0)
    far = np.max(np.abs(rings[double + 1] - rings[double]), axis=(1, 2), initial=0.0)
    return double[far > _EQUAL * stations.X[-1]]


def _step(row: int, stations: Stations, outer: _Tube, holes: Sequence[_Tube]) -> Iterator[_Step]:
    """The step of the outline after a row, if one ring is inside the other. Other jumps become a
    strip of the skin between the two rings.

    **Raises:** `ValueError` if a hole that ends on the step is cut by the narrow outline.
    """
    for wide, narrow in ((row, row + 1), (row + 1, row)):
        inner = outer.rings[narrow]
        if not np.all(_inside(outer.rings[wide], inner) > 0):
            continue
        opened = []
        for tube in holes:
            if not tube.there[wide] or tube.there[narrow]:
                continue
            depths = _inside(inner, tube.rings[wide])
            if np.all(depths < 0) and np.all(_inside(tube.rings[wide], inner) < 0):
                opened.append(tube)
            elif not np.all(depths > 0):
                raise ValueError(
                    f"scene: a hole that ends on the step of the section at X = "
                    f"{stations.X[row]:.4g} m is cut by the smaller section; need one inside or "
                    f"outside of it"
                )
        yield _Step(row, wide, narrow, opened)
        return


def _inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance of points from one polygon [m], positive inside."""
    return depth(np.broadcast_to(polygon, (points.shape[0], *polygon.shape)), points)


def _step_face(step: _Step, outer: _Tube) -> np.ndarray:
    holes = [_ring(outer, step.narrow), *(_ring(tube, step.wide) for tube in step.opened)]
    face = _face(_ring(outer, step.wide), holes)
    return face if step.wide == step.row else _reversed(face)


def _skin(tube: _Tube, joined: np.ndarray) -> np.ndarray:
    """Triangles between the rings of neighbouring stations, those that are `joined`, seen from
    outside the tube."""
    first, last = tube.vertices[:-1][joined], tube.vertices[1:][joined]
    first_next, last_next = np.roll(first, -1, axis=1), np.roll(last, -1, axis=1)
    both = np.stack(
        [np.stack((first, first_next, last_next), -1), np.stack((first, last_next, last), -1)]
    )
    return both.reshape(-1, 3)


Ring = tuple[np.ndarray, np.ndarray]
"""Points (y, z) [m] and the indices of their vertices."""


def _ring(tube: _Tube, row: int) -> Ring:
    return tube.rings[row], tube.vertices[row]


def _face(outer: Ring, holes: Iterable[Ring] = ()) -> np.ndarray:
    """Triangles of a plane face with holes, seen from the tip."""
    rings = [outer, *((points[::-1], vertices[::-1]) for points, vertices in holes)]
    corners = library("manifold3d").triangulate([MILLIMETRES * points for points, _ in rings])
    return np.concatenate([vertices for _, vertices in rings])[np.asarray(corners)]


def _bottoms(tube: _Tube, steps: Sequence[_Step]) -> Iterator[np.ndarray]:
    """The ends of a hole inside the body, except those that open on a step."""
    open_rows = [step.wide for step in steps if any(tube is other for other in step.opened)]
    starts = (1 + np.flatnonzero(tube.there[1:] & ~tube.there[:-1])).tolist()
    ends = np.flatnonzero(tube.there[:-1] & ~tube.there[1:]).tolist()
    yield from (_face(_ring(tube, row)) for row in starts if row not in open_rows)
    yield from (_reversed(_face(_ring(tube, row))) for row in ends if row not in open_rows)


def _reversed(triangles: np.ndarray) -> np.ndarray:
    return triangles[:, ::-1]


def _closed(points: np.ndarray, triangles: np.ndarray) -> Body:
    """The surface without doubled vertices and empty triangles.

    **Raises:** `ValueError` if some edge does not have a triangle on each side.
    """
    vertices, place = np.unique(points.astype(np.float32), axis=0, return_inverse=True)
    triangles = place.reshape(-1)[triangles]
    a, b, c = triangles.T
    triangles = triangles[(a != b) & (b != c) & (c != a)]
    used, compact = np.unique(triangles, return_inverse=True)
    triangles = compact.reshape(-1, 3)
    edges = np.concatenate([triangles[:, pair] for pair in ((0, 1), (1, 2), (2, 0))])
    ways = [np.unique(side, axis=0, return_counts=True) for side in (edges, edges[:, ::-1])]
    single = all(np.all(counts == 1) for _, counts in ways)
    if not (single and np.array_equal(ways[0][0], ways[1][0])):
        raise ValueError(
            "scene: the surface of the body is not closed in single precision; need walls and "
            "steps of more than a millionth of the arm's length"
        )
    return Body(vertices[used], triangles)
