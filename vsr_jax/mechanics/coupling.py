r"""What ties the cross-sections of an arm together beside its loads: the interface that the solvers
know, and the data of the coupled balance.

A coupling has unknowns x of its own, with as many residual rows. It may change the forces of the
threads, and it gives what Newton's method needs of it: a start, sizes of its unknowns and rows, and
its part of the tangent system,

$$\begin{pmatrix} A & P \\ F R & D \end{pmatrix}
\begin{pmatrix} \delta\xi \\ \delta x \end{pmatrix} = \begin{pmatrix} r \\ s \end{pmatrix},$$

a border of the system A of the strains. A coupling without a border has $P = 0$ and $D = 1$ there;
one that follows from the strain and its derivative is changed by the step of the strain too.

To add one, derive from `Coupling` and name it in `couplings_of`. All arrays of one arm have the
arms of a batch in further axes at their end.
"""

from abc import abstractmethod
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arm.scene import CrossSections, Scene
from ..chain.border import Border, listed
from ..numerics.component import Forces, Vector
from ..numerics.damped_rules import HARDENING_STAGES, SOFT_STAGES
from ..numerics.quadrature import Grid
from .balance import without_force
from .loading import Loading
from .point_forces import PointForces
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
        """The problem with a fraction of its loads. Constraints that soften are springs up to the
        fraction 1, with all loads; above it they harden up to 2, where they are exact."""
        if self.loads is None:
            return self
        if not self.softens:
            return self._replace(loads=self.loads.scaled(share))
        hardness = jnp.maximum(share - 1.0, 0.0)
        couplings = tuple(coupling.softened(hardness) for coupling in self.couplings)
        return self._replace(loads=self.loads.scaled(jnp.minimum(share, 1.0)), couplings=couplings)

    def loosened(self, loose: Array | None) -> "ArmProblem":
        """The problem that is solved where the given one is not, where `loose` is true."""
        if loose is None or not self.softens:
            return self
        return self._replace(couplings=tuple(one.loosened(loose) for one in self.couplings))

    def was_loosened(self, loose: Array | None) -> Array | None:
        """Whether constraints were loosened, by a solve that ended `loose` or by one that it began
        from; None without constraints."""
        if loose is None or not self.softens:
            return None
        for coupling in self.couplings:
            loose = coupling.was_loosened(loose)
        return loose

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

    def as_loose_as(self, others: tuple["Coupling", ...]) -> "ArmProblem":
        """The problem with its couplings loosened as those of one that it begins from."""
        couplings = list(self.couplings)
        for other in others:
            couplings = [one.as_loose_as(other) for one in couplings]
        return self._replace(couplings=tuple(couplings))

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
        discs = None if self.loads is None else self.loads.discs
        return tau if discs is None else discs.elsewhere(tau)

    @property
    def follows_rate(self) -> bool:
        """Whether a coupling follows the strain and its derivative along the arm: the tangent lacks
        what that does to the forces, so that Newton's method converges linearly."""
        return any(coupling.follows_rate for coupling in self.couplings)

    @property
    def softens(self) -> bool:
        """Whether a coupling is a constraint that springs can replace on the way to a solution."""
        return any(coupling.softens for coupling in self.couplings)

    @property
    def begins_soft(self) -> bool:
        """Whether a solve from rest begins with springs in place of a constraint."""
        return any(coupling.begins_soft for coupling in self.couplings)

    @property
    def dissipates(self) -> Array | None:
        """Whether the tangent of a coupling is not symmetric; None if never."""
        each = [x for coupling in self.couplings if (x := coupling.dissipates()) is not None]
        return sum(each[1:], each[0]) > 0 if each else None

    @property
    def length(self) -> Array:
        """Length of the arm [m]."""
        return jnp.sum(self.grid.h, axis=0)


class ArmState(NamedTuple):
    """Quantities computed from the unknowns: the strain, what the threads carry, their forces along
    the nodes, the loads with those of the couplings, the reaction (both None without loads and
    straight tendons), and what each coupling noted."""

    xi: Vector
    carried: Carried
    tau: Forces
    loads: Loading | None
    along: Reaction | None
    notes: tuple[Any, ...]


