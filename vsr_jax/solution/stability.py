r"""Eigenvalues of the tangent stiffness, scaled so that an arm without forces has the eigenvalue 1;
the least is the stability margin.

Where loads couple the nodes, a change $\delta\xi = (\kappa, \upsilon)$ of the strain
rotates the sections in the world frame by $\theta = \int R \kappa \, dX$. With the wrench
$(m, n)$ and the derivative $p'$ of the axis, all in the world frame, the residual changes by

$$\delta r = H \, \delta\xi - (R^T (\delta m - \theta \times m),
R^T (\delta n - \theta \times n)), \quad
-\delta n' = \delta f, \quad -\delta m' = \rho' \times n + p' \times \delta n + \delta c,$$

with the displacement $\rho' = \theta \times p' + R \upsilon$ and the changes of the load densities
by rotation and displacement. A product with the tangent thus takes a few sums along the arm. It is
the exact derivative of the discrete residual: $\theta$ is that of the Magnus steps.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.scene import CrossSections, Scene
from ..mechanics.balance import (
    free_block,
    free_components,
    residual,
    spread,
    tangent,
    thread_direction,
    thread_wrench,
)
from ..mechanics.cable import chords_of
from ..mechanics.chords import Pull
from ..mechanics.loading import Loading, loading
from ..mechanics.reaction import (
    Reaction,
    partial_rotation,
    react,
    rotations,
    slopes_of,
)
from ..models.base import Nodes
from ..numerics import component as c, stacked
from ..numerics.component import Matrix, Vector
from ..numerics.implicit import change_of
from ..numerics.lanczos import Operator, extreme_pairs
from ..numerics.quadrature import Grid, beyond, gauss_legendre
from ..numerics.se3 import exp_coefficients, stacked_rotation
from ..numerics.stacked import cross
from .bearing import Supported, units_of


def extreme_supported(arm: Supported, *, greatest: bool = False) -> Array:
    """As `extreme`, of an arm with held sections or contacts."""
    return _extreme(arm, -1 if greatest else 0)


def extreme(scene: Scene, forces: Vector, nodes: Nodes, *, greatest: bool = False) -> Array:
    r"""Least or greatest eigenvalue of $\Sigma^{-1/2} H \Sigma^{-1/2}$: node by node without loads,
    of the whole arm with loads or straight tendons.

    For the whole arm it is that of the symmetric part of the whole tangent, restricted to the
    changes of strain that the taut cables allow; NaN if the Lanczos method does not converge.
    Otherwise cables are ignored: a finite number of them cannot stiffen every section.
    """
    if scene.reacts:
        return _extreme(arm_of(scene, forces, nodes), -1 if greatest else 0)
    lower = free_block(tangent(nodes.xi, nodes.sections, nodes.tau(forces)), scene.free)
    root = jnp.sqrt(c.join(free_components(nodes.sections.stiffness, scene.free)))
    values = jnp.linalg.eigvalsh(
        c.join_matrix(c.symmetric(lower)) / (root[..., :, None] * root[..., None, :])
    )
    if nodes.sections.flexible is not None:
        bends = nodes.sections.flexible[..., None] > 0
        values = jnp.where(bends, values, -jnp.inf if greatest else jnp.inf)
    return jnp.max(values) if greatest else jnp.min(values)


class Arm(eqx.Module):
    """Data of the tangent of the whole arm: strain, cross-sections, thread forces and loads at the
    nodes of a grid.

    `tau`: forces of the threads along the nodes; `forces`: at their start; `units` scales changes
    of the free strains, $\\Sigma^{-1/2} W^{-1/2}$ with W the weights of the nodes; `taut`: see
    `ScaledTangent`.
    """

    xi: Vector
    sections: CrossSections
    tau: Vector
    forces: Vector
    loads: Loading
    grid: Grid
    units: Float[Array, "strains stages steps"]
    taut: tuple[Array, ...]
    free: tuple[int, ...] = eqx.field(static=True)

    def tangent(self) -> "ScaledTangent":
        """The scaled tangent as an operator."""
        lower = tangent(self.xi, self.sections, self.tau)
        return ScaledTangent(
            lower,
            self.units,
            self.grid.weight,
            _along(self.xi, self.grid, self.loads, self.forces),
            self.taut,
            self.free,
        )

    def form(self, v: Array) -> Array:
        """$v^T S v$ with S the scaled tangent, by differentiation of the residual: its derivative
        compiles faster than that of the operator."""

        def imbalance(xi: Vector) -> Vector:
            along = react(xi, self.grid, self.loads, self.forces)
            wrench = stacked.components(along.wrench)
            return residual(xi, self.sections, self.tau, wrench)

        x = spread(tuple(self.units * _projected(v, self.units, self.taut)), self.free)
        return jnp.sum(self.grid.weight * c.dot(x, jax.jvp(imbalance, (self.xi,), (x,))[1]))


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _extreme(arm: Arm | Supported, place: int) -> Array:
    return extreme_pairs(arm.tangent()).values[place]


@partial(_extreme.defjvp, symbolic_zeros=True)
def _extreme_jvp(place: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    values, vectors = extreme_pairs(primals[0].tangent())
    return values[place], change_of(lambda arm: arm.form(vectors[place]), primals, tangents)


class _PointSlope(NamedTuple):
    """Derivative (6, motion) of a wrench at a point in the world frame with respect to the motion
    of its section (see `mechanics.reaction`).

    **Fields:** `end`: 1 at its place among the starts of the steps and the tip; `before`: 1 at the
    nodes between the base and that place; `matrix`.
    """

    end: Float[Array, " steps_and_one"]
    before: Float[Array, "stages steps"]
    matrix: Float[Array, "6 motion"]


class _Along(NamedTuple):
    r"""Linearisation of the reaction with respect to the strain, in the world frame.

    **Fields:** `rotation` R, `wrench` (m, n), `axis` p' and `weight` at the nodes; `density`:
    derivative of the load density by the motion of its section; `points`; `turn`: derivative of the
    rotation from the start of each step to its nodes, and in the last row of the whole step, with
    respect to the angular strains (component and stage) at the nodes of the step; `beyond`: matrix
    that takes values at the nodes to their integrals from each node to the tip; `ends`, `pull`: of
    the chords of straight tendons, as `Slopes` and `Reaction` have them.
    """

    rotation: Float[Array, "3 3 stages steps"]
    wrench: Float[Array, "6 stages steps"]
    axis: Float[Array, "3 stages steps"]
    weight: Float[Array, "stages steps"]
    density: Float[Array, "6 motion stages steps"] | None
    points: tuple[_PointSlope, ...]
    turn: Float[Array, "strains 3 rows steps"]
    beyond: Float[Array, "nodes nodes"]
    ends: Float[Array, "6 motion steps"] | None
    pull: Pull | None


class ScaledTangent(Operator):
    r"""Symmetric part of $W^{1/2} \Sigma^{-1/2} (\partial r / \partial \xi) \Sigma^{-1/2} W^{-1/2}$
    with W the weights of the nodes, on arrays of shape (free strains, stages, steps).

    Excluded are changes of strain on rigid pieces and at nodes of zero weight, from pieces of the
    arm of zero length, and those that change the path length of a taut cable (`taut`: orthonormal,
    zero for slack ones).
    """

    lower: Matrix
    units: Float[Array, "strains stages steps"]
    weight: Float[Array, "stages steps"]
    along: _Along
    taut: tuple[Array, ...]
    free: tuple[int, ...] = eqx.field(static=True)

    @property
    def like(self) -> Array:
        return self.units

    def allowed(self, v: Array) -> Array:
        return _projected(v, self.units, self.taut)

    def times(self, v: Array) -> Array:
        back = jax.linear_transpose(self._times, self.like)
        v = self.allowed(v)
        return self.allowed(0.5 * (self._times(v) + back(v)[0]))

    def _times(self, v: Array) -> Array:
        x = spread(tuple(self.units * v), self.free)
        moved = stacked.components(_reaction_change(stacked.stack(x), self.along))
        r = c.subtract(c.matvec(c.symmetric(self.lower), x), moved)
        return self.weight * self.units * jnp.stack(free_components(r, self.free))


def _projected(v: Array, units: Array, taut: tuple[Array, ...]) -> Array:
    v = jnp.where(units > 0, v, 0.0)
    for unit in taut:
        v = v - jnp.sum(unit * v) * unit
    return v


def arm_of(scene: Scene, forces: Vector, nodes: Nodes) -> Arm:
    """Data of the tangent at a solution, or at any other strain."""
    sections, grid, free = nodes.sections, nodes.grid, scene.free
    loads = loading(scene, grid)
    assert loads is not None
    xi = tuple(jnp.broadcast_to(x, grid.X.shape) for x in nodes.xi)
    units = units_of(sections, grid, free)
    along_sections = nodes.tau(forces)
    if loads.discs is not None:
        along_sections = loads.discs.elsewhere(along_sections)
    taut: list[Array] = []
    for place in scene.length_driven:
        wrench = _unit_wrench(scene, xi, nodes, place)
        unit = grid.weight * units * jnp.stack(free_components(wrench, free))
        for other in taut:
            unit = unit - jnp.sum(other * unit) * other
        size = jnp.sum(unit**2)
        holds = (forces[place] < 0) & (size > 0)
        taut.append(jnp.where(holds, unit / jnp.sqrt(jnp.where(holds, size, 1.0)), 0.0))
    return Arm(xi, sections, along_sections, forces, loads, grid, units, tuple(taut), free)


def _unit_wrench(scene: Scene, xi: Vector, nodes: Nodes, place: int) -> Vector:
    """Derivative of a thread's length by the strain at each node."""
    if scene.actuators[place].straight:
        rotation = rotations(stacked.stack(xi[:3]), nodes.grid.h, scene.rod.frame)[1]
        return chords_of(scene, xi, nodes.grid).unit(place, rotation)
    path = nodes.sections.paths[place]
    wrench = thread_wrench(thread_direction(xi, path)[0], path)
    return c.times(nodes.sections.reach[place], wrench)


