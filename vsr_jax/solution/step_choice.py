r"""Number of steps that meets a tolerance, found by trial solves of the scene; one compiled program
covers all numbers of steps.

The steps are of order 6. A grid has a fixed capacity and leaves unused steps empty, so that the
number of steps may be traced. The reference of each trial is the same arm with all steps of the
grid in use. If these are not enough, the next trial has four times the capacity.
"""

from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..arm.scene import Scene
from ..mechanics.balance import forces_where
from ..models.base import Status, resolved
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import program
from ..numerics.quadrature import Grid, make_grid
from ..typing import VectorLike, cast
from ..validation import instance, interval, is_traced, positive

_CAPACITIES = (64, 256, 1024)
"""Capacities of the trial grids, in steps: each is one compiled program, so there are few of them,
and a capacity four times the last wastes little on the steps that stay empty."""

_STEP_COUNTS = (*range(1, 17), *range(18, 29, 2), *range(32, 49, 4))
"""Numbers of steps to try with a capacity of 64, closer together where one step more costs a larger
share; larger capacities scale them."""

_SHARE = 0.5
"""Largest error of the samples, as a share of the tolerance: other inputs may have a larger
error."""

_SAMPLES = 16
"""Trial inputs per plan: the corners of the range of three actuators, and as many random inputs."""

_NOTICED = 0.01
"""Least effect of a number, as a share of the largest, for its derivative to count: the relative
error of a slope that moves nothing would otherwise decide."""

_ROUNDED = 1e-5
"""Tolerance, as a share of the length, below which single precision is not tried: its rounding
along an arm is about a tenth of that."""


class Plan(NamedTuple):
    """Result of `plan`.

    - `model`: for `solve(..., model=plan.model)`; static, so that it works under `jax.jit`,
      `jax.vmap` and `jax.grad`.
    - `dtype`: "float32" or "float64", the lowest sufficient precision: pass the inputs in it.
      Single precision is only tried if the inputs are double and no gradient tolerance is given.
    - `error` [m]: largest error of the tip position over the samples.
    - `gradient_error`: largest relative error of a derivative of the tip position; None without a
      gradient tolerance.
    """

    model: StrainDependent
    dtype: str
    error: float
    gradient_error: float | None


def plan(
    scene: Scene,
    tolerance: float,
    inputs_range: VectorLike | Sequence[VectorLike],
    *,
    gradient_tolerance: float | None = None,
) -> Plan:
    """The fewest steps that bring the tip position within `tolerance` for inputs in a range.

    Trial solves at corners and at random points of the range, up to 16 samples in all, meet half
    the tolerance. Samples without a stable equilibrium are ignored.

    **Arguments:**
    - `scene`: with concrete numbers; a plan also holds for scenes near it.
    - `tolerance` [m]: error bound of the tip position.
    - `inputs_range`: lower and upper bound of the inputs, a pair of numbers or of arrays with one
      number per actuator. Their dtype is the precision.
    - `gradient_tolerance`: bound on the relative error of the derivatives of the tip position with
      respect to the scene's numbers and to the inputs. Derivatives with respect to a number p that
      is zero, or whose effect $|p| |\\partial x / \\partial p|$ is below 1 % of the largest, are
      ignored.

    **Raises:** `ValueError` for invalid arguments, for a tolerance that 768 steps do not meet or
    that is below the precision, and if no sample has a stable equilibrium.
    """
    instance("scene", scene, Scene, "a Scene")
    tolerance = positive("tolerance", tolerance)
    if gradient_tolerance is not None:
        gradient_tolerance = positive("gradient_tolerance", gradient_tolerance)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, inputs_range))):
        raise ValueError(
            "scene, inputs_range: got traced numbers, need concrete ones: make the plan outside "
            "jax.jit"
        )
    samples = _samples(scene, inputs_range)
    chosen = choose(scene, tolerance, samples, gradient_tolerance)
    if chosen is None:
        raise ValueError(
            "inputs_range: got no sample with a stable equilibrium, need a range with some; solve "
            "one sample and read its status"
        )
    if (
        samples.dtype != np.float64
        or gradient_tolerance is not None
        or tolerance < _ROUNDED * float(scene.rod.length)
    ):
        return chosen
    error = chosen.error + _rounding(scene, samples, chosen.model)
    return chosen._replace(dtype="float32", error=error) if error <= _SHARE * tolerance else chosen


