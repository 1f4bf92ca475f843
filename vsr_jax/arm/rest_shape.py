"""Arms whose rest shape is a curve through points."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics import se3
from ..numerics.compiling import program
from ..numerics.loops import fori_loop, scan
from ..numerics.magnus import step_twist
from ..numerics.quadrature import gauss_legendre
from ..typing import ArrayLike, MatrixLike, Pose, Scalar, ScalarLike
from ..validation import concrete, numbers, rotation_fault
from .placement import pose
from .profile import FunctionOfX
from .spline import spline_rate, spline_slopes

Points = Float[Array, "points 3"]
Frames = Float[Array, "points 3 3"]

_CORRECTIONS = 6
"""Corrections of the strain, each of which gains the square of the angle from point to point."""


class RestShape(NamedTuple):
    """A curve as an arm at rest: its `length` [m], its `strain` as a function of X, its `base`."""

    length: Scalar
    strain: FunctionOfX
    base: Pose


def rest_shape(points: MatrixLike, frames: ArrayLike | None, roll: ScalarLike) -> RestShape:
    r"""The curve through points, see `vsr_jax.Rod.through`.

    Tangents and abscissas come from a cubic spline through the points, parametrized by its arc
    length, and frames, if there are none, from rotation-minimizing transport. The strain is the
    derivative of a cubic spline $\Theta(X)$ whose increments are the logarithms of $g_i^{-1}
    g_{i+1}$, corrected until the strain, integrated by Magnus steps of order 6, leads from each
    pose to the next.

    **Source:** W. Wang, B. Jüttler, D. Zheng, Y. Liu, Computation of rotation minimizing frames,
    ACM Transactions on Graphics 27 (2008): double reflection.
    """
    r = _checked_points(points)
    R = None if frames is None else _checked_frames(frames, r)
    start = pose(pointing=_chords(r)[0], roll=roll)[:3, :3].astype(r.dtype)
    *spline, base = _curve(r, R, start)
    return RestShape(spline[0][-1], FunctionOfX("Rod.through", spline_rate, *spline), base)


@program("rest shape")
def _curve(r: Points, R: Frames | None, start: Array) -> tuple[Array, Array, Array, Pose]:
    """The spline whose derivative is the strain, and the first pose; `start` is a rotation whose y
    axis is that of the first frame, but for its share along the curve."""
    X = jnp.concatenate([jnp.zeros(1, r.dtype), jnp.cumsum(jnp.linalg.norm(_chords(r), axis=1))])
    for _ in range(2):  # from the lengths of chords to those of arcs
        X = _arc_lengths(X, r)
    if R is None:
        tangents = _slopes(X, r)
        R = _transported(r, tangents / jnp.linalg.norm(tangents, axis=1, keepdims=True), start)
    poses = jax.vmap(se3.pose)(R, r)
    wanted = jax.vmap(lambda g, after: se3.log(se3.inverse(g) @ after))(poses[:-1], poses[1:])
    turns = fori_loop(
        0, _CORRECTIONS, lambda _, turns: turns + wanted - _twists(*_spline(X, turns)), wanted
    )
    return *_spline(X, turns), poses[0]


def _spline(X: Array, turns: Array) -> tuple[Array, Array, Array]:
    """Abscissas, values and slopes of the spline with the increments `turns` (pieces, 6)."""
    sums = jnp.concatenate([jnp.zeros_like(turns[:1]), jnp.cumsum(turns, axis=0)])
    return X, sums, _slopes(X, sums)


def _twists(X: Array, sums: Array, slopes: Array) -> Array:
    """Magnus increments (pieces, 6) of the strain from each abscissa to the next."""
    nodes = jnp.asarray(gauss_legendre(3)[0], X.dtype)

    def twist(start: Scalar, h: Scalar) -> Array:
        stages = [spline_rate(start + h * node, X, sums, slopes) for node in nodes]
        return step_twist(jnp.stack(stages), h)

    return jax.vmap(twist)(X[:-1], jnp.diff(X))


def _slopes(X: Array, values: Array) -> Array:
    return jax.vmap(spline_slopes, (None, 1), 1)(X, values)


def _arc_lengths(t: Array, r: Points) -> Array:
    """Arc length [m] of the spline through `r` at the parameters `t`, at its points."""
    nodes, weights = (jnp.asarray(x, t.dtype) for x in gauss_legendre(5))
    places = t[:-1, None] + jnp.diff(t)[:, None] * nodes
    rates = jax.vmap(lambda x: spline_rate(x, t, r, slopes))
    slopes = _slopes(t, r)
    speed = jnp.linalg.norm(jax.vmap(rates)(places), axis=-1)
    lengths = jnp.diff(t) * (speed @ weights)
    return jnp.concatenate([jnp.zeros(1, t.dtype), jnp.cumsum(lengths)])


def _transported(r: Points, tangents: Points, start: Float[Array, "3 3"]) -> Frames:
    """Rotation-minimizing frames along a curve."""

    def reflected(axis: Array, vector: Array) -> Array:
        return vector - 2 * (axis @ vector) / (axis @ axis) * axis

    def across(tangent: Array, y: Array) -> Array:
        y = y - (tangent @ y) * tangent
        return y / jnp.linalg.norm(y)

    def moved(y: Array, at: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        chord, tangent, after = at
        mirrored = reflected(chord, tangent)
        y = across(after, reflected(after - mirrored, reflected(chord, y)))
        return y, y

    first = across(tangents[0], start[:, 1])
    _, rest = scan(moved, first, (_chords(r), tangents[:-1], tangents[1:]))
    y = jnp.concatenate([first[None], rest])
    return jnp.stack([tangents, y, jnp.cross(tangents, y)], axis=-1)


def _chords(r: Points) -> Float[Array, "pieces 3"]:
    return jnp.diff(r, axis=0)


def _checked_points(points: MatrixLike) -> Points:
    r = numbers("Rod.through.points", points, None)
    if r.ndim != 2 or r.shape[0] < 2 or r.shape[1] != 3:
        raise ValueError(
            f"Rod.through.points: got shape {r.shape}, need two points or more, shape (points, 3)"
        )
    known = concrete(r)
    if known is not None:
        near = np.flatnonzero(~np.any(np.diff(known, axis=0), axis=1))
        if near.size:
            raise ValueError(
                f"Rod.through.points: got the same point at {near[0]} and {near[0] + 1}, need "
                f"different ones in a row"
            )
    return r


def _checked_frames(frames: ArrayLike, r: Points) -> Frames:
    name = "Rod.through.frames"
    R = numbers(name, frames, (r.shape[0], 3, 3)).astype(r.dtype)
    known, chords = concrete(R), concrete(_chords(r))
    if known is not None:
        wrong = [rotation_fault(one) is not None for one in known]
        if any(wrong):
            raise ValueError(f"{name}: got no rotation at point {np.argmax(wrong)}, need rotations")
        if chords is not None:
            along = np.concatenate([chords, chords[-1:]])
            against = np.einsum("pi,pi->p", known[:, :, 0], along) <= 0
            if np.any(against):
                raise ValueError(
                    f"{name}: got an x axis against the curve at point {np.argmax(against)}, need "
                    f"x axes along it"
                )
    return R
