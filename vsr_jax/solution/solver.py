"""`solve`: the equilibrium of a scene under its inputs."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..models.base import Model, Outcome, Status, resolved
from ..models.strain_dependent import StrainDependent
from ..typing import cast
from ..validation import instance, is_traced, positive
from .equilibrium import Equilibrium
from .step_choice import choose


class SolveError(RuntimeError):
    """Raised by `solve(..., throw=True)` if no equilibrium was found; its text is the message of
    the status."""


def solve(
    scene: Scene,
    inputs: Any,
    *,
    model: Model | None = None,
    tolerance: float | None = None,
    throw: bool = False,
) -> Equilibrium:
    r"""Static equilibrium of a scene: a stationary point of

    $\Pi(\xi) = \int_0^L \frac12 (\xi - \xi^*)^T \Sigma (\xi - \xi^*) \, dX - \sum_i \tau_i
    l_i(\xi)$,

    with $l_i$ the length of thread i. Solves one scene; batch with `jax.vmap`. All results are
    differentiable with respect to every number of the scene and to the inputs, by implicit
    differentiation in forward and reverse mode.

    **Arguments:**
    - `scene`: rod and actuators.
    - `inputs`: one number per actuator: tau [N] for a `Thread`, tension [N] for a `Tendon`,
      pressure [Pa] for a `Chamber`. Their dtype is the precision of the whole computation.
    - `model`: `StrainDependent()` by default, the exact one; `Prescribed(basis)`; `Continuum()`.
    - `tolerance` [m]: error bound of the tip position, instead of a `model`. The number of steps is
      chosen for these inputs by trial solves. `plan` does the same ahead of `jax.jit`, for ranges
      of inputs and for gradients. The result's `model` is the chosen one, `eq.error` its estimated
      error.
    - `throw`: raise if the solve did not converge. Otherwise `status` gives the reason and the
      shape is NaN.

    **Raises:** `ValueError` for a wrong number of inputs and, if their values are concrete, for NaN
    or a tension < 0; for a tolerance that no number of steps meets; for a tolerance together with a
    model. `SolveError` with `throw=True`; under `jax.jit`, the run-time error of equinox.

    **Source:** eq. (8)-(21) of Renda et al. 2020.
    """
    instance("scene", scene, Scene, "a Scene")
    values = scene.check_inputs(inputs)
    chosen = _model(scene, values, model, tolerance)
    scene, chosen = cast((scene, chosen), values.dtype)
    equilibrium = Equilibrium(scene, values, chosen, outcome_of(scene, values, chosen))
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


@eqx.filter_jit
def outcome_of(scene: Scene, inputs: Float[Array, " inputs"], model: Model) -> Outcome:
    """Outcome of a model; all arguments have one precision. NaN and inputs that an actuator cannot
    exert get their own status."""
    finite, admitted = jnp.all(jnp.isfinite(inputs)), scene.admits(inputs)
    outcome = resolved(model, scene, model.solve(scene, jnp.where(finite & admitted, inputs, 0.0)))
    status = jnp.where(admitted, outcome.status, Status.INADMISSIBLE)
    return outcome._replace(status=jnp.where(finite, status, Status.NOT_FINITE).astype(jnp.int32))


def _raise_if_failed(equilibrium: Equilibrium) -> Equilibrium:
    if not is_traced(equilibrium.status):
        if not bool(equilibrium.converged):
            raise SolveError(equilibrium.message)
        return equilibrium
    for status in list(Status)[1:]:
        equilibrium = eqx.error_if(equilibrium, equilibrium.status == status, status.message)
    return equilibrium