def choose(
    scene: Scene, tolerance: float, samples: Array, gradient_tolerance: float | None = None
) -> Plan | None:
    """The plan for samples of inputs, shape (samples, inputs); None if no sample has an
    equilibrium."""
    if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, samples))):
        raise ValueError(
            "tolerance: got a traced scene or traced inputs, need concrete numbers; under jax.jit "
            "use the result of an earlier vsr.plan"
        )
    scene, least = cast(scene, samples.dtype), np.inf
    for capacity in _CAPACITIES:
        attempt = _attempt(scene, samples, capacity, tolerance, gradient_tolerance)
        if attempt.plan is not None or not attempt.solvable:
            return attempt.plan
        least = min(least, attempt.least)
    raise _unmet(tolerance, gradient_tolerance, least)


class _Attempt(NamedTuple):
    """Result of the trial solves with one capacity.

    **Fields:** the `plan`, None if no number of steps meets the tolerances; `least`, the least
    error [m] of the tip over the numbers of steps; `solvable`, whether a sample may have an
    equilibrium.
    """

    plan: Plan | None = None
    least: float = np.inf
    solvable: bool = True


def _attempt(
    scene: Scene,
    samples: Array,
    capacity: int,
    tolerance: float,
    gradient_tolerance: float | None,
) -> _Attempt:
    counts = np.array(_STEP_COUNTS) * (capacity // _CAPACITIES[0])
    trial = scene, samples, jnp.append(jnp.asarray(counts), capacity)
    errors, status = (np.asarray(x) for x in _tip_errors(*trial, capacity))
    if np.any(status == Status.UNDER_RESOLVED):
        return _Attempt()
    solved = status == Status.CONVERGED
    if not np.any(solved):
        return _Attempt(solvable=False)
    worst, slopes = _worst(errors[solved]), None
    fits = worst <= _SHARE * tolerance
    if gradient_tolerance is not None and np.any(fits):
        slopes = _worst(np.asarray(_gradient_errors(*trial, capacity))[solved])
        fits &= slopes <= _SHARE * gradient_tolerance
    least = float(np.min(worst))
    if not np.any(fits):
        return _Attempt(least=least)
    first = int(np.argmax(fits))
    model = StrainDependent(int(counts[first]))
    slope = None if slopes is None else float(slopes[first])
    return _Attempt(Plan(model, str(samples.dtype), float(worst[first]), slope), least)


def _unmet(tolerance: float, gradient_tolerance: float | None, least: float) -> ValueError:
    """The error if no capacity is enough; `least`: the least error [m] of the tip."""
    most = _STEP_COUNTS[-1] * _CAPACITIES[-1] // _CAPACITIES[0]
    if least == np.inf:
        return ValueError(
            f"tolerance: got {tolerance:g} m, but the arm bends too fast along its length for "
            f"{most} steps"
        )
    if least <= _SHARE * tolerance:
        return ValueError(
            f"gradient_tolerance: got {gradient_tolerance:g}, which {most} steps do not meet, "
            f"need a larger one"
        )
    return ValueError(
        f"tolerance: got {tolerance:g} m, need at least {least / _SHARE:.2g} m, the best of up to "
        f"{most} steps"
    )


def _worst(errors: np.ndarray) -> np.ndarray:
    """Largest error over the samples, and over all numbers of steps from the given one up: a single
    small error may be a coincidence."""
    return np.maximum.accumulate(np.max(np.nan_to_num(errors, nan=np.inf), axis=0)[::-1])[::-1]


def _samples(scene: Scene, inputs_range: VectorLike | Sequence[VectorLike]) -> Array:
    """Corners of the range, all or a random selection, and random inputs between them."""
    size = len(scene.inputs)
    low, high = interval("inputs_range", inputs_range, size)
    scene.check_inputs(low)
    scene.check_inputs(high)
    random = np.random.default_rng(0)
    if 2**size <= _SAMPLES // 2:
        corners = np.array(list(product((0.0, 1.0), repeat=size)))
    else:
        corners = np.concatenate(
            [np.zeros((1, size)), np.ones((1, size)), random.integers(0, 2, (_SAMPLES // 2, size))]
        )
    between = random.uniform(size=(_SAMPLES - len(corners), size))
    share = jnp.asarray(np.concatenate([corners, between]), low.dtype)
    return low + share * (high - low)


def _rounding(scene: Scene, samples: Array, model: StrainDependent) -> float:
    """Largest distance [m] between the tips in single and in double precision; infinite if a solve
    fails in single precision only."""
    tips, rounded = (
        np.asarray(_tips(cast(scene, dtype), samples.astype(dtype), model))
        for dtype in (jnp.dtype("float64"), jnp.dtype("float32"))
    )
    solved = np.all(np.isfinite(tips), axis=1)
    return float(np.max(np.nan_to_num(np.linalg.norm(rounded - tips, axis=1)[solved], nan=np.inf)))


@program("plan")
def _tips(scene: Scene, samples: Array, model: StrainDependent) -> Array:
    return jax.vmap(lambda inputs: _tip_of(scene, inputs, model)[0])(samples)


class _Trial(StrainDependent):
    """Steps of which only the first `wanted` have a length."""

    wanted: Array

    def __init__(self, capacity: int, wanted: Array):
        super().__init__(capacity)
        self.wanted = wanted

    def grid(self, scene: Scene) -> Grid:
        return make_grid(scene.edges(), self.wanted, self.order // 2, room=self.steps)


def _tip_of(scene: Scene, inputs: Array, model: StrainDependent) -> tuple[Array, Array]:
    """Position of the tip, NaN where the solve failed, and the status."""
    scene = scene.at(inputs)
    outcome = model.solve(scene, inputs)
    sound = outcome.status == Status.CONVERGED
    tip = model.tip(scene, forces_where(sound, outcome.forces), outcome.state)[:3, 3]
    return jnp.where(sound, tip, jnp.nan), resolved(model, scene, outcome).status


@program("plan")
def _tip_errors(scene: Scene, samples: Array, steps: Array, capacity: int) -> tuple[Array, Array]:
    """Distance [m] of the tip from the reference, the solve with the last number of steps, for each
    sample and each other number; and the status of the reference."""

    def of(inputs: Array) -> tuple[Array, Array]:
        tips, status = jax.vmap(lambda wanted: _tip_of(scene, inputs, _Trial(capacity, wanted)))(
            steps
        )
        return jnp.linalg.norm(tips[:-1] - tips[-1], axis=1), status[-1]

    return lax.map(of, samples)


@program("plan")
def _gradient_errors(scene: Scene, samples: Array, steps: Array, capacity: int) -> Array:
    """Largest relative error of a derivative, for each sample and each number of steps except the
    last, the reference."""
    numbers_, rest = eqx.partition(scene, eqx.is_inexact_array)

    def of(inputs: Array) -> Array:
        def tip(values: Any, wanted: Array) -> Array:
            return _tip_of(eqx.combine(values[0], rest), values[1], _Trial(capacity, wanted))[0]

        values = numbers_, inputs
        slopes = jax.vmap(lambda wanted: jax.jacrev(tip)(values, wanted))(steps)
        slopes = jnp.concatenate(
            [leaf.reshape(steps.size, 3, -1) for leaf in jax.tree.leaves(slopes)], axis=2
        )
        return jax.vmap(lambda slope: gradient_error(slope, slopes[-1], values))(slopes[:-1])

    return lax.map(of, samples)


def gradient_error(slopes: Array, true: Array, values: Any) -> Array:
    r"""Largest relative error of the tip's derivatives, over the numbers p in `values` whose effect
    $|p| |\partial x / \partial p|$ is at least 1 % of the largest.

    **Arguments:** `slopes` and `true`, shape (3, numbers); `values`, a pytree of the numbers.
    """
    size = jnp.concatenate([jnp.abs(leaf).reshape(-1) for leaf in jax.tree.leaves(values)])
    length = jnp.linalg.norm(true, axis=0)
    counts = (size * length > 0) & (size * length >= _NOTICED * jnp.max(size * length))
    error = jnp.linalg.norm(slopes - true, axis=0) / jnp.where(counts, length, 1.0)
    return jnp.max(jnp.where(counts, error, 0.0))
