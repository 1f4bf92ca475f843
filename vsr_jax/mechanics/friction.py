r"""Friction of tendons: the capstan equation $\tau' = \mp \mu \varphi' \tau$ with the turning rate
$\varphi'$ of the tendon's path.

Where the strain jumps, at the end of another tendon or at a point force, or where the routing has a
corner, the path has a kink of angle $\Delta\varphi$. Over a kink the tension changes by the factor
$e^{\mp \mu \Delta\varphi}$.

The unit tangent of the path in the world frame is $R t$, so $\varphi' = |t' + k \times t|$. The
derivative of the strain along the arm follows from the balance, $H \xi' = \Lambda' - \partial r /
\partial X + B_\tau \tau'$, without finite differences.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.routing import thread_tangent
from ..arm.scene import CrossSections
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, beyond, interpolation, locate, weighted, within
from .balance import actuation_wrench, completed, free_block, free_components, residual, tangent


class Friction(NamedTuple):
    r"""Friction of the tendons that have it.

    - `coefficients`: $\pm\mu$ of each, positive for pull.
    - `sections_rate`: $\partial / \partial X$ of the cross-sections at the nodes.
    - `breaks`: 1 for each step that starts at a breakpoint, where paths may have kinks; None if the
      arm has no breakpoints.
    """

    coefficients: Vector
    sections_rate: CrossSections
    breaks: Array | None


def decay(turning: Array, kinks: Array | None, coefficient: Array, grid: Grid) -> Array:
    r"""Remaining share of the tension at the nodes, $e^{-\mu \varphi(X)}$, from the rates
    $\varphi'$ there and the kinks before each step."""
    angle = jnp.sum(grid.weight * turning, axis=(0, 1)) - beyond(turning[None], grid)[0]
    return jnp.exp(-coefficient * (angle if kinks is None else angle + jnp.cumsum(kinks, axis=0)))


def share_left(
    reach: Array | None, turning: Array, kinks: Array | None, coefficient: Array, grid: Grid
) -> Array:
    """Share of a thread's force at the nodes, from its reach (None for the whole arm), its turning
    rate and its kinks."""
    return c.times(reach, decay(c.times(reach, turning), kinks, coefficient, grid))


def decay_at(
    turning: Array, kinks: Array | None, coefficient: Array, grid: Grid, X: Array
) -> Array:
    """`decay` at abscissas X."""
    step, sigma = locate(grid, X)
    through = jnp.cumsum(jnp.sum(grid.weight * turning, axis=0))
    before = jnp.append(jnp.zeros_like(through[:1]), through[:-1])
    if kinks is not None:
        before = before + jnp.cumsum(kinks)
    return jnp.exp(-coefficient * (before[step] + within(turning[None], grid, step, sigma)[0]))


def breaks_of(breakpoints: tuple[Array, ...], grid: Grid) -> Array | None:
    """1 for each step of a grid that starts at a breakpoint, 0 for the others; None without
    breakpoints."""
    if not breakpoints:
        return None
    return jnp.any(grid.start[:, None] == jnp.stack(breakpoints), axis=1).astype(grid.h.dtype)


def kinks_of(
    xi: Vector, sections: CrossSections, breaks: Array | None, place: int, grid: Grid
) -> Array | None:
    r"""Angles $\Delta\varphi$ [rad] of a thread's path at the start of each step, between its
    tangents on both sides.

    The tangents are those of the polynomials through the nodes of both steps, so that the angle has
    their order. Both are in the frame of the same section, since rotations do not jump. The ends of
    the thread itself are not kinks.
    """
    if breaks is None:
        return None
    at_start, at_end = interpolation(grid.X.shape[0])[0], interpolation(grid.X.shape[0]).sum(axis=0)
    t_c = jnp.broadcast_arrays(*thread_tangent(xi, sections.paths[place]))
    before = tuple(weighted(at_end, x)[:-1] for x in t_c)
    after = tuple(weighted(at_start, x)[1:] for x in t_c)
    inside, reach = breaks[1:], sections.reach[place]
    if reach is not None:
        inside = inside * reach[-1, :-1] * reach[0, 1:]
    bend = c.cross(before, after)
    square = c.dot(bend, bend)
    kinked = (inside > 0) & (square > 0)
    sine = jnp.sqrt(jnp.where(kinked, square, 1.0))
    angle = jnp.where(kinked, jnp.arctan2(sine, c.dot(before, after)), 0.0)
    return jnp.concatenate([jnp.zeros_like(angle[:1]), angle])


def balanced_strain_rate(
    xi: Vector,
    tau: Forces,
    tau_rate: Forces,
    reaction_rate: Vector | None,
    sections: CrossSections,
    rate: CrossSections,
    free: tuple,
) -> Vector:
    r"""Derivative of the balanced strain along the arm, $\xi' = H^{-1} (\Lambda' - \partial r /
    \partial X + B_\tau \tau')$, six components.

    **Arguments:** `tau_rate`: $\tau'$; `reaction_rate`: $\Lambda'$, None without loads; `rate`: the
    derivative of `sections` along the arm.
    """

    def imbalance(sections: CrossSections) -> Vector:
        return residual(xi, sections, tau)

    change = jax.jvp(imbalance, *_alike((sections,), (rate,)))[1]
    right = c.subtract(actuation_wrench(xi, sections, tau_rate), change)
    right = right if reaction_rate is None else c.add(right, reaction_rate)
    factor = c.cholesky(free_block(tangent(xi, sections, tau), free))
    return completed(c.cholesky_solve(factor, free_components(right, free)), rate.rest, free)


def _alike(values: tuple, rates: tuple) -> tuple[Any, Any]:
    """Values and their rates broadcast to one shape: in a batch of arms either may be the same for
    all."""
    leaves, tree = jax.tree.flatten(values)
    pairs = [
        jnp.broadcast_arrays(x, dx) for x, dx in zip(leaves, jax.tree.leaves(rates), strict=True)
    ]
    return tuple(jax.tree.unflatten(tree, list(side)) for side in zip(*pairs, strict=True))


def turning_rate(
    xi: Vector, xi_rate: Vector, sections: CrossSections, rate: CrossSections, place: int
) -> Array:
    r"""Turning rate of a thread's path, $\varphi' = |t' + k \times t|$ [rad/m]."""
    t_c, t_c_rate = jax.jvp(
        thread_tangent, *_alike((xi, sections.paths[place]), (xi_rate, rate.paths[place]))
    )
    length = jnp.sqrt(c.dot(t_c, t_c))
    t = tuple(x / length for x in t_c)
    along = c.dot(t, t_c_rate)
    turn = c.add(
        tuple((a - along * b) / length for a, b in zip(t_c_rate, t, strict=True)),
        c.cross(xi[:3], t),
    )
    square = c.dot(turn, turn)
    straight = square <= 0
    return jnp.where(straight, 0.0, jnp.sqrt(jnp.where(straight, 1.0, square)))


def reaction_rate(xi: Vector, wrench: Vector, density: Vector) -> Vector:
    r"""Derivative of the reaction along the arm, $\Lambda' = -\mathrm{ad}^*_\xi \Lambda - (c, f)$,
    with the load density in the body frame."""
    k, u, M, N = xi[:3], xi[3:], wrench[:3], wrench[3:]
    moment = c.add(c.add(c.cross(k, M), c.cross(u, N)), density[:3])
    force = c.add(c.cross(k, N), density[3:])
    return c.scale(-1.0, (*moment, *force))
