"""The nodes of a chain in arrays (..., stages, steps, *arms)."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..numerics.component import Matrix, Tree
from ..numerics.once import once
from ..numerics.quadrature import Grid
from ..typing import Shape


def whole(x: Array, shape: Shape) -> Array:
    """An array whose last axes are those of all nodes, (stages, steps, *arms)."""
    return jnp.broadcast_to(x, (*x.shape[: x.ndim - len(shape)], *shape))


def block_of(H: Matrix, first: int, second: int, shape: Shape) -> Array:
    """Block (3, 3, stages, steps, *arms) of a matrix of all nodes, from two indices on."""
    entries = [whole(H[first + i][second + j], shape) for i in range(3) for j in range(3)]
    return jnp.stack(entries).reshape(3, 3, *shape)


def places_of(grid: Grid) -> tuple[Array, Array]:
    """Stage and step of each node, from the base to the tip."""
    stages, steps = grid.X.shape[:2]
    return jnp.tile(jnp.arange(stages), steps), jnp.repeat(jnp.arange(steps), stages)


def by_place(x: Array, grid: Grid, arms: int) -> Array:
    """Values (..., stages, steps, *arms) of nodes (..., nodes, *arms) from the base to the tip."""
    first, behind = x.shape[: x.ndim - arms - 1], x.shape[x.ndim - arms :]
    x = x.reshape(*first, *grid.X.shape[1::-1], *behind)
    return x.swapaxes(len(first), len(first) + 1)


def at_node(tree: Tree, place: tuple[Array, ...], arms: int) -> Tree:
    """Values (..., *arms) at the stage and the step of a node, of arrays (..., stages, steps,
    *arms) with so many axes of arms; or at a stage of all steps, which take the place of arms.

    A pass takes them from where they are: to bring the nodes into its order first would copy the
    arrays."""

    def own(x: Array) -> Array:
        for index in reversed(place):
            x = lax.dynamic_index_in_dim(x, index, x.ndim - arms - 1, keepdims=False)
        return once(x)

    return jax.tree.map(own, tree)


def at_last_nodes(jump: Array, stages: int) -> Array:
    """Matrices at the ends of steps (n, m, steps, ...) as those of nodes (n, m, stages, steps,
    ...), of the last of each step."""
    return jnp.pad(jump[:, :, None], [(0, 0), (0, 0), (stages - 1, 0), *[(0, 0)] * (jump.ndim - 2)])
