r"""What ties the cross-sections of an arm together beside its loads: the interfaces that the
solvers know, and the data of the coupled balance.

A coupling has unknowns x of its own, with as many residual rows. `Constraint` keeps the shape of
the arm from something by unknown forces; `ThreadRule` says what force a thread has, and where. Both
give what Newton's method needs: a start, the scales of unknowns and rows, and their part of the
tangent system,

$$\begin{pmatrix} A & P \\ F R & D \end{pmatrix}
\begin{pmatrix} \delta\xi \\ \delta x \end{pmatrix} = \begin{pmatrix} r \\ s \end{pmatrix},$$

a border of the system A of the strains. A coupling without a border has $P = 0$ and $D = 1$ there;
one that follows from the strain and its derivative is changed by the step of the strain too.

All arrays of one arm have the arms of a batch in further axes at their end.
"""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arm.scene import CrossSections, Scene
from ..chain import Border, Coupled
from ..chain.border import listed
from ..numerics.component import Forces, Vector
from ..numerics.damped_newton import HARDENING_STAGES, SOFT_STAGES
from ..numerics.quadrature import Grid
from .applied_load import AppliedLoad, Exerted, Loading
from .balance import without_force
from .reaction import Reaction

_BOW_TURN = 2.4
"""Angle [rad] by which the plane of bending of `ArmProblem.bowed` turns along the arm."""

SOFTENED = (SOFT_STAGES - 0.5) / HARDENING_STAGES
"""Hardness from which constraints have no energy."""

Shares = tuple[Array | None, ...]
"""Share of each thread's force at the nodes; None for 1."""


class Carried(NamedTuple):
    """Share of each thread's force at the nodes, and the change of the force there per change at
    its start: the same where the shares do not depend on it."""

    shares: Shares
    gains: Shares


