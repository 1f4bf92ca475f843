"""Stations along an arm that resolve its shape to a tolerance, with all that a solid or a drawing
needs there, in NumPy arrays.

A breakpoint has two stations, one on each side, because sizes may jump there.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..arm.rod import Rod
from ..arm.routing import thread_tangent
from ..arm.scene import Scene
from ..numerics.compiling import program
from ..solution.equilibrium import Equilibrium
from ..typing import DTypeLike, Scalar

MILLIMETRES = 1e3
"""Millimetres per metre: files for the workshop are in millimetres."""

MOST_STATIONS = 20_000
"""Stations above which a tolerance is refused."""

_BLOCK = 64
"""Abscissas per call: every call runs the same compiled program."""

_PROBES = (0.38, 0.71)
"""Places in an interval where its chord is compared with the arm; not simple fractions, so that
coils between two stations are seen."""

_FIRST_INTERVALS = 16
_FEWEST_INTERVALS = 3
_MOST_PARTS = 8
_FEWEST_ANGLES, _MOST_ANGLES = 72, 720


class Stations(NamedTuple):
    """An arm at stations from base to tip, in metres.

    **Fields:** `X` (stations,); `piece`, the smooth piece of the arm of each station; `pose`
    (stations, 4, 4); `outline` (y, z) of the outer wall, counterclockwise from the y axis to the z
    axis, (stations, angles, 2); `inner`, radius of the central hole (stations,); `path` (y, z) of
    each thread (stations, threads, 2); `laid`, whether the thread is there (stations, threads);
    `inside`, the abscissas moved into their pieces by rounding, where sections are evaluated.
    """

    X: Float[np.ndarray, " stations"]
    piece: Int[np.ndarray, " stations"]
    pose: Float[np.ndarray, "stations 4 4"]
    outline: Float[np.ndarray, "stations angles 2"]
    inner: Float[np.ndarray, " stations"]
    path: Float[np.ndarray, "stations threads 2"]
    laid: Bool[np.ndarray, "stations threads"]
    inside: Float[np.ndarray, " stations"]

    def place(self, yz: Float[np.ndarray, "stations points 2"]) -> np.ndarray:
        """Points of the sections in space [m], shape (stations, points, 3)."""
        y, z = yz[..., 0, None], yz[..., 1, None]
        R, r = self.pose[:, None, :3, :3], self.pose[:, None, :3, 3]
        return r + R[..., 1] * y + R[..., 2] * z

    @property
    def threads(self) -> Float[np.ndarray, "stations threads 3"]:
        """Positions of the threads [m]."""
        return self.place(self.path)


def stations_of(eq: Equilibrium, scene: Scene, tolerance: float) -> Stations:
    """Stations at which chords are within `tolerance` [m] of the outer wall, the axis and the
    threads.

    **Arguments:** `eq`: gives the poses; `scene`: gives sections and threads, on the same rod.

    **Raises:** `ValueError` if more than `MOST_STATIONS` are needed, and for NaN.
    """
    sampler = _Sampler(eq, scene, tolerance)
    return sampler.at(*sampler.resolved(tolerance))


def sections_at(scene: Scene, X: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (y, z) [m] of each thread, its slope $(t_y, t_z) / t_x$ at rest, and whether it is
    laid there, each with shape (stations, threads, ...). A thread is laid at both of its ends."""
    found = in_blocks(lambda x: _sections(scene, x, jnp.zeros(1, x.dtype)), _typed(scene, X))
    laid = np.array(
        [(low - 1e-9 * high <= X) & (high * (1 + 1e-9) >= X) for low, high in thread_ends(scene)]
    )
    return found[2], found[3], laid.reshape(-1, X.size).T


def thread_ends(scene: Scene) -> list[tuple[float, float]]:
    """Abscissas [m] of the start and the end of each thread."""
    length = float(scene.rod.length)
    return [
        (
            0.0 if actuator.start is None else float(actuator.start),
            length if actuator.end is None else min(float(actuator.end), length),
        )
        for actuator in scene.actuators
    ]


