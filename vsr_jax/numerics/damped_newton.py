"""Newton's method with Levenberg damping, for residuals that are nearly the gradient of an energy;
several problems side by side."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from . import damped_rules as rules
from .acceleration import Earlier, accelerated
from .batching import Iteration
from .component import select
from .damped_rules import SOFT_STAGES, Damped, Guard, Measures
from .newton import Root
from .once import once

MAX_DAMPED_STEPS, MAX_STAGED_STEPS = 200, 300
"""Bound on the evaluations of `damped_newton`, and that where there are stages; heavy soft arms
take 22 to 45."""
MAX_PLAIN_STEPS = 25
"""Bound on the plain Newton steps that follow where damping has failed."""
LOAD_INCREMENTS = 5
"""Increments in which `damped_newton` applies the loads where they cannot be applied at once: the
tangent is often indefinite at the start under all loads."""
MAX_TURN = 1.5
"""Bound on the angle [rad] by which one step of a loaded solve bends and twists the arm. A step
that coils the arm may lower the residual without approaching a solution."""
_MAX_DAMPING = 1e8
"""Damping at which plain Newton steps take over."""
_TAIL = 0.3
"""Angle [rad] of a step below which linear convergence is accelerated."""
_FIRST_STAGES = 100
"""Bound on the evaluations of the first careful attempt where there are stages."""
_SLOW_DAMPING, _HARDER = 100.0, 0.25
"""Damping with which the second one begins, and by how much of a stage its springs are harder."""
_SETTLED = 0.3
"""Size of an undamped step, or angle [rad] by which it turns the arm, below which the next stage
begins."""
_SLIDING, _CLOSE = 20, 1e-3
"""Bound on the evaluations of a first attempt where something slides with friction, and size of a
step below which the attempt may take twice as many."""
_ACCEPTED = 64
"""Largest accepted residual, in multiples of its rounding level."""
_MAX_RISES = 3
"""Rises of an accepted residual after which it is taken to be at rounding level."""
_DECAYED, _PROBE_DAMPING = 0.1, 1.0
"""Remainder of the motion of a probed arm that ends the probes, and their damping: a motion of
stiffness $\\lambda$, relative to the elastic one, is multiplied by $1 / (1 + \\lambda)$ in
each."""


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
    - Stages. While springs stand for constraints, a step that is not accepted is made shorter
      before damping rises at its start. The stages of constraints without an energy accept every
      finite step, undamped; one that goes back by half of the last one is halved. Where the
      constraints hold by a wide margin, the last stage follows at once. Nearly exact constraints
      that jump without end are loosened where they are. A problem that ends without a stable root
      begins once more, slowly, loosened and with harder springs.
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
    - `evaluate`: maps a point, a damping $\mu$, the fraction of the loads and whether the problem
      is loosened, which may be another one, to `Damped`.
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
    bound = MAX_STAGED_STEPS if stages else MAX_DAMPED_STEPS
    small = float(jnp.finfo(floor.dtype).eps ** 0.75)
    accepted = jnp.maximum(_ACCEPTED * floor, small)

    def going(guard: Guard) -> Array:
        negligible = (guard.miss < small) | (guard.rises >= _MAX_RISES)
        done = guard.fresh & (guard.damping == 0) & (guard.merit <= accepted) & negligible
        stuck = ~guard.definite & (guard.merit < floor)
        return ~((done | stuck) & (guard.applied == levels)) & (guard.plain < MAX_PLAIN_STEPS)

    def probing(guard: Guard) -> Array:
        found = ~going(guard) & guard.definite & (guard.merit <= accepted)
        decayed = guard.growth < _DECAYED
        return found & guard.doubtful & (guard.probes < rules.PROBES) & ~decayed

    def advance(state: tuple) -> tuple:
        x, step, earlier, old = state
        probe = probing(old)
        step = rules.shrunk(step, probe, measures.turn)
        plain = (old.spent >= bound) | (old.damping >= _MAX_DAMPING) | (old.plain > 0)
        trial = jax.tree.map(lambda a, s: jnp.where(old.fresh, a - s.astype(a.dtype), a), x, step)
        turn = measures.turn(step)
        slow = old.gradual & (not twice)
        little = (old.size < _SETTLED) | (~slow & (turn < _SETTLED)) if stages else None
        damping, applied = rules.attempt(old, little, plain, increments, levels)
        share = jnp.minimum(applied / increments, 1.0)
        if stages:
            share = share + jnp.maximum(applied - increments, 0.0) / stages
        new = evaluate(trial, jnp.where(probe, _PROBE_DAMPING, damping), share, old.loose)
        left = measures.work(new.residual, step)
        # the stages that are nearly exact have no energy
        hard = (old.gradual | (not twice)) & (applied >= increments + SOFT_STAGES)
        if new.slides is not None:
            hard = hard | (new.slides & ~old.gradual)
        taken = rules.accepted(old, new, left, floor, plain | hard, applied, increments)
        slid = steep = cut = None
        if new.slides is not None:
            slid = cut = ~probe & rules.worse(old, new, applied, accepted)
            taken = taken & ~slid
        if stages:
            steep = ~(probe | plain | hard | slow) & rules.steep(old, taken, increments)
            cut = steep if slid is None else slid | steep
        taken, cut = once(taken), None if cut is None else once(cut)
        guard, more, last = rules.judged(
            old, new, left, taken, plain | hard, damping, applied, floor, accepted, small
        )
        shorter = 1.0
        if cut is not None:
            less, shorter = rules.shorter(old, steep)
            guard = select(cut, less, guard._replace(cuts=jnp.zeros_like(old.cuts)))
        guard = guard._replace(plain=old.plain + plain.astype(jnp.int32))
        last, more = once(last), once(jnp.where(probe, 1.0, jnp.where(hard, 0.0, more)))
        new_step = jax.tree.map(lambda s, last: s + more.astype(s.dtype) * last, new.step, step)
        if stages and measures.dot is not None:
            back = measures.dot(new_step, step) < -0.5 * measures.dot(step, step)
            half = jnp.where(hard & ~old.clear & back, 0.5, 1.0)
            new_step = jax.tree.map(lambda s: half.astype(s.dtype) * s, new_step)
        if measures.dot is not None:
            tail = ~probe & (turn < _TAIL) & (new.size > small)
            linear = once(tail & rules.linear(old, guard))
            near = accelerated(new.step, step, earlier, linear & (old.whole > 0), measures.dot)
            new_step = select(linear, near, new_step)
            guard = guard._replace(rate=rules.slowest(old, guard, linear))
            earlier = select(taken, Earlier(new.step, step, earlier.proposed), earlier)
        if cut is not None:
            part = jax.tree.map(lambda s: jnp.asarray(shorter, s.dtype) * s, step)
            new_step = select(cut, part, new_step)
        pull = jnp.where(taken, measures.work(new.residual, new_step), guard.pull)
        go = once(going(old))
        ratio = measures.turn(new_step) / turn
        guard = select(go, guard._replace(pull=pull), rules.probed(old, probe, ratio))
        finished = jax.tree.map(
            lambda a, s: a - jnp.where(last, s, 0.0).astype(a.dtype), trial, new.step
        )
        x = select(go & taken, finished, x)
        if not (twice or stages):
            return x, new_step, earlier, guard
        failed = jnp.where(go, ~(taken & new.definite), old.definite & ~guard.definite)
        if slid is not None:
            most = jnp.where(guard.size < _CLOSE, 2 * _SLIDING, _SLIDING)
            failed = (failed & ~(go & slid)) | (go & (old.spent >= most))
        if stages:
            ended = ~(going(guard) | probing(guard))
            guard = rules.loosened(guard, hard, ended, levels)
            if not twice:
                sound = guard.definite & (guard.merit <= accepted)
                failed = (ended & ~sound) | (guard.spent >= _FIRST_STAGES)
        again = once(~old.gradual & failed)
        guard = select(again, second._replace(spent=guard.spent), guard)
        new_step = jax.tree.map(lambda s: jnp.where(again, 0.0, s).astype(s.dtype), new_step)
        return select(again, origin, x), new_step, earlier, guard

    careful = first = rules.careful(floor, increments)
    second = careful._replace(gradual=~careful.gradual)
    if twice:
        whole = jnp.full_like(floor, levels)
        first = careful._replace(applied=whole, damping=jnp.zeros_like(floor))
    else:
        slow = jnp.full_like(floor, _SLOW_DAMPING)
        harder = second.applied + _HARDER
        second = second._replace(applied=harder, damping=slow, loose=~second.loose)

    def begin(like: tuple | None) -> tuple:
        if like is None:
            step = jax.eval_shape(evaluate, start, floor, floor, first.loose).step
        else:
            step = like[1]
        step = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), step)
        return start, step, None if measures.dot is None else Earlier(step, step, step), first

    def busy(state: tuple) -> Array:
        return going(state[3]) | probing(state[3])

    def root(state: tuple) -> Root:
        x, _, _, guard = state
        return Root(x, guard.merit <= accepted, guard.definite, guard.spent, guard.loose)

    return Iteration(begin, advance, busy, root)