class ArmProblem(NamedTuple):
    """Data of the coupled balance: `forces` of the threads at their start as the inputs give them,
    and what couples the sections."""

    grid: Grid
    sections: CrossSections
    forces: Forces
    loads: Loading | None
    couplings: tuple["Coupling", ...]

    def with_share(self, share: Array) -> "ArmProblem":
        """The problem with a fraction of what comes `by_increments`. Constraints are soft up to the
        fraction 1; above it, they harden up to 2, where they are exact."""
        hardness, share = jnp.maximum(share - 1.0, 0.0), jnp.minimum(share, 1.0)
        couplings = tuple(one.scaled(share).softened(hardness) for one in self.couplings)
        loads = None if self.loads is None else self.loads.scaled(share)
        return self._replace(loads=loads, couplings=couplings)

    def loosened(self, loose: Array | None) -> "ArmProblem":
        """The problem that is solved where the given one is not, where `loose` is true."""
        if loose is None:
            return self
        return self._constraints_by(lambda one: one.loosened(loose))

    def was_loosened(self, loose: Array | None) -> Array | None:
        """Whether constraints were loosened, by a solve that ended `loose` or by one that it began
        from; None without constraints."""
        if loose is None or not self.constrained:
            return None
        for one in self.constraints:
            loose = loose if one.looseness is None else loose | (one.looseness > 0)
        return loose

    def as_loose_as(self, others: tuple["Coupling", ...]) -> "ArmProblem":
        """The problem with its constraints loosened as those of one that it begins from."""
        problem = self
        for other in others:
            if isinstance(other, Constraint) and other.looseness is not None:
                problem = problem.loosened(other.looseness > 0)
        return problem

    def bowed(self, angle: Array) -> "ArmProblem":
        """The problem of an arm that is twisted by an angle [rad] at rest, and bent by as much in a
        plane that turns along it. What is in balance by symmetry alone is not with such a rest
        strain."""
        rest, steps = self.sections.rest, len(self.grid.h)
        turn = np.linspace(0.0, _BOW_TURN, steps).reshape(steps, *(1,) * angle.ndim)
        bow = angle / self.length
        ways = (np.ones_like(turn), np.cos(turn), np.sin(turn))
        bowed = (x + bow * way.astype(bow.dtype) for x, way in zip(rest[:3], ways, strict=True))
        return self._replace(sections=self.sections._replace(rest=(*bowed, *rest[3:])))

    def at_rest(self) -> "ArmProblem":
        """The problem without loads and forces and with relaxed couplings, so that its solution is
        the rest strain."""
        return self._replace(
            forces=without_force(self.forces),
            loads=None if self.loads is None else self.loads.absent(),
            couplings=tuple(coupling.relaxed() for coupling in self.couplings),
        )

    def prepared(self) -> "ArmProblem":
        """The problem for products with one tangent, see `Coupling.prepared`."""
        return self._replace(couplings=tuple(one.prepared() for one in self.couplings))

    def along_sections(self, tau: Forces) -> Forces:
        """Forces at the nodes of the threads that run along the sections, zero for the others."""
        return tau if self.loads is None else self.loads.along_sections(tau)

    @property
    def sections_of_threads(self) -> CrossSections:
        """The sections, where threads that do not run along these reach no node."""
        elsewhere = () if self.loads is None else self.loads.threads
        if not elsewhere:
            return self.sections
        none = jnp.zeros_like(self.sections.rest[0])
        reach = enumerate(self.sections.reach)
        return self.sections._replace(reach=tuple(none if i in elsewhere else x for i, x in reach))

    @property
    def constraints(self) -> tuple["Constraint", ...]:
        """The couplings that are constraints."""
        return tuple(one for one in self.couplings if isinstance(one, Constraint))

    @property
    def constrained(self) -> bool:
        """Whether there are constraints."""
        return bool(self.constraints)

    @property
    def by_increments(self) -> bool:
        """Whether loads or couplings can come by increments."""
        return self.loads is not None or any(one.by_increments for one in self.couplings)

    @property
    def begins_soft(self) -> bool:
        """Whether a solve from rest begins with springs in place of a constraint."""
        return any(one.begins_soft for one in self.constraints)

    @property
    def follows_rate(self) -> bool:
        """Whether a coupling follows the strain and its derivative along the arm: the tangent lacks
        what that does to the forces, so that Newton's method converges linearly."""
        return any(coupling.follows_rate for coupling in self.couplings)

    @property
    def dissipates(self) -> Array | None:
        """Whether the tangent of a constraint is not symmetric; None if never."""
        each = [x for one in self.constraints if (x := one.dissipates()) is not None]
        return sum(each[1:], each[0]) > 0 if each else None

    @property
    def length(self) -> Array:
        """Length of the arm [m]."""
        return jnp.sum(self.grid.h, axis=0)

    def _constraints_by(self, change: Any) -> "ArmProblem":
        """The problem with a change of every constraint."""
        return self._replace(
            couplings=tuple(
                change(one) if isinstance(one, Constraint) else one for one in self.couplings
            )
        )


class ArmState(NamedTuple):
    """Quantities computed from the unknowns: the strain, what the threads carry, their forces along
    the nodes, the loads with those of the constraints, the reaction (both None without loads and
    straight tendons), and what each coupling noted."""

    xi: Vector
    carried: Carried
    tau: Forces
    loads: Loading | None
    along: Reaction | None
    notes: tuple[Any, ...]

    @property
    def exerted(self) -> tuple[Exerted, ...]:
        """What all loads exert."""
        return () if self.along is None else self.along.exerted


class Scales(NamedTuple):
    """Stiffnesses k that make rows to forces, and lengths l, so that unknowns and rows over $k l$
    are numbers that compare to angles; in the form of the unknowns, or broadcast to it."""

    stiffness: PyTree
    length: PyTree

    @property
    def units(self) -> tuple[PyTree, PyTree]:
        """Factors that scale rows and changes to square roots of energies: see `tangent_solve`."""
        root = jax.tree.map(jnp.sqrt, self.stiffness)
        return jax.tree.map(lambda x: 1 / x, root), root

    @property
    def radians(self) -> PyTree:
        """Factors that make unknowns comparable to angles."""
        return jax.tree.map(lambda k, length: 1 / (k * length), self.stiffness, self.length)


