r"""The reaction $\Lambda$ to the loads: the wrench on each cross-section by the loads beyond it.

In the world frame, with $p' = R u$ and load densities $(c, f)$,

$$n(X) = \sum_{X_i > X} F_i + \int_X^L f \, ds, \quad
m(X) = \sum_{X_i > X} M_i + \int_X^L (c + p' \times n) \, ds, \quad
\Lambda = (R^T m, R^T n).$$

Two passes along the arm: rotations from the base to the tip, wrenches from the tip to the base. All
loads depend on the shape through rotations only, so positions are not computed. Wrenches jump only
at the ends of steps.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import Scene
from ..numerics import component as c
from ..numerics.component import Matrix, Vector
from ..numerics.magnus import magnus_6
from ..numerics.quadrature import (
    Grid,
    beyond,
    gauss_legendre,
    interpolation,
    locate,
    weighted,
    within,
)
from ..numerics.se3 import base_pose, rotation_components


class FollowerPoint(NamedTuple):
    """A wrench that follows a section: the number of steps before it, 1 at the nodes before it and
    0 beyond, and the wrench in the body frame."""

    step: Array
    before: Array
    wrench: Vector


class Loading(NamedTuple):
    r"""The loads of a scene on a grid, node arrays of shape (stages, steps); None for those that
    are absent.

    - `dead`: wrench $(\sum M_i + \int c, n)$ of the world-frame loads beyond each node, known in
      advance; `dead_density`: $(c, f)$ in the world frame;
    - `follower_density`: $(c, f)$ in the body frame; `follower_points`: wrenches at points in the
      body frame;
    - `base`: pose of the base, the identity for None.
    """

    dead: Vector | None
    dead_density: Vector | None
    follower_density: Vector | None
    follower_points: tuple[FollowerPoint, ...]
    base: Array | None

    @property
    def follows(self) -> bool:
        """Whether a load rotates with the arm."""
        return self.follower_density is not None or bool(self.follower_points)

    def scaled(self, share: Array) -> "Loading":
        """A fraction of all loads."""
        return self._mapped(lambda x: share * x)

    def absent(self) -> "Loading":
        """Zero in place of all loads."""
        return self._mapped(jnp.zeros_like)

    def _mapped(self, function: Callable[[Array], Array]) -> "Loading":
        """A function of every component of the loads."""
        points = tuple(
            point._replace(wrench=jax.tree.map(function, point.wrench))
            for point in self.follower_points
        )
        return self._replace(
            dead=jax.tree.map(function, self.dead),
            dead_density=jax.tree.map(function, self.dead_density),
            follower_density=jax.tree.map(function, self.follower_density),
            follower_points=points,
        )


class Reaction(NamedTuple):
    r"""Results of both passes.

    - `starts`, `rotation`: rotations at the start of each step and at the nodes.
    - `world`, `density`: wrench $(m, n)$ in the world frame and its density $(c + p' \times n, f)$
      at the nodes.
    - `wrench`: $\Lambda$ in the body frame.
    - `axis`, `points`, `follower`: in the world frame the axis $p'$, the follower wrenches at
      points and the follower density.
    - `body_density`: density (c, f) of all loads in the body frame.
    """

    starts: Matrix
    rotation: Matrix
    world: Vector
    density: Vector
    wrench: Vector
    axis: Vector
    points: tuple[Vector, ...]
    follower: Vector | None
    body_density: Vector


def loading(scene: Scene, grid: Grid) -> Loading | None:
    """The loads of a scene on a grid; None if it has none."""
    if not scene.loads:
        return None
    density = scene.density(grid.X, "world")
    parts = [] if density is None else [beyond(density, grid)]
    for X, wrench in scene.point_wrenches("world"):
        parts.append(tuple(jnp.where(grid.X < X, w, 0.0) for w in wrench))
    dead = None
    for part in parts:
        dead = part if dead is None else c.add(dead, part)
    points = tuple(
        FollowerPoint(jnp.sum(grid.start < X), (grid.X < X).astype(X.dtype), wrench)
        for X, wrench in scene.point_wrenches("body")
    )
    return Loading(dead, density, scene.density(grid.X, "body"), points, scene.rod.base)


def partial_rotation(k: Vector, h: Array, sigma: Array | float) -> Vector:
    r"""Rotation vector from the start of a step to the fraction $\sigma$ of it, from the angular
    strain at its nodes.

    The Magnus expansion of the polynomial through the nodes, $k = b_0 + b_1 x + b_2 x^2$ with x
    from -1/2 to 1/2 on the step, to the order of the steps. About the middle of the step the
    coefficients are small sums of differences, so that single precision keeps its digits. Rotations
    at the nodes need that order too: with the first commutators alone the error at the tip of a
    loaded arm is of order 4.5 instead of 6.
    """
    stages = k[0].shape[0]
    near = tuple(x[stages // 2] for x in k)  # differences from it are exact, or nearly
    through = [weighted(interpolation(stages, 0.5), x - x0) for x, x0 in zip(k, near, strict=True)]
    b = [tuple(x[power] for x in through) for power in range(stages)]
    b[0] = c.add(near, b[0])
    h, middle = h * sigma, 0.5 * (sigma - 1.0)
    if stages == 1:
        return c.scale(h, b[0])
    if stages == 2:
        mean = c.scale(h, c.add(b[0], c.scale(middle, b[1])))
        return c.add(mean, c.scale(h * sigma / 12, c.cross(mean, b[1])))
    bend = c.scale(middle, b[2])
    mean = c.scale(h, c.add(b[0], c.scale(middle, c.add(b[1], bend))))
    slope = c.scale(h * sigma, c.add(b[1], c.scale(2.0, bend)))
    return magnus_6(mean, slope, c.scale(h * sigma * sigma, b[2]), c.cross)


def rotations(k: Vector, h: Array, base: Array | None) -> tuple[Matrix, Matrix, Matrix]:
    """Rotation at the start of every step, at the nodes and at the end of the arm, from the angular
    strain at the nodes."""
    # within each step up to its nodes, and up to its end
    parts = jnp.append(jnp.asarray(gauss_legendre(k[0].shape[0])[0], h.dtype), 1.0)
    within_step = rotation_components(partial_rotation(k, h, parts.reshape(-1, *(1,) * h.ndim)))
    whole = jax.tree.map(lambda x: x[-1], within_step)
    to_nodes = jax.tree.map(lambda x: x[:-1], within_step)
    matrix = base_pose(base, h.dtype)[:3, :3]
    first = tuple(tuple(jnp.broadcast_to(x, whole[0][0][0].shape) for x in row) for row in matrix)
    end, starts = lax.scan(lambda R, E: (c.matmul(R, E), R), first, whole)
    return starts, c.matmul(starts, to_nodes), end


def react(xi: Vector, grid: Grid, loads: Loading) -> Reaction:
    """Reaction at the nodes for the strain `xi`, six component arrays of shape (stages, steps,
    *arms)."""
    starts, R, end = rotations(xi[:3], grid.h, loads.base)
    zero = (jnp.zeros_like(xi[0]),) * 3
    m, n = (zero, zero) if loads.dead is None else (loads.dead[:3], loads.dead[3:])
    back = c.transpose(R)
    density = (*zero, *zero) if loads.dead_density is None else loads.dead_density
    body_density = turned(back, density)
    points = tuple(
        turned(_rotation_at(starts, end, point.step), point.wrench)
        for point in loads.follower_points
    )
    for point, wrench in zip(loads.follower_points, points, strict=True):
        m, n = (
            c.add(m, c.scale(point.before, wrench[:3])),
            c.add(n, c.scale(point.before, wrench[3:])),
        )
    follower = None
    if loads.follower_density is not None:
        follower = turned(R, loads.follower_density)
        density, body_density = (
            c.add(density, follower),
            c.add(body_density, loads.follower_density),
        )
        along = beyond(follower, grid)
        m, n = c.add(m, along[:3]), c.add(n, along[3:])
    axis = c.matvec(R, xi[3:])
    arm = c.cross(axis, n)
    m = c.add(m, beyond(arm, grid))
    density = (*c.add(density[:3], arm), *density[3:])
    wrench = turned(back, (*m, *n))
    return Reaction(starts, R, (*m, *n), density, wrench, axis, points, follower, body_density)


def reaction_change(change: Vector, along: Reaction, grid: Grid, loads: Loading) -> Vector:
    r"""Change $\delta\Lambda$ of the reaction with a change $(\kappa, \upsilon)$ of the strain, of
    the order of the nodes' quadrature.

    With the rotation $\theta(X) = \int_0^X R \kappa \, ds$ of the sections in the world frame

    $$\delta n = \int_X^L \theta \times f \, ds, \quad
    \delta m = \int_X^L ((\theta \times p' + R \upsilon) \times n + p' \times \delta n + \theta
    \times c) \, ds, \quad \delta\Lambda = R^T (\delta m - \theta \times m, \delta n - \theta \times
    n),$$

    where c and f are the follower densities; follower points add $\theta \times F$ before them. All
    arrays broadcast: several changes can be stacked in an axis behind those of the nodes, where the
    other arguments have size 1.
    """
    R, m, n = along.rotation, along.world[:3], along.world[3:]
    bend, whole = c.matvec(R, change[:3]), grid.weight
    later = beyond(bend, grid)
    theta = c.subtract(tuple(jnp.sum(whole * x, axis=(0, 1)) for x in bend), later)
    zero = (jnp.zeros_like(theta[0]),) * 3
    dm, dn = zero, zero
    for point, wrench in zip(loads.follower_points, along.points, strict=True):
        turn = tuple(jnp.sum(whole * point.before * x, axis=(0, 1)) for x in bend)
        dm = c.add(dm, c.scale(point.before, c.cross(turn, wrench[:3])))
        dn = c.add(dn, c.scale(point.before, c.cross(turn, wrench[3:])))
    if along.follower is not None:
        more = beyond(
            (*c.cross(theta, along.follower[:3]), *c.cross(theta, along.follower[3:])), grid
        )
        dm, dn = c.add(dm, more[:3]), c.add(dn, more[3:])
    moved = c.cross(c.add(c.cross(theta, along.axis), c.matvec(R, change[3:])), n)
    if loads.follows:
        moved = c.add(moved, c.cross(along.axis, dn))
    dm = c.add(dm, beyond(moved, grid))
    return turned(
        c.transpose(R), (*c.subtract(dm, c.cross(theta, m)), *c.subtract(dn, c.cross(theta, n)))
    )


def react_at(xi: Vector, grid: Grid, loads: Loading, X: Array) -> Vector:
    r"""Reaction $\Lambda$ at abscissas X, six component arrays of their shape, from the strain at
    the nodes."""
    along = react(xi, grid, loads)
    step, sigma = locate(grid, X)
    starts = tuple(tuple(x[step] for x in row) for row in along.starts)
    R = c.matmul(
        starts,
        rotation_components(
            partial_rotation(tuple(x[:, step] for x in xi[:3]), grid.h[step], sigma)
        ),
    )
    first = float(gauss_legendre(grid.X.shape[0])[0][0])
    world = tuple(
        wrench[0, step] + within(q, grid, step, first) - within(q, grid, step, sigma)
        for wrench, q in zip(along.world, along.density, strict=True)
    )
    return turned(c.transpose(R), world)


def turned(R: Matrix, wrench: Vector) -> Vector:
    """Moment and force of a wrench, each rotated by R."""
    return (*c.matvec(R, wrench[:3]), *c.matvec(R, wrench[3:]))


def _rotation_at(starts: Matrix, end: Matrix, step: Array) -> Matrix:
    """Rotation at the start of a step, or at the end of the arm for the step after the last."""
    steps = starts[0][0].shape[0]
    here = jnp.arange(steps + 1).reshape(-1, *(1,) * step.ndim) == step

    def pick(start: Array, last: Array) -> Array:
        return jnp.sum(jnp.where(here, jnp.concatenate([start, last[None]]), 0.0), axis=0)

    return tuple(
        tuple(pick(s, e) for s, e in zip(row, last, strict=True))
        for row, last in zip(starts, end, strict=True)
    )
