"""Array shapes that signatures share (see jaxtyping for the notation), and the change of precision
of a whole tree."""

from typing import Any

import equinox as eqx
import jax
from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Twist = Float[Array, "6"]
Pose = Float[Array, "4 4"]


def cast(tree: Any, dtype: Any) -> Any:
    """`tree` with its floating-point arrays in `dtype`."""
    return jax.tree.map(
        lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, tree
    )