class Coupling(eqx.Module):
    """What ties cross-sections together. Its unknowns x are one array of shape (m, ...) or a tuple
    of arrays, and its rows have the same shapes."""

    follows_rate: ClassVar[bool] = False
    """Whether the strain and its derivative along the arm give its unknowns."""
    by_increments: ClassVar[bool] = False
    """Whether it can come by increments on the way to a solution."""

    @abstractmethod
    def guess(self, forces: Forces, grid: Grid) -> PyTree:
        """Unknowns that go with the forces of all threads at their start, to begin with."""

    @abstractmethod
    def residual(
        self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem, free: tuple[int, ...]
    ) -> PyTree:
        """Its rows, zero in equilibrium."""

    @abstractmethod
    def scales(self, problem: ArmProblem) -> Scales:
        """Scales of its unknowns and rows."""

    @abstractmethod
    def relaxed(self) -> "Coupling":
        """The coupling with the rest strain as its solution, and with finite derivatives there."""

    def note(self, x: PyTree, at: ArmState, own: tuple[Exerted, ...], problem: ArmProblem) -> Any:
        """What both its residual and its part of the tangent need, from what its loads exert;
        nothing by default."""
        return None

    def border(self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem) -> Border | None:
        """Its part of the tangent system; none by default, for the tangent 1."""
        return None

    def sizes(self, x: PyTree, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Dimensionless sizes of a change of its unknowns, by the shapes that they cause; by
        default from its scales."""
        factors = self.scales(problem).radians
        return jax.tree.leaves(jax.tree.map(jnp.multiply, x, factors))

    def row_sizes(self, rows: PyTree, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Dimensionless sizes of its rows; by default from its scales."""
        return Coupling.sizes(self, rows, at, problem)

    def from_rate(self, xi: Vector, rate: Vector, sections: CrossSections) -> PyTree:
        r"""Its unknowns, where it `follows_rate`, from the strain and the derivative $(\xi -
        \xi^*)'$ along the arm, which models with a basis know."""
        raise NotImplementedError

    def scaled(self, share: Array) -> "Coupling":
        """A fraction of it, where it comes `by_increments`; the same by default."""
        return self

    def softened(self, hardness: Array) -> "Coupling":
        """The coupling with springs in its place or beside it, from `hardness` 0 up to 1, where it
        is exact; the same by default."""
        return self

    def prepared(self) -> "Coupling":
        """The coupling with rows whose derivative takes longer to find, and less to apply many
        times; the same by default."""
        return self

    def after(self, x: PyTree, at: ArmState, problem: ArmProblem) -> "Coupling":
        """The coupling with the memory of a solution before it; the same by default."""
        return self

    def remembering(self, other: "Coupling", X: Array, grid: Grid) -> "Coupling":
        """The coupling with the memory of another one, at the nodes X; the same by default."""
        return self

    def like(self, other: "Coupling") -> bool:
        """Whether the unknowns of another coupling can start its own."""
        return type(self) is type(other)

    def moved(self, x: PyTree, X: Array, grid: Grid) -> PyTree:
        """Its unknowns on another grid than that with the nodes X; unchanged by default."""
        return x


class ThreadRule(Coupling):
    """A rule for the force of threads: at their start, or along them."""

    def forces(self, x: PyTree, forces: Forces) -> Forces:
        """Force of every thread at its start; unchanged by default."""
        return forces

    def carried(
        self, x: PyTree, xi: Vector, problem: ArmProblem, forces: Forces, carried: Carried
    ) -> Carried:
        """What the threads carry at the nodes, of their forces at the start; unchanged by
        default."""
        return carried

    def shares_at(
        self,
        x: PyTree,
        xi: Vector,
        scene: Scene,
        grid: Grid,
        X: Array,
        forces: Forces,
        shares: Shares,
    ) -> Shares:
        """Share of each thread's force at abscissas X of any shape, from the strain at the nodes of
        a grid; unchanged by default."""
        return shares


class Constraint(Coupling):
    """A constraint on the shape of the arm. Its unknowns are forces. On the way to a solution
    springs stand in its place, whose energy shows whether a step is an advance."""

    begins_soft: ClassVar[bool] = False
    """Whether a solve from rest begins with springs: the exact constraint seldom leads from there
    to a solution."""

    @abstractmethod
    def exerts(self, x: PyTree) -> tuple[AppliedLoad, ...]:
        """The loads by its unknowns."""

    @abstractmethod
    def prevents(
        self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem
    ) -> tuple[Vector, Array]:
        """Wrenches at the nodes whose work is the change of what it prevents, six components
        (rows, stages, steps, ...), and how much that gives way (rows, ...), below 1 where it holds
        the arm."""

    @property
    def looseness(self) -> Array | None:
        """1 where it has a rougher discretization; None if it has none."""
        return None

    def loosened(self, loose: Array) -> "Constraint":
        """The constraint with a rougher discretization where `loose` is true, for what is not
        solved without; the same by default."""
        return self

    def start(self, xi: Vector, problem: ArmProblem) -> Vector:
        """Strain from which Newton's method starts; unchanged by default."""
        return xi

    def dissipates(self) -> Array | None:
        """Whether it follows a law of friction, so that its tangent is not symmetric; None if
        never, by default."""
        return None

    def clear(self, at: ArmState, note: Any, problem: ArmProblem) -> Array | bool:
        """Whether the arm satisfies it by a wide margin, so that it has no effect; never by
        default."""
        return False

    def springs(
        self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem, free: tuple[int, ...]
    ) -> "Springs | None":
        """Its part of the tangent system in place of a border; none by default."""
        return None


@runtime_checkable
class Springs(Protocol):
    """A constraint whose unknowns are forces at places of the arm, in the tangent system: springs
    in the elimination, in place of a border."""

    def symmetric(self) -> "Springs":
        """The springs with what depends on other unknowns held."""
        ...

    def added_to(self, coupled: Coupled) -> Coupled:
        """How the sections act on each other, with the springs in their cells."""
        ...

    def driven(self, right: Vector, rows: PyTree) -> tuple[Vector, Array]:
        """A right side for the strains, with what the rows and it cause beside, and the changes (6,
        stages, steps, ...) of the wrenches in the cells by these alone."""
        ...

    def followed(self, strain: Vector, rows: PyTree, motions: Array) -> tuple[Vector, PyTree]:
        """The change of strain, with what the motions in the cells (6, stages, steps, ...) cause
        beside, and the changes of the unknowns."""
        ...


def forces_at(couplings: tuple[Coupling, ...], unknowns: tuple, forces: Forces) -> Forces:
    """Force of every thread at its start: as the inputs give it, or as a rule does."""
    for coupling, x in zip(couplings, unknowns, strict=True):
        if isinstance(coupling, ThreadRule):
            forces = coupling.forces(x, forces)
    return forces


def loads_of(couplings: tuple[Coupling, ...], unknowns: tuple) -> list[tuple[AppliedLoad, ...]]:
    """The loads by the unknowns of each coupling."""
    return [
        coupling.exerts(x) if isinstance(coupling, Constraint) else ()
        for coupling, x in zip(couplings, unknowns, strict=True)
    ]


def loads_with(
    couplings: tuple[Coupling, ...], unknowns: tuple, loads: Loading | None
) -> Loading | None:
    """The loads, and those by the unknowns of the couplings."""
    if loads is None:
        return None
    return loads.having(tuple(one for own in loads_of(couplings, unknowns) for one in own))


def clear_of(at: ArmState, problem: ArmProblem) -> Array | None:
    """Whether the arm satisfies all its constraints by a wide margin; None if it has none."""
    each = [
        coupling.clear(at, note, problem)
        for coupling, note in zip(problem.couplings, at.notes, strict=True)
        if isinstance(coupling, Constraint)
    ]
    return jnp.all(jnp.stack(jnp.broadcast_arrays(*each)), axis=0) if each else None


def borders_of(
    problem: ArmProblem, unknowns: tuple, at: ArmState
) -> tuple[dict[int, Border], Border | None]:
    """The borders by the places of their couplings, and all as one; None if there is none."""
    each = [
        coupling.border(x, at, note, problem)
        for coupling, x, note in zip(problem.couplings, unknowns, at.notes, strict=True)
    ]
    found = {i: border for i, border in enumerate(each) if border is not None}
    if not found:
        return found, None
    return found, jax.tree.map(lambda *parts: listed(parts), *found.values())


def springs_of(
    problem: ArmProblem, unknowns: tuple, at: ArmState, free: tuple[int, ...]
) -> dict[int, Springs]:
    """The springs of constraints by the places of these."""
    places = enumerate(zip(problem.couplings, unknowns, at.notes, strict=True))
    each = {
        i: coupling.springs(x, at, note, problem, free)
        for i, (coupling, x, note) in places
        if isinstance(coupling, Constraint)
    }
    return {i: springs for i, springs in each.items() if springs is not None}
