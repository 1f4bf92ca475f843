"""Newton's method with Levenberg damping, for residuals that are nearly the gradient of an energy;
several problems side by side."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from .acceleration import Earlier, accelerated
from .batching import Iteration
from .component import select
from .newton import Root

MAX_DAMPED_STEPS = 200
"""Bound on the evaluations of `damped_newton`; heavy soft arms take 22 to 45."""
MAX_PLAIN_STEPS = 25
"""Bound on the plain Newton steps that follow where damping has failed."""
LOAD_INCREMENTS = 5
"""Increments in which `damped_newton` applies the loads where they cannot be applied at once: the
tangent is often indefinite at the start under all loads."""
SOFT_STAGES, HARDENING_STAGES = 1, 5
"""Number of increments after the loads with springs in place of constraints, which have an energy,
and of all by which constraints harden in `damped_newton`."""
MAX_TURN = 1.5
"""Bound on the angle [rad] by which one step of a loaded solve bends and twists the arm. A step
that coils the arm may lower the residual without approaching a solution."""
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1.0, 0.3, 1e8
"""Damping to begin with where the loads are applied at once, least one above zero, and that at
which plain Newton steps take over."""
_RAISE, _LOWER = 8.0, 4.0
"""Factor by which damping rises after a rejected step, and divisor after an accepted one."""
_MIN_CONTRACTION, _MAX_CONTRACTION = 0.25, 0.99
"""Contraction of the residual above which a step is extrapolated, and the largest that is used: it
bounds the extrapolation to 98 steps."""
_TAIL, _QUADRATIC = 0.3, 0.3
"""Angle [rad] of a step below which linear convergence is accelerated, and ratio of successive
contractions below which convergence is quadratic."""
_CERTAIN, _NEAR = 0.1, 1e-4
"""Contraction of steps and residuals, and size of a step, below which the last step is taken
without an evaluation after it: what it leaves is then known from the contraction."""
_CUTS = 5
"""Number of times that a step which does not lower the residual is halved where something slides
with friction."""
_FIRST_STAGES = 80
"""Bound on the evaluations of the first careful attempt where there are stages."""
_SLOW_DAMPING, _HARDER = 100.0, 0.25
"""Damping with which the second one begins, and by how much of a stage its springs are harder."""
_SLIDING, _CLOSE = 20, 1e-3
"""Bound on the evaluations of a first attempt where something slides with friction, and size of a
step below which the attempt may take twice as many."""
_SETTLED = 0.3
"""Size of an undamped step below which springs are replaced by the constraints that they stand
for."""
_ACCEPTED = 64
"""Largest accepted residual, in multiples of its rounding level."""
_MAX_RISES = 3
"""Rises of an accepted residual after which it is taken to be at rounding level."""


_PROBES, _SETTLING, _DECAYED, _PROBE_DAMPING = 16, 6, 0.1, 1.0
"""Steps of a creeping arm by which a doubtful solution is probed; the first of them that only let
the slowest motion prevail; the remainder after the others that ends them; and their damping: a
motion of stiffness $\\lambda$, relative to the elastic one, is multiplied by $1 / (1 + \\lambda)$
in each."""


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
    of a residual and a step; `turn`, a norm of a step; and `dot`, the scalar product of two, where
    convergence may be linear."""

    work: Callable[[Any, Any], Array]
    turn: Callable[[Any], Array]
    dot: Callable[[Any, Any], Array] | None = None


class _Guard(NamedTuple):
    """State of each problem in `damped_newton` besides the point and the step: size of the step and
    of the sum of all steps to come, size of the residual, whether the tangent is definite, the work
    of the residual over the step; damping, load increments applied, whether the step may be tried,
    how often an undamped step raised an accepted residual, whether the loads come by increments,
    the number of evaluations and of plain Newton steps; the number of undamped steps in a row under
    the same loads, by what factor the last of them became smaller, and their rate where they shrink
    linearly; whether the solution is to be probed, the number of probes, and the growth of the
    motion in them; whether the constraints hold by a wide margin, and how often the step of what
    slides was halved."""

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


