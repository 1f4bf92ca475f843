r"""`find_path`: a path of inputs on which constraints hold, such as a distance to obstacles.

The path is a Bézier curve with the control points $c_i$, whose ends are given,

$u(t) = \sum_{i=0}^n \binom{n}{i} t^i (1 - t)^{n - i} c_i, \quad 0 \le t \le 1.$

Of the paths with margins $g_k(u(t_j)) \ge 0$ at all samples $t_j$ it is to be close to the straight
line, whose control points $\bar c_i$ are evenly spaced:

$\min_c v^2 \sum_{jk} \max(0, \epsilon - g_k(u(t_j)))^2 + w^2 \sum_i |c_i - \bar c_i|^2$

for a weight w that decreases to zero (`bounded_least_squares`). A curve lies within the convex hull
of its control points, hence between the bounds if they do.
"""

from collections.abc import Sequence
from math import comb
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
from ..numerics.loops import fori_loop
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import ArrayLike, Scalar, VectorLike, cast
from ..validation import concrete, count, instance, instances, interval, is_traced
from .constraint import Constraint
from .margins import margins_of, shortfall, violation

_BOWS, _TRIED = (0.02, 0.05, 0.1, 0.2, 0.35, 0.5), 12
"""How far the control points of each start are from the straight line at most, as a fraction of the
ranges, and the random paths among which it is chosen."""
_ENOUGH = 1e-3
"""Norm of the residuals that is small enough: all constraints hold."""


class InputPath(NamedTuple):
    """Result of `find_path`; `print` it for a summary.

    - `inputs`: at the samples, in order, shape (samples, actuators).
    - `equilibria`: the arm there, an `Equilibrium` with a batch axis of that size.
    - `violation`: largest violation of a constraint, dimensionless; 0 where all hold at all
      samples.
    - `feasible`: whether all hold.
    """

    inputs: Float[Array, "samples inputs"]
    equilibria: Equilibrium
    violation: Scalar
    feasible: Bool[Array, ""]

    def __str__(self) -> str:
        if not eqx.is_array_like(self.inputs) or is_traced(self.inputs) or self.inputs.ndim != 2:
            return f"InputPath(inputs={self.inputs}, violation={self.violation})"
        verdict = (
            "all constraints hold"
            if bool(self.feasible)
            else f"NO PATH FOUND, the constraints are violated by {float(self.violation):.2g}"
        )
        first, last = (", ".join(f"{x:.6g}" for x in self.inputs[i]) for i in (0, -1))
        return f"{len(self.inputs)} samples from {first} to {last}: {verdict}"

    __repr__ = __str__


def find_path(
    scene: Scene,
    first: VectorLike,
    last: VectorLike,
    bounds: Sequence[ArrayLike],
    constraints: Sequence[Constraint],
    *,
    samples: int = 33,
    bends: int = 4,
    model: Model | None = None,
    progress: bool = True,
) -> InputPath:
    r"""Path of inputs from `first` to `last` on which constraints hold, close to the straight line.

        path = vsr.find_path(
            scene, [2.0, 0.0], [0.0, 2.0], (0.0, 3.0), [vsr.constraint.Clearance(0.002, ball)]
        )

    The path $u(t) = \sum_i \binom{n}{i} t^i (1 - t)^{n-i} c_i$ is a smooth Bézier curve. The search
    starts near the straight line, then further away. Constraints hold at the samples; between them
    the arm may come closer. A path takes seconds, or minutes where the way is narrow, there are
    many actuators or contact is solved.

    All samples are solved on their own, side by side. Where an arm has several equilibria, find out
    with `follow(scene, path.inputs)` whether it stays in these.

    **Arguments:**
    - `first`, `last`: inputs at the ends, one number per actuator. The dtype of `first` is the
      precision.
    - `bounds`: least and greatest inputs, a pair of numbers or of arrays with one number per
      actuator.
    - `constraints`: of `vsr_jax.constraint`, for example `Clearance(0.002, obstacles)` or
      `MaxContactForce(0.1)`.
    - `samples`: number of samples, evenly spaced in t, with both ends.
    - `bends`: number of control points between the ends.
    - `model`: as for `solve`.
    - `progress`: whether to say on stderr that the program compiles, if that takes more than three
      seconds.

    **Returns:** an `InputPath`; `feasible` says whether one was found. It has no derivatives.

    **Raises:** `ValueError` for wrong shapes, bounds that contradict each other or an actuator's
    range, ends beyond the bounds, and no constraints.
    """
    instance("scene", scene, Scene, "a Scene")
    start = scene.check_inputs(first)
    end = scene.check_inputs(last).astype(start.dtype)
    low, high = (x.astype(start.dtype) for x in interval("bounds", bounds, start.size))
    scene.check_inputs(low)
    for name, one in (("first", start), ("last", end)):
        _check_within(name, one, low, high)
    kept = instances("constraints", constraints, Constraint, "a Constraint")
    if not kept:
        raise ValueError("constraints: got none, need at least one; without, any path will do")
    count("samples", samples, least=3)
    scene, model, kept = cast((scene, model, kept), start.dtype)
    curve = jnp.asarray(_bernstein(samples, count("bends", bends) + 1), start.dtype)
    problem = _PathProblem(scene, start, end, low, high, kept, model, curve)
    with messages(progress):
        return _find_path(problem)


