r"""Numbers kept between bounds by a smooth map: $p = p_0 + (p_1 - p_0) \sin^2(z / 2)$ for any z.
The bounds themselves are reached.

Without bounds $p = \pi z$, of which z from 0 to $\pi$ are more than a turn and a half.
"""

import jax.numpy as jnp
from jaxtyping import Array

_INSIDE = 0.01
"""Share of the range by which starts keep off its ends, where the map's slope is nothing."""


def share(z: Array) -> Array:
    r"""Share of the range, $\sin^2(z / 2)$."""
    return jnp.sin(z / 2) ** 2


def at_share(share: Array) -> Array:
    """The z of a share, which is taken a little off the ends."""
    return 2 * jnp.arcsin(jnp.sqrt(jnp.clip(share, _INSIDE, 1 - _INSIDE)))


def number(low: Array, high: Array, z: Array) -> Array:
    """The number at z; where the bounds are infinite it has none."""
    endless = jnp.isinf(low)
    start, span = jnp.where(endless, 0.0, low), jnp.where(endless, 0.0, high - low)
    return jnp.where(endless, jnp.pi * z, start + span * share(z))


def coordinate(low: Array, high: Array, number: Array) -> Array:
    """The z of a number, which is taken a little off the bounds."""
    span = jnp.where(high > low, high - low, 1.0)
    return jnp.where(jnp.isinf(low), number / jnp.pi, at_share((number - low) / span))
