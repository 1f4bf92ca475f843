r"""Inverse statics: inputs that bring an arm's tip, or points along the arm, to target positions.

$\min_s \sum_j |x_j(s) - x_j^*|^2 / L^2 + v^2 \sum_k \max(0, \epsilon - g_k(s))^2
+ w^2 \sum_i (s_i - s_{0i})^2, \quad u = u_0 + (u_1 - u_0) s, \quad 0 \le s_i \le 1$

for a weight w that decreases to zero (`bounded_least_squares`), with the margins $g_k \ge 0$ of
constraints. $s_0$ is the share at which an input is closest to its rest: zero for an actuator, the
scene's own value for a driven number. So the second sum selects the least effort among many
solutions. The first start is the nearest of 512 random inputs; further starts follow if it does not
reach the target. From a result for a target near by $s_0$ and the only start are its inputs.
Derivatives are those of the optimality condition.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..arm.scene import Scene
from ..models.base import Model
from ..numerics import bounded_least_squares
from ..numerics.compiling import messages, program
from ..numerics.component import norm, split
from ..numerics.se3 import rotation_vector
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import ArrayLike, DTypeLike, Pose, Scalar, cast
from ..validation import instance, instances, interval, is_traced, numbers, on_arm, positive, rigid
from .constraint import Constraint
from .margins import margins_of, shortfall, violation

_SAMPLES, _STARTS = 512, 6
"""Random inputs, and the starts chosen among them."""
_CLOSE_ENOUGH = {"float64": 1e-6, "float32": 1e-3}
"""Miss, relative to the length, below which no further start is used."""
_SAME_BASIN = 0.1
"""Distance, relative to the diagonal of the box of shares, within which inputs are assumed to lead
to the same minimum."""


class Reach(NamedTuple):
    """Result of `reach`; `print` it for a summary.

    - `inputs`: as for `solve`.
    - `equilibrium`: the arm for these inputs.
    - `miss` [m]: distance from the target; for several points the root of the sum of squares, for a
      pose with the angle [rad] times the arm's length.
    - `reached`: whether the miss is at most `allowed_miss` and all constraints hold; if not, this
      is the nearest found.
    - `allowed_miss` [m]: largest miss that counts as reached.
    - `violation`: largest violation of a constraint, dimensionless; 0 where all hold.
    """

    inputs: Float[Array, " inputs"]
    equilibrium: Equilibrium
    miss: Scalar
    reached: Bool[Array, ""]
    allowed_miss: Scalar
    violation: Scalar

    @property
    def tip(self) -> Pose:
        """Pose of the tip for these inputs, shape (4, 4)."""
        return self.equilibrium.tip

    def __str__(self) -> str:
        numbers = (self.inputs, self.miss, self.reached, self.allowed_miss, self.violation)
        if not all(eqx.is_array_like(x) and not is_traced(x) for x in numbers):
            return f"Reach(inputs={self.inputs}, miss={self.miss})"
        if self.inputs.ndim > 1:
            worst = float(np.max(np.asarray(self.miss)))
            reached = int(np.sum(np.asarray(self.reached)))
            return f"{reached} of {self.reached.size} targets reached, largest miss {worst:.2g} m"
        verdict = (
            "within the"
            if bool(self.miss <= self.allowed_miss)
            else "out of reach, this is the nearest point found: more than the"
        )
        violated = (
            f"\nviolation  {float(self.violation):.2g}, the constraints do not hold"
            if bool(self.violation > 0)
            else ""
        )
        return (
            f"inputs     {', '.join(f'{value:.6g}' for value in np.asarray(self.inputs))}\n"
            f"miss       {float(self.miss):.2g} m, {verdict} {float(self.allowed_miss):.2g} m "
            f"allowed{violated}"
        )

    __repr__ = __str__


def reach(
    scene: Scene,
    target: ArrayLike,
    bounds: Sequence[ArrayLike],
    *,
    X: ArrayLike | None = None,
    constraints: Sequence[Constraint] = (),
    model: Model | None = None,
    allowed_miss: float | None = None,
    start: Reach | None = None,
    progress: bool = True,
) -> Reach:
    """Inputs within bounds that bring the arm to a target, with the least effort among all that do.

    One target at a time; batch with `jax.vmap`. Derivatives of the inputs with respect to the
    target and the numbers of the scene and the constraints are implicit.

    **Arguments:**
    - `target`: position of the tip [m], shape (3,); its pose, a rigid transform of shape (4, 4); or
      with `X` the positions of points on the axis, shape (points, 3). Its dtype is the precision.
    - `bounds`: least and greatest inputs, a pair of numbers or of arrays with one number per input.
    - `X`: abscissas [m] of the points on the arm, shape (points,).
    - `constraints`: what must hold besides, of `vsr_jax.constraint`, for example
      `Clearance(0.002, obstacles)`.
    - `model`: as for `solve`.
    - `allowed_miss` [m]: largest miss that counts as reached; by default 1e-4 of the length, in
      single precision 1e-3. It only affects `reached`; the inputs are those of the nearest point in
      any case.
    - `start`: the result for a target near by, as in a control loop. The inputs then change as
      little as they can, in place of the least effort; no other start is tried, and each solve
      begins with the equilibrium of the start and stays in its branch. No derivative is taken with
      respect to it.
    - `progress`: whether to say on stderr that the program compiles, if that takes more than three
      seconds.

    **Returns:** a `Reach`.

    **Raises:** `ValueError` for wrong shapes, a pose that is not a rigid transform, points beyond
    the arm, bounds that contradict each other or an actuator's range, a scene without actuators,
    other constraints, and a start with other actuators.
    """
    instance("scene", scene, Scene, "a Scene")
    aim = numbers("target", target, None)
    stations = None if X is None else numbers("X", X, None).astype(aim.dtype)
    _check_target(aim, stations, scene)
    low, high = _check_bounds(scene, bounds, aim.dtype)
    kept = instances("constraints", constraints, Constraint, "a Constraint")
    scene, model, stations, kept = cast((scene, model, stations, kept), aim.dtype)
    share = 1e-4 if aim.dtype == jnp.float64 else 1e-3
    allowed = (
        share * scene.rod.length
        if allowed_miss is None
        else jnp.asarray(positive("allowed_miss", allowed_miss), aim.dtype)
    )
    if start is not None:
        start = lax.stop_gradient(cast(_check_start(start, low), aim.dtype))
    problem = _ReachProblem(scene, aim, stations, low, high, kept, model, start)
    with messages(progress):
        return _reach(problem, allowed)


class _ReachProblem(NamedTuple):
    """Target, bounds and model; `X` is None for the tip; `start`, a result near by, if any."""

    scene: Scene
    target: Array
    X: Array | None
    low: Array
    high: Array
    constraints: tuple[Constraint, ...]
    model: Model | None
    start: Reach | None

    def inputs(self, share: Array) -> Array:
        """Inputs at shares of the range between their bounds."""
        return jnp.minimum(self.low + (self.high - self.low) * share, self.high)

    @property
    def idle(self) -> Array:
        """Share at which each input is closest to its rest, or to that of the start."""
        span = jnp.where(self.high > self.low, self.high - self.low, 1.0)
        rest = self.scene.rest_inputs if self.start is None else self.start.inputs
        return (jnp.clip(rest, self.low, self.high) - self.low) / span

    def at(self, share: Array) -> Equilibrium:
        """Equilibrium for inputs at shares of the range."""
        near = None if self.start is None else self.start.equilibrium
        return solve(self.scene, self.inputs(share), model=self.model, start=near)

    def places(self, eq: Equilibrium) -> Array:
        """What the target prescribes: pose of the tip, its position, or positions of the points."""
        if self.X is not None:
            return eq.position(self.X)
        return eq.tip if self.target.shape == (4, 4) else eq.tip[:3, 3]

    def misses(self, places: Array) -> Array:
        """Differences from the target [m], shape (differences,)."""
        if self.target.shape != (4, 4):
            return (places - self.target).reshape(-1)
        turn = self.target[:3, :3].T @ places[:3, :3]
        return jnp.concatenate(
            [places[:3, 3] - self.target[:3, 3], self.scene.rod.length * rotation_vector(turn)]
        )

    def seen(self, share: Array) -> tuple[Array, Array | None]:
        """What the residual depends on, at shares of the range: places and margins."""
        eq = self.at(share)
        return self.places(eq), margins_of(self.constraints, eq) if self.constraints else None

    def residual_of(self, places: Array, margins: Array | None) -> Array:
        """Differences from the target relative to the arm's length, and what the margins lack."""
        misses = self.misses(places) / self.scene.rod.length
        if margins is None:
            return misses
        return jnp.concatenate([misses, shortfall(margins)])

    def residual(self, share: Array) -> Array:
        """Residual at shares of the range."""
        return self.residual_of(*self.seen(share))


