r"""Friction of tendons: the capstan equation $\tau' = \mp \mu \varphi' \tau$ with the rate at which the tendon's path turns.

The unit tangent of the path in the world frame is $R t$, so $\varphi' = |t' + k \times t|$. The change of the strain along the arm
that it needs is that of the balance itself, $H \xi' = \Lambda' - \partial r / \partial X + B_\tau \tau'$: no differences are taken.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import component as c
from .balance import actuation_wrench, chosen, chosen_rows, residual, spread, tangent, with_locked
from .component import Vector
from .quadrature import Grid, beyond, locate, within
from .routing import thread_tangent
from .scene import CrossSections


class Rubbing(NamedTuple):
    r"""Friction of the tendons that have it: $\pm\mu$ of each (positive for pull), and how the cross-sections change along the
    arm, $\partial / \partial X$ at the nodes."""

    coefficients: Vector
    sections_rate: CrossSections


def decay(turning: Array, coefficient: Array, grid: Grid) -> Array:
    r"""Share of the tension left at the nodes, $e^{-\mu \varphi(X)}$, from the rates $\varphi'$ there."""
    whole = jnp.sum(grid.weight * turning, axis=(0, 1))
    return jnp.exp(-coefficient * (whole - beyond((turning,), grid)[0]))


def rubbed(reach: Array | None, turning: Array, coefficient: Array, grid: Grid) -> Array:
    """Share of a thread's force at the nodes, from where it reaches (None for everywhere) and how it turns there."""
    if reach is None:
        return decay(turning, coefficient, grid)
    return reach * decay(reach * turning, coefficient, grid)


def decay_at(turning: Array, coefficient: Array, grid: Grid, X: Array) -> Array:
    """`decay` at abscissas X."""
    step, sigma = locate(grid, X)
    through = jnp.cumsum(jnp.sum(grid.weight * turning, axis=0))
    before = jnp.append(jnp.zeros_like(through[:1]), through[:-1])
    return jnp.exp(-coefficient * (before[step] + within(turning, grid, step, sigma)))


def strain_rate(
    xi: Vector, tau: Vector, tau_rate: Vector, reaction_rate: Vector | None, sections: CrossSections, rate: CrossSections, free: tuple
) -> Vector:
    r"""Change of the strain along the arm, $\xi' = H^{-1} (\Lambda' - \partial r / \partial X + B_\tau \tau')$, six components.

    **Arguments:** `reaction_rate`: $\Lambda'$, None without loads; `rate`: the change of `sections` along the arm.
    """

    def imbalance(sections: CrossSections) -> Vector:
        return residual(xi, sections, tau)

    change = jax.jvp(imbalance, (sections,), (rate,))[1]
    right = c.subtract(actuation_wrench(xi, sections, tau_rate), change)
    right = right if reaction_rate is None else c.add(right, reaction_rate)
    factor = c.cholesky(chosen_rows(tangent(xi, sections, tau), free))
    answer = spread(c.cholesky_solve(factor, chosen(right, free)), free)
    return with_locked(answer, rate.rest, free)


def turning_rate(xi: Vector, xi_rate: Vector, sections: CrossSections, rate: CrossSections, place: int) -> Array:
    r"""Rate at which a thread's path turns, $\varphi' = |t' + k \times t|$ [rad/m]."""
    path, path_rate = sections.paths[place], rate.paths[place]
    t_c, t_c_rate = jax.jvp(thread_tangent, (xi, path), (xi_rate, path_rate))
    length = jnp.sqrt(c.dot(t_c, t_c))
    t = tuple(x / length for x in t_c)
    along = c.dot(t, t_c_rate)
    turn = c.add(tuple((a - along * b) / length for a, b in zip(t_c_rate, t, strict=True)), c.cross(xi[:3], t))
    square = c.dot(turn, turn)
    straight = square <= 0
    return jnp.where(straight, 0.0, jnp.sqrt(jnp.where(straight, 1.0, square)))


def reaction_rate(xi: Vector, wrench: Vector, density: Vector) -> Vector:
    r"""Change of the reaction, $\Lambda' = -\mathrm{ad}^*_\xi \Lambda - (c, f)$, with the load's density in the body frame."""
    k, u, M, N = xi[:3], xi[3:], wrench[:3], wrench[3:]
    moment = c.add(c.add(c.cross(k, M), c.cross(u, N)), density[:3])
    force = c.add(c.cross(k, N), density[3:])
    return c.scale(-1.0, (*moment, *force))
