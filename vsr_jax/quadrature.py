"""Gauss-Legendre nodes on the pieces of an arm.

An arm is cut at its breakpoints into pieces on which everything is smooth; each piece is cut into equal steps and each
step carries the same Gauss nodes. Nodes and weights of the reference step are constants; the pieces may be traced.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._types import Scalar


class Grid(NamedTuple):
    """Steps along an arm with their Gauss nodes: `start` and `h` [m] of each step, `X` and `weight` [m] of each node."""

    start: Float[Array, " steps"]
    h: Float[Array, " steps"]
    X: Float[Array, "stages steps"]
    weight: Float[Array, "stages steps"]


def gauss_legendre(stages: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of Gauss-Legendre quadrature on [0, 1]; exact for polynomials of degree `2 stages - 1`."""
    nodes, weights = np.polynomial.legendre.leggauss(stages)
    return (nodes + 1) / 2, weights / 2


def piece_edges(length: Scalar, breakpoints: tuple[Scalar, ...]) -> Float[Array, " edges"]:
    """Ends of the pieces of [0, L], rising; breakpoints beyond the arm make empty pieces at its ends."""
    inner = [jnp.clip(point, 0, length) for point in breakpoints]
    return jnp.sort(jnp.stack([jnp.zeros_like(length), *inner, length]))


def make_grid(edges: Float[Array, " edges"], steps: int, stages: int) -> Grid:
    """Grid of at least `steps` steps, shared evenly by the pieces between `edges`, with `stages` nodes a step."""
    pieces = edges.size - 1
    share = -(-steps // pieces)
    width = jnp.repeat(jnp.diff(edges) / share, share, total_repeat_length=pieces * share)
    start = jnp.repeat(edges[:-1], share, total_repeat_length=pieces * share)
    start = start + width * np.tile(np.arange(share), pieces).astype(width.dtype)
    nodes, weights = (x.astype(width.dtype) for x in gauss_legendre(stages))
    return Grid(start, width, start + nodes[:, None] * width, jnp.asarray(weights[:, None] * width))