class Coupling(eqx.Module):
    """What ties cross-sections together. Its unknowns x are one array of shape (m, ...) or a tuple
    of arrays, and its rows have the same shapes."""

    follows_rate: ClassVar[bool] = False
    """Whether the strain and its derivative along the arm give its unknowns."""

    softens: ClassVar[bool] = False
    """Whether it is a constraint on the shape that springs can replace on the way to a solution."""

    begins_soft: ClassVar[bool] = False
    """Whether a solve from rest does so from the beginning: the exact constraint seldom leads from
    there to a solution."""

    @abstractmethod
    def relaxed(self) -> "Coupling":
        """The coupling with the rest strain as its solution."""

    def prepared(self) -> "Coupling":
        """The coupling with rows whose derivative takes longer to find, and less to apply many
        times; the same by default."""
        return self

    @abstractmethod
    def guess(self, forces: Forces, grid: Grid) -> PyTree:
        """Unknowns that go with the forces of all threads at their start, to begin with."""

    def start(self, xi: Vector, problem: ArmProblem) -> Vector:
        """Strain from which Newton's method starts; unchanged by default."""
        return xi

    def softened(self, hardness: Array) -> "Coupling":
        """The coupling with springs in place of its constraint, from `hardness` 0 up to 1, where it
        is exact; the same by default."""
        return self

    def loosened(self, loose: Array) -> "Coupling":
        """The coupling with a rougher discretization where `loose` is true, for what is not solved
        without; the same by default."""
        return self

    def was_loosened(self, loose: Array) -> Array:
        """Whether it is loosened, or a solve ended `loose`; only the latter by default."""
        return loose

    def as_loose_as(self, other: "Coupling") -> "Coupling":
        """The coupling, loosened where another one is that it begins from; the same by default."""
        return self

    def loads(self, x: PyTree, loads: Loading | None) -> Loading | None:
        """The loads, and the wrenches that it exerts on the arm; none by default."""
        return loads

    @abstractmethod
    def residual(
        self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem, free: tuple[int, ...]
    ) -> PyTree:
        """Its rows, zero in equilibrium."""

    @abstractmethod
    def sizes(self, x: PyTree, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Dimensionless sizes of a change of its unknowns, by the shapes that they cause."""

    @abstractmethod
    def row_sizes(self, rows: PyTree, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Dimensionless sizes of its rows."""

    @abstractmethod
    def units(self, problem: ArmProblem) -> tuple[PyTree, PyTree]:
        """Factors that scale its rows and its changes to square roots of energies: see
        `tangent_solve`."""

    @abstractmethod
    def radians(self, problem: ArmProblem) -> PyTree:
        """Factors that make its unknowns comparable to angles."""

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

    def after(self, x: PyTree, at: ArmState, problem: ArmProblem) -> "Coupling":
        """The coupling with the memory of a solution before it; the same by default."""
        return self

    def remembering(self, other: "Coupling", X: Array, grid: Grid) -> "Coupling":
        """The coupling with the memory of another one, at the nodes X; the same by default."""
        return self

    def note(self, x: PyTree, at: ArmState, problem: ArmProblem) -> Any:
        """What both its residual and its border need; nothing by default."""
        return None

    def border(self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem) -> Border | None:
        """Its part of the tangent system; none by default, for the tangent 1."""
        return None

    def points(self, x: PyTree, at: ArmState, note: Any, problem: ArmProblem) -> PointForces | None:
        """Its part of the tangent system, in place of a border; none by default."""
        return None

    def dissipates(self) -> Array | None:
        """Whether it follows a law of friction, so that its tangent is not symmetric; None if
        never, by default."""
        return None

    def clear(self, at: ArmState, note: Any, problem: ArmProblem) -> Array | bool:
        """Whether the arm satisfies a constraint that `softens` by a wide margin, so that the exact
        one has no effect; never by default."""
        return False

    def from_rate(self, xi: Vector, rate: Vector, sections: CrossSections) -> PyTree:
        r"""Its unknowns, where it `follows_rate`, from the strain and the derivative $(\xi -
        \xi^*)'$ along the arm, which models with a basis know."""
        raise NotImplementedError

    def like(self, other: "Coupling") -> bool:
        """Whether the unknowns of another coupling can start its own."""
        return type(self) is type(other)

    def moved(self, x: PyTree, X: Array, grid: Grid) -> PyTree:
        """Its unknowns on another grid than that with the nodes X; unchanged by default."""
        return x


def forces_at(couplings: tuple[Coupling, ...], unknowns: tuple, forces: Forces) -> Forces:
    """Force of every thread at its start: as the inputs give it, or as a coupling does."""
    for coupling, x in zip(couplings, unknowns, strict=True):
        forces = coupling.forces(x, forces)
    return forces


def loads_with(
    couplings: tuple[Coupling, ...], unknowns: tuple, loads: Loading | None
) -> Loading | None:
    """The loads, and the wrenches that the couplings exert on the arm."""
    for coupling, x in zip(couplings, unknowns, strict=True):
        loads = coupling.loads(x, loads)
    return loads


def clear_of(at: ArmState, problem: ArmProblem) -> Array | None:
    """Whether the arm satisfies all its constraints by a wide margin; None if it has none."""
    each = [
        coupling.clear(at, note, problem)
        for coupling, note in zip(problem.couplings, at.notes, strict=True)
        if coupling.softens
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


def points_of(problem: ArmProblem, unknowns: tuple, at: ArmState) -> dict[int, PointForces]:
    """Forces at places of the arm by the places of their couplings."""
    each = [
        coupling.points(x, at, note, problem)
        for coupling, x, note in zip(problem.couplings, unknowns, at.notes, strict=True)
    ]
    return {i: points for i, points in enumerate(each) if points is not None}
