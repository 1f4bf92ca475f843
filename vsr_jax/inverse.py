r"""Inverse statics: the inputs that bring an arm's tip, or points along it, to where they are wanted.

With inputs $u = u_0 + (u_1 - u_0) \sin^2(z / 2)$ between their bounds, z is found that makes

$$\sum_j |x_j(z) - x_j^*|^2 / L^2 + w^2 \sum_i (\sin^2(z_i / 2) - s_i)^2$$

least, where $s_i$ is the share at which the input is nearest to nothing: by damped Gauss-Newton steps (Levenberg-Marquardt of
optimistix), for a weight w that falls to that of rounding. The second sum chooses the least effort among many solutions. The starts
are the nearest of some inputs that are tried out first.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jax import lax
from jaxtyping import Array, Bool, Float

from ._check import instance, is_traced, numbers, positive
from ._types import Scalar, cast
from .equilibrium import Equilibrium
from .model import Model
from .scene import Scene
from .solve import solve

_TRIED, _STARTS, _STEPS = 512, 6, 40
_WEIGHTS = (0.25, 0.5, 0.9)
"""Exponents of the machine's epsilon that give w."""
_LOST = 10.0
_INSIDE = 0.01


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
        return jnp.concatenate([places[:3, 3] - self.target[:3, 3], self.scene.rod.length * _angles(turn)])


def _angles(turn: Array) -> Array:
    """Rotation vector [rad] of a rotation matrix, smooth at the identity; at half a turn its length is right, its sign is not sure."""
    axis = 0.5 * jnp.stack([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    square = jnp.dot(axis, axis)
    small = square < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    angle = jnp.arctan2(sine, (jnp.trace(turn) - 1) / 2)
    near = jnp.trace(turn) > 1
    return jnp.where(small & near, 1 + square / 6, angle / sine) * axis


def _check_shapes(target: Array, X: Array | None) -> None:
    if X is None and target.shape not in ((3,), (4, 4)):
        raise ValueError(f"target: got shape {target.shape}, need (3,), a place, or (4, 4), a pose, or with X (points, 3)")
    if X is not None and (X.ndim != 1 or target.shape != (X.size, 3)):
        raise ValueError(f"X: got shape {X.shape} for targets of shape {target.shape}, need (points,) for (points, 3)")


def _check_bounds(scene: Scene, bounds: Any, dtype: Any) -> tuple[Array, Array]:
    size = len(scene.actuators)
    if not size:
        raise ValueError("scene: got no actuators, need one at least")
    if not isinstance(bounds, tuple | list) or len(bounds) != 2:
        raise ValueError(f"bounds: got {bounds!r}, need a pair, the least and the greatest inputs")
    pair = []
    for i, bound in enumerate(bounds):
        array = numbers(f"bounds[{i}]", bound, None)
        if array.shape not in ((), (size,)):
            raise ValueError(f"bounds[{i}]: got shape {array.shape}, need one number or {size}, one an actuator")
        pair.append(jnp.broadcast_to(array, (size,)).astype(dtype))
    low, high = pair
    if is_traced(low) or is_traced(high):
        return low, high
    if np.any(np.asarray(low) > np.asarray(high)):
        raise ValueError(f"bounds: got {np.asarray(low)} to {np.asarray(high)}, need the least inputs first")
    scene.check_inputs(low)
    return low, high


@eqx.filter_jit
def _reach(task: _Task, allowed: Scalar) -> Reach:
    size = task.low.size
    tried = jnp.asarray(np.random.default_rng(0).uniform(size=(_TRIED, size)), task.low.dtype)
    tried = jnp.concatenate([task.idle[None], tried])
    places = jax.vmap(lambda share: task.places(task.at(share)))(tried)  # of the scene alone: under vmap over targets these are solved once
    distance = jax.vmap(lambda x: jnp.linalg.norm(task.misses(x)))(places)
    nearest = jnp.argsort(jnp.where(jnp.isfinite(distance), distance, jnp.inf))[:_STARTS]
    shares = jax.vmap(lambda share: _descend(task, share))(tried[nearest])
    effort = jnp.sum((shares - task.idle) ** 2, axis=1)
    found = jax.vmap(task.at)(shares)
    misses = jax.vmap(lambda eq: jnp.linalg.norm(task.misses(task.places(eq))))(found)
    misses = jnp.where(jnp.isfinite(misses), misses, jnp.inf)
    there = misses <= allowed
    best = jnp.where(jnp.any(there), jnp.argmin(jnp.where(there, effort, jnp.inf)), jnp.argmin(misses))
    arrays, rest = eqx.partition(found, eqx.is_array)
    chosen = eqx.combine(jax.tree.map(lambda x: x[best], arrays), rest)
    return Reach(task.inputs(shares[best]), chosen, misses[best], there[best])


def _descend(task: _Task, share: Array) -> Array:
    """Share of the range at the least sum of squares, from a start."""
    eps = float(jnp.finfo(share.dtype).eps)
    numbers_, rest = eqx.partition(task, eqx.is_inexact_array)
    solver = optimistix.Dogleg(rtol=eps**0.7, atol=eps**0.7)

    def residual(z: Array, args: tuple[Any, Array]) -> Array:
        here = eqx.combine(args[0], rest)
        part = jnp.sin(z / 2) ** 2
        missed = here.misses(here.places(here.at(part))) / here.scene.rod.length
        return jnp.concatenate([jnp.where(jnp.isfinite(missed), missed, _LOST), args[1] * (part - here.idle)])

    def stage(z: Array, weight: Array) -> tuple[Array, None]:
        found = optimistix.least_squares(residual, solver, z, (numbers_, weight), max_steps=_STEPS, throw=False)
        return found.value, None

    start = 2 * jnp.arcsin(jnp.sqrt(jnp.clip(share, _INSIDE, 1 - _INSIDE)))
    weights = jnp.asarray([eps**power for power in _WEIGHTS], share.dtype)
    z, _ = lax.scan(stage, start, weights)
    return jnp.sin(z / 2) ** 2
