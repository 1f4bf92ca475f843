r"""The balance of all cross-sections of an arm, coupled by loads, prescribed thread lengths or
friction.

The unknowns are the strain at the nodes, the tension T of each tendon with prescribed length, and
the turning rate $\varphi'$ of the path of each tendon with friction. The residual is eq. 21 at each
node, with the reaction and the tensions of the unknowns; for each tendon with prescribed length

$$\min(T, k_0 s) = 0, \quad s = (l^* + \delta)(1 + T / k) - l,$$

the complementarity of tension and slack, where the stiffness $k_0$ [N/m] only scales the two; and
for each tendon with friction the difference between the unknown rate and that of its path.
"""

from collections.abc import Iterable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import CrossSections, Scene, shared
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import components
from .balance import free_components, residual, thread_direction, thread_wrench, without_force
from .cable import Cable, cable_of, path_length
from .friction import (
    Friction,
    balanced_strain_rate,
    breaks_of,
    decay_at,
    kinks_of,
    reaction_rate,
    share_left,
    turning_rate,
)
from .reaction import Loading, Reaction, loading, react


class ArmProblem(NamedTuple):
    """Data of the coupled balance: `forces` of the threads at their start (ignored for cables), and
    what couples the sections."""

    grid: Grid
    sections: CrossSections
    forces: Forces
    loads: Loading | None
    cables: tuple[Cable, ...]
    friction: Friction | None

    def with_share(self, share: Array) -> "ArmProblem":
        """The problem with a fraction of its loads."""
        return self if self.loads is None else self._replace(loads=self.loads.scaled(share))

    def at_rest(self) -> "ArmProblem":
        """The problem without loads and forces and with slack cables, so that its solution is the
        rest strain."""
        cables = tuple(cable._replace(length=2 * cable.length) for cable in self.cables)
        loads = None if self.loads is None else self.loads.absent()
        return self._replace(forces=without_force(self.forces), cables=cables, loads=loads)


class Kind(NamedTuple):
    """Static structure of a problem: indices of the free strains, of the threads that are cables,
    and of those with friction."""

    free: tuple[int, ...]
    cables: tuple[int, ...]
    frictional: tuple[int, ...]


class ArmUnknown(NamedTuple):
    r"""Strain at the nodes (six component arrays), tension [N] of each cable, $\varphi'$ [rad/m] at
    the nodes of each tendon with friction."""

    xi: Vector
    tension: Forces
    turning: Vector


class ArmImbalance(NamedTuple):
    """Residual: wrench at the nodes for the free strains, force of each cable [N], turning rate of
    each tendon with friction."""

    wrench: Vector
    cable: Forces
    turning: Vector


class ArmState(NamedTuple):
    """Quantities computed from the unknowns: share of each thread's force at the nodes (None for
    1), its force there, the reaction, the slack of each cable [m]."""

    carried: tuple[Array | None, ...]
    tau: Forces
    along: Reaction | None
    slack: Vector


def problem_of(scene: Scene, inputs: Array, grid: Grid) -> tuple[ArmProblem, Kind]:
    """The coupled balance of a scene on a grid."""
    sections, forces = scene.sections(grid.X), scene.forces(inputs)
    cables = [
        cable_of(scene, inputs[place], place, sections, grid) for place in scene.length_driven
    ]
    friction = None
    if scene.frictional:
        _, rate = jax.jvp(scene.sections, (grid.X,), (jnp.ones_like(grid.X),))
        friction = Friction(
            tuple(_signed_friction(scene, p) for p in scene.frictional),
            rate,
            breaks_of(scene.breakpoints, grid),
        )
    problem = ArmProblem(grid, sections, forces, loading(scene, grid), tuple(cables), friction)
    return problem, Kind(scene.free, scene.length_driven, scene.frictional)


def with_tensions(forces: Forces, tensions: Iterable[Array], kind: Kind) -> Forces:
    """Force of every thread at its start: as given, or minus the tension of a cable."""
    found = list(forces)
    for place, tension in zip(kind.cables, tensions, strict=True):
        found[place] = -tension
    return tuple(found)


def state_of(unknown: ArmUnknown, problem: ArmProblem, kind: Kind) -> ArmState:
    """Quantities computed from the unknowns."""
    grid, sections, xi = problem.grid, problem.sections, unknown.xi
    carried = _shares(unknown, problem, kind)
    tau = shared(with_tensions(problem.forces, unknown.tension, kind), carried)
    along = None if problem.loads is None else react(xi, grid, problem.loads)
    slack = tuple(
        cable.slack(tension, path_length(xi, sections, place, grid), carried[place], grid)
        for place, cable, tension in zip(kind.cables, problem.cables, unknown.tension, strict=True)
    )
    return ArmState(carried, tau, along, slack)


def carried_forces(unknown: ArmUnknown, problem: ArmProblem, kind: Kind) -> Forces:
    """Force of each thread at the nodes."""
    forces = with_tensions(problem.forces, unknown.tension, kind)
    return shared(forces, _shares(unknown, problem, kind))


def _shares(unknown: ArmUnknown, problem: ArmProblem, kind: Kind) -> tuple[Array | None, ...]:
    """Share of each thread's force at the nodes."""
    sections, carried = problem.sections, list(problem.sections.reach)
    if problem.friction is not None:
        for place, turning, mu in zip(
            kind.frictional, unknown.turning, problem.friction.coefficients, strict=True
        ):
            kinks = kinks_of(unknown.xi, sections, problem.friction.breaks, place, problem.grid)
            carried[place] = share_left(carried[place], turning, kinks, mu, problem.grid)
    return tuple(carried)


