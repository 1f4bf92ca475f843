"""Batches of arms in the last axis of a solver's arrays, so that passes along the arm use
contiguous rows."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

_ALIASED = 64
"""Batch sizes that are multiples of this are padded: their rows would all map to the same few cache
lines."""


def side_by_side(solve: Callable) -> Callable:
    """`solve` with a rule for `jax.vmap` that puts the batch into the last axis of every array.

    With the batch in the first axis, every array is transposed before and after each pass along the
    arm, which took most of the time. Padding with eight copies of the last arm costs less than rows
    whose length is a power of two.

    **Arguments:** `solve`: takes pytrees of arrays and returns one. For a batch each array has one
    more axis at its end, of size 1 where it is the same for all arms.
    """

    @custom_vmap
    def batched_solve(*arguments: Any) -> Any:
        return solve(*arguments)

    @batched_solve.def_vmap
    def _(size: int, batched: list, *arguments: Any) -> tuple[Any, Any]:
        batch_size = size + 8 if size % _ALIASED == 0 else size
        # copies of the last arm fill the row; an empty batch has none
        place = jnp.minimum(jnp.arange(batch_size), max(size - 1, 0))

        def row(x: Any, along: bool) -> Any:
            if not along:
                return x[..., None]
            x = x if size else jnp.zeros((1, *x.shape[1:]), x.dtype)
            return jnp.moveaxis(x[place], 0, -1)

        result = solve(*jax.tree.map(row, arguments, tuple(batched)))
        result = jax.tree.map(
            lambda x: jnp.moveaxis(jnp.broadcast_to(x, (*x.shape[:-1], batch_size)), -1, 0)[:size],
            result,
        )
        return result, jax.tree.map(lambda _: True, result)

    return batched_solve


def arms_in(tree: Any, axes: int) -> tuple[int, ...]:
    """Shape of the batch of arms: what the last `axes` axes of all arrays broadcast to."""
    return np.broadcast_shapes(*(x.shape[x.ndim - axes :] for x in jax.tree.leaves(tree)))
