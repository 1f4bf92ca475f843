r"""Gradient descent within bounds under constraints, from many starts in parallel.

$\min_z f(p) + w \sum_k \max(0, \epsilon - g_k(p))^2, \quad p = p_0 + (p_1 - p_0) \sin^2(z / 2)$

by an optimizer of optax. The penalty weight w grows with the steps. The best point that satisfies
every $g_k \ge 0$ is recorded, so that the result is feasible although penalties alone do not
guarantee it. A step to a point without equilibrium is halved until an equilibrium is found.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, PyTree

from ..numerics.compiling import program
from ..typing import Scalar
from . import bounded

_PENALTY_MARGIN = 1e-3
r"""Margin $\epsilon$ below which a constraint is penalised: greater than 0, so that the minimum of
the penalty lies inside the feasible set."""

_FIRST_WEIGHT, _LAST_WEIGHT = 1.0, 1e4
"""Penalty weights of the first and the last step. With the last one a violation of 1 % costs as
much as an objective of 1."""

Numbers = dict[str, Array]


class DesignProblem(eqx.Module):
    """Bounds of the free numbers, and `terms`: a function of the numbers that returns the objective
    and the margins of each constraint."""

    low: Numbers
    high: Numbers
    terms: Callable[[Numbers], tuple[Scalar, list[Array]]]

    def at(self, z: Numbers) -> Numbers:
        """Numbers at coordinates z."""
        return jax.tree.map(bounded.number, self.low, self.high, z)

    def loss(self, z: Numbers, penalty_weight: Scalar) -> tuple[Scalar, tuple[Scalar, Array]]:
        """Objective plus penalty; as auxiliary output the objective and the least margin of each
        constraint."""
        objective, margins = self.terms(self.at(z))
        penalty = sum(
            jnp.sum(jnp.maximum(_PENALTY_MARGIN - margin, 0.0) ** 2) for margin in margins
        )
        return objective + penalty_weight * penalty, (
            objective,
            jnp.stack([jnp.min(margin) for margin in margins]),
        )


class Best(NamedTuple):
    """The best point so far: its coordinates, objective and least margins. The initial value is
    infinitely bad."""

    z: Numbers
    objective: Array
    margins: Array

    @property
    def violation(self) -> Array:
        """Largest violation of a constraint; 0 where all are satisfied."""
        return jnp.maximum(-jnp.min(self.margins, axis=-1), 0.0)

    def better(self, other: "Best") -> Array:
        """Whether this point is better: feasible before infeasible; of two feasible points the
        lower objective, of two infeasible ones the smaller violation."""
        mine, its = self.violation, other.violation
        return jnp.where((mine <= 0) & (its <= 0), self.objective < other.objective, mine < its)


class DescentState(NamedTuple):
    """State of a descent: the point to evaluate, the last point with an equilibrium, the
    optimizer's state, the best point so far."""

    z: Numbers
    sound: Numbers
    optimizer: PyTree
    best: Best


class History(NamedTuple):
    """Objective and largest violation at each step of each start, shape (steps, starts), NaN where
    there was no equilibrium; and the free numbers there by name, shape (steps, starts, ...)."""

    objective: np.ndarray
    violation: np.ndarray
    numbers: dict[str, np.ndarray] = {}


@lru_cache
def adam(learning_rate: float, steps: int) -> optax.GradientTransformationExtraArgs:
    """Adam with a learning rate that decays to zero along a cosine. Equal arguments return the same
    object, so that programs are compiled once."""
    return optax.with_extra_args_support(
        optax.adam(optax.cosine_decay_schedule(learning_rate, steps), b2=0.99)
    )


def first_update(optimizer: optax.GradientTransformationExtraArgs, z: Numbers) -> PyTree:
    """First update of an optimizer for $f = |z|^2 / 2$: a program that identifies the optimizer."""

    def half(z: Numbers) -> Array:
        return jnp.asarray(sum(jnp.sum(x**2) for x in jax.tree.leaves(z))) / 2

    return optimizer.update(z, optimizer.init(z), z, value=half(z), grad=z, value_fn=half)[0]


def penalty_weight(done: int, total: int) -> Array:
    """Weight of the penalties after `done` of `total` steps."""
    return jnp.asarray(_FIRST_WEIGHT * (_LAST_WEIGHT / _FIRST_WEIGHT) ** (done / max(total - 1, 1)))


def begin(
    problem: DesignProblem,
    optimizer: optax.GradientTransformationExtraArgs,
    given: Numbers,
    starts: int,
    candidates: int,
    seed: int,
) -> DescentState:
    """Initial states: the first start at the given numbers, every other at the best of `candidates`
    random points, the first of them if none has an equilibrium."""
    generator = np.random.default_rng(seed)
    first = jax.tree.map(bounded.coordinate, problem.low, problem.high, given)
    margins = eqx.filter_eval_shape(problem.loss, problem.low, jnp.ones(()))[1][1]
    bad = jnp.full((starts, *margins.shape), -jnp.inf, margins.dtype)

    def draw() -> Numbers:
        drawn = {
            name: jnp.asarray(generator.uniform(size=(starts, *low.shape)), low.dtype)
            for name, low in problem.low.items()
        }
        return jax.tree.map(lambda share, own: bounded.at_share(share).at[0].set(own), drawn, first)

    points = [draw() for _ in range(candidates)]
    worst = Best(points[0], jnp.full(starts, jnp.inf, margins.dtype), bad)
    best = worst
    for z in points:
        state = DescentState(z, z, jax.vmap(optimizer.init)(z), best)
        best = descend(problem, optimizer, state, penalty_weight(0, 1))[0].best
    return DescentState(best.z, best.z, jax.vmap(optimizer.init)(best.z), worst._replace(z=best.z))


@program("design")
def descend(
    problem: DesignProblem,
    optimizer: optax.GradientTransformationExtraArgs,
    states: DescentState,
    penalty_weight: Scalar,
) -> tuple[DescentState, tuple[Array, Array]]:
    """One step of every start; also returns objective and largest violation before the step."""
    return jax.vmap(lambda state: _step(problem, optimizer, state, penalty_weight))(states)


def _step(
    problem: DesignProblem,
    optimizer: optax.GradientTransformationExtraArgs,
    state: DescentState,
    penalty_weight: Scalar,
) -> tuple[DescentState, tuple[Array, Array]]:
    (loss, (objective, margins)), slope = jax.value_and_grad(problem.loss, has_aux=True)(
        state.z, penalty_weight
    )
    sound = jnp.isfinite(loss) & jnp.all(
        jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(slope)])
    )
    slope = _where(sound, slope, jax.tree.map(jnp.zeros_like, slope))
    update, after = optimizer.update(
        slope,
        state.optimizer,
        state.z,
        value=loss,
        grad=slope,
        value_fn=lambda z: problem.loss(z, penalty_weight)[0],
    )
    ahead, halfway = (
        optax.apply_updates(state.z, update),
        jax.tree.map(lambda a, b: 0.5 * (a + b), state.sound, state.z),
    )
    here = Best(state.z, objective, margins)
    best = _where(sound & here.better(state.best), here, state.best)
    z, at, after = _where(sound, (ahead, state.z, after), (halfway, state.sound, state.optimizer))
    lost = jnp.where(sound, 0.0, jnp.nan)
    return DescentState(z, at, after, best), (objective + lost, here.violation + lost)


def _where(condition: Array, new: PyTree, old: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def best_start(best: Best) -> int:
    """Index of the best start: the least violation, then the least objective."""
    return int(np.lexsort((np.asarray(best.objective), np.asarray(best.violation)))[0])
