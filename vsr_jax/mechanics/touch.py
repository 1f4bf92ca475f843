r"""Where an arm touches obstacles: gaps, contact forces and their derivatives by motions.

The outline of the arm is the surface swept by spheres of radius $\rho(X)$ on its axis. On each step
of the grid and for each obstacle the nearest point of the axis is found,

$$\sigma = \arg\min_s \, d(r(s)) - \rho(s) + \epsilon (2 s - 1)^2, \quad 0 \le s \le 1,$$

with the distance d to the obstacle and the polynomial r(s) through the step. The small $\epsilon$
makes it unique where the arm lies along a surface, and is smaller still where it does not. The gap
there is $g = d(r) - \rho$. Without friction the contact force is $\lambda n$ with $n = \nabla d$.

The position r(s) is an integral of the axis with weights $a_j(s)$ for the nodes of the step. A
force at s acts on node j with the share $a_j(s) / a_j(1)$, so that its work is that of the discrete
positions: but for $\epsilon$ the balance is the gradient of a discrete energy.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..arm.obstacles import Obstacle
from ..arm.rod import Rod
from ..numerics.batching import arms_in
from ..numerics.quadrature import Grid, gauss_legendre, interpolation
from ..numerics.stacked import columns, matmul, rows, skew
from .pose_terms import base_of

_SAMPLES, _ITERATIONS = 5, 6
"""Points of a step from which the nearest one starts, and Newton steps from it."""


class Surroundings(NamedTuple):
    r"""The obstacles around an arm.

    **Fields:** the `obstacles`, the `rod` and the position of its `base`; `flatness` $\epsilon$
    [m]; `lift` [m], added to all gaps; `force` [N] of each obstacle on each step, shape (obstacles
    * steps, ...); `soft`: None, or 1 where penalties of a `stiffness` [N/m] and `width` [m] stand
    for the forces.
    """

    obstacles: tuple[Obstacle, ...]
    rod: Rod
    base: Array
    flatness: Array
    lift: Array
    stiffness: Array
    force: Array
    soft: Array | None
    width: Array | None


class Touch(NamedTuple):
    r"""Contact of each obstacle with each step, arrays (..., obstacles, steps, *arms).

    **Fields:** `gap` [m]; `normal` (3) and `place` (3) of the contact in the world; `sigma`, its
    place in the step; `shares` (stages) of a force there for the nodes of the step; `force` [N];
    `slope` (6, 6): derivative of the wrench by the motion of the section, at a given force; `cell`
    (stages): 1 for the node at the end of whose cell, of its weight, the contact is nearest; and
    `lever` (3) from there.
    """

    gap: Array
    normal: Array
    place: Array
    sigma: Array
    shares: Array
    force: Array
    slope: Array
    cell: Array
    lever: Array


class _Nearest(NamedTuple):
    """The nearest point of one step: place in the step, gap there without and with the term in
    epsilon, normal, position, and the matrix of `Touch.slope` per force."""

    sigma: Array
    gap: Array
    raised: Array
    normal: Array
    place: Array
    slope: Array


def touch_of(axis: Array, grid: Grid, around: Surroundings) -> Touch:
    """Contact for the axis p' at the nodes, shape (3, stages, steps, *arms)."""
    parts = jnp.sum(grid.weight * axis, axis=1)
    base = base_of(around.base, parts.ndim - 2)[:, None]
    starts = base + jnp.cumsum(parts, axis=1) - parts
    found = [
        _each(_nearest, obstacle, around.rod, around.flatness, starts, axis, grid.start, grid.h)
        for obstacle in around.obstacles
    ]
    near = jax.tree.map(lambda *x: jnp.stack(x, axis=x[0].ndim - starts.ndim + 1), *found)
    # empty steps, all at one place, touch nothing
    lift = around.lift + jnp.where(grid.h > 0, 0.0, 1e3 * around.rod.length)
    gap = near.gap + lift
    force, slope = around.force.reshape(gap.shape), near.slope
    if around.soft is None or around.width is None:
        slope = force * slope
    else:
        raised = near.raised + lift
        root = jnp.sqrt(raised**2 + around.width**2)
        penalty = 0.5 * around.stiffness * (root - raised)
        rate = 0.5 * around.stiffness * (raised / root - 1)
        force = jnp.where(around.soft > 0, penalty, force)
        push = jnp.where(around.soft > 0, rate, 0.0) * near.normal[:, None] * near.normal[None]
        slope = (force * slope).at[3:, 3:].add(push)
    cumulative, weights = _weights(near.sigma, grid.X.shape[0])
    shares = cumulative / weights.reshape(-1, *(1,) * near.sigma.ndim)
    cell = _cell_of(near.sigma, grid.X.shape[0])
    ends = starts[:, None] + jnp.cumsum(grid.weight * axis, axis=1)
    lever = near.place - jnp.sum(cell * ends[:, :, None], axis=1)
    return Touch(gap, near.normal, near.place, near.sigma, shares, force, slope, cell, lever)


def contact_forces(touch: Touch) -> Array:
    """Force by all contacts beyond each node in the world, (3, stages, steps, *arms)."""
    forces = touch.force * touch.normal
    of_step = jnp.sum(forces, axis=1)
    later = lax.cumsum(of_step, axis=1, reverse=True) - of_step
    return later[:, None] + jnp.sum(touch.shares[None] * forces[:, None], axis=2)


