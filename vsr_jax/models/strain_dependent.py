r"""The strain-dependent model (eq. 19-21): with the basis $B_q = \Sigma^{-1} B_\tau(\xi)$ the
coordinates are $q = \tau$, and the strain is solved at the nodes.

Without loads each node is solved alone. With loads the reaction is part of the balance of each node
and all nodes are solved together (see `arm_balance`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..arm.rod import STRAIGHT
from ..arm.scene import Scene, shared
from ..elements.problem import problem_of
from ..mechanics.applied_load import Loading
from ..mechanics.arm_balance import ArmSolution, ArmUnknown, carried_from_start, state_of
from ..mechanics.arm_solve import solve_arm
from ..mechanics.balance import (
    forces_where,
    newton_step,
    residual,
    solve_balance,
    strain_norm,
    without_force,
)
from ..mechanics.coupling import ArmProblem, Coupling
from ..mechanics.reaction import react_at
from ..numerics.component import Forces, Vector, free_components, spread
from ..numerics.magnus import ORDERS
from ..numerics.quadrature import Grid
from ..validation import choice, count
from .base import Near, Nodes, Outcome, Status, SteppedModel, classify, rest_where_failed


class StrainDependent(SteppedModel):
    r"""Strain from the balance of each cross-section, $\xi = \Sigma^{-1} (B_\tau(\xi) \tau +
    \Lambda) + \xi^*$ (eq. 21).

    Without loads $\Lambda = 0$ and the strain is exact; the only error is that of the pose steps.
    With loads the reaction is computed on the same steps, and the pose at their ends has their
    order.

    **Arguments:**
    - `steps`: steps along the arm, at least one on each smooth piece, the others distributed by
      length.
    - `order`: order of the steps, 2, 4 (Zanna's, eq. 5) or 6, with one, two or three nodes per
      step.
    """

    steps: int = eqx.field(static=True)
    order: int = eqx.field(static=True)
    balanced_everywhere = begins_near = remembers = on_nodes = True

    def __init__(self, steps: int = 32, order: int = 6):
        self.steps = count("StrainDependent.steps", steps)
        self.order = choice("StrainDependent.order", order, ORDERS)

    def solve(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        if scene.coupled:
            return self._solve_together(scene, problem_of(scene, inputs, self.grid(scene)))
        grid = self.grid(scene)
        sections, forces = scene.sections(grid.X), scene.forces(inputs)
        tau = sections.carry(forces)
        solution = solve_balance(sections, tau, None, scene.free)
        status = classify(solution.xi, sections, tau, solution.balanced, solution.definite)
        status = jnp.where(
            status == Status.CONVERGED, _status_of_ends(scene, forces, solution.xi), status
        )
        xi = rest_where_failed(status, solution.xi, sections)
        nodes = Nodes(grid, xi, sections, sections.reach)
        return Outcome(ArmSolution(xi, (), ()), forces, status, solution.steps, nodes)

    def solve_from(self, scene: Scene, inputs: Float[Array, " inputs"], near: Near) -> Outcome:
        if not scene.coupled:  # a few steps of each section alone, from anywhere
            return self.solve(scene, inputs)
        problem = problem_of(scene, inputs, self.grid(scene))
        guess = near.model.unknowns_on(near.scene, near.forces, near.state, problem)
        if isinstance(near.state, ArmSolution):
            problem = problem.as_loose_as(lax.stop_gradient(near.state.couplings))
        return self._solve_together(scene, problem, lax.stop_gradient(guess))

    def solve_at(self, scene: Scene, inputs: Float[Array, " inputs"], near: Near) -> Outcome:
        if not scene.coupled:
            return self.solve(scene, inputs)
        state, grid = lax.stop_gradient(near.state), self.grid(scene)
        problem = self.problem_on(scene, inputs, state, grid).as_loose_as(state.couplings)
        solution = ArmUnknown(state.xi, state.coupled)
        return self._solve_together(scene, problem, solution, solved=True)

    def solve_after(self, scene: Scene, inputs: Float[Array, " inputs"], near: Near) -> Outcome:
        if not scene.coupled:
            return self.solve(scene, inputs)
        problem = problem_of(scene, inputs, self.grid(scene))
        couplings = tuple(
            new.remembering(old, problem.grid.X, problem.grid)
            for new, old in zip(problem.couplings, self._memory(near), strict=True)
        )
        guess = lax.stop_gradient(ArmUnknown(near.state.xi, near.state.coupled))
        return self._solve_together(scene, problem._replace(couplings=couplings), guess)

    def remembered(self, near: Near) -> Near:
        if not near.scene.coupled:
            return near
        return near._replace(state=near.state._replace(couplings=self._memory(near)))

    def _memory(self, near: Near) -> tuple[Coupling, ...]:
        """The couplings of a solution by this model, with the memory of it."""
        old, unknown = self.balance(near.scene, near.forces, near.state)
        at = state_of(unknown.xi, unknown.coupled, old)
        return tuple(
            coupling.after(x, at, old)
            for coupling, x in zip(old.couplings, unknown.coupled, strict=True)
        )

    def at_rest(self, scene: Scene, dtype: Any) -> Near:
        zero = jnp.zeros(len(scene.actuators), dtype)
        problem = problem_of(scene, zero, self.grid(scene))
        forces = without_force(problem.forces)
        xi = tuple(jnp.broadcast_to(x, problem.grid.X.shape) for x in problem.sections.rest)
        if not scene.coupled:
            return Near(self, scene, forces, ArmSolution(xi, (), ()))
        coupled = tuple(coupling.guess(forces, problem.grid) for coupling in problem.couplings)
        return Near(self, scene, forces, ArmSolution(xi, coupled, problem.couplings))

    def straight(self, state: ArmSolution) -> ArmSolution:
        xi = (jnp.full_like(x, u) for x, u in zip(state.xi, STRAIGHT, strict=True))
        return state._replace(xi=tuple(xi))

    def _solve_together(
        self,
        scene: Scene,
        problem: ArmProblem,
        guess: ArmUnknown | None = None,
        *,
        solved: bool = False,
    ) -> Outcome:
        found = solve_arm(problem, scene.free, guess, solved=solved)
        unknown, balanced, definite, steps, loose, restarted = found
        problem = problem.loosened(loose)
        forces, shares = carried_from_start(unknown, problem)
        given = problem.along_sections(shared(problem.forces, shares))
        sections = problem.sections_of_threads
        status = classify(unknown.xi, sections, given, balanced, definite, loaded=scene.reacts)
        sound = status == Status.CONVERGED
        xi = rest_where_failed(status, unknown.xi, problem.sections)
        coupled = jax.tree.map(lambda x: jnp.where(sound, x, 0.0), unknown.coupled)
        state = ArmSolution(xi, coupled, problem.couplings)
        nodes = Nodes(problem.grid, xi, problem.sections, shares)
        loosened = problem.was_loosened(loose)
        sound_forces = forces_where(sound, forces)
        return Outcome(state, sound_forces, status, steps, nodes, loosened, restarted)

    def node_strain(self, scene: Scene, state: ArmSolution) -> Vector:
        return state.xi

    def nodes(self, scene: Scene, forces: Forces, state: ArmSolution) -> Nodes:
        grid = self.grid(scene)
        return Nodes(
            grid,
            state.xi,
            scene.sections(grid.X),
            state.shares_at(scene, grid, grid.X, forces),
        )

    def balance(
        self, scene: Scene, forces: Forces, state: ArmSolution
    ) -> tuple[ArmProblem, ArmUnknown]:
        grid = self.grid(scene)
        loads = super().loading(scene, state, grid)
        problem = ArmProblem(grid, scene.sections(grid.X), forces, loads, state.couplings)
        return problem, ArmUnknown(state.xi, state.coupled)

    def loading(self, scene: Scene, state: ArmSolution, grid: Grid) -> Loading | None:
        return state.loading(super().loading(scene, state, grid))

    def coordinates(
        self, scene: Scene, forces: Forces, state: ArmSolution
    ) -> Float[Array, " dofs"]:
        return jnp.array(forces, state.xi[0].dtype)

    def dofs(self, scene: Scene) -> int:
        return len(scene.actuators)

    def dof_labels(self, size: int) -> None:
        return None

    def strain_on(self, scene: Scene, forces: Forces, state: ArmSolution, grid: Grid) -> Vector:
        if state.xi[0].shape == grid.X.shape:
            return state.xi
        return super().strain_on(scene, forces, state, grid)

    def problem_on(self, scene: Scene, inputs: Array, state: ArmSolution, grid: Grid) -> ArmProblem:
        problem, X = super().problem_on(scene, inputs, state, grid), self.grid(scene).X
        couplings = tuple(
            new.remembering(old, X, grid)
            for new, old in zip(problem.couplings, state.couplings, strict=True)
        )
        return problem._replace(couplings=couplings)

    def unknowns_on(
        self, scene: Scene, forces: Forces, state: ArmSolution, problem: ArmProblem
    ) -> ArmUnknown:
        X, grid = self.grid(scene).X, problem.grid
        found = list(zip(state.couplings, state.coupled, strict=True))

        def begun(new: Coupling) -> Any:
            for old, x in found:
                if new.like(old):
                    return new.moved(x, X, grid)
            return new.guess(forces, grid)

        coupled = tuple(map(begun, problem.couplings))
        return ArmUnknown(self.strain_on(scene, forces, state, grid), coupled)

    def strain(
        self, scene: Scene, forces: Forces, state: ArmSolution, X: Float[Array, " stations"]
    ) -> Vector:
        return self._strain(scene, forces, state, X)

    def smooth_strain(
        self, scene: Scene, forces: Forces, state: ArmSolution, X: Float[Array, " stations"]
    ) -> Vector:
        return self._strain(scene, forces, state, X, smooth=True)

    def _strain(
        self, scene: Scene, forces: Forces, state: ArmSolution, X: Array, *, smooth: bool = False
    ) -> Vector:
        grid = self.grid(scene)
        loads = self.loading(scene, state, grid)
        reaction = None
        if loads is not None:
            chords = loads.along_chords(forces, state.shares_at(scene, grid, grid.X, forces))
            reaction = react_at(state.xi, grid, loads, X, chords, smooth=smooth)
        tau = shared(forces, state.shares_at(scene, grid, X, forces))
        tau = tau if loads is None else loads.along_sections(tau)
        start = tuple(jnp.interp(X, grid.X.T.reshape(-1), x.T.reshape(-1)) for x in state.xi)
        sections = scene.sections(X)
        xi = solve_balance(sections, tau, reaction, scene.free, start).xi
        off = free_components(residual(xi, sections, tau, reaction), scene.free)
        size = strain_norm(spread(off, scene.free), sections.stiffness)
        # near collapse the strain between unresolved nodes may not be found
        found = jnp.where(size <= jnp.finfo(size.dtype).eps ** 0.5, 1.0, jnp.nan)
        return tuple(found.astype(x.dtype) * x for x in xi)


def _status_of_ends(scene: Scene, forces: Forces, xi: Vector) -> Array:
    """Status of the two ends of the arm, where no node lies: a tapered arm fails at its tip first.
    One Newton step from the strain at the nearest node is accurate enough."""
    sections = scene.sections(jnp.stack([jnp.zeros_like(scene.rod.length), scene.rod.length]))
    tau = sections.carry(forces)
    beside = lax.stop_gradient(tuple(jnp.stack([x[0, 0], x[-1, -1]]) for x in xi))
    _, step = newton_step(beside, sections, tau, None, scene.free)
    definite = ~jnp.isnan(step[-1])
    there = tuple(
        jnp.where(definite, x - s, x) for x, s in zip(beside, spread(step, scene.free), strict=True)
    )
    return classify(there, sections, tau, jnp.ones_like(definite), definite)