def _check_within(name: str, inputs: Array, low: Array, high: Array) -> None:
    known = concrete((inputs >= low) & (inputs <= high))
    if known is not None and not known.all():
        raise ValueError(f"{name}: got {inputs}, need inputs between {low} and {high}")


def _bernstein(samples: int, degree: int) -> Float[np.ndarray, "samples points"]:
    """Bernstein polynomials at evenly spaced samples."""
    t, i = np.linspace(0, 1, samples)[:, None], np.arange(degree + 1)
    return np.array([comb(degree, int(k)) for k in i]) * t**i * (1 - t) ** (degree - i)


class _PathProblem(NamedTuple):
    """Ends, bounds, constraints and model; `curve`: weights of the control points at the samples,
    shape (samples, points)."""

    scene: Scene
    first: Array
    last: Array
    low: Array
    high: Array
    constraints: tuple[Constraint, ...]
    model: Model | None
    curve: Array

    @property
    def straight(self) -> Array:
        """Control points of the straight line, as shares of the ranges, (points, inputs)."""
        span = jnp.where(self.high > self.low, self.high - self.low, 1.0)
        t = jnp.linspace(0, 1, self.curve.shape[1], dtype=self.low.dtype)[:, None]
        return (self.first + t * (self.last - self.first) - self.low) / span

    def inputs(self, share: Array) -> Array:
        """Inputs at the samples, for inner control points as shares of the ranges in a row."""
        ends = self.straight
        points = jnp.concatenate([ends[:1], share.reshape(ends[1:-1].shape), ends[-1:]])
        return jnp.clip(
            self.low + (self.high - self.low) * (self.curve @ points), self.low, self.high
        )

    def at(self, share: Array) -> Equilibrium:
        """Equilibria at the samples."""
        return jax.vmap(lambda u: solve(self.scene, u, model=self.model))(self.inputs(share))

    def margins(self, eqs: Equilibrium) -> Array:
        """All margins at all samples, shape (samples, margins)."""
        return jax.vmap(lambda eq: margins_of(self.constraints, eq))(eqs)

    def residual(self, share: Array) -> Array:
        """What the margins lack."""
        return shortfall(self.margins(self.at(share))).reshape(-1)


@program("find_path")
def _find_path(problem: _PathProblem) -> InputPath:
    arrays, others = eqx.partition(problem, eqx.is_inexact_array)
    problem = eqx.combine(lax.stop_gradient(arrays), others)
    rest = problem.straight[1:-1].reshape(-1)
    enough = jnp.asarray(_ENOUGH, rest.dtype)

    def nearest(_: Array, starts: Array) -> Array:
        found = bounded_least_squares.nearest(problem.residual, starts, rest, enough)
        return jnp.broadcast_to(found.share, starts.shape)

    # again from there, with all weights: only the first start of a search has them
    share = fori_loop(0, 2, nearest, _starts(problem, rest))[0]
    there = problem.at(share)
    violated = violation(problem.margins(there))
    return InputPath(problem.inputs(share), there, violated, violated <= 0)


def _starts(problem: _PathProblem, rest: Array) -> Float[Array, "starts shares"]:
    """Random paths further and further from the straight line, each the best of several."""
    draws = np.random.default_rng(0).uniform(-1, 1, (len(_BOWS), _TRIED, rest.size))
    draws = jnp.asarray(np.array(_BOWS)[:, None, None] * draws, rest.dtype)
    tried = jnp.clip(rest + draws, 0.0, 1.0)

    def best(tried: Array) -> Array:
        lack = jax.vmap(lambda share: jnp.linalg.norm(problem.residual(share)))(tried)
        return tried[jnp.argmin(jnp.where(jnp.isfinite(lack), lack, jnp.inf))]

    return lax.map(best, tried)
