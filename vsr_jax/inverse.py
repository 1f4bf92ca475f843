r"""Inverse statics: the inputs that bring an arm's tip, or points along it, to where they are wanted.

With inputs $u = u_0 + (u_1 - u_0) \sin^2(z / 2)$ between their bounds, z is found that makes

$$\sum_j |x_j(z) - x_j^*|^2 / L^2 + w^2 \sum_i (\sin^2(z_i / 2) - s_i)^2$$

least, where $s_i$ is the share at which the input is nearest to nothing: by damped Gauss-Newton steps (optimistix's dogleg
within a trust region), for a weight w that falls to that of rounding. The second sum chooses the least effort among many
solutions. The first start is the nearest of some inputs that are tried out beforehand; the next nearest follow where it does not
lead to the target.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import lax
from jaxtyping import Array, Bool, Float

from . import bounded
from ._check import instance, interval, numbers, positive
from ._types import Scalar, cast
from .equilibrium import Equilibrium
from .model import Model
from .scene import Scene
from .se3 import rotation_vector
from .solve import solve

_TRIED, _STARTS, _STEPS = 512, 6, 40
_WEIGHTS = (0.25, 0.5, 0.9)
"""Exponents of the machine's epsilon that give w."""
_LAST_STEPS, _BESIDE = 200, 0.1
_LOST = 10.0
_RADIUS = 0.1
"""First radius of the trust region, in z. Near a bound, where z hardly moves the input, a whole Newton step would lead round it."""


class Reach(NamedTuple):
    """What `reach` found.

    - `inputs`: one number an actuator.
    - `equilibrium`: the arm there.
    - `miss` [m]: distance of the points from where they are wanted, the root of the sum of squares; of a pose [m], with the angle
      [rad] times the arm's length.
    - `reached`: whether that is within the tolerance. If not, this is the nearest found.
    """

    inputs: Float[Array, " inputs"]
    equilibrium: Equilibrium
    miss: Scalar
    reached: Bool[Array, ""]


def reach(scene: Scene, target: Any, bounds: Any, *, X: Any = None, model: Model | None = None, tolerance: float | None = None) -> Reach:
    """Inputs within bounds that bring the arm to a target, with the least effort among those that do.

    One target at a time; batch with `jax.vmap`. Derivatives of the inputs by the target and by the scene's numbers are implicit.

    **Arguments:**
    - `target`: place of the tip [m], shape (3,); its pose, shape (4, 4); or with `X` the places of points of the axis, shape
      (points, 3). Its dtype is the precision.
    - `bounds`: the least and the greatest inputs, a pair of numbers or of arrays with one number an actuator.
    - `X`: abscissas [m] of the points, shape (points,).
    - `model`: as for `solve`.
    - `tolerance` [m]: miss that counts as reached; a millionth of the length, in single precision a thousandth.

    **Raises:** `ValueError` for shapes that do not fit, bounds that contradict each other or an actuator's range, and no actuators.
    """
    instance("scene", scene, Scene, "a Scene")
    wanted = numbers("target", target, None)
    places = None if X is None else numbers("X", X, None).astype(wanted.dtype)
    _check_shapes(wanted, places)
    low, high = _check_bounds(scene, bounds, wanted.dtype)
    scene, model, places = cast((scene, model, places), wanted.dtype)
    share = 1e-6 if wanted.dtype == jnp.float64 else 1e-3
    allowed = share * scene.rod.length if tolerance is None else jnp.asarray(positive("tolerance", tolerance), wanted.dtype)
    return _reach(_Task(scene, wanted, places, low, high, model), allowed)


class _Task(NamedTuple):
    """What is to be reached: `X` is None for the tip."""

    scene: Scene
    target: Array
    X: Array | None
    low: Array
    high: Array
    model: Model | None

    def inputs(self, share: Array) -> Array:
        """Inputs at a share of the way between their bounds."""
        return self.low + (self.high - self.low) * share

    @property
    def idle(self) -> Array:
        """Share at which each input is nearest to nothing."""
        span = jnp.where(self.high > self.low, self.high - self.low, 1.0)
        return (jnp.clip(jnp.zeros_like(self.low), self.low, self.high) - self.low) / span

    def at(self, share: Array) -> Equilibrium:
        """The arm at a share of the way between the bounds."""
        return solve(self.scene, self.inputs(share), model=self.model)

    def places(self, eq: Equilibrium) -> Array:
        """Pose of the tip, its place, or those of the points."""
        if self.X is not None:
            return eq.position(self.X)
        return eq.tip if self.target.shape == (4, 4) else eq.tip[:3, 3]

    def misses(self, places: Array) -> Array:
        """What is missed [m], in a row."""
        if self.target.shape != (4, 4):
            return (places - self.target).reshape(-1)
        turn = self.target[:3, :3].T @ places[:3, :3]
        return jnp.concatenate([places[:3, 3] - self.target[:3, 3], self.scene.rod.length * rotation_vector(turn)])


