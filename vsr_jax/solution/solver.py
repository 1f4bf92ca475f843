"""`solve`: the equilibrium of a scene under its inputs."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..arm.plausible import warn
from ..arm.scene import Scene
from ..models.base import Model, Near, Outcome, Status, resolved
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import program
from ..typing import VectorLike, cast
from ..validation import instance, is_traced, positive
from .equilibrium import Equilibrium
from .plausible_strain import strain_warnings
from .step_choice import choose


class SolveError(RuntimeError):
    """Raised by `solve(..., throw=True)` if no equilibrium was found; its text is the message of
    the status."""


def solve(
    scene: Scene,
    inputs: VectorLike,
    *,
    model: Model | None = None,
    tolerance: float | None = None,
    start: Equilibrium | None = None,
    throw: bool = False,
) -> Equilibrium:
    r"""Static equilibrium of a scene: a stationary point of

    $\Pi(\xi) = \int_0^L \frac12 (\xi - \xi^*)^T \Sigma (\xi - \xi^*) \, dX
    - \sum_i \tau_i l_i(\xi) + \sum_j \Pi_j(\xi)$,

    with $l_i$ the length of thread i under a given force, and $\Pi_j$ the potentials of dead forces
    and of elastic tendons driven by their length (see `energy`). Follower loads, dead moments and
    friction have no potential; they enter the balance of every cross-section. Solves one scene;
    batch with `jax.vmap`. All results are differentiable with respect to every number of the scene
    and to the inputs, by implicit differentiation in forward and reverse mode.

    **Arguments:**
    - `scene`: rod, actuators and loads.
    - `inputs`: one number per actuator: tau [N] for a `Thread`, tension [N] for a `Tendon` or its
      change of length [m] with `control="length"`, pressure [Pa] for a `Chamber`; then the numbers
      that the scene has `driven`. Their dtype is the precision of the whole computation.
    - `model`: `StrainDependent()` by default, which balances every cross-section on given steps;
      `Prescribed(basis)`, which restricts the strain to a basis; `Continuum()`, which integrates
      with adaptive steps.
    - `tolerance` [m]: error bound of the tip position, instead of a `model`. The number of steps is
      chosen for these inputs by trial solves. `plan` does the same ahead of `jax.jit`, for ranges
      of inputs and for gradients. The result's `model` is the chosen one, `eq.error` its estimated
      error.
    - `start`: an equilibrium near by, of any model and of a scene with the same kinds of actuators,
      from which Newton's method of a loaded `StrainDependent` starts; the other models and arms
      without loads have no use for it. A small change of a soft arm then takes a third to a fifth
      of the steps. Where it does not lead straight to a stable equilibrium, the solve starts again
      as without it; of several stable equilibria the result is the one near `start`. No derivative
      is taken with respect to it.
    - `throw`: raise if the solve did not converge. Otherwise `status` gives the reason and the
      shape is NaN.

    **Raises:** `ValueError` for a wrong number of inputs and, if their values are concrete, for NaN
    or a tension < 0; for a tolerance that no number of steps meets; for a tolerance together with a
    model; for a start of a scene with other actuators. `SolveError` with `throw=True`; under
    `jax.jit`, the run-time error of equinox.

    **Warns:** `UnitWarning` of inputs that would strain the arm far too much, if the solve fails.

    **Source:** eq. (8)-(21) of Renda et al. 2020.
    """
    instance("scene", scene, Scene, "a Scene")
    values = scene.check_inputs(inputs)
    chosen = _model(scene, values, model, tolerance)
    scene, chosen = cast((scene, chosen), values.dtype)
    near = None if start is None else cast(near_of(scene, start), values.dtype)
    equilibrium = Equilibrium(scene, values, chosen, outcome_of(scene, values, chosen, near))
    if not is_traced(equilibrium.status) and not bool(equilibrium.converged):
        warn(strain_warnings(equilibrium))
    return _raise_if_failed(equilibrium) if throw else equilibrium


def _model(scene: Scene, inputs: Array, model: Model | None, tolerance: float | None) -> Model:
    if tolerance is not None:
        if model is not None:
            raise ValueError(
                f"tolerance: got {tolerance!r} and a model, need one of them: a model already "
                f"fixes the resolution"
            )
        found = choose(scene, positive("tolerance", tolerance), inputs[None])
        return StrainDependent() if found is None else found.model
    return (
        StrainDependent()
        if model is None
        else instance("model", model, Model, "StrainDependent(), Prescribed(basis) or Continuum()")
    )


def near_of(scene: Scene, start: Equilibrium) -> Near:
    """What a solve needs of the equilibrium that it starts from."""
    instance("start", start, Equilibrium, "an Equilibrium, the result of another solve")
    start.refuse_batch()
    kinds = [
        tuple((type(actuator).__name__, actuator.unit) for actuator in one.actuators)
        for one in (start.scene, scene)
    ]
    same = start.scene.frictional == scene.frictional
    if kinds[0] != kinds[1] or not same:
        raise ValueError(
            f"start: got an equilibrium of a scene with {_named(start.scene)}, need one with "
            f"{_named(scene)}, as the scene that is solved"
        )
    return Near(start.model, start.scene, start.sound_forces, start.state)


def _named(scene: Scene) -> str:
    names = [type(actuator).__name__ for actuator in scene.actuators]
    return f"the actuators {', '.join(names)}" if names else "no actuators"


@program("solve")
def outcome_of(
    scene: Scene, inputs: Float[Array, " inputs"], model: Model, near: Near | None = None
) -> Outcome:
    """Outcome of a model, started from a solution near by if one is given; all arguments have one
    precision. NaN and inputs that an actuator cannot exert get their own status."""

    def solver(scene: Scene, values: Array) -> Outcome:
        return model.solve(scene, values) if near is None else model.solve_from(scene, values, near)

    return checked_outcome(scene, inputs, model, solver)


def checked_outcome(
    scene: Scene,
    inputs: Float[Array, " inputs"],
    model: Model,
    solver: Callable[[Scene, Array], Outcome],
) -> Outcome:
    """Outcome of a solver for admissible inputs, with the status of others and of steps that do not
    resolve the shape. The solver gets the scene with its driven numbers at the inputs."""
    given = status_of_inputs(scene, inputs)
    admitted = given == Status.CONVERGED
    inputs = jnp.where(admitted, inputs, scene.rest_inputs if scene.driven else 0.0)
    there = scene.at(inputs)
    outcome = resolved(model, there, solver(there, inputs))
    return outcome._replace(status=jnp.where(admitted, outcome.status, given))


def status_of_inputs(scene: Scene, inputs: Float[Array, " inputs"]) -> Int[Array, ""]:
    """`Status` of inputs that are NaN or that an actuator cannot exert, converged for others."""
    status = jnp.where(scene.admits(inputs), Status.CONVERGED, Status.INADMISSIBLE)
    finite = jnp.all(jnp.isfinite(inputs))
    return jnp.where(finite, status, Status.NOT_FINITE).astype(jnp.int32)


def _raise_if_failed(equilibrium: Equilibrium) -> Equilibrium:
    if not is_traced(equilibrium.status):
        if not bool(equilibrium.converged):
            raise SolveError(equilibrium.message)
        return equilibrium
    for status in list(Status)[1:]:
        equilibrium = eqx.error_if(equilibrium, equilibrium.status == status, status.message)
    return equilibrium