def damped_newton(
    evaluate: Callable[[Any, Array, Array, Array], Damped],
    measures: Measures,
    start: Any,
    floor: Array,
    increments: int = 1,
    origin: Any = None,
    *,
    stages: int = 0,
) -> Iteration:
    r"""Root of a residual that is the gradient of an energy, or nearly so, by Newton's method with
    Levenberg damping.

    The tangent is $H + \mu \Sigma$: an implicit time step of a creeping arm. $\mu$ rises until the
    tangent is positive definite and falls with every accepted step.

    - Acceptance. A step is accepted if the energy falls along it, $r(x - s) \cdot s \ge -r(x) \cdot
      s$ for the step s that is subtracted, or if the residual becomes smaller.
    - First attempt. All loads are applied at once, without damping. At the first step that is not
      accepted, and at the first tangent that is not positive definite, the problem begins again
      from `origin`: the loads are then applied in equal increments, one per accepted step, and
      steps are always accepted until all loads are applied. A problem with neither increments nor
      an `origin` begins with the careful attempt, and with a first damping.
    - Extrapolation. The tangent may be approximate. Where it is much too stiff for a soft motion of
      the arm, the residual along a full step contracts only by $\rho$ near 1. The next step then
      includes $\rho^2 / (1 - \rho)$ of the last one, the remainder of the geometric series.
    - Acceleration, with `measures.dot`. Near the solution, steps that shrink linearly, as with
      friction, and not quadratically are replaced by those of `accelerated`.
    - Stages. The stages of constraints without an energy accept every finite step, undamped; one
      that goes back by half of the last one is halved. Where the constraints hold by a wide margin,
      the last stage follows at once.
      A problem that ends without a stable root begins once more, slowly, with harder springs.
    - Friction. What `slides` has no energy: its steps are accepted where the residual becomes
      smaller, else halved, some times. Its first attempt has at most `_SLIDING` evaluations, near
      the solution twice as many.
    - Probing. Where the tangent is doubtful at the end, the arm is moved from the solution by the
      last step, made small, and creeps: $s_{n+1} = s_n + (H + \mu \Sigma)^{-1} r(x - s_n)$. The
      solution is unstable if the motion grows after some steps.
    - Last step. Near the solution, where the last step and residual were at most `_CERTAIN` of
      those before, the next step is taken without another evaluation if what it leaves, by the
      same ratio or the rate of linear convergence, is negligible and accepted.

    The iteration ends with a last step, or where the residual is accepted, the step is undamped,
    and either the step times $1 / (1 - \rho)$, the sum of all steps to come, is negligible, or the
    residual has risen three times, which is rounding; that step is not taken. A residual that is
    not accepted never ends the iteration before its bounds do. A problem that reaches the bound on
    its evaluations or on $\mu$ gets some plain Newton steps, which find an unstable equilibrium if
    one is near. Several problems can be solved together, in the last axes of all arrays; each stops
    when it is done.

    **Arguments:**
    - `evaluate`: maps a point, a damping $\mu$, the fraction of the loads and whether this is a
      second careful attempt, which may solve another problem, to `Damped`.
    - `measures`: of steps.
    - `floor`: size of the residual that counts as rounding, one entry per problem.
    - `increments`: number of load increments.
    - `origin`: where the second attempt begins, the start by default.
    - `stages`: further increments after the loads, each once the problem before it is nearly
      solved: of constraints that are springs first and exact in the last one.

    **Returns:** the `Iteration`, whose result is a `Root`: it is converged if the residual is
    rounding or as small as a negligible step.
    """
    evaluate = jax.jit(evaluate, inline=True)  # traced once for its shapes and in the loop
    twice = increments > 1 or origin is not None
    origin = start if origin is None else origin
    levels = increments + stages
    small = float(jnp.finfo(floor.dtype).eps ** 0.75)
    accepted = jnp.maximum(_ACCEPTED * floor, small)

    def once_more(guard: _Guard) -> Array:
        return guard.gradual & (not twice)

    def going(guard: _Guard) -> Array:
        negligible = (guard.miss < small) | (guard.rises >= _MAX_RISES)
        done = guard.fresh & (guard.damping == 0) & (guard.merit <= accepted) & negligible
        stuck = ~guard.definite & (guard.merit < floor)
        return ~((done | stuck) & (guard.applied == levels)) & (guard.plain < MAX_PLAIN_STEPS)

    def probing(guard: _Guard) -> Array:
        found = ~going(guard) & guard.definite & (guard.merit <= accepted)
        decayed = guard.growth < _DECAYED
        return found & guard.doubtful & (guard.probes < _PROBES) & ~decayed

    def advance(state: tuple) -> tuple:
        x, step, earlier, old = state
        probe = probing(old)
        step = _shrunk(step, probe, measures.turn)
        plain = (old.spent >= MAX_DAMPED_STEPS) | (old.damping >= _MAX_DAMPING) | (old.plain > 0)
        trial = jax.tree.map(lambda a, s: jnp.where(old.fresh, a - s.astype(a.dtype), a), x, step)
        damping, applied = _attempt(old, plain, increments, levels)
        share = jnp.minimum(applied / increments, 1.0)
        if stages:
            share = share + jnp.maximum(applied - increments, 0.0) / stages
        new = evaluate(trial, jnp.where(probe, _PROBE_DAMPING, damping), share, once_more(old))
        left = measures.work(new.residual, step)
        # the stages that are nearly exact have no energy
        hard = (old.gradual | (not twice)) & (applied >= increments + SOFT_STAGES)
        if new.slides is not None:
            hard = hard | (new.slides & ~old.gradual)
        taken = _accepted(old, new, left, floor, plain | hard, applied, increments)
        cut = None if new.slides is None else ~probe & _worse(old, new, applied, accepted)
        taken = taken if cut is None else taken & ~cut
        guard, more, last = _judged(
            old, new, left, taken, plain | hard, damping, applied, floor, accepted, small
        )
        if cut is not None:
            shorter = _shorter(old)
            guard = select(cut, shorter, guard._replace(cuts=jnp.zeros_like(old.cuts)))
        guard = guard._replace(plain=old.plain + plain.astype(jnp.int32))
        more = jnp.where(probe, 1.0, jnp.where(hard, 0.0, more))
        new_step = jax.tree.map(lambda s, last: s + more.astype(s.dtype) * last, new.step, step)
        if stages and measures.dot is not None:
            back = measures.dot(new_step, step) < -0.5 * measures.dot(step, step)
            half = jnp.where(hard & ~old.clear & back, 0.5, 1.0)
            new_step = jax.tree.map(lambda s: half.astype(s.dtype) * s, new_step)
        if measures.dot is not None:
            tail = ~probe & (measures.turn(step) < _TAIL) & (new.size > small)
            linear = tail & _linear(old, guard)
            near = accelerated(new.step, step, earlier, linear & (old.whole > 0), measures.dot)
            new_step = select(linear, near, new_step)
            guard = guard._replace(rate=_slowest(old, guard, linear))
            earlier = select(taken, Earlier(new.step, step, earlier.proposed), earlier)
        if cut is not None:
            new_step = select(cut, jax.tree.map(lambda s: 0.5 * s, step), new_step)
        pull = jnp.where(taken, measures.work(new.residual, new_step), guard.pull)
        go = going(old)
        ratio = measures.turn(new_step) / measures.turn(step)
        guard = select(go, guard._replace(pull=pull), _probed(old, probe, ratio))
        finished = jax.tree.map(
            lambda a, s: a - jnp.where(last, s, 0.0).astype(a.dtype), trial, new.step
        )
        x = select(go & taken, finished, x)
        if not (twice or stages):
            return x, new_step, earlier, guard
        failed = jnp.where(go, ~(taken & new.definite), old.definite & ~guard.definite)
        if cut is not None:
            bound = jnp.where(guard.size < _CLOSE, 2 * _SLIDING, _SLIDING)
            failed = (failed & ~(go & cut)) | (go & (old.spent >= bound))
        if not twice:
            sound = guard.definite & (guard.merit <= accepted)
            ended = ~(going(guard) | probing(guard))
            failed = (ended & ~sound) | (guard.spent >= _FIRST_STAGES)
        again = ~old.gradual & failed
        guard = select(again, second._replace(spent=guard.spent), guard)
        new_step = jax.tree.map(lambda s: jnp.where(again, 0.0, s).astype(s.dtype), new_step)
        return select(again, origin, x), new_step, earlier, guard

    careful = first = _careful(floor, increments)
    second = careful._replace(gradual=~careful.gradual)
    if twice:
        whole = jnp.full_like(floor, levels)
        first = careful._replace(applied=whole, damping=jnp.zeros_like(floor))
    else:
        slow = jnp.full_like(floor, _SLOW_DAMPING)
        second = second._replace(applied=second.applied + _HARDER, damping=slow)

    def begin(like: tuple | None) -> tuple:
        if like is None:
            step = jax.eval_shape(evaluate, start, floor, floor, once_more(first)).step
        else:
            step = like[1]
        step = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), step)
        return start, step, None if measures.dot is None else Earlier(step, step, step), first

    def busy(state: tuple) -> Array:
        return going(state[3]) | probing(state[3])

    def root(state: tuple) -> Root:
        x, _, _, guard = state
        return Root(x, guard.merit <= accepted, guard.definite, guard.spent, once_more(guard))

    return Iteration(begin, advance, busy, root)


