r"""The reaction $\Lambda$ to the loads: the wrench on each cross-section by the loads beyond it.

In the world frame, with $p' = R u$ and load densities $(c, f)$,

$$n(X) = \sum_{X_i > X} F_i + \int_X^L f \, ds, \quad
m(X) = \sum_{X_i > X} M_i + \int_X^L (c + p' \times n) \, ds, \quad
\Lambda = (R^T m, R^T n).$$

Two passes along the arm: rotations from the base to the tip, wrenches from the tip to the base.
Positions are computed only if a load depends on them. Wrenches jump only at the ends of steps, but
for contact forces (see `touch`).
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..chain import Coupled
from ..numerics.component import Forces, Vector
from ..numerics.implicit import change_of, unchanged
from ..numerics.magnus import magnus_6
from ..numerics.once import once
from ..numerics.quadrature import (
    Grid,
    before,
    beyond,
    gauss_legendre,
    interpolation,
    locate,
    sum_along,
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
from .chords import Pull, pull_of
from .loading import Loading
from .pose_terms import base_of
from .touch import Touch, contact_wrenches, touch_of


class Reaction(NamedTuple):
    r"""Results of both passes: matrices (3, 3, ...), vectors (3, ...) and wrenches (6, ...), with
    the axes (stages, steps) of the nodes behind.

    - `starts`, `end`, `rotation`: rotations at the start of each step, (3, 3, steps), at the end of
      the arm, (3, 3), and at the nodes.
    - `world`, `density`: wrench $(m, n)$ in the world frame and its density $(c + p' \times n, f)$
      at the nodes.
    - `wrench`: $\Lambda$ in the body frame.
    - `axis`, `points`, `follower`: in the world frame the axis $p'$, the follower wrenches at
      points (6,) and the follower density.
    - `body_density`: density (c, f) of all loads in the body frame.
    - `seen`: rotation and position where each load acts that depends on the pose.
    - `pull`: the chords of straight tendons, whose wrenches are parts of `world` and `wrench`.
    - `touch`: the contacts.
    """

    starts: Array
    end: Array
    rotation: Array
    world: Array
    density: Array
    wrench: Array
    axis: Array
    points: tuple[Array, ...]
    follower: Array | None
    body_density: Array
    seen: tuple[tuple[Array, Array | None], ...]
    pull: Pull | None
    touch: Touch | None


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
    end, starts = lax.scan(lambda R, E: (matmul(R, once(E)), R), first, whole)
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


def react(xi: Vector, grid: Grid, loads: Loading, forces: Forces = ()) -> Reaction:
    """Reaction at the nodes for the strain `xi`, six component arrays of shape (stages, steps,
    *arms), and for the `forces` of the threads at their start."""
    whole = stack(xi)
    starts, R, end = rotations(rows(whole, 0, 3), grid.h, loads.base)
    zero, back = jnp.zeros_like(whole), transpose(R)
    world = zero if loads.dead is None else loads.dead
    density = zero if loads.dead_density is None else loads.dead_density
    body_density = turned(back, density)
    points = tuple(
        turned(rotation_at(starts, end, point.step), point.wrench)
        for point in loads.follower_points
    )
    for point, wrench in zip(loads.follower_points, points, strict=True):
        world = world + point.before * wrench[:, None, None]
    follower = None
    if loads.follower_density is not None:
        follower = turned(R, loads.follower_density)
        density, body_density = density + follower, body_density + loads.follower_density
        world = world + beyond(follower, grid)
    axis = matvec(R, rows(whole, 3, 6))
    seen = _seen(starts, end, R, axis, grid, loads)
    for term, (turn, place) in zip(loads.by_pose, seen, strict=True):
        here = term.wrench(turn, place)
        if term.before is None:
            density, body_density = density + here, body_density + turned(back, here)
            world = world + beyond(here, grid)
        else:
            world = world + term.before * here[:, None, None]
    touch = None if loads.around is None else touch_of(axis, R, grid, loads.around)
    if touch is not None:
        world = world + contact_wrenches(touch)
    arm = cross(axis, rows(world, 3, 6))
    world, density = _with_moment(world, beyond(arm, grid)), _with_moment(density, arm)
    pull = None
    if loads.discs is not None:
        pull = pull_of(loads.discs, starts, end, axis, grid, forces)
        chords = pull.wrench
        world = world + chords
        density = _with_moment(density, cross(axis, rows(chords, 3, 6)))
    wrench = turned(back, world)
    return Reaction(
        starts,
        end,
        R,
        world,
        density,
        wrench,
        axis,
        points,
        follower,
        body_density,
        seen,
        pull,
        touch,
    )


def _seen(
    starts: Array, end: Array, R: Array, axis: Array, grid: Grid, loads: Loading
) -> tuple[tuple[Array, Array | None], ...]:
    """Rotation and position where each load acts that depends on the pose; None for positions if no
    load depends on them."""
    if not loads.by_pose:
        return ()
    positions = loads.motion == 6
    base = jnp.asarray(base_pose(loads.base, grid.h.dtype))[:3, 3]
    base = base_of(base, axis.ndim - 3)[:, None, None]
    along = any(term.step is None for term in loads.by_pose)
    nodes = base + before(axis, grid) if positions and along else None
    seen = []
    for term in loads.by_pose:
        if term.step is None or term.before is None:
            seen.append((R, nodes))
        else:
            place = (base + sum_along(term.before * axis, grid))[:, 0, 0] if positions else None
            seen.append((rotation_at(starts, end, term.step), place))
    return tuple(seen)


def coupled_by(along: Reaction, loads: Loading, grid: Grid) -> Coupled:
    """How the sections act on each other by the loads, without the contacts."""
    size, density, joined = loads.motion, None, None
    ends, at_points = None, []
    if along.pull is not None:
        cut = loads.only_discs
        ends = along.pull.cut_slopes(size) if cut else along.pull.slopes(size)
        joined = along.pull.joined if cut else None
    if along.follower is not None:
        density = _turning(along.follower, size)
    for point, wrench in zip(loads.follower_points, along.points, strict=True):
        at_points.append((point.step, _turning(wrench, size)))
    for term, (turn, place) in zip(loads.by_pose, along.seen, strict=True):
        here = term.slope(turn, place, size)
        if term.step is not None:
            at_points.append((term.step, here))
        else:
            density = here if density is None else density + here
    for step, slope in at_points:  # at the end of the step before each
        there = jnp.arange(grid.h.shape[0]).reshape(-1, *(1,) * step.ndim) == step - 1
        here = there.astype(grid.h.dtype) * slope[:, :, None]
        ends = here if ends is None else ends + here
    world = along.rotation, along.axis, along.world, along.density
    return Coupled(*world, density, ends, joined=joined)


def _turning(wrench: Array, size: int) -> Array:
    """Derivative (6, size, ...) of a wrench that turns with its section."""
    turn = jnp.concatenate([-skew(rows(wrench, 0, 3)), -skew(rows(wrench, 3, 6))])
    return turn if size == 3 else jnp.concatenate([turn, jnp.zeros_like(turn)], axis=1)


def _with_moment(wrench: Array, moment: Array) -> Array:
    """A wrench (6, ...) and a moment more."""
    total = rows(wrench, 0, 3) + moment
    return jnp.concatenate([total, jnp.broadcast_to(rows(wrench, 3, 6), total.shape)])


def react_at(
    xi: Vector,
    grid: Grid,
    loads: Loading,
    X: Array,
    forces: Forces = (),
    *,
    smooth: bool = False,
) -> Vector:
    r"""Reaction $\Lambda$ at abscissas X, six component arrays of their shape, from the strain at
    the nodes and the `forces` of the threads at their start. `smooth`: with each contact force
    spread over its step."""
    along = react(xi, grid, loads, forces)
    step, sigma = locate(grid, X)
    k = stack(xi[:3])[:, :, step]
    turn = stacked_rotation(partial_rotation(k, grid.h[step], sigma))
    R = matmul(along.starts[:, :, step], turn)
    first = float(gauss_legendre(grid.X.shape[0])[0][0])
    since, q = along.world[:, 0, step], along.density
    world = since + within(q, grid, step, first) - within(q, grid, step, sigma)
    if along.touch is not None:
        world = world + along.touch.carried(step, sigma, smooth)
    return components(turned(transpose(R), world))


def rotation_at(starts: Array, end: Array, step: Array) -> Array:
    """Rotation at the start of a step, or at the end of the arm for the step after the last."""
    whole = jnp.concatenate([starts, end[:, :, None]], axis=2)
    here = jnp.arange(whole.shape[2]).reshape(-1, *(1,) * step.ndim) == step
    return jnp.sum(jnp.where(here, whole, 0.0), axis=2)
