r"""The potential energy of an arm, part by part:

$$\Pi = \int_0^L \tfrac12 (\xi - \xi^*)^T \Sigma (\xi - \xi^*) \, dX
+ \sum_{i \in \text{cables}} \frac{T_i^2}{2 k_i} (l_i^* + \delta_i)
- \sum_{i \in \text{forces}} \tau_i l_i - \int_0^L f \cdot r \, dX - \sum_j F_j \cdot r(X_j).$$

An equilibrium is a stationary point of it, under the lengths of the tendons that are driven by
their length. So its derivative by a given force is $d\Pi / d\tau_i = -l_i$.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import Scene
from ..mechanics.balance import thread_direction
from ..mechanics.cable import cable_of
from ..models.base import Nodes
from ..numerics import component as c
from ..numerics.component import Vector
from ..typing import Scalar


class Energy(NamedTuple):
    """Parts of the potential energy [J].

    **Fields:** `elastic`: of the rod's strain; `cables`: of the stretch of tendons that are driven
    by their length; `actuation`: of given forces and pressures; `loads`: of dead forces, zero for
    an axis at the world's origin.
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
    scene: Scene, inputs: Array, forces: Vector, nodes: Nodes, positions: Array, at_points: Array
) -> Energy:
    """Energy of a solved scene.

    **Arguments:** `forces` [N] of the threads at their start; `positions` [m] of the nodes, shape
    (*nodes, 3); `at_points` [m], those of the scene's dead point loads, shape (points, 3).
    """
    weight, driven = nodes.grid.weight, scene.length_driven
    strain = c.subtract(nodes.xi, nodes.sections.rest)
    elastic = jnp.sum(weight * c.dot(c.multiply(nodes.sections.stiffness, strain), strain)) / 2
    tau, zero = nodes.tau(forces), jnp.zeros_like(elastic)
    actuation = cables = loads = zero
    for i, path in enumerate(nodes.sections.paths):
        if i in driven:
            cables = cables + _stretch(scene, inputs, forces, nodes, i)
        else:
            actuation -= jnp.sum(weight * tau[i] * thread_direction(nodes.xi, path)[1])
    density = scene.density(nodes.grid.X, "world")
    if density is not None:
        loads -= jnp.sum(weight * c.dot(density[3:], c.split(positions)))
    for place, (_, wrench) in zip(at_points, scene.point_wrenches("world"), strict=True):
        loads -= c.dot(wrench[3:], c.split(place))
    return Energy(elastic, cables, actuation, loads)


def _stretch(scene: Scene, inputs: Array, forces: Vector, nodes: Nodes, place: int) -> Array:
    r"""Energy of a cable's stretch, $\frac{1}{2k} \int T^2 ds$ over its free length."""
    cable = cable_of(scene, inputs[place], place, nodes.sections, nodes.grid)
    share = nodes.shares[place]
    square = None if share is None else share**2
    return forces[place] ** 2 * cable.stretch(square, nodes.grid) / 2
