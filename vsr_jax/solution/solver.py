"""The one entry: a scene and its inputs in, an equilibrium out."""

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
    """Raised by `solve(..., throw=True)` when no equilibrium was found; its text is the status in
    words."""


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

    with $l_i$ the length of thread i. One scene at a time; batch with `jax.vmap`. Derivatives of
    everything that comes back, with respect to every number of the scene and to the inputs, are
    implicit and go in forward and reverse mode.

    **Arguments:**
    - `scene`: rod and actuators.
    - `inputs`: one number an actuator: tau [N] for a `Thread`, tension [N] for a `Tendon`, pressure
      [Pa] for a `Chamber`. Their dtype is the precision of the whole computation.
    - `model`: `StrainDependent()` by default, the exact one; `Prescribed(basis)`; `Continuum()`.
    - `tolerance` [m]: of the tip's place, instead of a `model`: as many steps as it takes for these
      inputs, found by trying (see `plan`, which also chooses for ranges of inputs and for
      gradients, and beforehand, as `jax.jit` needs it). What was chosen is the `model` of the
      result; `eq.error` says what came of it.
    - `throw`: raise if the solve did not converge. Otherwise the status says so and the shape is
      NaN.

    **Raises:** `ValueError` for a wrong number of inputs and, where their values are known, for NaN
    or a tension < 0; for a tolerance that no number of steps meets, or together with a model.
    `SolveError` with `throw=True`; under `jax.jit` the error equinox raises at run time.

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
                f"tolerance: got {tolerance!r} and a model, need one of them: a model says itself "
                f"how fine it is"
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
    """What a model makes of inputs, those that an actuator cannot exert refused by their status;
    all in one precision."""
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
