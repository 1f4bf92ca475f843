r"""Acceleration of a linearly convergent iteration $x_{k+1} = x_k - d_k$ whose steps $g(x)$ vanish
at the solution."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

_PARALLEL = 1e-4
"""Squared sine of the angle between both changes of the steps below which only the last is used."""
_LARGEST = 50.0
"""Largest multiple of an earlier step that is taken again."""


class Earlier(NamedTuple):
    """Steps before the last one: $g_{k-1}$, $d_{k-2}$ and $g_{k-2}$."""

    proposed: Any
    taken: Any
    before: Any


def accelerated(
    step: Any, last: Any, earlier: Earlier, both: Array, dot: Callable[[Any, Any], Array]
) -> Any:
    r"""Step of Anderson's acceleration of depth two (D. G. Anderson, J. ACM 12, 1965),

    $$d_k = g_k + \sum_j \gamma_j (d_j - \Delta_j), \quad \Delta_j = g_j - g_{j+1}, \quad
    j = k - 1, k - 2,$$

    where $\gamma$ minimises $|g_k - \sum_j \gamma_j \Delta_j|$: exact where two motions of the arm
    converge linearly, with contractions of either sign.

    **Arguments:** `step`: $g_k$; `last`: $d_{k-1}$; `both`: whether the steps before the last one
    may be used, one entry per problem; `dot`: scalar product of two steps.
    """
    first = _difference(earlier.proposed, step)
    second = _difference(earlier.before, earlier.proposed)
    a, b, c = dot(first, first), dot(first, second), dot(second, second)
    p, q = dot(first, step), dot(second, step)
    determinant = a * c - b * b
    both = both & (determinant > _PARALLEL * a * c)
    whole = jnp.where(both, determinant, jnp.where(a > 0, a, 1.0))
    gamma = jnp.where(both, p * c - q * b, p) / whole
    other = jnp.where(both, q * a - p * b, 0.0) / whole
    gamma, other = (jnp.clip(x, -_LARGEST, _LARGEST) for x in (gamma, other))
    return jax.tree.map(
        lambda g, d, change, taken, before: (
            g + gamma.astype(g.dtype) * (d - change) + other.astype(g.dtype) * (taken - before)
        ),
        step,
        last,
        first,
        earlier.taken,
        second,
    )


def _difference(one: Any, other: Any) -> Any:
    return jax.tree.map(jnp.subtract, one, other)
