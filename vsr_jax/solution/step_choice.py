r"""How many steps a tolerance takes: tried out on the scene itself, all numbers of steps in one
compiled program.

The steps are of order 6. A grid with room for many of them leaves those empty that are not wanted,
so their number may be traced. The reference of each trial is the same arm with as many steps as
there is room for; where these are not enough, there is room for four times as many in the next.
"""

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
from ..numerics.quadrature import Grid, make_grid
from ..typing import cast
from ..validation import instance, interval, is_traced, positive

_ROOMS = (64, 256, 1024)
_LADDER = (
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    9,
    10,
    11,
    12,
    13,
    14,
    15,
    16,
    18,
    20,
    22,
    24,
    26,
    28,
    32,
    36,
    40,
    44,
    48,
)
"""Numbers of steps that are tried where there is room for 64; with more room they grow alike."""

_SHARE = 0.5
"""Share of a tolerance that the samples may take up: other inputs may ask for more."""

_SAMPLES = 16
_NOTICED = 0.01
_ROUNDED = 1e-5
"""Tolerance, as a share of the length, below which single precision is not tried."""


class Plan(NamedTuple):
    """What `plan` chose.

    - `model`: for `solve(..., model=plan.model)`; static, so that it goes through `jax.jit`,
      `jax.vmap` and `jax.grad`.
    - `dtype`: "float32" or "float64", the least precision that will do: give the inputs in it.
      Single precision is tried where the inputs are double, and only if no gradient tolerance is
      asked for.
    - `error` [m]: the largest error of the tip's place that was found for it.
    - `gradient_error`: the largest relative error of a derivative of the tip's place, None where
      none was asked for.
    """

    model: StrainDependent
    dtype: str
    error: float
    gradient_error: float | None


