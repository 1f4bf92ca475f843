"""The rules of `damped_newton`: the state of each problem beside its point and step, when a step is
taken, and how damping, loads and stages change."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .component import select

SOFT_STAGES, HARDENING_STAGES = 1, 4
"""Number of increments after the loads with springs in place of constraints, which have an energy,
and of all by which constraints harden in `damped_newton`."""
_FIRST_DAMPING, _MIN_DAMPING = 1.0, 0.3
"""Damping to begin with where the loads are applied at once, and least one above zero."""
_RAISE, _LOWER = 8.0, 4.0
"""Factor by which damping rises after a rejected step, and divisor after an accepted one."""
_MIN_CONTRACTION, _MAX_CONTRACTION = 0.25, 0.99
"""Contraction of the residual above which a step is extrapolated, and the largest that is used: it
bounds the extrapolation to 98 steps."""
_QUADRATIC = 0.3
"""Ratio of successive contractions below which convergence is quadratic."""
_CERTAIN, _NEAR = 0.1, 1e-4
"""Contraction of steps and residuals, and size of a step, below which the last step is taken
without an evaluation after it: what it leaves is then known from the contraction."""
_CUTS, _SOFT_CUTS, _SOFT_CUT = 5, 2, 0.25
"""Number of times that a step which does not lower the residual is halved where something slides
with friction; the same where springs stand for constraints, and what is left of a step then."""
_JUMPING, _BACK = 40, 2
"""Number of evaluations of nearly exact constraints after which the problem is loosened, and by how
many stages it goes back then."""
PROBES, _SETTLING = 16, 6
"""Steps of a creeping arm by which a doubtful solution is probed, and the first of them that only
let the slowest motion prevail."""


class Damped(NamedTuple):
    """Evaluation of one point and one damping for `damped_newton`: the step to subtract, its size,
    the residual, its size, whether the damped tangent is positive definite, whether that is
    doubtful, since it is far from symmetric, and, with constraints, whether they hold by a wide
    margin, and whether it has no energy at all, since something slides with friction."""

    step: Any
    size: Array
    residual: Any
    merit: Array
    definite: Array
    doubtful: Array
    clear: Array | None = None
    slides: Array | None = None


class Measures(NamedTuple):
    """Measures of steps for `damped_newton`, with one entry per problem: `work`, the scalar product
    of a residual and a step; `turn`, a norm of a step; a step that `stirs` all motions, of size 1
    or so; and `dot`, the scalar product of two, where convergence may be linear."""

    work: Callable[[Any, Any], Array]
    turn: Callable[[Any], Array]
    stirs: Any
    dot: Callable[[Any, Any], Array] | None = None


class Guard(NamedTuple):
    """State of each problem in `damped_newton` besides the point and the step: size of the step and
    of the sum of all steps to come, size of the residual, whether the tangent is definite, the work
    of the residual over the step; damping, load increments applied, whether the step may be tried,
    how often an undamped step raised an accepted residual, whether the loads come by increments,
    the number of evaluations and of plain Newton steps; the number of undamped steps in a row under
    the same loads, by what factor the last of them became smaller, and their rate where they shrink
    linearly; whether the solution is to be probed, the number of probes, and the growth of the
    motion in them; whether the constraints hold by a wide margin, how often the last step was made
    shorter, whether the problem is a loosened one, and the number of evaluations with nearly exact
    constraints."""

    size: Array
    miss: Array
    merit: Array
    definite: Array
    pull: Array
    damping: Array
    applied: Array
    fresh: Array
    rises: Array
    gradual: Array
    spent: Array
    plain: Array
    whole: Array
    contraction: Array
    rate: Array
    doubtful: Array
    probes: Array
    growth: Array
    clear: Array
    cuts: Array
    loose: Array
    hard: Array


def careful(floor: Array, increments: int) -> Guard:
    """State of every problem before the first evaluation of the careful attempt."""
    zero, no = jnp.zeros_like(floor), jnp.zeros(floor.shape, bool)
    none = jnp.zeros(floor.shape, jnp.int32)
    damping = jnp.full_like(floor, 0.0 if increments > 1 else _FIRST_DAMPING)
    return Guard(
        size=zero,
        miss=zero,
        merit=zero + jnp.inf,
        definite=~no,
        pull=zero,
        damping=damping,
        applied=zero + 1,
        fresh=no,
        rises=none,
        gradual=no,
        spent=none,
        plain=none,
        whole=none,
        contraction=zero + jnp.inf,
        rate=zero,
        doubtful=no,
        probes=none,
        growth=zero + 1,
        clear=no,
        cuts=none,
        loose=no,
        hard=none,
    )


def shrunk(step: Any, probe: Array, first: Array, measures: Measures) -> Any:
    """The steps, those of a probe made so small that the residual is linear and so large that its
    rounding is small; the `first` one also stirs the motions that a symmetric problem never makes.
    """
    size = measures.turn(step)
    small = jnp.finfo(size.dtype).eps ** 0.25
    scale = jnp.where(probe, small / jnp.where(size > 0, size, 1.0), 1.0)
    stir = jnp.where(probe & first, small, 0.0)
    return jax.tree.map(
        lambda s, d: scale.astype(s.dtype) * s + (stir * d).astype(s.dtype), step, measures.stirs
    )


def probed(old: Guard, probe: Array, ratio: Array) -> Guard:
    """State after a probe, if it was one, along which the motion changed by the factor `ratio`."""
    probes, spent = (count + probe.astype(jnp.int32) for count in (old.probes, old.spent))
    growth = jnp.where(probe & (probes > _SETTLING), old.growth * ratio, old.growth)
    grown = (probes == PROBES) & (growth > 1)
    return old._replace(definite=old.definite & ~grown, spent=spent, probes=probes, growth=growth)


def attempt(
    old: Guard, little: Array | None, plain: Array, increments: int, levels: int
) -> tuple[Array, Array]:
    """Damping and load increments of the next evaluation: less and more than before if the last
    step may be tried. A stage, where there are any, ends with an undamped step that is a `little`
    one."""
    damping = jnp.where(old.fresh, _lowered(old.damping), old.damping)
    more = jnp.where(old.fresh, jnp.minimum(old.applied + 1, increments), old.applied)
    if little is not None:
        settled = old.fresh & (old.damping == 0) & little
        further = jnp.where(old.clear, levels, jnp.minimum(old.applied + 1, levels))
        further = jnp.where(settled, further, old.applied)
        more = jnp.where(old.applied >= increments, further, more)
    return jnp.where(plain, 0.0, damping), jnp.where(plain, levels, more)


def shorter(old: Guard, steep: Array | None) -> tuple[Guard, Array | float]:
    """State where a step is made shorter, and what is left of it: a half, or where it is too
    `steep` for springs a quarter, with more damping after it. Steps after it shrink because of
    that, not linearly."""
    guard = _anew(old)._replace(spent=old.spent + 1, cuts=old.cuts + 1)
    if steep is None:
        return guard, 0.5
    damping = jnp.where(steep, _raised(old.damping), old.damping)
    left = jnp.where(steep, _SOFT_CUT, 0.5)
    return guard._replace(damping=damping, pull=jnp.where(steep, left, 1.0) * old.pull), left


def loosened(guard: Guard, hard: Array, ended: Array, levels: int) -> Guard:
    """State after an evaluation with nearly exact constraints, if it was a `hard` one. Where they
    have jumped without end the problem is loosened and goes on from where it is."""
    guard = guard._replace(hard=guard.hard + hard.astype(jnp.int32))
    jumping = (guard.hard >= _JUMPING) & ~ended & ~guard.loose
    back = _anew(guard)._replace(
        loose=~jnp.zeros_like(guard.loose),
        applied=jnp.full_like(guard.applied, levels - _BACK),
        rate=jnp.zeros_like(guard.rate),
        rises=jnp.zeros_like(guard.rises),
    )
    return select(jumping, back, guard)


def _anew(guard: Guard) -> Guard:
    """State in which the last step tells nothing of the next one."""
    return guard._replace(
        whole=jnp.zeros_like(guard.whole),
        contraction=jnp.full_like(guard.contraction, jnp.inf),
    )


def accepted(
    old: Guard,
    new: Damped,
    left: Array,
    floor: Array,
    plain: Array,
    applied: Array,
    increments: int,
) -> Array:
    """Whether the step to a new point is taken. A point that was evaluated only with more damping
    is kept.

    **Arguments:** `left`: work of the new residual over the step.
    """
    better = (
        (old.applied < increments)
        | (old.applied < applied)
        | (left >= -old.pull)
        | (new.merit < old.merit)
        | (new.merit < floor)
        | plain
    )
    return ~old.fresh | (jnp.isfinite(new.merit) & better)


def worse(old: Guard, new: Damped, applied: Array, accepted: Array) -> Array:
    """Whether a step of what slides does not lower the residual, and is halved."""
    assert new.slides is not None
    here = new.slides & old.fresh & (old.applied == applied) & (old.cuts < _CUTS)
    return here & ~(new.merit < jnp.maximum(old.merit, accepted))


def steep(old: Guard, taken: Array, increments: int) -> Array:
    """Whether a step that is not taken is made shorter, in place of another one with more damping
    from the same point: where all loads are applied."""
    return old.fresh & ~taken & (old.applied >= increments) & (old.cuts < _SOFT_CUTS)


def judged(
    old: Guard,
    new: Damped,
    left: Array,
    taken: Array,
    plain: Array,
    damping: Array,
    applied: Array,
    floor: Array,
    accepted: Array,
    small: float,
) -> tuple[Guard, Array, Array]:
    """State after an evaluation, its `pull` still that of the last step; the fraction of that step
    by which the next one is extrapolated; and whether the next one is the last, taken without
    another evaluation."""
    good = taken & (new.definite | plain)
    damping = jnp.where(good, damping, _raised(jnp.where(taken, damping, old.damping)))
    # an undamped step between two residuals under the same loads
    whole = old.fresh & (old.damping == 0) & (damping == 0) & (old.applied == applied)
    ratio = new.size / old.size
    more = _extrapolated(whole & (new.merit > 4 * floor), jnp.minimum(left / old.pull, ratio))
    rho = jnp.where(whole, jnp.clip(ratio, 0.0, _MAX_CONTRACTION), 0.0)
    both = jnp.maximum(jnp.maximum(ratio, old.rate), new.merit / old.merit)
    both = jnp.clip(both, 0.0, 1.0)
    merit, miss = both * new.merit, both / (1 - both) * new.size
    certain = whole & taken & new.definite & (both < _CERTAIN) & (new.size < _NEAR)
    last = certain & (merit <= accepted) & (miss < small)
    risen = whole & (old.merit <= accepted) & (new.merit >= old.merit)
    there = old._replace(
        size=new.size,
        miss=jnp.where(last, miss, new.size / (1 - rho)),
        merit=jnp.where(last, merit, new.merit),
        definite=new.definite,
        damping=damping,
        applied=applied,
        fresh=new.definite | plain,
        rises=old.rises + risen.astype(jnp.int32),
        whole=jnp.where(whole, old.whole + 1, 0),
        contraction=jnp.where(whole, ratio, jnp.inf),
        doubtful=new.doubtful,
        clear=old.clear if new.clear is None else new.clear,
    )
    here = old._replace(damping=damping, fresh=plain)
    guard = select(taken, there, here)
    # a rejected step is computed again with more damping before it is used; that of a problem that
    # is done is never used
    return (
        guard._replace(spent=old.spent + 1),
        more,
        last,
    )


def _extrapolated(wanted: Array, left: Array) -> Array:
    """Fraction of the last step to take again where wanted, from the contraction of the residual
    along it."""
    rho = jnp.clip(left, 0.0, _MAX_CONTRACTION)
    return jnp.where(wanted & (rho > _MIN_CONTRACTION), rho**2 / (1 - rho), 0.0)


def linear(old: Guard, guard: Guard) -> Array:
    """Whether steps shrink by nearly the same factor, and not by its square."""
    there = guard.whole > old.whole
    return there & (guard.contraction > _QUADRATIC * old.contraction)


def slowest(old: Guard, guard: Guard, linear: Array) -> Array:
    """Rate of linear convergence since the loads, the damping or the attempt changed, 0 if there
    was none."""
    rate = jnp.where(linear, guard.contraction, 0.0)
    return jnp.maximum(rate, jnp.where(guard.whole > 0, old.rate, 0.0))


def _raised(damping: Array) -> Array:
    return jnp.maximum(_RAISE * damping, _MIN_DAMPING)


def _lowered(damping: Array) -> Array:
    return jnp.where(damping >= _LOWER * _MIN_DAMPING, damping / _LOWER, 0.0)
