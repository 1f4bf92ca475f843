"""Dimensionless sizes of strains, wrenches and thread forces, by their effect on the arm's
shape."""

import jax.numpy as jnp
from jaxtyping import Array

from ..arm.routing import Path
from ..arm.scene import CrossSections
from ..numerics import component as c
from ..numerics.component import Vector
from ..numerics.quadrature import Grid
from .balance import unit_wrench


def shape_size(strain: Vector, length: Array) -> Array:
    r"""Size of a change of strain by its effect on the shape, $\sqrt{L^2 |\kappa|^2 +
    |\upsilon|^2}$: rotation over the length of the arm, and strain.

    An energy norm would underrate the bending of a slender arm: at L/r = 1000 a strain of 1e-6 in
    its fibres rotates the tip by 1e-3.
    """
    return jnp.sqrt(length**2 * c.dot(strain[:3], strain[:3]) + c.dot(strain[3:], strain[3:]))


def shape_of(wrench: Vector, sections: CrossSections, length: Array) -> Array:
    """`shape_size` of the strain that a wrench causes at rest, zero on rigid pieces."""
    strain = tuple(f / s for f, s in zip(wrench, sections.stiffness, strict=True))
    return c.times(sections.flexible, shape_size(strain, length))


def pull_of(sections: CrossSections, path: Path, length: Array) -> Array:
    """`shape_size` of the strain per unit of a thread's force at rest [1/N]."""
    wrench = unit_wrench(sections.rest, path)
    return shape_of(wrench, sections, length)


def softest(stiffness: Vector) -> Array:
    """Smaller bending stiffness of each section [N m^2]."""
    return jnp.minimum(stiffness[1], stiffness[2])


def node_weight(grid: Grid) -> Array:
    """Weights of the nodes [m], above zero also in an empty step."""
    return jnp.maximum(grid.weight, 1e-6 * jnp.max(grid.weight))
