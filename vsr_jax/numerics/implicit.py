"""What the implicit derivatives of all solvers share: tangents of what does not move are left out,
those of truth values are empty."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from .component import Tree


def change_of(function: Callable, primals: tuple, tangents: tuple) -> Any:
    """Derivative of a function along tangents of which some are symbolic zeros: by those it is not
    differentiated at all.

    A scene has dozens of numbers; mostly a few of them move, and the rest would double the program
    for nothing.
    """
    leaves, tree = jax.tree.flatten(primals)
    rates = jax.tree.leaves(tangents)
    moving = [i for i, rate in enumerate(rates) if not isinstance(rate, SymbolicZero)]

    def moved(*values: Array) -> Any:
        changed = dict(zip(moving, values, strict=True))
        return function(
            *jax.tree.unflatten(tree, [changed.get(i, leaf) for i, leaf in enumerate(leaves)])
        )

    return jax.jvp(moved, tuple(leaves[i] for i in moving), tuple(rates[i] for i in moving))[1]


def instantiated(tangents: Tree, primals: Tree) -> Tree:
    """Tangents with arrays of zeros for symbolic ones."""
    return jax.tree.map(
        lambda rate, x: jnp.zeros_like(x) if isinstance(rate, SymbolicZero) else rate,
        tangents,
        primals,
    )


def no_derivative(*values: Array) -> tuple[Any, ...]:
    """Tangents of integer and boolean outputs."""
    return tuple(np.zeros(value.shape, jax.dtypes.float0) for value in values)