def plan(
    scene: Scene, tolerance: float, inputs_range: Any, *, gradient_tolerance: float | None = None
) -> Plan:
    """The fewest steps with which the tip's place holds to `tolerance` for inputs within a range.

    They are tried out on the corners of the range and between them, up to 16 samples in all, and
    meet half the tolerance there. Samples without a stable equilibrium do not count.

    **Arguments:**
    - `scene`: with known numbers; a plan holds for scenes near it too.
    - `tolerance` [m]: of the tip's place.
    - `inputs_range`: the least and the greatest inputs, a pair of numbers or of arrays with one
      number an actuator. Their dtype is the precision.
    - `gradient_tolerance`: the relative error that the derivatives of the tip's place by the
      scene's numbers and by the inputs may have. Those by a number p that is zero, or with an
      effect $|p| |\\partial x / \\partial p|$ below a hundredth of the greatest, do not count.

    **Raises:** `ValueError` for arguments that make no sense, for a tolerance that 768 steps do not
    meet or that is beyond the precision, and where no sample has a stable equilibrium.
    """
    instance("scene", scene, Scene, "a Scene")
    tolerance = positive("tolerance", tolerance)
    if gradient_tolerance is not None:
        gradient_tolerance = positive("gradient_tolerance", gradient_tolerance)
    if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, inputs_range))):
        raise ValueError(
            "scene, inputs_range: got numbers that are traced, need known ones: make the plan "
            "before jax.jit"
        )
    samples = _samples(scene, inputs_range)
    chosen = choose(scene, tolerance, samples, gradient_tolerance)
    if chosen is None:
        raise ValueError(
            "inputs_range: got no sample that has a stable equilibrium, need a range with some; "
            "solve one to see why"
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
    """The plan for some samples of inputs, shape (samples, inputs); None where none of them has an
    equilibrium."""
    if any(is_traced(leaf) for leaf in jax.tree.leaves((scene, samples))):
        raise ValueError(
            "tolerance: got a scene or inputs that are traced, need known numbers; under jax.jit "
            "use a vsr.plan made before"
        )
    scene, least, most = cast(scene, samples.dtype), np.inf, _LADDER[-1] * _ROOMS[-1] // _ROOMS[0]
    for room in _ROOMS:
        ladder = np.array(_LADDER) * (room // _ROOMS[0])
        trial = scene, samples, jnp.append(jnp.asarray(ladder), room)
        errors, status = (np.asarray(x) for x in _tip_errors(*trial, room))
        if np.any(status == Status.UNDER_RESOLVED):
            continue
        solved = status == Status.CONVERGED
        if not np.any(solved):
            return None
        worst, slopes = _worst(errors[solved]), None
        least = min(least, float(np.min(worst)))
        fits = worst <= _SHARE * tolerance
        if gradient_tolerance is not None and np.any(fits):
            slopes = _worst(np.asarray(_gradient_errors(*trial, room))[solved])
            fits &= slopes <= _SHARE * gradient_tolerance
        if np.any(fits):
            first = int(np.argmax(fits))
            slope = None if slopes is None else float(slopes[first])
            return Plan(
                StrainDependent(int(ladder[first])), str(samples.dtype), float(worst[first]), slope
            )
    if least == np.inf:
        raise ValueError(
            f"tolerance: got {tolerance:g} m, but the arm bends too fast along its length for "
            f"{most} steps"
        )
    if least <= _SHARE * tolerance:
        raise ValueError(
            f"gradient_tolerance: got {gradient_tolerance:g}, which {most} steps do not meet, "
            f"need a greater one"
        )
    raise ValueError(
        f"tolerance: got {tolerance:g} m, need at least {least / _SHARE:.2g} m, the best of up to "
        f"{most} steps"
    )


def _worst(errors: np.ndarray) -> np.ndarray:
    """Largest error over the samples for each number of steps, and for all greater numbers: chance
    finds small errors too."""
    return np.maximum.accumulate(np.max(np.nan_to_num(errors, nan=np.inf), axis=0)[::-1])[::-1]


def _samples(scene: Scene, inputs_range: Any) -> Array:
    """Corners of the range, as many as there is room for, and inputs between them."""
    size = len(scene.actuators)
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
    """Greatest distance [m] of the tip in single precision from that in double; infinite where a
    solve is lost."""
    tips, rounded = (
        np.asarray(_tips(cast(scene, dtype), samples.astype(dtype), model))
        for dtype in (jnp.dtype("float64"), jnp.dtype("float32"))
    )
    solved = np.all(np.isfinite(tips), axis=1)
    return float(np.max(np.nan_to_num(np.linalg.norm(rounded - tips, axis=1)[solved], nan=np.inf)))


@eqx.filter_jit
def _tips(scene: Scene, samples: Array, model: StrainDependent) -> Array:
    return jax.vmap(lambda inputs: _tip_of(scene, inputs, model)[0])(samples)


class _Trial(StrainDependent):
    """Steps of which only the first `wanted` are not empty."""

    wanted: Array

    def __init__(self, room: int, wanted: Array):
        super().__init__(room)
        self.wanted = wanted

    def grid(self, scene: Scene) -> Grid:
        return make_grid(scene.edges(), self.wanted, self.order // 2, room=self.steps)


def _tip_of(scene: Scene, inputs: Array, model: StrainDependent) -> tuple[Array, Array]:
    """Place of the tip, NaN where the solve failed, and the status."""
    outcome = model.solve(scene, inputs)
    sound = outcome.status == Status.CONVERGED
    tip = model.tip(scene, forces_where(sound, outcome.forces), outcome.state)[:3, 3]
    return jnp.where(sound, tip, jnp.nan), resolved(model, scene, outcome).status


@eqx.filter_jit
def _tip_errors(scene: Scene, samples: Array, steps: Array, room: int) -> tuple[Array, Array]:
    """Distance [m] of the tip from that of the last number of steps, for each sample and each other
    number; and the status of the last."""

    def of(inputs: Array) -> tuple[Array, Array]:
        tips, status = jax.vmap(lambda wanted: _tip_of(scene, inputs, _Trial(room, wanted)))(steps)
        return jnp.linalg.norm(tips[:-1] - tips[-1], axis=1), status[-1]

    return lax.map(of, samples)


@eqx.filter_jit
def _gradient_errors(scene: Scene, samples: Array, steps: Array, room: int) -> Array:
    """Largest relative error of a derivative, for each sample and each number of steps but the
    last, which is the reference."""
    numbers_, rest = eqx.partition(scene, eqx.is_inexact_array)

    def of(inputs: Array) -> Array:
        def tip(values: Any, wanted: Array) -> Array:
            return _tip_of(eqx.combine(values[0], rest), values[1], _Trial(room, wanted))[0]

        values = numbers_, inputs
        slopes = jax.vmap(lambda wanted: jax.jacrev(tip)(values, wanted))(steps)
        slopes = jnp.concatenate(
            [leaf.reshape(steps.size, 3, -1) for leaf in jax.tree.leaves(slopes)], axis=2
        )
        return jax.vmap(lambda slope: gradient_error(slope, slopes[-1], values))(slopes[:-1])

    return lax.map(of, samples)


def gradient_error(slopes: Array, true: Array, values: Any) -> Array:
    r"""Largest relative error of the tip's derivatives, over the numbers p in `values` whose effect
    $|p| |\partial x / \partial p|$ is a hundredth of the greatest or more; both of shape (3,
    numbers)."""
    size = jnp.concatenate([jnp.abs(leaf).reshape(-1) for leaf in jax.tree.leaves(values)])
    length = jnp.linalg.norm(true, axis=0)
    counts = (size * length > 0) & (size * length >= _NOTICED * jnp.max(size * length))
    error = jnp.linalg.norm(slopes - true, axis=0) / jnp.where(counts, length, 1.0)
    return jnp.max(jnp.where(counts, error, 0.0))