def _check_target(target: Array, X: Array | None, scene: Scene) -> None:
    if X is None and target.shape not in ((3,), (4, 4)):
        raise ValueError(
            f"target: got shape {target.shape}, need (3,), a position, or (4, 4), a pose, or with "
            f"X (points, 3)"
        )
    if X is not None and (X.ndim != 1 or target.shape != (X.size, 3)):
        raise ValueError(
            f"X: got shape {X.shape} for targets of shape {target.shape}, need (points,) for "
            f"(points, 3)"
        )
    if target.shape == (4, 4):
        rigid("target", target)
    if X is not None:
        on_arm("X", X, scene.greatest_length)


def _check_bounds(
    scene: Scene, bounds: Sequence[ArrayLike], dtype: DTypeLike
) -> tuple[Array, Array]:
    size = len(scene.inputs)
    if not size:
        raise ValueError("scene: got no actuators, need at least one")
    low, high = interval("bounds", bounds, size)
    scene.check_inputs(low)
    scene.check_inputs(high)
    return low.astype(dtype), high.astype(dtype)


def _check_start(start: Reach, low: Array) -> Reach:
    instance("start", start, Reach, "a Reach, the result for another target")
    if start.inputs.shape != low.shape:
        raise ValueError(
            f"start: got inputs of shape {start.inputs.shape}, need {low.shape}, one per actuator; "
            f"use jax.vmap for a batch"
        )
    return start


