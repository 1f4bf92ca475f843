r"""How fast the path of a thread turns in space, and by which angle up to a section.

The unit tangent of the path in the world frame is $R t$, so it turns at the rate $\varphi' = |t' +
k \times t|$. The derivative of the strain along the arm follows from the balance of each section,
without finite differences. Where the strain jumps, or where the routing has a corner, the path has
a kink.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.routing import Path, thread_tangent
from ..arm.scene import CrossSections
from ..numerics import component as c
from ..numerics.component import Forces, Vector, free_block, free_components
from ..numerics.implicit import change_of
from ..numerics.loops import alike
from ..numerics.once import once
from ..numerics.quadrature import Grid, beyond, interpolation, locate, weighted, within
from .balance import completed, over_threads, tangent, thread_wrench


def turned(turning: Array, kinks: Array | None, grid: Grid) -> Array:
    r"""Turning angle $\varphi(X)$ of a path from the base to the nodes, from the rates $\varphi'$
    there and the kinks before each step."""
    angle = jnp.sum(grid.weight * turning, axis=(0, 1)) - beyond(turning[None], grid)[0]
    return angle if kinks is None else angle + jnp.cumsum(kinks, axis=0)


def turned_at(turning: Array, kinks: Array | None, grid: Grid, X: Array) -> Array:
    """`turned` at abscissas X."""
    step, sigma = locate(grid, X)
    through = jnp.cumsum(jnp.sum(grid.weight * turning, axis=0))
    before = jnp.append(jnp.zeros_like(through[:1]), through[:-1])
    if kinks is not None:
        before = before + jnp.cumsum(kinks)
    return before[step] + within(turning[None], grid, step, sigma)[0]


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
    free: tuple[int, ...],
) -> Vector:
    r"""Derivative of the balanced strain along the arm, six components, which keeps the balance,

    $$\frac{d}{dX} r(\xi, \tau, X) = H \xi' - B_\tau \tau' + \partial r / \partial X =
    \Lambda',$$

    in the free strains; $\xi^{*\prime}$ in the others and on rigid pieces. Its own derivatives
    follow from this equation too: those through the factors of H would be three times the program.

    **Arguments:** `tau_rate`: $\tau'$; `reaction_rate`: $\Lambda'$, None without loads; `rate`: the
    derivative of `sections` along the arm.
    """

    def imbalance(free_rate: Vector, *given: Any) -> Vector:
        xi, tau, tau_rate, reaction_rate, sections, rate = given
        xi_rate = completed(free_rate, sections._replace(rest=rate.rest), free)
        change = residual_rate(xi, xi_rate, tau, tau_rate, sections, rate)
        change = change if reaction_rate is None else c.subtract(change, reaction_rate)
        return free_components(change, free)

    def solve(given: tuple, right: Vector) -> Vector:
        xi, tau, _, _, sections, _ = given
        factor = c.cholesky(free_block(tangent(xi, sections, tau), free))
        return c.scale(-1.0, c.cholesky_solve(factor, right))

    @jax.custom_jvp
    def solved(*given: Any) -> Vector:
        none = tuple(jnp.zeros_like(x) for x in free_components(given[0], free))
        return solve(given, imbalance(none, *given))

    @partial(solved.defjvp, symbolic_zeros=True)
    def _(primals: tuple, tangents: tuple) -> tuple[Vector, Vector]:
        found = solved(*primals)
        change = change_of(lambda *given: imbalance(found, *given), primals, tangents)
        return found, solve(primals, change)

    found = solved(xi, tau, tau_rate, reaction_rate, sections, rate)
    return completed(found, sections._replace(rest=rate.rest), free)


def residual_rate(
    xi: Vector,
    xi_rate: Vector,
    tau: Forces,
    tau_rate: Forces,
    sections: CrossSections,
    rate: CrossSections,
) -> Vector:
    """Derivative along the arm of `residual` without its reaction. Not by `jax.jvp`: on a CPU each
    component would compute the directions of all threads and their derivatives again."""
    given = (one._replace(paths=(), reach=()) for one in (sections, rate))
    pairs = zip((xi, xi_rate), given, strict=True)
    elastic = jax.jvp(lambda xi, at: at.elastic_wrench(xi), *_alike(*pairs))[1]

    def less(total: Vector, paths: tuple[Path, Path], forces: tuple[Array, Array]) -> Vector:
        force, force_rate = forces
        directions = direction_rate(xi, xi_rate, *paths)
        wrench, wrench_rate = jax.jvp(thread_wrench, *_alike(*zip(directions, paths, strict=True)))
        total = c.subtract(total, c.scale(force_rate, wrench))
        return c.subtract(total, c.scale(force, wrench_rate))

    paths = tuple(zip(sections.paths, rate.paths, strict=True))
    forces = tuple(zip(tau, tau_rate, strict=True))
    return c.times(sections.flexible, over_threads(less, elastic, paths, forces))


def direction_rate(
    xi: Vector, xi_rate: Vector, path: Path, path_rate: Path
) -> tuple[Vector, Vector]:
    r"""Unit tangent t of a thread's path and its derivative $t' = (1 - t t^T) t_c' / |t_c|$ along
    the arm, in the frame of the section."""
    t_c, t_c_rate = jax.jvp(thread_tangent, *_alike((xi, path), (xi_rate, path_rate)))
    length = jnp.sqrt(c.dot(t_c, t_c))
    t = tuple(once(x / length) for x in t_c)
    along = c.dot(t, t_c_rate)
    return t, tuple(once((a - along * b) / length) for a, b in zip(t_c_rate, t, strict=True))


def _alike(values: tuple, rates: tuple) -> tuple[Any, Any]:
    """Values and their rates broadcast to one shape: in a batch of arms either may be the same for
    all."""
    leaves, tree = jax.tree.flatten(values)
    pairs = [
        jnp.broadcast_arrays(x, dx) for x, dx in zip(leaves, jax.tree.leaves(rates), strict=True)
    ]
    pairs = [alike(*pair) for pair in pairs]
    return tuple(jax.tree.unflatten(tree, list(side)) for side in zip(*pairs, strict=True))


def turning_rate(
    xi: Vector, xi_rate: Vector, sections: CrossSections, rate: CrossSections, place: int
) -> Array:
    r"""Turning rate of a thread's path, $\varphi' = |t' + k \times t|$ [rad/m]."""
    t, t_rate = direction_rate(xi, xi_rate, sections.paths[place], rate.paths[place])
    turn = c.add(t_rate, c.cross(xi[:3], t))
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
