r"""The balance of all cross-sections of an arm, coupled by loads, prescribed thread lengths or
friction.

The unknowns are the strain at the nodes and those of the couplings (see `coupling`). The residual
is eq. 21 at each node, with the reaction to the loads and the thread forces that the couplings
give, and the rows of the couplings.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..arm.scene import Scene, shared
from ..numerics.component import Forces, Vector, free_components
from ..numerics.quadrature import Grid
from ..numerics.stacked import components, stack
from .applied_load import Loading
from .balance import residual
from .coupling import (
    ArmProblem,
    ArmState,
    Carried,
    Coupling,
    Shares,
    ThreadRule,
    forces_at,
    loads_of,
    loads_with,
)
from .reaction import react
from .sizes import pull_of, shape_of, shape_size


class ArmUnknown(NamedTuple):
    """Strain at the nodes (six component arrays), and the unknowns of each coupling."""

    xi: Vector
    coupled: tuple[PyTree, ...]


class ArmImbalance(NamedTuple):
    """Residual: wrench at the nodes for the free strains, and the rows of each coupling."""

    wrench: Vector
    coupled: tuple[PyTree, ...]


class ArmSolution(NamedTuple):
    """A solution: strain at the nodes, the couplings of the arm and their unknowns."""

    xi: Vector
    coupled: tuple[PyTree, ...]
    couplings: tuple[Coupling, ...]

    def loading(self, loads: Loading | None) -> Loading | None:
        """The loads, and the wrenches that the couplings exert on the arm."""
        return loads_with(self.couplings, self.coupled, loads)

    def shares_at(self, scene: Scene, grid: Grid, X: Array, forces: Forces) -> Shares:
        """Share of each thread's force at abscissas X of any shape; `grid` is that of the nodes,
        `forces` are those at the start."""
        shares = scene.thread_reach(X)
        for coupling, x in zip(self.couplings, self.coupled, strict=True):
            if isinstance(coupling, ThreadRule):
                shares = coupling.shares_at(x, self.xi, scene, grid, X, forces, shares)
        return shares


def state_of(xi: Vector, coupled: tuple[PyTree, ...], problem: ArmProblem) -> ArmState:
    """Quantities computed from the unknowns."""
    grid, couplings, loads = problem.grid, problem.couplings, problem.loads
    forces = forces_at(couplings, coupled, problem.forces)
    carried = _carried(xi, coupled, problem, forces)
    tau = problem.along_sections(shared(forces, carried.shares))
    along, by_couplings = None, loads_of(couplings, coupled)
    if loads is not None:
        loads = loads.having(tuple(load for own in by_couplings for load in own))
        along = react(xi, grid, loads, loads.along_chords(forces, carried.shares))
    at = ArmState(xi, carried, tau, loads, along, ())
    first, notes = len(at.exerted) - sum(map(len, by_couplings)), []
    for coupling, x, own in zip(couplings, coupled, by_couplings, strict=True):
        exerted = at.exerted[first : first + len(own)]
        notes.append(coupling.note(x, at, exerted, problem))
        first += len(own)
    return at._replace(notes=tuple(notes))


def _carried(
    xi: Vector, coupled: tuple[PyTree, ...], problem: ArmProblem, forces: Forces
) -> Carried:
    carried = Carried(problem.sections.reach, problem.sections.reach)
    for coupling, x in zip(problem.couplings, coupled, strict=True):
        if isinstance(coupling, ThreadRule):
            carried = coupling.carried(x, xi, problem, forces, carried)
    return carried


def carried_from_start(unknown: ArmUnknown, problem: ArmProblem) -> tuple[Forces, Shares]:
    """Force of each thread at its start, and its share at the nodes."""
    forces = forces_at(problem.couplings, unknown.coupled, problem.forces)
    return forces, _carried(*unknown, problem, forces).shares


def imbalance_of(
    unknown: ArmUnknown, at: ArmState, problem: ArmProblem, free: tuple[int, ...]
) -> ArmImbalance:
    """The residual."""
    wrench = None if at.along is None else components(at.along.wrench)
    r = residual(unknown.xi, problem.sections, at.tau, wrench)
    rows = tuple(
        coupling.residual(x, at, note, problem, free)
        for coupling, x, note in zip(problem.couplings, unknown.coupled, at.notes, strict=True)
    )
    return ArmImbalance(free_components(r, free), rows)


def rounding_of(problem: ArmProblem) -> Array:
    """Rounding error of the `shape_size` of a balanced residual, one entry per arm of a batch.

    A multiple of the machine epsilon times the sizes of the terms in balance: threads, loads and
    curvature at rest.
    """
    sections, loads, length = problem.sections, problem.loads, problem.length

    def largest(x: Array) -> Array:
        return jnp.max(x, axis=(0, 1))

    straight = tuple(jnp.zeros_like(x) for x in sections.rest[3:])
    total = 1.0 + largest(shape_size((*sections.rest[:3], *straight), length))
    if problem.forces:
        pull = pull_of(sections, sections.every_path, length)
        pull = pull.reshape(len(problem.forces), -1, *length.shape)
        total = total + jnp.sum(jnp.abs(stack(problem.forces)) * jnp.max(pull, axis=1), axis=0)
    if loads is not None:
        for load in loads.loads:
            for part in load.sizes(length, loads.base, loads.motion):
                size = jnp.abs(part)
                levers = length * jnp.sum(size[3:], axis=0)
                wrench = (*components(size[:3] + levers), *components(size[3:]))
                total = total + largest(shape_of(wrench, sections, length))
    return 64 * jnp.finfo(total.dtype).eps * total
