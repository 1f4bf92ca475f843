"""Cubic not-a-knot splines. **Source:** C. de Boor, A Practical Guide to Splines, ch. IV."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.loops import scan
from ..typing import Scalar, ScalarLike, VectorLike
from ..validation import concrete, numbers

Points = Float[Array, " points"]


def spline_points(name: str, value: VectorLike) -> Points:
    """`value` as the abscissas [m] of a spline: at least two, increasing."""
    points = numbers(name, value, None)
    if points.ndim != 1 or points.size < 2:
        raise ValueError(
            f"{name}: got shape {points.shape}, need an array of two abscissas or more"
        )
    known = concrete(points)
    if known is not None and not np.all(np.diff(known) > 0):
        raise ValueError(f"{name}: got {known.tolist()}, need increasing abscissas")
    return points


def spline_breakpoints(points: Points) -> tuple[Scalar, ...]:
    """Abscissas [m] where the third derivative jumps: all but two at each end."""
    return tuple(points[i] for i in range(2, points.size - 2))


def spline_value(X: ScalarLike, points: Points, values: Points) -> Scalar:
    """Value at X [m] of the spline through `values` at the abscissas `points` [m].

    Two points give the straight line and three the parabola through them. The first and the last
    piece extend beyond the end points.
    """
    slopes = spline_slopes(points, values)
    i, h, s = _piece(X, points)
    secant = (values[i + 1] - values[i]) / h
    d0, d1 = slopes[i], slopes[i + 1]
    return values[i] + h * s * (d0 + s * ((3 * secant - 2 * d0 - d1) + s * (d0 + d1 - 2 * secant)))


def spline_rate(X: ScalarLike, points: Points, values: Array, slopes: Array) -> Array:
    """Derivative at X [m] of the spline through `values` (points, ...), from its `slopes`."""
    i, h, s = _piece(X, points)
    secant = (values[i + 1] - values[i]) / h
    d0, d1 = slopes[i], slopes[i + 1]
    return d0 + s * (2 * (3 * secant - 2 * d0 - d1) + 3 * s * (d0 + d1 - 2 * secant))


def _piece(X: ScalarLike, points: Points) -> tuple[Array, Scalar, ScalarLike]:
    """Index of the piece in which X [m] is, its length, and the share of it before X."""
    i = jnp.clip(jnp.searchsorted(points, X, side="right") - 1, 0, points.size - 2)
    h = points[i + 1] - points[i]
    return i, h, (X - points[i]) / h


def spline_slopes(points: Points, values: Points) -> Points:
    """Derivatives of the spline at its points."""
    x, h = points, jnp.diff(points)
    secant = jnp.diff(values) / h
    n = x.size
    if n == 2:
        return jnp.stack([secant[0], secant[0]])
    if n == 3:
        second = (secant[1] - secant[0]) / (x[2] - x[0])
        return jnp.stack(
            [secant[0] - second * h[0], secant[0] + second * h[0], secant[1] + second * h[1]]
        )
    inner = 3 * (h[1:] * secant[:-1] + h[:-1] * secant[1:])
    ends = []
    for (p, q), (s, t) in ((h[:2], secant[:2]), (h[-2:][::-1], secant[-2:][::-1])):
        ends.append((q, p + q, ((p + 2 * (p + q)) * q * s + p**2 * t) / (p + q)))
    (first, above, start), (last, below, end) = ends
    lower = jnp.concatenate([jnp.zeros(1, x.dtype), h[1:], below[None]])
    diagonal = jnp.concatenate([first[None], 2 * (h[:-1] + h[1:]), last[None]])
    upper = jnp.concatenate([above[None], h[:-1], jnp.zeros(1, x.dtype)])
    return _tridiagonal(lower, diagonal, upper, jnp.concatenate([start[None], inner, end[None]]))


def _tridiagonal(lower: Array, diagonal: Array, upper: Array, right: Array) -> Array:
    """Solution by elimination; the rows of a spline need no pivoting."""

    def down(
        above: tuple[Array, Array], row: tuple[Array, Array, Array, Array]
    ) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (ratio, value), (left, middle, beyond, side) = above, row
        pivot = middle - left * ratio
        here = beyond / pivot, (side - left * value) / pivot
        return here, here

    def up(after: Array, row: tuple[Array, Array]) -> tuple[Array, Array]:
        here = row[1] - row[0] * after
        return here, here

    zero = jnp.zeros((), right.dtype)
    _, rows = scan(down, (zero, zero), (lower, diagonal, upper, right))
    return scan(up, zero, rows, reverse=True)[1]
