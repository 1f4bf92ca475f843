r"""Descent within bounds under constraints, from many starts side by side.

Of numbers $p = p_0 + (p_1 - p_0) \sin^2(z / 2)$ the z is found that makes $f(p) + w \sum_k \max(0,
\epsilon - g_k(p))^2$ small, by an optimiser of optax, with a weight w that rises as the descent
goes on. The best that keeps every $g_k \ge 0$ is remembered, so that what comes out is feasible
although penalties are not. A step to where nothing is in equilibrium is halved until something is.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array

from ..typing import Scalar
from . import bounded

_BACKING = 1e-3
_LEAST_WEIGHT, _MOST_WEIGHT = 1.0, 1e4

Numbers = dict[str, Array]


class Problem(eqx.Module):
    """Bounds of the free numbers, and `terms`: a function of the numbers that gives the objective
    and the margins of each constraint."""

    low: Numbers
    high: Numbers
    terms: Callable[[Numbers], tuple[Scalar, list[Array]]]

    def at(self, z: Numbers) -> Numbers:
        """The numbers at coordinates z."""
        return jax.tree.map(bounded.number, self.low, self.high, z)

    def loss(self, z: Numbers, weight: Scalar) -> tuple[Scalar, tuple[Scalar, Array]]:
        """Objective and penalty, with the objective and the least margin of each constraint
        beside."""
        objective, margins = self.terms(self.at(z))
        penalty = sum(jnp.sum(jnp.maximum(_BACKING - margin, 0.0) ** 2) for margin in margins)
        return objective + weight * penalty, (
            objective,
            jnp.stack([jnp.min(margin) for margin in margins]),
        )


class Best(NamedTuple):
    """The best found: its coordinates, objective and least margins; before anything is found these
    are infinitely bad."""

    z: Numbers
    objective: Array
    margins: Array

    @property
    def violation(self) -> Array:
        """The greatest violation of a constraint, 0 where all are kept."""
        return jnp.maximum(-jnp.min(self.margins, axis=-1), 0.0)

    def better(self, other: "Best") -> Array:
        """Feasible before infeasible; of two feasible ones the lower objective, of two others the
        smaller violation."""
        mine, its = self.violation, other.violation
        return jnp.where((mine <= 0) & (its <= 0), self.objective < other.objective, mine < its)


class State(NamedTuple):
    """Where a descent stands: the point to try, the last one that was sound, the optimiser's state,
    the best so far."""

    z: Numbers
    sound: Numbers
    optimizer: Any
    best: Best


class Trace(NamedTuple):
    """Objective and greatest violation at each step of each start, shape (steps, starts); NaN where
    nothing was in equilibrium."""

    objective: np.ndarray
    violation: np.ndarray


@lru_cache
def adam(learning_rate: float, steps: int) -> optax.GradientTransformationExtraArgs:
    """Adam with a learning_rate that falls to nothing along a cosine; one object for the same
    numbers, so that programs are compiled once."""
    return optax.with_extra_args_support(
        optax.adam(optax.cosine_decay_schedule(learning_rate, steps), b2=0.99)
    )


def first_update(optimizer: optax.GradientTransformationExtraArgs, z: Numbers) -> Any:
    """What an optimiser makes of a first slope, of the same numbers as the point: a program that
    tells it from others."""

    def half(z: Numbers) -> Array:
        return jnp.asarray(sum(jnp.sum(x**2) for x in jax.tree.leaves(z))) / 2

    return optimizer.update(z, optimizer.init(z), z, value=half(z), grad=z, value_fn=half)[0]


def weight(done: int, total: int) -> Array:
    """Weight of the penalties after so many steps of a total."""
    return jnp.asarray(_LEAST_WEIGHT * (_MOST_WEIGHT / _LEAST_WEIGHT) ** (done / max(total - 1, 1)))


def begin(
    problem: Problem,
    optimizer: optax.GradientTransformationExtraArgs,
    given: Numbers,
    starts: int,
    candidates: int,
    seed: int,
) -> State:
    """States of the starts: the first at the given numbers, each other at the best of some that are
    drawn and candidates."""
    generator = np.random.default_rng(seed)
    first = jax.tree.map(bounded.coordinate, problem.low, problem.high, given)
    margins = eqx.filter_eval_shape(problem.loss, problem.low, jnp.ones(()))[1][1]
    bad = jnp.full((starts, *margins.shape), -jnp.inf, margins.dtype)
    nothing = Best({}, jnp.full(starts, jnp.inf, margins.dtype), bad)
    best = None
    for _ in range(candidates):
        drawn = {
            name: jnp.asarray(generator.uniform(size=(starts, *low.shape)), low.dtype)
            for name, low in problem.low.items()
        }
        z = jax.tree.map(lambda share, own: bounded.at_share(share).at[0].set(own), drawn, first)
        state = State(
            z, z, jax.vmap(optimizer.init)(z), nothing._replace(z=z) if best is None else best
        )
        best = descend(problem, optimizer, state, weight(0, 1))[0].best
    z = nothing.z if best is None else best.z
    return State(z, z, jax.vmap(optimizer.init)(z), nothing._replace(z=z))


@eqx.filter_jit
def descend(
    problem: Problem,
    optimizer: optax.GradientTransformationExtraArgs,
    states: State,
    weight: Scalar,
) -> tuple[State, tuple[Array, Array]]:
    """One step of every start, with objective and greatest violation before it."""
    return jax.vmap(lambda state: _step(problem, optimizer, state, weight))(states)


def _step(
    problem: Problem, optimizer: Any, state: State, weight: Scalar
) -> tuple[State, tuple[Array, Array]]:
    (loss, (objective, margins)), slope = jax.value_and_grad(problem.loss, has_aux=True)(
        state.z, weight
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
        value_fn=lambda z: problem.loss(z, weight)[0],
    )
    ahead, halfway = (
        optax.apply_updates(state.z, update),
        jax.tree.map(lambda a, b: 0.5 * (a + b), state.sound, state.z),
    )
    here = Best(state.z, objective, margins)
    best = _where(sound & here.better(state.best), here, state.best)
    z, at, after = _where(sound, (ahead, state.z, after), (halfway, state.sound, state.optimizer))
    lost = jnp.where(sound, 0.0, jnp.nan)
    return State(z, at, after, best), (objective + lost, here.violation + lost)


def _where(condition: Array, new: Any, old: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def chosen(best: Best) -> int:
    """Which start's best is the best of all."""
    return int(np.lexsort((np.asarray(best.objective), np.asarray(best.violation)))[0])