def at_cells(touch: Touch) -> Array:
    """Derivatives (6, 6, stages, steps, *arms) of all contact wrenches by the motions of the ends
    of the cells of the nodes."""
    d, f = skew(touch.lever), skew(touch.force * touch.normal)
    turned, moved = columns(touch.slope, 0, 3), columns(touch.slope, 3, 6)
    slope = jnp.concatenate([turned - matmul(moved, d), moved], axis=1)
    moment = rows(slope, 0, 3) + matmul(d, rows(slope, 3, 6))
    turning = jnp.concatenate([matmul(f, d), jnp.zeros_like(d)], axis=1)
    slope = jnp.concatenate([moment + turning, rows(slope, 3, 6)])
    return jnp.sum(touch.cell * slope[:, :, None], axis=3)


def _cell_of(sigma: Array, stages: int) -> Array:
    """1 for the node at the end of whose cell a place in the step is nearest, else 0."""
    ends = np.cumsum(gauss_legendre(stages)[1])
    between = np.concatenate([[-np.inf], (ends[1:] + ends[:-1]) / 2, [np.inf]])
    limits = jnp.asarray(between, sigma.dtype).reshape(-1, *(1,) * sigma.ndim)
    return ((sigma >= limits[:-1]) & (sigma < limits[1:])).astype(sigma.dtype)


def _weights(sigma: Array, stages: int) -> tuple[Array, Array]:
    """Weights (stages, ...) of the integral from the start of a step of length 1 to sigma, and of
    that over the whole step."""
    b = jnp.asarray(interpolation(stages), sigma.dtype)
    powers = [sigma ** (p + 1) / (p + 1) for p in range(stages)]
    cumulative = jnp.stack([sum(b[p, j] * powers[p] for p in range(stages)) for j in range(stages)])
    return cumulative, jnp.asarray(gauss_legendre(stages)[1], sigma.dtype)


def _nearest(
    obstacle: Obstacle, rod: Rod, flatness: Array, start: Array, axis: Array, X: Array, h: Array
) -> _Nearest:
    """The nearest point of one step of one arm."""

    def place(s: Array) -> Array:
        return start + h * (axis @ _weights(s, axis.shape[1])[0])

    def gap(s: Array) -> Array:
        return obstacle.distance(place(s)) - rod.outline(X + s * h)

    # less where the gap has a clear minimum
    curved = 4 * (gap(jnp.zeros_like(h)) + gap(jnp.ones_like(h)) - 2 * gap(0.5 * jnp.ones_like(h)))
    flat = flatness * 8 * flatness / (8 * flatness + jnp.maximum(curved, 0.0))

    def lifted(s: Array) -> Array:
        return gap(s) + flat * (2 * s - 1) ** 2

    slope_at, curvature_at = jax.grad(lifted), jax.grad(jax.grad(lifted))
    samples = jnp.linspace(0.0, 1.0, _SAMPLES, dtype=h.dtype)
    first = samples[jnp.argmin(jax.vmap(lifted)(samples))]

    def closer(_: Array, s: Array) -> Array:
        slope, curvature = slope_at(s), curvature_at(s)
        step = jnp.where(curvature > 0, slope / curvature, jnp.sign(slope))
        return jnp.clip(s - jnp.clip(step, -0.25, 0.25), 0.0, 1.0)

    s = lax.stop_gradient(lax.fori_loop(0, _ITERATIONS, closer, first))
    curvature = lax.stop_gradient(curvature_at(s))
    inside = (s > 0) & (s < 1) & (curvature > 0)
    curvature = jnp.where(inside, curvature, 1.0)
    # its derivative by the shape is that of the root of the slope
    s = jnp.clip(s - jnp.where(inside, slope_at(s) / curvature, 0.0), 0.0, 1.0)
    r, along = jax.jvp(place, (s,), (jnp.ones_like(s),))
    normal, turn = jax.jvp(jax.grad(obstacle.distance), (r,), (along,))
    bend = jax.jacfwd(jax.grad(obstacle.distance))(r)
    moved = jnp.concatenate([jnp.cross(along, normal), turn])
    slope = -jnp.where(inside, 1 / curvature, 0.0) * moved[:, None] * moved[None]
    return _Nearest(s, gap(s), lifted(s), normal, r, slope.at[3:, 3:].add(bend))


def _each(
    function: Callable,
    obstacle: Obstacle,
    rod: Rod,
    flatness: Array,
    starts: Array,
    axis: Array,
    X: Array,
    h: Array,
) -> Any:
    """A function of every step of every arm, its axes in front of those of steps and arms."""
    behind = h.ndim - 1
    of_arm = jax.vmap(function, (None, None, None, 1, 2, 0, 0), -1)
    arguments = obstacle, rod, flatness, starts, axis, X, h
    if behind:
        arms = arms_in(arguments, behind)
        arguments = jax.tree.map(
            lambda x: jnp.broadcast_to(x, (*x.shape[: x.ndim - behind], *arms)), arguments
        )
        of_arm = jax.vmap(of_arm, -1, -1)
    return of_arm(*arguments)