def _careful(floor: Array, increments: int) -> _Guard:
    """State of every problem before the first evaluation of the careful attempt."""
    zero, no = jnp.zeros_like(floor), jnp.zeros(floor.shape, bool)
    none = jnp.zeros(floor.shape, jnp.int32)
    damping = jnp.full_like(floor, 0.0 if increments > 1 else _FIRST_DAMPING)
    return _Guard(
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
    )


def _shrunk(step: Any, probe: Array, turn: Callable[[Any], Array]) -> Any:
    """The steps, those of a probe made so small that the residual is linear and so large that its
    rounding is small."""
    size = turn(step)
    scale = jnp.finfo(size.dtype).eps ** 0.25 / jnp.where(size > 0, size, 1.0)
    scale = jnp.where(probe, scale, 1.0)
    return jax.tree.map(lambda s: scale.astype(s.dtype) * s, step)


def _probed(old: _Guard, probe: Array, ratio: Array) -> _Guard:
    """State after a probe, if it was one, along which the motion changed by the factor `ratio`."""
    probes, spent = (count + probe.astype(jnp.int32) for count in (old.probes, old.spent))
    growth = jnp.where(probe & (probes > _SETTLING), old.growth * ratio, old.growth)
    grown = (probes == _PROBES) & (growth > 1)
    return old._replace(definite=old.definite & ~grown, spent=spent, probes=probes, growth=growth)