@program("reach")
def _reach(problem: _ReachProblem, allowed: Scalar) -> Reach:
    still = _still(problem)
    enough = jnp.minimum(allowed / still.scene.rod.length, _CLOSE_ENOUGH[still.target.dtype.name])
    starts = _starts(problem) if problem.start is None else still.idle[None]
    found = bounded_least_squares.nearest(
        still.residual, lax.stop_gradient(starts), still.idle, enough
    )
    share = _moving(problem, found)
    there = problem.at(share)
    miss = norm(split(problem.misses(problem.places(there))))
    miss = jnp.where(jnp.isfinite(miss), miss, jnp.inf)
    violated = jnp.zeros_like(miss)
    if problem.constraints:
        violated = violation(margins_of(problem.constraints, there))
    reached = (miss <= allowed) & (violated <= 0)
    return Reach(problem.inputs(share), there, miss, reached, allowed, violated)


def _starts(problem: _ReachProblem) -> Float[Array, "starts inputs"]:
    """The nearest of random inputs, then repeatedly the nearest of those that are not close to a
    start already chosen: there may be several minima."""
    tried = jnp.asarray(
        np.random.default_rng(0).uniform(size=(_SAMPLES, problem.low.size)), problem.low.dtype
    )
    tried = jnp.concatenate([problem.idle[None], tried])
    # independent of the target: under vmap over targets solved once
    seen = jax.vmap(problem.seen)(tried)
    distance = jax.vmap(lambda *x: jnp.linalg.norm(problem.residual_of(*x)))(*seen)
    distance, starts = jnp.where(jnp.isfinite(distance), distance, jnp.inf), []
    for _ in range(_STARTS):
        starts.append(tried[jnp.argmin(distance)])
        beside = jnp.linalg.norm(tried - starts[-1], axis=1) < _SAME_BASIN * tried.shape[1] ** 0.5
        distance = jnp.where(beside, jnp.inf, distance)
    return jnp.stack(starts)


def _moving(problem: _ReachProblem, found: bounded_least_squares.Nearest) -> Array:
    """The shares found, with the derivatives of the stationary point for the last weight."""

    def half(share: Array) -> Array:
        effort = bounded_least_squares.last_weight(share.dtype) * (share - problem.idle)
        return (jnp.sum(problem.residual(share) ** 2) + jnp.sum(effort**2)) / 2

    def slope(share: Array) -> Array:
        return jnp.where(found.free, jax.grad(half)(share), share - found.regular)

    def back(linear: Callable[[Array], Array], slope: Array) -> Array:
        return jnp.linalg.solve(jax.jacobian(linear)(slope), slope)

    root = lax.custom_root(slope, found.regular, lambda _, share: share, back)
    return found.share + root - lax.stop_gradient(root)


def _still(problem: _ReachProblem) -> _ReachProblem:
    arrays, rest = eqx.partition(problem, eqx.is_inexact_array)
    return eqx.combine(lax.stop_gradient(arrays), rest)
