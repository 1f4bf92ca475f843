r"""Eigenvalues of the tangent stiffness, scaled so that an arm without forces has 1: the least is the margin of stability."""

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import component as c
from .balance import chosen, chosen_rows, residual, spread, tangent, thread_direction, thread_wrench, with_locked
from .component import Vector
from .model import Nodes
from .reaction import loading, react
from .scene import Scene


def extremes(scene: Scene, forces: Vector, nodes: Nodes) -> tuple[Array, Array]:
    r"""Least and greatest eigenvalue of $\Sigma^{-1/2} H \Sigma^{-1/2}$: of each node alone, or of all together where they are coupled.

    Coupled, they are those of the symmetric part of the whole tangent, less the changes of strain that the taut cables forbid.
    """
    tau = nodes.tau(forces)
    if not scene.loads and not scene.length_driven:
        lower = chosen_rows(tangent(nodes.xi, nodes.sections, tau), scene.free)
        root = jnp.sqrt(c.join(chosen(nodes.sections.stiffness, scene.free)))
        scaled = c.join_matrix(c.symmetric(lower)) / (root[..., :, None] * root[..., None, :])
        values = jnp.linalg.eigvalsh(scaled)
        return jnp.min(values), jnp.max(values)
    values = jnp.linalg.eigvalsh(_whole(scene, forces, nodes, tau))
    return values[0], values[-1]


def _whole(scene: Scene, forces: Vector, nodes: Nodes, tau: Vector) -> Array:
    """Scaled tangent of all nodes, symmetric part, with the directions that taut cables forbid set to 1."""
    sections, grid, free = nodes.sections, nodes.grid, scene.free
    loads, shape = loading(scene, grid), nodes.xi[0].shape
    still = jnp.stack(jnp.broadcast_arrays(*chosen(nodes.xi, free)))

    def imbalance(values: Array) -> Array:
        xi = with_locked(spread(tuple(values), free), nodes.xi, free)
        reaction = None if loads is None else react(xi, grid, loads).wrench
        return jnp.stack(chosen(residual(xi, sections, tau, reaction), free))

    size = still.size
    jacobian = jax.jacfwd(lambda x: imbalance(x.reshape(still.shape)).reshape(-1))(still.reshape(-1))
    stiffness = jnp.stack([jnp.broadcast_to(s, shape) for s in chosen(sections.stiffness, free)])
    weight = jnp.broadcast_to(grid.weight, still.shape).reshape(-1)
    root = jnp.sqrt(weight * stiffness.reshape(-1))
    scaled = weight[:, None] * jacobian / (root[:, None] * root[None, :])
    scaled = 0.5 * (scaled + scaled.T)
    taut = []
    for place in scene.length_driven:
        path, reach = sections.paths[place], sections.reach[place]
        unit = chosen(thread_wrench(thread_direction(nodes.xi, path)[0], path), free)
        pull = jnp.stack([grid.weight * (x if reach is None else reach * x) for x in unit]).reshape(-1) / root
        taut.append(jnp.where(forces[place] < 0, pull, 0.0))
    if not taut:
        return scaled
    Q, R = jnp.linalg.qr(jnp.stack(taut, axis=1))
    Q = Q * (jnp.abs(jnp.diag(R)) > 0)
    rest = jnp.eye(size, dtype=Q.dtype) - Q @ Q.T
    return rest @ scaled @ rest + Q @ Q.T
