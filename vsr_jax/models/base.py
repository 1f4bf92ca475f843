"""The interface of all models, and the common part of those that advance the pose by Magnus
steps."""

from abc import abstractmethod
from dataclasses import replace
from enum import IntEnum
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.scene import CrossSections, Scene, shared, together
from ..elements.problem import loading, problem_of
from ..mechanics.applied_load import Loading
from ..mechanics.arm_balance import ArmUnknown
from ..mechanics.balance import shortened, thread_direction, thread_wrench
from ..mechanics.coupling import ArmProblem
from ..mechanics.resolution import COARSE, step_error
from ..numerics.component import Forces, Vector, dot, times
from ..numerics.magnus import stacked_twist, step_poses, tip_pose
from ..numerics.quadrature import Grid, gauss_legendre, locate, make_grid
from ..numerics.se3 import stacked_exp, whole_pose
from ..numerics.stacked import stack
from ..typing import Pose, Scalar
from .basis import unnamed
from .refinement import Refinement, balanced_strain, corrected_strain, merged_tip


class Status(IntEnum):
    """How a solve ended; every status but `CONVERGED` comes with a shape of NaN."""

    CONVERGED = 0
    NOT_CONVERGED = 1
    UNSTABLE = 2
    COLLAPSED = 3
    NOT_FINITE = 4
    INADMISSIBLE = 5
    UNDER_RESOLVED = 6
    BRANCH_LOST = 7

    @property
    def message(self) -> str:
        """The status in words."""
        return _MESSAGES[self]


_MESSAGES = {
    Status.CONVERGED: "converged",
    Status.NOT_CONVERGED: "the residual could not be brought down to rounding",
    Status.UNSTABLE: "the equilibrium is not stable: "
    "the tangent stiffness is not positive definite",
    Status.COLLAPSED: "collapsed: a thread has shortened its own path, or the arm, to nothing",
    Status.NOT_FINITE: "an input or an intermediate value is not finite",
    Status.INADMISSIBLE: "an input lies outside its actuator's range",
    Status.UNDER_RESOLVED: "under-resolved: the arm bends too fast "
    "along its length for so few steps",
    Status.BRANCH_LOST: "the branch could not be followed up to here: its steps became too short",
}


_NOTHING = 1e-4
"""Fraction of its rest length below which a path counts as collapsed."""

_UNSETTLED = 4
"""Factor by which the ratio of the errors of steps and of steps twice as long may differ from that
of their order, since a few steps are not yet in the asymptotic regime."""
_MANY = 8
"""Steps from which half as many are close enough to that regime under loads."""


class Nodes(NamedTuple):
    """A grid and, at its nodes, the strain, the cross-sections and the share of each thread's force
    (None for 1)."""

    grid: Grid
    xi: Vector
    sections: CrossSections
    shares: tuple[Array | None, ...]

    def tau(self, forces: Forces) -> Forces:
        """Force of each thread at the nodes."""
        return shared(forces, self.shares)


class Outcome(NamedTuple):
    """Result of a model's solve: its own state (finite even where it failed), the thread forces [N]
    at their start, a `Status`, the Newton steps, and its nodes, if they are at hand; whether
    constraints were loosened on the way, None for a scene or a model without; and whether it gave
    up the solution near by and began again from rest, None where it did not begin there."""

    state: Any
    forces: Forces
    status: Array
    steps: Array
    nodes: Nodes | None = None
    loosened: Array | None = None
    restarted: Array | None = None


class Near(NamedTuple):
    """A solution of a scene near by, from which a solve may start: its model, its scene, and the
    thread forces and the state of its `Outcome`."""

    model: "Model"
    scene: Scene
    forces: Forces
    state: Any


