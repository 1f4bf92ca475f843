r"""Inverse statics: the inputs that bring an arm's tip, or points along it, to where they are
wanted.

With inputs $u = u_0 + (u_1 - u_0) s$ between their bounds, $0 \le s_i \le 1$, the shares s are
found that make

$$\sum_j |x_j(s) - x_j^*|^2 / L^2 + w^2 \sum_i (s_i - s_{0i})^2$$

least for a weight w that falls to nothing, where $s_0$ is the share at which an input is nearest to
nothing (see `box`). The second sum chooses the least effort among many solutions. The first start
is the nearest of some inputs that are tried out beforehand; the next nearest follow where it does
not lead to the target. Derivatives are those of the condition for the least sum.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..arm.scene import Scene
from ..models.base import Model
from ..numerics import bounded_least_squares
from ..numerics.component import norm, split
from ..numerics.se3 import rotation_vector
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import Scalar, cast
from ..validation import instance, interval, numbers, on_arm, positive, rigid

_TRIED, _STARTS = 512, 6
_ENOUGH = {"float64": 1e-6, "float32": 1e-3}
"""Miss, by the length, from which on no other start is tried: at one that is greater there may be a
nearer place elsewhere."""
_BESIDE = 0.1
"""Distance, by the diagonal of the box of shares, within which inputs tried out lead to the same
place."""


class Reach(NamedTuple):
    """What `reach` found.

    - `inputs`: one number an actuator.
    - `equilibrium`: the arm there.
    - `miss` [m]: distance of the points from where they are wanted, the root of the sum of squares;
      of a pose [m], with the angle [rad] times the arm's length.
    - `reached`: whether that is at most `allowed_miss`. If not, this is the nearest found.
    - `allowed_miss` [m]: miss that counts as reached.
    """

    inputs: Float[Array, " inputs"]
    equilibrium: Equilibrium
    miss: Scalar
    reached: Bool[Array, ""]
    allowed_miss: Scalar


def reach(
    scene: Scene,
    target: Any,
    bounds: Any,
    *,
    X: Any = None,
    model: Model | None = None,
    allowed_miss: float | None = None,
) -> Reach:
    """Inputs within bounds that bring the arm to a target, with the least effort among those that
    do.

    One target at a time; batch with `jax.vmap`. Derivatives of the inputs by the target and by the
    scene's numbers are implicit.

    **Arguments:**
    - `target`: place of the tip [m], shape (3,); its pose, a rigid transform of shape (4, 4); or
      with `X` the places of points of the axis, shape (points, 3). Its dtype is the precision.
    - `bounds`: the least and the greatest inputs, a pair of numbers or of arrays with one number an
      actuator.
    - `X`: abscissas [m] of the points on the arm, shape (points,).
    - `model`: as for `solve`.
    - `allowed_miss` [m]: miss that counts as reached; a ten-thousandth of the length, in single
      precision a thousandth. It decides on `reached` alone: the nearest is found as exactly with
      any.

    **Raises:** `ValueError` for shapes that do not fit, a pose that is no rigid transform, points
    beyond the arm, bounds that contradict each other or an actuator's range, and no actuators.
    """
    instance("scene", scene, Scene, "a Scene")
    wanted = numbers("target", target, None)
    places = None if X is None else numbers("X", X, None).astype(wanted.dtype)
    _check_target(wanted, places, scene)
    low, high = _check_bounds(scene, bounds, wanted.dtype)
    scene, model, places = cast((scene, model, places), wanted.dtype)
    share = 1e-4 if wanted.dtype == jnp.float64 else 1e-3
    allowed = (
        share * scene.rod.length
        if allowed_miss is None
        else jnp.asarray(positive("allowed_miss", allowed_miss), wanted.dtype)
    )
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
        return jnp.concatenate(
            [places[:3, 3] - self.target[:3, 3], self.scene.rod.length * rotation_vector(turn)]
        )

    def missed(self, share: Array) -> Array:
        """What is missed at a share of the way, by the arm's length."""
        return self.misses(self.places(self.at(share))) / self.scene.rod.length


def _check_target(target: Array, X: Array | None, scene: Scene) -> None:
    if X is None and target.shape not in ((3,), (4, 4)):
        raise ValueError(
            f"target: got shape {target.shape}, need (3,), a place, or (4, 4), a pose, or with X "
            f"(points, 3)"
        )
    if X is not None and (X.ndim != 1 or target.shape != (X.size, 3)):
        raise ValueError(
            f"X: got shape {X.shape} for targets of shape {target.shape}, need (points,) for "
            f"(points, 3)"
        )
    if target.shape == (4, 4):
        rigid("target", target)
    if X is not None:
        on_arm("X", X, scene.rod.length)


def _check_bounds(scene: Scene, bounds: Any, dtype: Any) -> tuple[Array, Array]:
    size = len(scene.actuators)
    if not size:
        raise ValueError("scene: got no actuators, need one at least")
    low, high = interval("bounds", bounds, size)
    scene.check_inputs(low)
    return low.astype(dtype), high.astype(dtype)


@eqx.filter_jit
def _reach(task: _Task, allowed: Scalar) -> Reach:
    tried = jnp.asarray(
        np.random.default_rng(0).uniform(size=(_TRIED, task.low.size)), task.low.dtype
    )
    tried = jnp.concatenate([task.idle[None], tried])
    places = jax.vmap(lambda share: task.places(task.at(share)))(
        tried
    )  # of the scene alone: under vmap over targets these are solved once
    distance = jax.vmap(lambda x: jnp.linalg.norm(task.misses(x)))(places)
    still = _still(task)
    enough = jnp.minimum(allowed / still.scene.rod.length, _ENOUGH[still.target.dtype.name])
    found = bounded_least_squares.nearest(
        still.missed, lax.stop_gradient(_starts(tried, distance)), still.idle, enough
    )
    share = _moving(task, found)
    there = task.at(share)
    miss = norm(split(task.misses(task.places(there))))
    miss = jnp.where(jnp.isfinite(miss), miss, jnp.inf)
    return Reach(task.inputs(share), there, miss, miss <= allowed, allowed)


def _starts(
    tried: Float[Array, "tried inputs"], distance: Float[Array, " tried"]
) -> Float[Array, "starts inputs"]:
    """The nearest, then the nearest of those that are not beside a start: the tip may pass by the
    target more than once."""
    distance, starts = jnp.where(jnp.isfinite(distance), distance, jnp.inf), []
    for _ in range(_STARTS):
        starts.append(tried[jnp.argmin(distance)])
        beside = jnp.linalg.norm(tried - starts[-1], axis=1) < _BESIDE * tried.shape[1] ** 0.5
        distance = jnp.where(beside, jnp.inf, distance)
    return jnp.stack(starts)


def _moving(task: _Task, found: bounded_least_squares.Nearest) -> Array:
    """The share found, with its derivatives: those of where the slope of the sum with the last
    weight is nothing."""

    def half(share: Array) -> Array:
        effort = bounded_least_squares.last_weight(share.dtype) * (share - task.idle)
        return (jnp.sum(task.missed(share) ** 2) + jnp.sum(effort**2)) / 2

    def slope(share: Array) -> Array:
        return jnp.where(found.free, jax.grad(half)(share), share - found.regular)

    def back(linear: Any, slope: Array) -> Array:
        return jnp.linalg.solve(jax.jacobian(linear)(slope), slope)

    root = lax.custom_root(slope, found.regular, lambda _, share: share, back)
    return found.share + root - lax.stop_gradient(root)


def _still(task: _Task) -> _Task:
    arrays, rest = eqx.partition(task, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(arrays), rest)