def shares_at(
    scene: Scene, xi: Vector, turning: Vector, grid: Grid, X: Array
) -> tuple[Array | None, ...]:
    """Share of each thread's force at abscissas X of any shape, from strain and turning rates at
    the nodes of a grid."""
    shares = list(scene.sections(X).reach)
    if not scene.frictional:
        return tuple(shares)
    sections, breaks = scene.sections(grid.X), breaks_of(scene.breakpoints, grid)
    for place, rate in zip(scene.frictional, turning, strict=True):
        reach, kinks = sections.reach[place], kinks_of(xi, sections, breaks, place, grid)
        rate = c.times(reach, rate)
        left = decay_at(rate, kinks, _signed_friction(scene, place), grid, X)
        shares[place] = c.times(shares[place], left)
    return tuple(shares)


def _signed_friction(scene: Scene, place: int) -> Array:
    friction = scene.actuators[place].signed_friction
    assert friction is not None  # see Scene.frictional
    return friction


def imbalance_of(
    unknown: ArmUnknown, at: ArmState, problem: ArmProblem, kind: Kind
) -> ArmImbalance:
    """The residual."""
    wrench = None if at.along is None else components(at.along.wrench)
    r = free_components(residual(unknown.xi, problem.sections, at.tau, wrench), kind.free)
    cables = tuple(
        cable.complementarity(tension, slack)
        for cable, tension, slack in zip(problem.cables, unknown.tension, at.slack, strict=True)
    )
    if problem.friction is None:
        return ArmImbalance(r, cables, ())
    rates = _turning_rates(unknown, at, problem, problem.friction, kind)
    return ArmImbalance(r, cables, c.subtract(unknown.turning, rates))


def _turning_rates(
    unknown: ArmUnknown, at: ArmState, problem: ArmProblem, friction: Friction, kind: Kind
) -> Vector:
    xi, sections, loads = unknown.xi, problem.sections, problem.loads
    slopes = [jnp.zeros_like(xi[0])] * len(at.tau)
    for place, turning, mu in zip(
        kind.frictional, unknown.turning, friction.coefficients, strict=True
    ):
        slopes[place] = -mu * turning * at.tau[place]
    change = None
    if at.along is not None and loads is not None:
        along = at.along
        change = reaction_rate(xi, components(along.wrench), components(along.body_density))
    tau = tuple(jnp.broadcast_to(force, xi[0].shape) for force in at.tau)
    xi_rate = balanced_strain_rate(
        xi, tau, tuple(slopes), change, sections, friction.sections_rate, kind.free
    )
    return tuple(
        turning_rate(xi, xi_rate, sections, friction.sections_rate, place)
        for place in kind.frictional
    )


def shape_size(strain: Vector, length: Array) -> Array:
    r"""Size of a change of strain by its effect on the shape, $\sqrt{L^2 |\kappa|^2 +
    |\upsilon|^2}$: rotation over the length of the arm, and strain.

    An energy norm would underrate the bending of a slender arm: at L/r = 1000 a strain of 1e-6 in
    its fibres rotates the tip by 1e-3.
    """
    return jnp.sqrt(length**2 * c.dot(strain[:3], strain[:3]) + c.dot(strain[3:], strain[3:]))


def shape_of(wrench: Vector, stiffness: Vector, length: Array) -> Array:
    """`shape_size` of the strain that a wrench causes at rest."""
    return shape_size(tuple(f / s for f, s in zip(wrench, stiffness, strict=True)), length)


def pull_of(sections: CrossSections, place: int, length: Array) -> Array:
    """`shape_size` of the strain per unit of a thread's force at rest [1/N]."""
    path = sections.paths[place]
    return shape_of(
        thread_wrench(thread_direction(sections.rest, path)[0], path), sections.stiffness, length
    )


def rounding_of(problem: ArmProblem) -> Array:
    """Rounding error of the `shape_size` of a balanced residual, one entry per arm of a batch.

    A multiple of the machine epsilon times the sizes of the terms in balance: threads, loads and
    curvature at rest.
    """
    sections, loads, length = problem.sections, problem.loads, jnp.sum(problem.grid.h, axis=0)

    def largest(x: Array) -> Array:
        return jnp.max(x, axis=(0, 1))

    straight = tuple(jnp.zeros_like(x) for x in sections.rest[3:])
    total = 1.0 + largest(shape_size((*sections.rest[:3], *straight), length))
    for place, force in enumerate(problem.forces):
        total = total + jnp.abs(force) * largest(pull_of(sections, place, length))
    if loads is not None:
        densities = (loads.dead_density, loads.follower_density)
        wrenches = [length * density for density in densities if density is not None]
        wrenches += [part for part in (loads.dead,) if part is not None]
        wrenches += [point.wrench[:, None, None] for point in loads.follower_points]
        for term in loads.by_pose:
            size = term.size(loads.base, loads.motion)
            wrenches.append(length * size if term.step is None else size[:, None, None])
        for part in wrenches:
            size = jnp.abs(part)
            levers = length * jnp.sum(size[3:], axis=0)
            wrench = (*components(size[:3] + levers), *components(size[3:]))
            total = total + largest(shape_of(wrench, sections.stiffness, length))
    return 64 * jnp.finfo(total.dtype).eps * total