class Model(eqx.Module):
    """A method to compute and describe the equilibrium of a scene.

    `balanced_everywhere`: whether the balance of the cross-section (eq. 21) holds at every X where
    `strain` is evaluated, to rounding or to the model's tolerances. Derivatives and errors can then
    be taken from the balance instead of from `solve`.

    `begins_near`: whether `solve_from` begins at the solution near by. `remembers`: whether paths
    of inputs can be followed by `at_rest` and `solve_after`. `on_nodes`: whether its state is an
    `ArmSolution` on its `grid`, of the balance of `problem_of`.
    """

    balanced_everywhere: ClassVar[bool] = False
    begins_near: ClassVar[bool] = False
    remembers: ClassVar[bool] = False
    on_nodes: ClassVar[bool] = False

    @abstractmethod
    def solve(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        """Equilibrium for admissible inputs."""

    def solve_from(self, scene: Scene, inputs: Float[Array, " inputs"], near: Near) -> Outcome:
        """As `solve`, started from a solution near by; a model without a use for it ignores it."""
        return self.solve(scene, inputs)

    def solve_at(self, scene: Scene, inputs: Float[Array, " inputs"], near: Near) -> Outcome:
        """As `solve_from`, at a solution of the scene itself, whose derivatives are wanted: a model
        that can does not solve it again."""
        return self.solve_from(scene, inputs, near)

    def solve_after(self, scene: Scene, inputs: Float[Array, " inputs"], near: Near) -> Outcome:
        """As `solve_from`, on a path of inputs: contacts and tendons with friction remember the
        solution before, one by this model of the same scene."""
        raise ValueError(f"model: got {type(self).__name__}, need StrainDependent, with a memory")

    def at_rest(self, scene: Scene, dtype: Any) -> Near:
        """The arm at rest, from which a path of inputs starts."""
        raise ValueError(f"model: got {type(self).__name__}, need StrainDependent, with a memory")

    def remembered(self, near: Near) -> Near:
        """The same solution with a memory of itself, as all states on a path have it."""
        return near

    def straight(self, state: Any) -> Any:
        """The state of a straight arm, from one of zeros."""
        return state

    @abstractmethod
    def strain(
        self, scene: Scene, forces: Forces, state: Any, X: Float[Array, " stations"]
    ) -> Vector:
        r"""Strain $\xi$ at abscissas X, six component arrays."""

    @abstractmethod
    def tip(self, scene: Scene, forces: Forces, state: Any) -> Pose:
        """Pose of the arm's end."""

    @abstractmethod
    def poses(
        self, scene: Scene, forces: Forces, state: Any, X: Float[Array, " stations"]
    ) -> Float[Array, "stations 4 4"]:
        """Poses at abscissas X."""

    def coordinates(self, scene: Scene, forces: Forces, state: Any) -> Float[Array, " dofs"]:
        """Coordinates of the strain in the model's basis."""
        raise ValueError(
            f"q: got a solution by {type(self).__name__}, need one by StrainDependent or Prescribed"
        )

    def dofs(self, scene: Scene) -> int | None:
        """Number of degrees of freedom; None for a continuum."""
        return None

    @abstractmethod
    def nodes(self, scene: Scene, forces: Forces, state: Any) -> Nodes:
        """Nodes from which integrals along the arm are computed."""

    def loading(self, scene: Scene, state: Any, grid: Grid) -> Loading | None:
        """The loads on the grid of a solution, and the wrenches of what holds the arm."""
        return loading(scene, grid)

    def balance(self, scene: Scene, forces: Forces, state: Any) -> tuple[ArmProblem, ArmUnknown]:
        """The coupled balance at a solution of a scene with held sections or obstacles."""
        raise ValueError(f"model: got {type(self).__name__}, need StrainDependent")

    def refuse_whole_arm(self, scene: Scene) -> None:
        """Raises `ValueError` for a scene with held sections, obstacles or tendons with discs,
        which only the balance of the whole arm by `StrainDependent` has."""
        if scene.straight:
            raise ValueError(
                f"scene.actuators[{scene.straight[0]}].straight: got a tendon that runs straight "
                f"from disc to disc and {type(self).__name__}, need StrainDependent, the model for "
                f"such tendons"
            )
        found = "held sections" if scene.held else "obstacles" if scene.obstacles else None
        if found:
            raise ValueError(
                f"model: got {type(self).__name__} for a scene with {found}, need StrainDependent"
            )

    @abstractmethod
    def finer(self) -> "Model":
        """The same model with twice the steps, or with tighter tolerances if the steps are
        adaptive."""

    def strain_on(self, scene: Scene, forces: Forces, state: Any, grid: Grid) -> Vector:
        """Strain at the nodes of a grid, a first guess of another solution there."""
        xi = self.strain(scene, forces, state, grid.X.reshape(-1))
        return tuple(x.reshape(grid.X.shape) for x in xi)

    def problem_on(self, scene: Scene, inputs: Array, state: Any, grid: Grid) -> ArmProblem:
        """The coupled balance on another grid, for the inputs of a solution."""
        return problem_of(scene, inputs, grid)

    def unknowns_on(
        self, scene: Scene, forces: Forces, state: Any, problem: ArmProblem
    ) -> ArmUnknown:
        """Unknowns of the coupled balance on another grid, a first guess of the solution of a
        problem there."""
        xi = self.strain_on(scene, forces, state, problem.grid)
        coupled = tuple(one.guess(forces, problem.grid) for one in problem.couplings)
        return ArmUnknown(xi, coupled)

    def dof_labels(self, size: int) -> tuple[tuple[str, str], ...] | None:
        """Name and unit of each of the `size` coordinates; None where they are the forces of the
        threads."""
        return unnamed(size)

    def refined(self, scene: Scene, inputs: Array, forces: Forces, state: Any) -> Refinement:
        """Another solution, from which the error of the given one is estimated; by default that of
        the `finer` model."""
        grid, finer = make_grid(scene.edges(), 32, 3), self.finer()
        near = Near(self, scene, forces, state)
        found, X = finer.solve_from(scene, inputs, near), grid.X.reshape(-1)
        return Refinement(
            finer.tip(scene, found.forces, found.state),
            X,
            self.strain(scene, forces, state, X),
            finer.strain(scene, found.forces, found.state, X),
        )

    def step_error(self, scene: Scene, outcome: Outcome) -> Scalar | None:
        """Rough estimate of the tip's error by the steps, as a fraction of the arm's length; None
        for adaptive steps."""
        return None


class SteppedModel(Model):
    """A model whose pose advances by Magnus steps on the strain at their Gauss points."""

    steps: eqx.AbstractVar[int]
    order: eqx.AbstractVar[int]

    def breakpoints(self, scene: Scene) -> tuple[Array, ...]:
        """Abscissas [m] where steps must end, besides those of the scene."""
        return ()

    def grid(self, scene: Scene) -> Grid:
        """Steps along the arm and their nodes."""
        return self._grid(scene, self.steps, self.order // 2)

    def _grid(self, scene: Scene, steps: int, stages: int) -> Grid:
        return make_grid(scene.edges(self.breakpoints(scene)), steps, stages)

    def tip(self, scene: Scene, forces: Forces, state: Any) -> Pose:
        return tip_pose(self.node_strain(scene, state), self.grid(scene).h, scene.rod.frame)

    def finer(self) -> "SteppedModel":
        return replace(self, steps=2 * self.steps)

    def step_error(self, scene: Scene, outcome: Outcome) -> Scalar:
        nodes, forces = outcome.nodes, outcome.forces
        if nodes is None:
            nodes = self.nodes(scene, forces, outcome.state)
        # friction reduces a thread's force, loads do not
        sections = nodes.sections._replace(reach=nodes.shares)
        return step_error(nodes.xi, sections, forces, nodes.grid, loaded=scene.loaded)

    def smooth_strain(
        self, scene: Scene, forces: Forces, state: Any, X: Float[Array, " stations"]
    ) -> Vector:
        """The strain from which positions between the nodes follow: as `strain`, but without jumps
        at contacts."""
        return self.strain(scene, forces, state, X)

    @abstractmethod
    def node_strain(self, scene: Scene, state: Any) -> Vector:
        """Strain at the nodes of `grid`, six component arrays of shape (stages, steps)."""

    def refined(self, scene: Scene, inputs: Array, forces: Forces, state: Any) -> Refinement:
        if scene.obstacles:  # contacts are not corrected by one Newton step
            return super().refined(scene, inputs, forces, state)
        if self.balanced_everywhere and scene.edges().size == 2 and self.steps > 1:
            if not scene.coupled:
                return self._merged(scene, state)
            if self.steps >= _MANY:
                return self._coarser(scene, inputs, forces, state)
        grid = self._grid(scene, 2 * self.steps, 3)
        given, other = self._corrected(scene, inputs, forces, state, grid)
        return Refinement(tip_pose(other, grid.h, scene.rod.frame), grid.X, given, other)

    def _merged(self, scene: Scene, state: Any) -> Refinement:
        """By pairs of steps."""
        grid, xi = self.grid(scene), self.node_strain(scene, state)
        error = (self.steps / (self.steps // 2 * 2)) / (2**self.order - 1)
        return Refinement(merged_tip(xi, grid, scene.rod.frame), grid.X, xi, xi, _UNSETTLED * error)

    def _coarser(self, scene: Scene, inputs: Array, forces: Forces, state: Any) -> Refinement:
        """By half as many steps, with the orders that the errors of the tip and, as a polynomial
        through the nodes of a step, of the strain have."""
        steps = self.steps // 2
        grid = make_grid(scene.edges(), steps, self.order // 2)
        given, other = self._corrected(scene, inputs, forces, state, grid)
        tip, strain = (
            _UNSETTLED / ((self.steps / steps) ** order - 1)
            for order in (self.order, self.order // 2 + 1)
        )
        return Refinement(
            tip_pose(other, grid.h, scene.rod.frame), grid.X, given, other, tip, strain
        )

    def _corrected(
        self, scene: Scene, inputs: Array, forces: Forces, state: Any, grid: Grid
    ) -> tuple[Vector, Vector]:
        """The strain on a grid, and that corrected there."""
        if scene.coupled:
            problem = self.problem_on(scene, inputs, state, grid)
            unknown = self.unknowns_on(scene, forces, state, problem)
            return unknown.xi, corrected_strain(problem, unknown, scene.free)
        xi = self.strain_on(scene, forces, state, grid)
        return xi, xi if self.balanced_everywhere else balanced_strain(scene, forces, xi, grid)

    def poses(
        self, scene: Scene, forces: Forces, state: Any, X: Float[Array, " stations"]
    ) -> Float[Array, "stations 4 4"]:
        grid = self.grid(scene)
        ends = step_poses(self.node_strain(scene, state), grid.h, scene.rod.frame)
        step, _ = locate(grid, X)
        h = X - grid.start[step]
        nodes = gauss_legendre(self.order // 2)[0].astype(h.dtype)
        X_nodes = grid.start[step] + nodes[:, None] * h
        strain = self.smooth_strain(scene, forces, state, X_nodes.reshape(-1))
        twist = stacked_twist(stack(strain).reshape(6, *X_nodes.shape), h)
        return jax.vmap(jnp.matmul)(ends[step], whole_pose(stacked_exp(twist)))


def resolved(model: Model, scene: Scene, outcome: Outcome) -> Outcome:
    """The outcome, with the status under-resolved where it converged on too few steps for its
    shape, and without its nodes."""
    error, outcome = model.step_error(scene, outcome), outcome._replace(nodes=None)
    if error is None:
        return outcome
    coarse = (outcome.status == Status.CONVERGED) & ~(error <= COARSE)
    return outcome._replace(
        status=jnp.where(coarse, Status.UNDER_RESOLVED, outcome.status).astype(jnp.int32)
    )


def classify(
    xi: Vector,
    sections: CrossSections,
    tau: Forces,
    balanced: Array,
    definite: Array,
    *,
    loaded: bool = False,
) -> Array:
    """`Status` from the strain, whether it is balanced and whether the tangent is positive
    definite, over all nodes.

    With tendons alone (not `loaded`) the energy is convex. A node that cannot be balanced then has
    its minimum of energy at a kink of the energy, where the path of a thread has length zero: it is
    collapsed. So is a node where a path or the axis is shortened to less than 1e-4 of its rest
    length or is reversed. Under loads the strain of an arm that cannot be balanced says nothing: it
    is collapsed if one thread alone would shorten its path to zero, by the force that it is given.
    """
    collapsed = jnp.any(shortened(xi, sections, _NOTHING))
    if loaded:
        collapsed = collapsed & jnp.all(balanced)
    if sections.paths:
        pulling = _exhausted(tau, sections) if loaded else jnp.all(together(tau) <= 0)
        collapsed = collapsed | jnp.any(~balanced & pulling)
    finite = jnp.all(jnp.isfinite(sum(xi)))
    status = jnp.where(jnp.all(balanced), Status.CONVERGED, Status.NOT_CONVERGED)
    lost = ~jnp.all(definite)
    status = jnp.where(lost & jnp.all(balanced) if loaded else lost, Status.UNSTABLE, status)
    status = jnp.where(collapsed, Status.COLLAPSED, status)
    return jnp.where(finite, status, Status.NOT_FINITE).astype(jnp.int32)


def _exhausted(tau: Forces, sections: CrossSections) -> Array:
    r"""Whether one of the threads would shorten its path to zero alone, extrapolated from the rest
    state: $T w^T \Sigma^{-1} w \ge |t_c|$."""
    path = sections.every_path
    t, length = thread_direction(sections.rest, path)
    w = thread_wrench(t, path)
    strain = tuple(x / s for x, s in zip(w, sections.stiffness, strict=True))
    force = together(tuple(jnp.broadcast_to(force, sections.rest[0].shape) for force in tau))
    return jnp.any(-force * times(sections.flexible, dot(w, strain)) >= length)


def rest_where_failed(status: Array, xi: Vector, sections: CrossSections) -> Vector:
    """`xi`, replaced by the rest strain where the solve failed, so that later results stay
    finite."""
    return tuple(
        jnp.where(status == Status.CONVERGED, x, rest)
        for x, rest in zip(xi, sections.rest, strict=True)
    )
