r"""Smooth map from the real line to an interval: $p = p_0 + (p_1 - p_0) \sin^2(z / 2)$ for any z.
The ends of the interval are attained.

Without bounds $p = \pi z$, so that $0 \le z \le \pi$ covers more than one and a half turns of an
angle.
"""

import jax.numpy as jnp
from jaxtyping import Array

_INSET = 0.01
"""Share of the range that starting points keep from its ends, where the map has zero slope."""


def share(z: Array) -> Array:
    r"""Share of the range, $\sin^2(z / 2)$."""
    return jnp.sin(z / 2) ** 2


def at_share(share: Array) -> Array:
    """Coordinate z of a share; shares at an end are moved slightly inside."""
    return 2 * jnp.arcsin(jnp.sqrt(jnp.clip(share, _INSET, 1 - _INSET)))


def number(low: Array, high: Array, z: Array) -> Array:
    """Number at z; an infinite `low` means that there are no bounds."""
    unbounded = jnp.isinf(low)
    start, span = jnp.where(unbounded, 0.0, low), jnp.where(unbounded, 0.0, high - low)
    return jnp.where(unbounded, jnp.pi * z, start + span * share(z))


def coordinate(low: Array, high: Array, number: Array) -> Array:
    """Coordinate z of a number; numbers at a bound are moved slightly inside."""
    span = jnp.where(high > low, high - low, 1.0)
    return jnp.where(jnp.isinf(low), number / jnp.pi, at_share((number - low) / span))
