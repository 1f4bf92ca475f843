"""Types that signatures share: array shapes (see jaxtyping for the notation), arguments that are
converted to arrays, paths; and the change of precision of a tree."""

import os
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Twist = Float[Array, "6"]
Pose = Float[Array, "4 4"]

VectorLike = ArrayLike | Sequence[ArrayLike]
"""An array of one axis, or a list or tuple of numbers."""

MatrixLike = ArrayLike | Sequence[VectorLike]
"""An array of two axes, or a list or tuple of its rows."""

PathLike = str | os.PathLike[str]
"""The path of a file or folder."""

Tree = TypeVar("Tree")


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