class _Sampler:
    """Evaluates an arm at abscissas of its smooth pieces."""

    def __init__(self, eq: Equilibrium, scene: Scene, tolerance: float):
        self.eq, self.scene = eq, scene
        self.dtype = eq.inputs.dtype
        length = float(scene.rod.length)
        edges = np.unique(np.asarray(scene.edges(), float))
        kept = np.concatenate(([True], np.diff(edges) > 1e-9 * length))
        self.edges = edges[kept]
        self.edges[-1] = length
        self.ends = thread_ends(scene)
        self.angle = _angles(_FEWEST_ANGLES, self.dtype)
        widest = np.max(np.linalg.norm(self.at(*self._coarse()).outline, axis=-1))
        number = polygon_size(widest, tolerance, _FEWEST_ANGLES)
        self.angle = _angles(number, self.dtype)

    def at(self, X: np.ndarray, piece: np.ndarray) -> Stations:
        """The arm at abscissas [m]; at the ends of its piece as inside of it."""
        x = _typed(self.scene, X)
        low, high = (_typed(self.scene, ends) for ends in (self.edges[:-1], self.edges[1:]))
        inside = np.clip(x, np.nextafter(low, high)[piece], np.nextafter(high, low)[piece])
        pose = in_blocks(lambda x: self.eq.pose(x), x)
        outline, inner, path, _ = in_blocks(lambda x: _sections(self.scene, x, self.angle), inside)
        middle = 0.5 * (self.edges[:-1] + self.edges[1:])[piece]
        laid = np.array([(low < middle) & (middle < high) for low, high in self.ends])
        return Stations(
            X, piece, pose, outline, inner, path, laid.reshape(-1, X.size).T.astype(bool), inside
        )

    def resolved(self, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
        """Abscissas and pieces of the stations that meet the tolerance."""
        low, high, piece = self._intervals()
        done: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        while low.size:
            off = self._deviation(low, high, piece)
            if not np.all(np.isfinite(off)):
                X = low[np.argmin(np.isfinite(off))]
                raise ValueError(
                    f"arm: got a shape or a path that is NaN near X = {X:.4g} m, need finite ones"
                )
            wanted = np.ceil(np.sqrt(off / tolerance))
            parts = wanted.clip(1, _MOST_PARTS).astype(int)
            fine = parts == 1
            done.append((low[fine], high[fine], piece[fine]))
            low, high, piece = _split(low[~fine], high[~fine], piece[~fine], parts[~fine])
            if np.sum(wanted) + sum(part[0].size for part in done) > MOST_STATIONS:
                raise ValueError(
                    f"tolerance: got {tolerance:g} m, which needs more than {MOST_STATIONS} "
                    f"stations along the arm; need a larger one"
                )
        low, high, piece = (np.concatenate(part) for part in zip(*done, strict=True))
        X = np.concatenate((low, self.edges[1:]))
        piece = np.concatenate((piece, np.arange(self.edges.size - 1)))
        order = np.lexsort((X, piece))
        return X[order], piece[order]

    def _coarse(self) -> tuple[np.ndarray, np.ndarray]:
        low, high, piece = self._intervals()
        return np.concatenate((low, high)), np.concatenate((piece, piece))

    def _intervals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        low, high = self.edges[:-1], self.edges[1:]
        share = np.ceil(_FIRST_INTERVALS * (high - low) / self.edges[-1]).astype(int)
        return _split(low, high, np.arange(low.size), np.maximum(_FEWEST_INTERVALS, share))

    def _deviation(self, low: np.ndarray, high: np.ndarray, piece: np.ndarray) -> np.ndarray:
        """Distance [m] of the chords from the arm in each interval."""

        def points(X: np.ndarray) -> np.ndarray:
            here = self.at(X, piece)
            axis = here.pose[:, None, :3, 3]
            return np.concatenate((axis, here.place(here.outline), here.threads), axis=1)

        first, last, off = points(low), points(high), np.zeros(low.size)
        for share in _PROBES:
            chord = (1 - share) * first + share * last
            far = np.linalg.norm(points(low + share * (high - low)) - chord, axis=-1)
            off = np.maximum(off, np.max(far, axis=1) / (4 * share * (1 - share)))
        return off


def _split(
    low: np.ndarray, high: np.ndarray, piece: np.ndarray, parts: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Every interval in equal parts."""
    of = np.repeat(np.arange(low.size), parts)
    place = np.arange(of.size) - np.repeat(np.cumsum(parts) - parts, parts)
    width = ((high - low) / parts)[of]
    start = low[of] + place * width
    end = np.where(place + 1 == parts[of], high[of], low[of] + (place + 1) * width)
    return start, end, piece[of]


def _angles(number: int, dtype: DTypeLike) -> Array:
    """Angles [rad] around the outline; a multiple of 8 of them keeps the corners of rectangles."""
    return jnp.arange(number, dtype=dtype) * (2 * np.pi / number)


def polygon_size(radius: float, tolerance: float, fewest: int) -> int:
    """Corners of a polygon in a circle whose sides are within a tolerance of it; a multiple of
    8."""
    sagitta = min(tolerance / radius, 1.0)
    number = np.pi / np.arccos(1 - sagitta)
    return 8 * int(np.ceil(np.clip(number, fewest, _MOST_ANGLES) / 8))


def _typed(scene: Scene, X: np.ndarray) -> np.ndarray:
    return X.astype(scene.rod.length.dtype)


def in_blocks(function: Callable[[Array], Any], X: np.ndarray) -> Any:
    """A function of abscissas, called with blocks of one size."""
    count = -(-X.size // _BLOCK)
    padded = np.concatenate((X, np.full(count * _BLOCK - X.size, X[-1], X.dtype)))
    blocks = [
        jax.tree.map(lambda leaf: np.asarray(leaf, float), function(jnp.asarray(block)))
        for block in np.split(padded, count)
    ]
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: X.size], *blocks)


@program("export")
def _sections(scene: Scene, X: Array, angle: Array) -> tuple[Array, Array, Array, Array]:
    rod, sections = scene.rod, scene.sections(X)
    outline = jax.vmap(lambda x: _outline(rod, x, angle))(X)
    inner = jax.vmap(
        lambda x: jnp.broadcast_to(rod.section.inner_radius(x, rod.length), ()).astype(X.dtype)
    )(X)
    tangents = [thread_tangent(sections.rest, path) for path in sections.paths]
    if not tangents:
        empty = jnp.zeros((X.size, 0, 2), X.dtype)
        return outline, inner, empty, empty
    path = jnp.stack([jnp.stack((p.y, p.z), axis=-1) for p in sections.paths], axis=1)
    slope = jnp.stack([jnp.stack((t[1], t[2]), axis=-1) / t[0][:, None] for t in tangents], axis=1)
    return outline, inner, path, slope


def _outline(rod: Rod, X: Scalar, angle: Float[Array, " angles"]) -> Float[Array, "angles 2"]:
    """Points (y, z) [m] of the outer wall: that of the section, and the rim of a disc of known
    radius and thickness where it reaches beyond the section."""
    wall = [
        jnp.broadcast_to(part, angle.shape) for part in rod.section.outline(angle, X, rod.length)
    ]
    points = jnp.stack(wall, axis=-1)
    if rod.discs is None or rod.rim is None:
        return points
    rim = rod.rim * jnp.stack((jnp.cos(angle), jnp.sin(angle)), axis=-1)
    beyond = rod.rim > rod.section.outer_radius(X, rod.length)
    return jnp.where(rod.discs.stiffen(X, rod.length) & beyond, rim, points)