def _along(xi: Vector, grid: Grid, loads: Loading, forces: Vector) -> _Along:
    """The reaction and the derivatives that its change needs."""
    steps, size = grid.h.size, grid.X.size
    now = react(xi, grid, loads, forces)
    unit = jnp.eye(size, dtype=grid.h.dtype).reshape(1, *grid.X.shape, size)
    (integral,) = beyond(unit, grid._replace(h=grid.h[:, None]))
    slopes = slopes_of(now, loads)
    points = tuple(
        _PointSlope((jnp.arange(steps + 1) == p.step).astype(grid.h.dtype), p.before, p.matrix)
        for p in slopes.points
    )
    return _Along(
        now.rotation,
        now.world,
        now.axis,
        grid.weight,
        slopes.density,
        points,
        _turns(stacked.stack(xi[:3]), grid, now),
        integral.reshape(size, size),
        slopes.ends,
        now.pull,
    )


def _turns(k: Array, grid: Grid, now: Reaction) -> Array:
    """Derivatives of the rotation from the start of each step to its nodes and to its end with
    respect to each angular strain in the step, in the world frame."""
    stages, dtype = grid.X.shape[0], grid.h.dtype
    parts = jnp.append(jnp.asarray(gauss_legendre(stages)[0], dtype), 1.0)[:, None]

    def vectors(k: Array) -> Array:
        return partial_rotation(k[:, :, None], grid.h, parts)

    omega = vectors(k)
    ends = stacked.matmul(now.starts, stacked_rotation(omega[:, -1]))
    rotation = jnp.concatenate([now.rotation, ends[:, :, None]], axis=2)

    def by_strain(unit: Array) -> Array:
        change = jax.jvp(vectors, (k,), (jnp.broadcast_to(unit[..., None], k.shape),))[1]
        return stacked.matvec(rotation, _turn(omega, change))

    return jax.vmap(by_strain)(jnp.eye(3 * stages, dtype=dtype).reshape(-1, 3, stages))


