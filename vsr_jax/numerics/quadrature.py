"""Gauss-Legendre nodes on the pieces of an arm.

An arm is cut at its breakpoints into pieces on which everything is smooth; each piece is cut into
equal steps and each step carries the same Gauss nodes. Nodes and weights of the reference step are
constants; the pieces may be traced.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from ..typing import Scalar
from .loops import scan
from .small_product import parts


class Grid(NamedTuple):
    """Steps along an arm with their Gauss nodes: `start` and `h` [m] of each step, `X` and `weight`
    [m] of each node."""

    start: Float[Array, " steps"]
    h: Float[Array, " steps"]
    X: Float[Array, "stages steps"]
    weight: Float[Array, "stages steps"]


def gauss_legendre(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss-Legendre quadrature on [0, 1]; exact for polynomials of degree `2
    stages - 1`."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    return (nodes + 1) / 2, weights / 2


def piece_edges(length: Scalar, breakpoints: tuple[Scalar, ...]) -> Float[Array, " edges"]:
    """Ends of the pieces of [0, L] in ascending order; breakpoints beyond the arm make empty pieces
    at its ends."""
    inner = [jnp.clip(point, 0, length) for point in breakpoints]
    ends = jnp.stack([jnp.zeros_like(length), *inner, length])
    return ascending(ends) if inner else ends


def ascending(values: Float[Array, " values"]) -> Float[Array, " values"]:
    """A few values in ascending order, each placed by the number of those before it.

    XLA cannot store a program with a sort of its own (JAX 0.12), so that it would compile in every
    process.
    """
    place = jnp.arange(values.size)
    first = (values < values[:, None]) | ((values == values[:, None]) & (place < place[:, None]))
    there = jnp.sum(first, axis=1)[:, None] == place
    return jnp.sum(jnp.where(there, values[:, None], 0.0), axis=0)


def make_grid(
    edges: Float[Array, " edges"], steps: int | Array, stages: int, *, room: int | None = None
) -> Grid:
    """Grid of `steps` steps with `stages` nodes each.

    Every piece between `edges` has at least one step, also an empty piece, whose derivative by its
    length is then right; the other steps are distributed by the lengths of the pieces. Where
    `steps` is traced, `room` is the largest number: the steps beyond `steps` are empty and lie at
    the end of the arm.
    """
    least = edges.size - 1
    place = np.arange(max(int(steps) if room is None else room, least))
    wanted = max(int(steps), least) if room is None else jnp.maximum(steps, least)
    if least == 1:
        begin, width, at = edges[0], (edges[1] - edges[0]) / wanted, place
    else:
        begin, width, at = _distributed(edges, wanted, jnp.asarray(place))
    width = jnp.broadcast_to(width, place.shape)
    start = begin + at.astype(width.dtype) * width
    if room is not None:
        there = place < wanted
        width, start = jnp.where(there, width, 0.0), jnp.where(there, start, edges[-1])
    nodes, weights = (x.astype(width.dtype) for x in gauss_legendre(stages))
    return Grid(start, width, start + nodes[:, None] * width, jnp.asarray(weights[:, None] * width))


def _distributed(
    edges: Float[Array, " edges"], steps: int | Array, place: Array
) -> tuple[Array, Array, Array]:
    """For each step the start of its piece, its own length and its place in the piece, by the
    largest-remainder method.

    A few pieces are ranked and looked up by comparing all of them, which compiles to a fraction of
    the code of a sort, a search and gathers, whose derivatives scatter.
    """
    lengths = edges[1:] - edges[:-1]
    pieces = np.arange(lengths.size)
    exact = (steps - lengths.size) * lengths / jnp.sum(lengths)
    whole = jnp.floor(exact)
    missing = exact - whole
    ahead = (missing > missing[:, None]) | (
        (missing == missing[:, None]) & (pieces < pieces[:, None])
    )
    spare = steps - lengths.size - jnp.sum(whole).astype(int)
    count = 1 + whole.astype(int) + (jnp.sum(ahead, axis=1) < spare).astype(int)
    last = jnp.cumsum(count)
    piece = jnp.minimum(jnp.sum(last <= place[:, None], axis=1), lengths.size - 1)
    own = piece[:, None] == pieces

    def of_piece(values: Array) -> Array:
        return jnp.sum(jnp.where(own, values, 0), axis=1)

    return (
        of_piece(edges[:-1]),
        of_piece(lengths / count.astype(edges.dtype)),
        place - of_piece(last - count),
    )


def interpolation(stages: int, origin: float = 0.0) -> np.ndarray:
    r"""Coefficients $b_{pl}$ of the polynomial $\sum_p (\sigma - \sigma_0)^p \sum_l b_{pl} f_l$
    through values $f_l$ at the Gauss nodes on [0, 1].

    **Arguments:** `stages`; `origin`: $\sigma_0$.
    """
    return np.linalg.inv(np.vander(gauss_legendre(stages)[0] - origin, increasing=True))


def collocation(stages: int) -> np.ndarray:
    """Weights $a_{ij}$ of the integral from the start of a step of length 1 to its node i of the
    polynomial through values at the nodes: the coefficients of Gauss collocation."""
    powers = np.arange(1, stages + 1)
    return (gauss_legendre(stages)[0][:, None] ** powers / powers) @ interpolation(stages)


def remaining(stages: int) -> np.ndarray:
    """Weights of the integrals from each node, and in the last row from the start, to the end of a
    step of length 1; shape (stages + 1, stages)."""
    weights = gauss_legendre(stages)[1]
    return np.vstack([weights - collocation(stages), weights])


def merging(stages: int) -> np.ndarray:
    """Weights of the interpolation from the Gauss nodes of two equal steps, first those of the
    first step, to the nodes of the merged step, by the polynomial through all of them; shape
    (stages, 2 stages)."""
    nodes = gauss_legendre(stages)[0]
    through = np.linalg.inv(np.vander(np.concatenate([nodes, nodes + 1]) / 2, increasing=True))
    return np.vander(nodes, 2 * stages, increasing=True) @ through


def weighted(weights: np.ndarray, values: Array, axis: int = 0) -> Array:
    """Weighted sums of the values at the nodes of a step, along an axis: one for weights of shape
    (stages,), or one per row of a matrix of weights, in place of the axis."""
    nodes = parts(values, axis)
    if weights.ndim == 1:
        factors = weights.tolist()
    else:
        shape = [1] * values.ndim
        shape[axis] = -1
        factors = [column.reshape(shape) for column in weights.T.astype(values.dtype)]
    terms: list[Array] = [factor * node for factor, node in zip(factors, nodes, strict=True)]
    total = sum(terms[1:], terms[0])
    return total if weights.ndim > 1 else lax.squeeze(total, (axis,))


def beyond(density: Array, grid: Grid) -> Array:
    r"""Integral from each node to the end of the arm, $\int_X^L q \, ds$: exact for q of degree
    `stages - 1` in each step.

    **Arguments:** `density`: components $q$ at the nodes, shape (components, stages, steps, *arms).
    """
    sums = weighted(remaining(grid.X.shape[0]), grid.h * density, axis=1)
    whole = jnp.moveaxis(sums[:, -1], 1, 0)
    none = jnp.zeros_like(whole[0])
    _, later = scan(lambda total, part: (total + part, total), none, whole, reverse=True)
    return sums[:, :-1] + jnp.moveaxis(later, 0, 1)[:, None]


def sum_along(density: Array, grid: Grid) -> Array:
    """Integral over the whole arm, of the same number of axes as `density`: components at the
    nodes, shape (components, stages, steps, *arms)."""
    return jnp.sum(grid.weight * density, axis=(1, 2), keepdims=True)


def before(density: Array, grid: Grid) -> Array:
    r"""Integral from the base to each node, $\int_0^X q \, ds$; see `beyond`."""
    return sum_along(density, grid) - beyond(density, grid)


def before_point(grid: Grid, X: Scalar) -> tuple[Array, Array]:
    """Number of steps that start before X, and 1 at the nodes before X, 0 beyond."""
    return jnp.sum(grid.start < X), (grid.X < X).astype(grid.h.dtype)


def locate(grid: Grid, X: Array) -> tuple[Array, Array]:
    """Step in which each abscissa lies, and its place in the step as a fraction."""
    step = jnp.clip(jnp.searchsorted(grid.start, X, side="right") - 1, 0, grid.start.size - 1)
    h = grid.h[step]
    return step, jnp.where(h > 0, (X - grid.start[step]) / jnp.where(h > 0, h, 1.0), 0.0)


def onto(X: Array, start: Array | float, end: Array | float, slack: Array) -> tuple[Array, Array]:
    """Abscissas clipped to [start, end], and whether they lie there or at most `slack` beyond it.

    The others become `start`, so that results computed from them are finite. The derivative of the
    clipped ones is 1.
    """
    near = (X - start >= -slack) & (X - end <= slack)
    x = jnp.where(near, X, start)
    return x + lax.stop_gradient(jnp.clip(x, start, end) - x), near


def within(density: Array, grid: Grid, step: Array, sigma: Array | float) -> Array:
    r"""Integral from the start of a step to the fraction $\sigma$ of it of the polynomial through
    the values at its nodes, shape (components, stages, steps)."""
    weights = integral_weights(jnp.asarray(sigma, density.dtype), grid.X.shape[0])
    terms = [weight * density[:, i, step] for i, weight in enumerate(weights)]
    return grid.h[step] * sum(terms[1:], terms[0])


def value_weights(sigma: Array, stages: int) -> Array:
    r"""Weights (stages, ...) of the values at the nodes of a step in their polynomial at the
    fraction $\sigma$ of it."""
    return _by_nodes([sigma**p for p in range(stages)])


def integral_weights(sigma: Array, stages: int) -> Array:
    r"""Weights (stages, ...) of the values at the nodes of a step of length 1 in the integral of
    their polynomial from the start to the fraction $\sigma$."""
    return _by_nodes([sigma ** (p + 1) / (p + 1) for p in range(stages)])


def _by_nodes(powers: list[Array]) -> Array:
    """Weights of the nodes in what is linear in a polynomial, from that of each power."""
    rows = interpolation(len(powers)).T.tolist()
    return jnp.stack([sum(b * x for b, x in zip(row, powers, strict=True)) for row in rows])
