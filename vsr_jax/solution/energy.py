r"""The potential energy of an arm, part by part:

$$\Pi = \int_0^L \tfrac12 (\xi - \xi^*)^T \Sigma (\xi - \xi^*) \, dX
+ \sum_{i \in \text{cables}} \frac{T_i^2}{2 k_i} (l_i^* + \delta_i)
- \sum_{i \in \text{forces}} \tau_i l_i - \int_0^L f \cdot r \, dX - \sum_j F_j \cdot r(X_j)
+ V,$$

with V the potential of the loads that depend on the pose of their section.

An equilibrium is a stationary point of it, under the lengths of the tendons that are driven by
their length. So its derivative by a given force is $d\Pi / d\tau_i = -l_i$.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.actuator import ThreadState
from ..arm.pose_loads import PoseLoad
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..elements.chords import chords_of
from ..elements.driven_threads import driven_of, thread_length
from ..mechanics.balance import thread_direction
from ..models.base import Nodes
from ..numerics import component as c
from ..numerics.component import Vector
from ..typing import Scalar


class Energy(NamedTuple):
    """Parts of the potential energy [J].

    **Fields:** `elastic`: of the rod's strain; `cables`: of the stretch of tendons that are driven
    by their length; `actuation`: of given forces and pressures, and the `potential` of other laws,
    as of gas; `loads`: of dead forces, zero for an axis at the world's origin, and of loads that
    depend on the pose.
    """

    elastic: Scalar
    cables: Scalar
    actuation: Scalar
    loads: Scalar

    @property
    def total(self) -> Scalar:
        """Sum of the parts [J]."""
        return self.elastic + self.cables + self.actuation + self.loads


def energy_of(
    scene: Scene, inputs: Array, forces: Vector, nodes: Nodes, poses: Callable[[Array], Array]
) -> Energy:
    """Energy of a solved scene.

    **Arguments:** `forces` [N] of the threads at their start; `poses`: function of abscissas that
    returns the poses there.
    """
    weight, driven = nodes.grid.weight, scene.length_driven
    elastic = jnp.sum(weight * nodes.sections.elastic_energy(nodes.xi))
    tau, zero = nodes.tau(forces), jnp.zeros_like(elastic)
    actuation = cables = zero
    for i, path in enumerate(nodes.sections.paths):
        if i in driven:
            cables = cables + _stretch(scene, inputs, forces, nodes, i)
        elif i in scene.law_driven and i not in scene.frictional:
            thread = driven_of(scene, inputs[i], i, nodes.sections, nodes.grid)
            length = thread_length(scene, nodes.xi, nodes.sections, i, nodes.grid)
            state = ThreadState(forces[i], length, thread.rest, thread.scale)
            actuation += scene.actuators[i].potential(state, inputs[i])
        elif i in scene.straight:
            chords = chords_of(scene, nodes.xi, nodes.grid)
            actuation -= forces[i] * chords.path_length(i, nodes.shares[i])
        else:
            actuation -= jnp.sum(weight * tau[i] * thread_direction(nodes.xi, path)[1])
    return Energy(elastic, cables, actuation, _of_loads(scene, nodes, poses))


def _of_loads(scene: Scene, nodes: Nodes, poses: Callable[[Array], Array]) -> Scalar:
    """Potential of the dead forces and of the loads that depend on the pose."""
    rod, dead, grid = scene.rod, scene.point_wrenches("world"), nodes.grid
    held = [(load, load.place(rod)) for load in scene.pose_loads]
    points = [*(x for x, _ in dead), *(x for _, x in held if x is not None)]
    nodal = grid.X.reshape(-1)
    g = poses(jnp.concatenate([nodal, jnp.array(points, nodal.dtype)]))
    along, at_points = g[: nodal.size], list(g[nodal.size :])
    weight, total = grid.weight.reshape(-1), jnp.zeros_like(rod.length)
    density = scene.density(nodal, "world")
    if density is not None:
        total -= jnp.sum(weight * c.dot(density[3:], c.split(along[:, :3, 3])))
    for _, wrench in dead:
        total -= c.dot(wrench[3:], c.split(at_points.pop(0)[:3, 3]))
    for load, X in held:
        if X is None:
            of_node = jax.vmap(lambda x, g, load=load: _potential(load, rod, x, g))
            total += jnp.sum(weight * of_node(nodal, along))
        else:
            total += _potential(load, rod, X, at_points.pop(0))
    return total


def _potential(load: PoseLoad, rod: Rod, X: Array, g: Array) -> Scalar:
    energy = load.potential(rod, X, g[:3, :3], g[:3, 3])
    return jnp.zeros_like(X) if energy is None else energy


def _stretch(scene: Scene, inputs: Array, forces: Vector, nodes: Nodes, place: int) -> Array:
    r"""Energy of a cable's stretch, $\frac{1}{2k} \int T^2 ds$ over its free length."""
    cable = driven_of(scene, inputs[place], place, nodes.sections, nodes.grid)
    share = nodes.shares[place]
    square = None if share is None else share**2
    return forces[place] ** 2 * cable.stretch(square, nodes.grid) / 2
