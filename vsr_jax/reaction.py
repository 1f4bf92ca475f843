r"""The reaction $\Lambda$ to the loads: what each cross-section carries of the loads beyond it.

In the world frame, with $p' = R u$ and load densities $(c, f)$,

$$n(X) = \sum_{X_i > X} F_i + \int_X^L f \, ds, \quad m(X) = \sum_{X_i > X} M_i + \int_X^L (c + p' \times n) \, ds, \quad
\Lambda = (R^T m, R^T n).$$

Two passes along the arm: rotations from the base up, wrenches from the tip down. Every load here depends on the shape
through rotations only, so positions are never needed. Wrenches jump at the ends of steps only.
"""

import itertools
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from . import component as c
from .component import Matrix, Vector
from .kinematics import step_components
from .quadrature import Grid, beyond, gauss_legendre, interpolation, locate, weighted, within
from .scene import Scene
from .se3 import rotation_components


class FollowerPoint(NamedTuple):
    """A wrench that follows a section: the number of steps before it, 1 at the nodes before it, and its wrench there."""

    step: Array
    before: Array
    wrench: Vector


class Loading(NamedTuple):
    r"""The loads of a scene on a grid, node arrays of shape (stages, steps); what is absent is None.

    - `dead`: wrench $(\sum M_i + \int c, n)$ of the world-frame loads beyond each node, known beforehand;
      `dead_density`: $(c, f)$ in the world frame;
    - `follower_density`: $(c, f)$ in the body frame; `follower_points`: wrenches at points in the body frame;
    - `base`: rotation of the base, the identity for None.
    """

    dead: Vector | None
    dead_density: Vector | None
    follower_density: Vector | None
    follower_points: tuple[FollowerPoint, ...]
    base: Array | None

    @property
    def follows(self) -> bool:
        """Whether a load turns with the arm."""
        return self.follower_density is not None or bool(self.follower_points)


class Reaction(NamedTuple):
    """Both passes: rotations at the start of each step and at the nodes, wrench $(m, n)$ in the world frame and its density
    $(c + p' \\times n, f)$ at the nodes, the wrench $\\Lambda$ in the body frame; in the world frame the axis $p'$, the
    wrenches that follow at points and the density that follows; the density (c, f) of all loads in the body frame."""

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
        FollowerPoint(jnp.sum(grid.start < X), (grid.X < X).astype(X.dtype), wrench) for X, wrench in scene.point_wrenches("body")
    )
    base = None if scene.rod.base is None else scene.rod.base[:3, :3]
    return Loading(dead, density, scene.density(grid.X, "body"), points, base)


def partial_rotation(k: Vector, h: Array, sigma: Array | float) -> Vector:
    r"""Rotation vector from the start of a step to the fraction $\sigma$ of it, from the angular strain at its nodes.

    The Magnus expansion of the polynomial through the nodes, $k = \sum_p b_p \sigma^p$, to its first commutator; the error is
    $O(h^{s+1})$ as that of the polynomial.
    """
    stages = k[0].shape[0]
    weights = interpolation(stages)
    b = [tuple(weighted(weights[p], x) for x in k) for p in range(stages)]
    omega = c.scale(h * sigma, b[0])
    for p in range(1, stages):
        omega = c.add(omega, c.scale(h * sigma ** (p + 1) / (p + 1), b[p]))
    for p, q in itertools.combinations(range(stages), 2):
        weight = (1 / (p + 1) - 1 / (q + 1)) / (2 * (p + q + 2))
        omega = c.add(omega, c.scale(weight * h * h * sigma ** (p + q + 2), c.cross(b[p], b[q])))
    return omega


def rotations(k: Vector, h: Array, base: Array | None) -> tuple[Matrix, Matrix, Matrix]:
    """Rotation at the start of every step, at the nodes and at the end of the arm, from the angular strain at the nodes."""
    stages = k[0].shape[0]
    zero = jnp.zeros_like(k[0])  # the angular part of a step needs no linear strain
    omega = step_components(tuple((*(x[i] for x in k), zero[i], zero[i], zero[i]) for i in range(stages)), h)[:3]
    matrix = jnp.eye(3, dtype=h.dtype) if base is None else base
    first = tuple(tuple(jnp.broadcast_to(x, h[0].shape) for x in c.split(row)) for row in matrix)
    end, starts = lax.scan(lambda R, E: (c.matmul(R, E), R), first, rotation_components(omega))
    nodes = jnp.asarray(gauss_legendre(stages)[0], h.dtype)[:, None]
    return starts, c.matmul(starts, rotation_components(partial_rotation(k, h, nodes))), end


def react(xi: Vector, grid: Grid, loads: Loading) -> Reaction:
    """Reaction at the nodes of the strain `xi`, six component arrays of shape (stages, steps)."""
    starts, R, end = rotations(xi[:3], grid.h, loads.base)
    zero = (jnp.zeros_like(xi[0]),) * 3
    m, n = (zero, zero) if loads.dead is None else (loads.dead[:3], loads.dead[3:])
    back = c.transpose(R)
    density = (*zero, *zero) if loads.dead_density is None else loads.dead_density
    body_density = _turn(back, density)
    points = tuple(_turn(_rotation_at(starts, end, point.step), point.wrench) for point in loads.follower_points)
    for point, turned in zip(loads.follower_points, points, strict=True):
        m, n = c.add(m, c.scale(point.before, turned[:3])), c.add(n, c.scale(point.before, turned[3:]))
    follower = None
    if loads.follower_density is not None:
        follower = turned = _turn(R, loads.follower_density)
        density, body_density = c.add(density, turned), c.add(body_density, loads.follower_density)
        along = beyond(turned, grid)
        m, n = c.add(m, along[:3]), c.add(n, along[3:])
    axis = c.matvec(R, xi[3:])
    arm = c.cross(axis, n)
    m = c.add(m, beyond(arm, grid))
    density = (*c.add(density[:3], arm), *density[3:])
    wrench = _turn(back, (*m, *n))
    return Reaction(starts, R, (*m, *n), density, wrench, axis, points, follower, body_density)


def react_at(xi: Vector, grid: Grid, loads: Loading, X: Array) -> Vector:
    r"""Reaction $\Lambda$ at abscissas X, six component arrays of their shape, from the strain at the nodes."""
    along = react(xi, grid, loads)
    step, sigma = locate(grid, X)
    starts = tuple(tuple(x[step] for x in row) for row in along.starts)
    R = c.matmul(starts, rotation_components(partial_rotation(tuple(x[:, step] for x in xi[:3]), grid.h[step], sigma)))
    first = float(gauss_legendre(grid.X.shape[0])[0][0])
    world = tuple(
        wrench[0, step] + within(q, grid, step, first) - within(q, grid, step, sigma)
        for wrench, q in zip(along.world, along.density, strict=True)
    )
    return _turn(c.transpose(R), world)


def _turn(R: Matrix, wrench: Vector) -> Vector:
    return (*c.matvec(R, wrench[:3]), *c.matvec(R, wrench[3:]))


def _rotation_at(starts: Matrix, end: Matrix, step: Array) -> Matrix:
    """Rotation at the start of a step, or at the end of the arm for the step after the last."""
    return tuple(tuple(jnp.append(s, e)[step] for s, e in zip(row, last, strict=True)) for row, last in zip(starts, end, strict=True))
