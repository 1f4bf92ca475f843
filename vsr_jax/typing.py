"""Types that signatures share: array shapes (see jaxtyping for the notation), arguments that are
converted to arrays, paths; and the conversion of numbers and of the precision of a tree.

What is converted has a type with a name, which help and messages show in place of its members.
"""

import os
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Real
from typing_extensions import TypeAliasType

Scalar = Float[Array, ""]
Twist = Float[Array, "6"]
Pose = Float[Array, "4 4"]

ScalarLike = TypeAliasType("ScalarLike", Real[Array | np.ndarray | np.number | float | int, ""])
"""A real number: of Python, NumPy or JAX."""

VectorLike = TypeAliasType("VectorLike", jax.typing.ArrayLike | Sequence[ScalarLike])
"""An array of one axis, or a list or tuple of numbers."""

MatrixLike = TypeAliasType("MatrixLike", jax.typing.ArrayLike | Sequence[VectorLike])
"""An array of two axes, or a list or tuple of its rows."""

ArrayLike = TypeAliasType("ArrayLike", jax.typing.ArrayLike | Sequence)
"""A number, an array of any number of axes, or lists or tuples in each other."""

DTypeLike = TypeAliasType("DTypeLike", jax.typing.DTypeLike)
"""What names a precision, as `"float32"` and `jnp.float64`."""

PathLike = TypeAliasType("PathLike", str | os.PathLike[str])
"""The path of a file or folder."""

Size = Any
"""Length of an axis: an integer, in `jax.export` also a symbol."""

Shape = tuple[Size, ...]
"""Lengths of axes."""

Tree = TypeVar("Tree")


def real(value: ArrayLike) -> Array:
    """`value` as a floating-point array; a number of Python, or integers, in the precision of what
    they are combined with."""
    array = value if isinstance(value, Array) else jnp.asarray(value)
    return array if jnp.issubdtype(array.dtype, jnp.floating) else 1.0 * array


def cast(tree: Tree, dtype: DTypeLike) -> Tree:
    """`tree` with its floating-point arrays in `dtype`, one that stands in several places converted
    once."""
    converted: dict[int, Array] = {}

    def once(leaf: Any) -> Any:
        if not eqx.is_inexact_array(leaf):
            return leaf
        if id(leaf) not in converted:
            converted[id(leaf)] = leaf.astype(dtype)
        return converted[id(leaf)]

    return jax.tree.map(once, tree)