def _turn(omega: Array, change: Array) -> Array:
    r"""Rotation $\epsilon$ in the body frame due to a change of a rotation vector,
    $\tilde\epsilon = R^T \delta R$ for $R = \exp \tilde\omega$."""
    _, b, c3 = exp_coefficients(stacked.dot(omega, omega))
    across = cross(omega, change)
    return change + c3 * cross(omega, across) - b * across


def _reaction_change(x: Array, along: _Along) -> Array:
    r"""First-order change of the reaction $\Lambda$ due to a change (6, stages, steps) of the
    strain."""
    steps = x.shape[2]
    kappa = x[:3].reshape(-1, 1, 1, steps)
    turns = jnp.sum(along.turn * kappa, axis=0)
    before = jnp.asarray(np.triu(np.ones((steps, steps + 1)), 1), x.dtype)
    starts = turns[:, -1] @ before
    theta = starts[:, None, :-1] + turns[:, :-1]

    def integral(density: Array) -> Array:
        return (density.reshape(len(density), -1) @ along.beyond.T).reshape(density.shape)

    (m, n), p = (along.wrench[:3], along.wrench[3:]), along.axis
    dm, dn = cross(m, theta), cross(n, theta)
    moving = cross(theta, p) + stacked.matvec(along.rotation, x[3:])
    moved = jnp.zeros_like(along.wrench)  # the change of the loads beyond, without levers
    for point in along.points:
        turn = jnp.sum(point.end * starts, axis=1)
        shift = jnp.sum(along.weight * point.before * moving, axis=(1, 2))
        motion = jnp.concatenate([turn, shift])[: point.matrix.shape[1]]
        moved = moved + point.before * (point.matrix @ motion)[:, None, None]
    if along.density is not None:
        motion = theta
        if along.density.shape[1] == 6:
            whole = jnp.sum(along.weight * moving, axis=(1, 2), keepdims=True)
            motion = jnp.concatenate([theta, whole - integral(moving)])
        moved = moved + integral(stacked.matvec(along.density, motion))
    density = cross(moving, n)
    if along.density is not None or along.points:
        density = density + cross(p, moved[3:])
    change = moved + jnp.concatenate([dm + integral(density), dn])
    if along.pull is not None:
        shift = jnp.sum(along.weight * moving, axis=1) @ before
        change = change + _chord_change(starts, shift, along.pull, along.ends)
    return stacked.turned(stacked.transpose(along.rotation), change)


def _chord_change(theta: Array, shift: Array, pull: Pull, ends: Array | None) -> Array:
    """Change of the wrench of straight tendons on the nodes, in the world frame, less that by the
    displacement of the nodes, from the motions of the starts of the steps and the tip."""
    springs = jnp.sum(pull.across(pull.turned(theta, shift), cut=False), axis=1)
    if ends is None:
        return springs
    at_ends = jnp.sum(ends[:, :3] * theta[:, 1:], axis=1)
    later = jnp.cumsum(at_ends[:, ::-1], axis=1)[:, ::-1]
    return springs + later[:, None]
