r"""The reaction $\Lambda$ to the loads: the wrench on each cross-section by the loads beyond it.

In the world frame, with $p' = R u$ and load densities $(c, f)$,

$$n(X) = \sum_{X_i > X} F_i + \int_X^L f \, ds, \quad
m(X) = \sum_{X_i > X} M_i + \int_X^L (c + p' \times n) \, ds, \quad
\Lambda = (R^T m, R^T n).$$

Two passes along the arm: rotations from the base to the tip, wrenches from the tip to the base.
Positions are computed only if a load depends on them. Wrenches jump only at the ends of steps, but
for loads that say so (`AppliedLoad.within_step`).
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..chain import Coupled
from ..numerics.component import Forces, Vector
from ..numerics.implicit import change_of, unchanged
from ..numerics.loops import scan
from ..numerics.magnus import magnus_6
from ..numerics.once import once
from ..numerics.quadrature import (
    Grid,
    beyond,
    gauss_legendre,
    interpolation,
    locate,
    weighted,
    within,
)
from ..numerics.se3 import base_pose, stacked_rotation, stacked_turn
from ..numerics.stacked import (
    components,
    cross,
    matmul,
    matvec,
    rows,
    skew,
    stack,
    transpose,
    turned,
)
from .applied_load import Exerted, Loading, Pose


class Reaction(NamedTuple):
    r"""Results of both passes: wrenches (6, stages, steps) at the nodes.

    - `pose`: where the sections are.
    - `world`, `density`: wrench $(m, n)$ in the world frame and its density $(c + p' \times n, f)$.
    - `wrench`: $\Lambda$ in the body frame. `body_density`: density (c, f) of all loads there.
    - `exerted`: what each load exerts.
    """

    pose: Pose
    world: Array
    density: Array
    wrench: Array
    body_density: Array
    exerted: tuple[Exerted, ...]

    def coupled(self, loading: Loading) -> Coupled:
        """How the sections act on each other by the loads."""
        pose, size = self.pose, loading.motion
        each = [
            load.slopes(pose, exerted, size)
            for load, exerted in zip(loading.loads, self.exerted, strict=True)
        ]
        spans = [one.spans for one in each if one.spans is not None]
        return Coupled(
            pose.rotation,
            pose.axis,
            self.world,
            self.density,
            density=_sum([one.density for one in each]),
            ends=_sum([one.ends for one in each]),
            spans=spans[0] if spans else None,
        )


def partial_rotation(k: Array, h: Array, sigma: Array | float) -> Array:
    r"""Rotation vector from the start of a step to the fraction $\sigma$ of it, from the angular
    strain (3, stages, ...) at its nodes.

    The Magnus expansion of the polynomial through the nodes, $k = b_0 + b_1 x + b_2 x^2$ with x
    from -1/2 to 1/2 on the step, to the order of the steps. About the middle of the step the
    coefficients are small sums of differences, so that single precision keeps its digits. Rotations
    at the nodes need that order too: with the first commutators alone the error at the tip of a
    loaded arm is of order 4.5 instead of 6.
    """
    stages = k.shape[1]
    near = k[:, stages // 2]  # differences from it are exact, or nearly
    b = once(weighted(interpolation(stages, 0.5), k - near[:, None], axis=1))
    b = components(b, axis=1)
    h, middle = h * sigma, 0.5 * (sigma - 1.0)
    first = near + b[0]
    if stages == 1:
        return h * first
    if stages == 2:
        mean = h * (first + middle * b[1])
        return mean + h * sigma / 12 * cross(mean, b[1])
    bend = middle * b[2]
    mean = once(h * (first + middle * (b[1] + bend)))
    slope = once(h * sigma * (b[1] + 2.0 * bend))
    return magnus_6(mean, slope, h * sigma * sigma * b[2], cross)


@jax.custom_jvp
def rotations(k: Array, h: Array, base: Array | None) -> tuple[Array, Array, Array]:
    r"""Rotation at the start of every step (3, 3, steps, *arms), at the nodes (3, 3, stages, steps,
    *arms) and at the end of the arm, from the angular strain (3, stages, steps, *arms) at the
    nodes.

    Its derivative is $\delta R = \tilde\theta R$ with the sum $\theta$ of all turns before, in
    the world frame: sums along the arm, without a pass.
    """
    within_step = stacked_rotation(once(_within_steps(k, h)))
    whole = jnp.moveaxis(within_step[:, :, -1], 2, 0)
    matrix = base_pose(base, h.dtype)[:3, :3]
    first = jnp.broadcast_to(
        matrix.reshape(3, 3, *matrix.shape[2:], *(1,) * (whole.ndim - 1 - matrix.ndim)),
        whole.shape[1:],
    )
    end, starts = scan(lambda R, E: (matmul(R, once(E)), R), first, whole)
    starts = jnp.moveaxis(starts, 0, 2)
    return starts, matmul(starts[:, :, None], within_step[:, :, :-1]), end


def _within_steps(k: Array, h: Array) -> Array:
    """Rotation vectors from the start of each step to its nodes, and to its end."""
    parts = jnp.append(jnp.asarray(gauss_legendre(k.shape[1])[0], h.dtype), 1.0)
    return partial_rotation(k[:, :, None], h, parts.reshape(-1, *(1,) * h.ndim))


@partial(rotations.defjvp, symbolic_zeros=True)
def _rotations_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    k, h, base = primals
    starts, R, end = rotations(k, h, base)
    ends = jnp.concatenate([starts[:, :, 1:], end[:, :, None]], axis=2)
    turn = stacked_turn(_within_steps(k, h), change_of(_within_steps, (k, h), tangents[:2]))
    turn = matvec(jnp.concatenate([R, ends[:, :, None]], axis=2), turn)
    of_step = turn[:, -1]
    until = jnp.cumsum(of_step, axis=1)
    before = until - of_step
    theta = before, before[:, None] + turn[:, :-1], until[:, -1]
    changes = tuple(matmul(skew(t), x) for t, x in zip(theta, (starts, R, end), strict=True))
    if base is not None and not unchanged(tangents[2]):
        first = matmul(tangents[2][:3, :3], transpose(base[:3, :3]))
        first = first.reshape(3, 3, *first.shape[2:], *(1,) * (end.ndim - first.ndim))
        changes = (
            changes[0] + matmul(first[:, :, None], starts),
            changes[1] + matmul(first[:, :, None, None], R),
            changes[2] + matmul(first, end),
        )
    return (starts, R, end), changes


def react(xi: Vector, grid: Grid, loading: Loading, forces: Forces = ()) -> Reaction:
    """Reaction at the nodes for the strain `xi`, six component arrays of shape (stages, steps,
    *arms), and for the `forces` of the threads at their start."""
    whole = stack(xi)
    starts, R, end = rotations(rows(whole, 0, 3), grid.h, loading.base)
    axis, none = matvec(R, rows(whole, 3, 6)), jnp.zeros_like(whole)
    pose = Pose(starts, end, R, axis, loading.base, grid, forces)
    exerted = tuple(load.exerted(pose) for load in loading.loads)
    wrench = _sum([one.wrench for one in exerted])
    world = none if wrench is None else wrench
    load_density = _sum([one.density for one in exerted])
    density = none if load_density is None else load_density
    levered = _sum([one.levered for one in exerted])
    body_density = turned(transpose(R), density)
    arm = cross(axis, rows(world, 3, 6))
    world, density = _with_moment(world, beyond(arm, grid)), _with_moment(density, arm)
    if levered is not None:
        world = world + levered
        density = _with_moment(density, cross(axis, rows(levered, 3, 6)))
    return Reaction(pose, world, density, turned(transpose(R), world), body_density, exerted)


def _sum(parts: Sequence[Array | None]) -> Array | None:
    """The sum of those that there are."""
    there = [part for part in parts if part is not None]
    return sum(there[1:], there[0]) if there else None


def _with_moment(wrench: Array, moment: Array) -> Array:
    """A wrench (6, ...) and a moment more."""
    total = rows(wrench, 0, 3) + moment
    return jnp.concatenate([total, jnp.broadcast_to(rows(wrench, 3, 6), total.shape)])


def react_at(
    xi: Vector,
    grid: Grid,
    loading: Loading,
    X: Array,
    forces: Forces = (),
    *,
    smooth: bool = False,
) -> Vector:
    r"""Reaction $\Lambda$ at abscissas X, six component arrays of their shape, from the strain at
    the nodes and the `forces` of the threads at their start. `smooth`: with each jump inside a step
    spread over it."""
    along = react(xi, grid, loading, forces)
    step, sigma = locate(grid, X)
    k = stack(xi[:3])[:, :, step]
    turn = stacked_rotation(partial_rotation(k, grid.h[step], sigma))
    R = matmul(along.pose.starts[:, :, step], turn)
    first = float(gauss_legendre(grid.X.shape[0])[0][0])
    since, q = along.world[:, 0, step], along.density
    world = since + within(q, grid, step, first) - within(q, grid, step, sigma)
    for load, exerted in zip(loading.loads, along.exerted, strict=True):
        jump = load.within_step(exerted, step, sigma, smooth=smooth)
        world = world if jump is None else world + jump
    return components(turned(transpose(R), world))