def _attempt(old: _Guard, plain: Array, increments: int, levels: int) -> tuple[Array, Array]:
    """Damping and load increments of the next evaluation: less and more than before if the last
    step may be tried."""
    damping = jnp.where(old.fresh, _lowered(old.damping), old.damping)
    more = jnp.where(old.fresh, jnp.minimum(old.applied + 1, increments), old.applied)
    if levels > increments:
        settled = old.fresh & (old.damping == 0) & (old.size < _SETTLED)
        further = jnp.where(old.clear, levels, jnp.minimum(old.applied + 1, levels))
        further = jnp.where(settled, further, old.applied)
        more = jnp.where(old.applied >= increments, further, more)
    return jnp.where(plain, 0.0, damping), jnp.where(plain, levels, more)


def _shorter(old: _Guard) -> _Guard:
    """State where a step is halved. Steps after it shrink because of that, not linearly."""
    return old._replace(
        spent=old.spent + 1,
        cuts=old.cuts + 1,
        whole=jnp.zeros_like(old.whole),
        contraction=jnp.full_like(old.contraction, jnp.inf),
    )


def _accepted(
    old: _Guard,
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


def _worse(old: _Guard, new: Damped, applied: Array, accepted: Array) -> Array:
    """Whether a step of what slides does not lower the residual, and is halved."""
    assert new.slides is not None
    here = new.slides & old.fresh & (old.applied == applied) & (old.cuts < _CUTS)
    return here & ~(new.merit < jnp.maximum(old.merit, accepted))


def _judged(
    old: _Guard,
    new: Damped,
    left: Array,
    taken: Array,
    plain: Array,
    damping: Array,
    applied: Array,
    floor: Array,
    accepted: Array,
    small: float,
) -> tuple[_Guard, Array, Array]:
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


def _linear(old: _Guard, guard: _Guard) -> Array:
    """Whether steps shrink by nearly the same factor, and not by its square."""
    there = guard.whole > old.whole
    return there & (guard.contraction > _QUADRATIC * old.contraction)


def _slowest(old: _Guard, guard: _Guard, linear: Array) -> Array:
    """Rate of linear convergence since the loads, the damping or the attempt changed, 0 if there
    was none."""
    rate = jnp.where(linear, guard.contraction, 0.0)
    return jnp.maximum(rate, jnp.where(guard.whole > 0, old.rate, 0.0))


def _raised(damping: Array) -> Array:
    return jnp.maximum(_RAISE * damping, _MIN_DAMPING)


def _lowered(damping: Array) -> Array:
    return jnp.where(damping >= _LOWER * _MIN_DAMPING, damping / _LOWER, 0.0)
