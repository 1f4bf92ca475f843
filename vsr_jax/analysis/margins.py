r"""Constraints as residuals of least squares: $v \max(0, \epsilon - g_k)$ for the margins $g_k$."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..solution.equilibrium import Equilibrium
from ..typing import Scalar
from .arms import Arms
from .constraint import Constraint

_INSIDE, _STRICT = 1e-4, 100.0
r"""The margin $\epsilon$ that constraints are to have, and the weight v: so heavy that they hold as
well where other residuals do not vanish."""


def margins_of(constraints: tuple[Constraint, ...], eq: Equilibrium) -> Float[Array, " margins"]:
    """Margins of at least one constraint for one arm."""
    arms = Arms.of(eq)
    return jnp.concatenate([constraint(arms) for constraint in constraints])


def shortfall(margins: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The residuals."""
    return _STRICT * jnp.maximum(_INSIDE - margins, 0.0)


def violation(margins: Float[Array, "*shape"]) -> Scalar:
    """Largest violation, 0 where all constraints hold, infinite where a margin is not known."""
    least = jnp.min(margins)
    return jnp.where(jnp.isfinite(least), jnp.maximum(-least, 0.0), jnp.inf)
