"""Types that signatures share: array shapes (see jaxtyping for the notation), arguments that are
converted to arrays, paths; and the change of precision of a tree."""

import os
from collections.abc import Sequence
from typing import TypeVar

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
    """`tree` with its floating-point arrays in `dtype`."""
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, tree
    )
