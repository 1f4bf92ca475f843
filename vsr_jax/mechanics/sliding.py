r"""How contacts slide in their steps as the arm shears.

The nearest point of a step is where the slope g' of the gap vanishes, and it depends on the shear
strains $\upsilon_j$ at the nodes of the step. As the point slides by $-\delta g' / g''$, the shares
of its force $\lambda n$ at the nodes change, and by that the shear strains. With the values
$\ell_j(\sigma)$ of the polynomials of the nodes, their weights $w_j$, the length h of the step and
the compliance c of shear,

$$\delta g' = m \cdot z + h \sum_j \ell_j \, n \cdot \upsilon_j, \quad
\upsilon_j = c \, (r_j + f_j), \quad
f_j = -\frac{\lambda}{g''} \frac{\ell_j}{w_j} n \, \delta g',$$

where z is the motion of the arm there and r a residual, all in the world's axes. The elimination
along the arm knows the motions only, so this is solved for each contact alone:

$$\delta g' = \frac{m \cdot z + h \sum_j \ell_j \, n \cdot c \, r_j}
{1 + h \tfrac{\lambda}{g''} \sum_j \tfrac{c}{w_j} \ell_j^2}.$$

Without it the steps of Newton's method shrink by a factor of 0.4 to 0.7 only where a soft arm is
pressed against an obstacle.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..numerics.component import Vector
from ..numerics.once import once
from ..numerics.quadrature import Grid, gauss_legendre, value_weights
from ..numerics.stacked import components, matvec, stack, total, transpose
from .reaction import Reaction
from .touch import Touch, motions_at


class Sliding(NamedTuple):
    r"""Sliding by shear.

    **Fields:** the `touch`, whose `slide` includes shear; `values` $\ell$ (stages, obstacles,
    steps, *arms); `shares` $h / w$ of the nodes of a step (stages, 1, ...), and the `compliance` c,
    of the shear strains that are `free`, (stages, steps, *arms); the `rotation` of the nodes and
    the lengths `h`.
    """

    touch: Touch
    values: Array
    shares: Array
    compliance: Array
    free: tuple[int, ...]
    rotation: Array
    h: Array

    def driven(self, right: Vector) -> tuple[Vector, Array]:
        """A residual (six components) with the forces by sliding that it causes, and the change of
        the wrenches (6, stages, steps, *arms) by these in the cells."""
        touch = self.touch
        shear = self.compliance * matvec(self.rotation, stack(right[3:]))
        slope = total(self.values * shear[:, :, None], 1)
        slope = once(touch.slide * self.h * total(touch.normal * slope, 0))
        push = total(touch.cell * (slope * touch.sliding)[:, None], 2)
        return _with_force(right, self._forces(slope)), push

    def followed(self, strain: Vector, motions: Array) -> Vector:
        """A change of strain with the shear by motions in the cells."""
        touch = self.touch
        slope = once(touch.slide * total(touch.sliding * motions_at(touch.cell, motions), 0))
        return _with_force(strain, self.compliance * self._forces(slope))

    def _forces(self, slope: Array) -> Array:
        """Forces f in the axes of the nodes (3, stages, steps, *arms), those of locked strains
        zero."""
        force = total(self.values * (slope * self.touch.normal)[:, None], 2)
        force = self.shares * matvec(transpose(self.rotation), force)
        zero = jnp.zeros_like(force[0])
        return stack(tuple(x if i in self.free else zero for i, x in enumerate(force, 3)))


def sliding_of(
    along: Reaction, stiffness: Vector, flexible: Array | None, free: tuple[int, ...], grid: Grid
) -> Sliding | None:
    """Sliding of the contacts; None without contacts and where nothing shears."""
    touch, sheared = along.touch, tuple(i for i in free if i > 3)
    if touch is None or not sheared:
        return None
    compliance = 1 / stiffness[sheared[0]]
    for i in sheared[1:]:
        compliance = jnp.maximum(compliance, 1 / stiffness[i])
    if flexible is not None:
        compliance = compliance * flexible
    stages = grid.X.shape[0]
    values, weights = value_weights(touch.sigma, stages), gauss_legendre(stages)[1]
    shares = jnp.asarray(1 / weights, grid.h.dtype).reshape(-1, *(1,) * grid.h.ndim)
    gain = total(values**2 * (shares * compliance)[:, None], 0)
    touch = touch._replace(slide=touch.slide / (1 - grid.h * touch.slide * gain))
    return Sliding(touch, values, shares, compliance, sheared, along.rotation, grid.h)


def _with_force(wrench: Vector, force: Array) -> Vector:
    """Six components and a force more."""
    return (
        *wrench[:3],
        *(x + more for x, more in zip(wrench[3:], components(force), strict=True)),
    )
