r"""Tendons with prescribed length: slack and tension of the cable, and the length of a thread's
path.

A cable of free length $l^* + \delta$ under the tension T has the length $(l^* + \delta)(1 + T /
k)$; its slack is that length minus the length of the path."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import CrossSections, Scene
from ..numerics import component as c
from ..numerics.component import Vector
from ..numerics.quadrature import Grid
from ..typing import Scalar
from .balance import largest_force_scale, thread_direction


class Cable(NamedTuple):
    r"""A tendon with prescribed length: its free length $l^* + \delta$ [m], its compliance $1/k$
    [1/N] (None if inextensible) and a stiffness $k_0$ [N/m] that scales slack to tension."""

    length: Array
    compliance: Array | None
    scale: Array

    def slack(self, tension: Array, path: Array, share: Array | None, grid: Grid) -> Array:
        """Slack on a path of a given length [m], negative if the cable is too short."""
        return self.length - path + tension * self.stretch(share, grid)

    def complementarity(self, tension: Array, slack: Array) -> Array:
        r"""$\min(T, k_0 s)$ [N], zero where tension or slack is zero and the other is not
        negative."""
        return jnp.where(tension < self.scale * slack, tension, self.scale * slack)

    def stretch(self, share: Array | None, grid: Grid) -> Array:
        """Stretch per unit of the tension at the start [m/N]; `share` is the fraction of it at the
        nodes."""
        if self.compliance is None:
            return jnp.zeros_like(self.length)
        if share is None:
            return self.length * self.compliance
        reached = jnp.sum(jnp.where(share > 0, grid.weight, 0.0), axis=(0, 1))
        mean = jnp.sum(grid.weight * share, axis=(0, 1)) / reached
        return self.length * self.compliance * mean


def cable_of(
    scene: Scene, change: Scalar, place: int, sections: CrossSections, grid: Grid
) -> Cable:
    """The cable of a tendon with prescribed length, for a change of its length [m]."""
    stiffness = scene.actuators[place].cable_stiffness
    length = path_length(sections.rest, sections, place, grid) + change
    compliance = None if stiffness is None else 1 / stiffness
    scale = largest_force_scale(sections.stiffness) / scene.rod.length
    return Cable(length, compliance, scale)


def path_length(xi: Vector, sections: CrossSections, place: int, grid: Grid) -> Array:
    r"""Length of a thread's path, $\int |t_c| dX$ [m], from the strain at the nodes."""
    length, reach = thread_direction(xi, sections.paths[place])[1], sections.reach[place]
    return jnp.sum(grid.weight * c.times(reach, length), axis=(0, 1))
