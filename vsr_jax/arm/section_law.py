r"""How a section resists its strain: energy per length, wrench and tangent stiffness.

With the change of strain $\varepsilon = \xi - \xi^*$ and an energy $W(\varepsilon)$ per length of
the arm, a section carries the wrench $\partial W / \partial \varepsilon$, and resists a small
change by the tangent $\partial^2 W / \partial \varepsilon^2$.
"""

from abc import abstractmethod

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.component import Matrix, Vector, dot, matvec, multiply


class SectionLaw(eqx.Module):
    r"""The law of a section. One of your own defines `energy`, and is what `Material.law` returns;
    wrench and tangent follow by differentiation.

    All are functions of six components $(\varepsilon_k, \varepsilon_u)$ [1/m, -], arrays of one
    shape that stand for many sections side by side, and of the diagonal of $\Sigma$ (see
    `Material.stiffness`), which is to be the tangent of the law at rest: it is the scale of all
    convergence tests. Fields of a law are numbers of the section at one X.
    """

    @abstractmethod
    def energy(self, strain: Vector, stiffness: Vector) -> Array:
        r"""$W(\varepsilon)$ [J/m], convex."""

    def wrench(self, strain: Vector, stiffness: Vector) -> Vector:
        r"""Moment and force $\partial W / \partial \varepsilon$ [N m, N]."""
        return jax.grad(lambda x: jnp.sum(self.energy(x, stiffness)))(strain)

    def tangent(self, strain: Vector, stiffness: Vector) -> Matrix:
        r"""Lower triangle of $\partial^2 W / \partial \varepsilon^2$, row i with i + 1 entries."""

        def column(j: int) -> Vector:
            unit = tuple(jnp.full_like(x, float(i == j)) for i, x in enumerate(strain))
            return jax.jvp(lambda x: self.wrench(x, stiffness), (strain,), (unit,))[1]

        columns = [column(j) for j in range(6)]
        return tuple(tuple(columns[j][i] for j in range(i + 1)) for i in range(6))


class LinearLaw(SectionLaw):
    r"""$W = \tfrac12 \varepsilon^T \Sigma \varepsilon$: the law of a linear elastic material."""

    def energy(self, strain: Vector, stiffness: Vector) -> Array:
        return 0.5 * dot(multiply(stiffness, strain), strain)

    def wrench(self, strain: Vector, stiffness: Vector) -> Vector:
        return multiply(stiffness, strain)

    def tangent(self, strain: Vector, stiffness: Vector) -> Matrix:
        zero = jnp.zeros_like(strain[0])
        return tuple((*[zero] * i, stiffness[i]) for i in range(6))


class CoupledLaw(SectionLaw):
    r"""$W = \tfrac12 \varepsilon^T \Sigma \varepsilon$ with the rows of a full matrix $\Sigma$."""

    matrix: Matrix

    @staticmethod
    def of(matrix: Float[Array, "6 6"]) -> "CoupledLaw":
        """The law of a matrix that is symmetric."""
        return CoupledLaw(tuple(tuple(matrix[i, j] for j in range(6)) for i in range(6)))

    def energy(self, strain: Vector, stiffness: Vector) -> Array:
        return 0.5 * dot(self.wrench(strain, stiffness), strain)

    def wrench(self, strain: Vector, stiffness: Vector) -> Vector:
        return matvec(self.matrix, strain)

    def tangent(self, strain: Vector, stiffness: Vector) -> Matrix:
        return tuple(row[: i + 1] for i, row in enumerate(self.matrix))