def _check_shapes(target: Array, X: Array | None) -> None:
    if X is None and target.shape not in ((3,), (4, 4)):
        raise ValueError(f"target: got shape {target.shape}, need (3,), a place, or (4, 4), a pose, or with X (points, 3)")
    if X is not None and (X.ndim != 1 or target.shape != (X.size, 3)):
        raise ValueError(f"X: got shape {X.shape} for targets of shape {target.shape}, need (points,) for (points, 3)")


def _check_bounds(scene: Scene, bounds: Any, dtype: Any) -> tuple[Array, Array]:
    size = len(scene.actuators)
    if not size:
        raise ValueError("scene: got no actuators, need one at least")
    low, high = interval("bounds", bounds, size)
    scene.check_inputs(low)
    return low.astype(dtype), high.astype(dtype)


@eqx.filter_jit
def _reach(task: _Task, allowed: Scalar) -> Reach:
    tried = jnp.asarray(np.random.default_rng(0).uniform(size=(_TRIED, task.low.size)), task.low.dtype)
    tried = jnp.concatenate([task.idle[None], tried])
    places = jax.vmap(lambda share: task.places(task.at(share)))(tried)  # of the scene alone: under vmap over targets these are solved once
    distance = jax.vmap(lambda x: jnp.linalg.norm(task.misses(x)))(places)
    share = _last(task, _searched(_still(task), lax.stop_gradient(_starts(tried, distance)), allowed))
    found = task.at(share)
    miss = jnp.linalg.norm(task.misses(task.places(found)))
    miss = jnp.where(jnp.isfinite(miss), miss, jnp.inf)
    return Reach(task.inputs(share), found, miss, miss <= allowed)


def _starts(tried: Float[Array, "tried inputs"], distance: Float[Array, " tried"]) -> Float[Array, "starts inputs"]:
    """The nearest, then the nearest of those that are not beside a start: the tip may pass by the target more than once."""
    distance, starts = jnp.where(jnp.isfinite(distance), distance, jnp.inf), []
    for _ in range(_STARTS):
        starts.append(tried[jnp.argmin(distance)])
        beside = jnp.linalg.norm(tried - starts[-1], axis=1) < _BESIDE * tried.shape[1] ** 0.5
        distance = jnp.where(beside, jnp.inf, distance)
    return jnp.stack(starts)


def _searched(task: _Task, starts: Float[Array, "starts inputs"], allowed: Scalar) -> Array:
    """Share of the range from the first start that leads there, or else from the one that leads nearest. Without derivatives."""

    def pending(state: tuple[Array, Array, Array]) -> Array:
        number, _, miss = state
        return (number < len(starts)) & (miss > allowed)

    def attempt(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        number, share, miss = state
        new = _descend(task, starts[number])
        there = jnp.linalg.norm(task.misses(task.places(task.at(new))))
        nearer = there < miss
        return number + 1, jnp.where(nearer, new, share), jnp.where(nearer, there, miss)

    _, share, _ = lax.while_loop(pending, attempt, (jnp.array(0), starts[0], jnp.full_like(allowed, jnp.inf)))
    return share


def _descend(task: _Task, share: Array) -> Array:
    """Share of the range at the least sum of squares, from a start, for one weight after another."""

    def stage(z: Array, weight: Array) -> tuple[Array, None]:
        return _least(task, z, weight, _STEPS), None

    weights = jnp.asarray([jnp.finfo(share.dtype).eps ** power for power in _WEIGHTS], share.dtype)
    return bounded.share(lax.scan(stage, bounded.at_share(share), weights)[0])


def _last(task: _Task, share: Array) -> Array:
    """The same share, with its derivatives: of the sum of squares with the last weight."""
    z = 2 * jnp.arcsin(jnp.sqrt(share))
    return bounded.share(_least(task, z, jnp.asarray(jnp.finfo(share.dtype).eps ** _WEIGHTS[-1], share.dtype), _LAST_STEPS))


def _least(task: _Task, z: Array, weight: Array, steps: int) -> Array:
    """Where the sum of squares is least, near z."""
    eps = float(jnp.finfo(z.dtype).eps)
    numbers_, rest = eqx.partition(task, eqx.is_inexact_array)
    solver = optimistix.Dogleg(rtol=eps**0.7, atol=eps**1.4)  # also of the sum, which is a square

    def residual(y: Array, args: tuple[Any, Array]) -> Array:
        here = eqx.combine(args[0], rest)
        part = bounded.share(_RADIUS * y)
        missed = here.misses(here.places(here.at(part))) / here.scene.rod.length
        return jnp.concatenate([jnp.where(jnp.isfinite(missed), missed, _LOST), args[1] * (part - here.idle)])

    found = optimistix.least_squares(residual, solver, z / _RADIUS, (numbers_, weight), max_steps=steps, throw=False)
    return _RADIUS * found.value


def _still(task: _Task) -> _Task:
    arrays, rest = eqx.partition(task, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(arrays), rest)
