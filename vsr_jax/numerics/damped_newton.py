"""Newton's method with Levenberg damping, for residuals that are nearly the gradient of an energy;
several problems side by side."""

from collections.abc import Callable
from typing import Any, NamedTuple

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
step below which the attempt may take twice as many, and a doubtful sign may be rounding."""
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
    - Single precision. Near the solution, a doubtful tangent is taken to be as definite as the one
      before it: rounding may change a sign. It is probed in the end.
    - Friction. What `slides` has no energy: its steps are accepted where the residual becomes
      smaller, else halved, some times. Its first attempt has at most `_SLIDING` evaluations, near
      the solution twice as many.
    - Probing. Where the tangent is doubtful at the end, the arm is moved from the solution by the
      last step and by one that stirs all motions, made small, and creeps: $s_{n+1} = s_n + (H + \mu
      \Sigma)^{-1} r(x - s_n)$. The solution is unstable if the motion grows after some steps.
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
    twice = increments > 1 or origin is not None
    first, second = _attempts(floor, increments, stages, twice)
    small = float(jnp.finfo(floor.dtype).eps ** 0.75)
    method = _Method(
        jax.jit(evaluate, inline=True),  # traced once for its shapes and in the loop
        measures,
        start,
        start if origin is None else origin,
        first,
        second,
        floor,
        jnp.maximum(_ACCEPTED * floor, small),
        small,
        increments,
        stages,
        twice,
    )
    return Iteration(method.begin, method.advance, method.busy, method.root)


def _attempts(floor: Array, increments: int, stages: int, twice: bool) -> tuple[Guard, Guard]:
    """State of every problem before its first and before its second attempt."""
    careful = rules.careful(floor, increments)
    second = careful._replace(gradual=~careful.gradual)
    if twice:
        whole = jnp.full_like(floor, increments + stages)
        return careful._replace(applied=whole, damping=jnp.zeros_like(floor)), second
    slow, harder = jnp.full_like(floor, _SLOW_DAMPING), second.applied + _HARDER
    return careful, second._replace(applied=harder, damping=slow, loose=~second.loose)


class _State(NamedTuple):
    """State of the iteration: the last point, the step to subtract from it, the steps before that
    one where linear convergence is accelerated, else None, and the rest."""

    x: Any
    step: Any
    earlier: Earlier | None
    guard: Guard


class _Trial(NamedTuple):
    """A point that was evaluated.

    **Fields:** the point; the step to it and the angle by which that turns the arm; whether it is a
    probe, a plain Newton step, one of a slow second attempt, one without an energy; damping and
    load increments; what was found; the work of the new residual over the step; whether the step is
    taken; whether it is to be halved, since something slides, whether made shorter, since springs
    are too steep for it, and whether one of both, None where that cannot be.
    """

    point: Any
    step: Any
    turn: Array
    probe: Array
    plain: Array
    slow: Array
    hard: Array
    damping: Array
    applied: Array
    new: Damped
    left: Array
    taken: Array
    slid: Array | None
    steep: Array | None
    cut: Array | None


class _Method(NamedTuple):
    """The method of `damped_newton` with its arguments.

    **Fields:** beside these, the state before the `first` and before the `second` attempt; the
    largest `accepted` residual and the size of a negligible, `small` step; `twice`: whether the
    second attempt is the careful one.
    """

    evaluate: Callable[[Any, Array, Array, Array], Damped]
    measures: Measures
    start: Any
    origin: Any
    first: Guard
    second: Guard
    floor: Array
    accepted: Array
    small: float
    increments: int
    stages: int
    twice: bool

    @property
    def levels(self) -> int:
        """Load increments and stages."""
        return self.increments + self.stages

    def begin(self, like: _State | None) -> _State:
        """The first state; `like`: any other one, None if there is none yet."""
        if like is None:
            given = self.start, self.floor, self.floor, self.first.loose
            step = jax.eval_shape(self.evaluate, *given).step
        else:
            step = like.step
        step = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), step)
        earlier = None if self.measures.dot is None else Earlier(step, step, step)
        return _State(self.start, step, earlier, self.first)

    def busy(self, state: _State) -> Array:
        """Which problems are not done."""
        return self._going(state.guard) | self._probing(state.guard)

    def root(self, state: _State) -> Root:
        """The result."""
        guard = state.guard
        return Root(state.x, self._sound(guard), guard.definite, guard.spent, guard.loose)

    def advance(self, state: _State) -> _State:
        """The state after one evaluation."""
        trial = self._tried(state)
        old, hard = state.guard, trial.hard
        guard, more, last = rules.judged(
            old,
            trial.new,
            trial.left,
            trial.taken,
            trial.plain | hard,
            trial.damping,
            trial.applied,
            self.floor,
            self.accepted,
            self.small,
        )
        shorter = 1.0
        if trial.cut is not None:
            less, shorter = rules.shorter(old, trial.steep)
            guard = select(trial.cut, less, guard._replace(cuts=jnp.zeros_like(old.cuts)))
        guard = guard._replace(plain=old.plain + trial.plain.astype(jnp.int32))
        last = once(last)
        more = once(jnp.where(trial.probe, 1.0, jnp.where(hard, 0.0, more)))
        step, earlier, guard = self._following(state, trial, guard, more, shorter)
        work = self.measures.work(trial.new.residual, step)
        pull = jnp.where(trial.taken, work, guard.pull)
        go = once(self._going(old))
        ratio = self.measures.turn(step) / trial.turn
        guard = select(go, guard._replace(pull=pull), rules.probed(old, trial.probe, ratio))
        finished = jax.tree.map(
            lambda a, s: a - jnp.where(last, s, 0.0).astype(a.dtype), trial.point, trial.new.step
        )
        x = select(go & trial.taken, finished, state.x)
        return self._again(_State(x, step, earlier, guard), old, trial, go)

    def _sound(self, guard: Guard) -> Array:
        """Which problems have an accepted residual, with constraints that are exact."""
        sound = guard.merit <= self.accepted
        return sound & (guard.applied == self.levels) if self.stages else sound

    def _going(self, guard: Guard) -> Array:
        """Which problems are not solved."""
        negligible = (guard.miss < self.small) | (guard.rises >= _MAX_RISES)
        done = guard.fresh & (guard.damping == 0) & (guard.merit <= self.accepted) & negligible
        stuck = ~guard.definite & (guard.merit < self.floor)
        ended = (done | stuck) & (guard.applied == self.levels)
        return ~ended & (guard.plain < MAX_PLAIN_STEPS)

    def _probing(self, guard: Guard) -> Array:
        """Which solutions are still to be probed."""
        found = ~self._going(guard) & guard.definite & (guard.merit <= self.accepted)
        decayed = guard.growth < _DECAYED
        return found & guard.doubtful & (guard.probes < rules.PROBES) & ~decayed

    def _tried(self, state: _State) -> _Trial:
        """The next evaluation, and whether its step is taken."""
        x, step, _, old = state
        probe = self._probing(old)
        step = rules.shrunk(step, probe, old.probes == 0, self.measures)
        bound = MAX_STAGED_STEPS if self.stages else MAX_DAMPED_STEPS
        plain = (old.spent >= bound) | (old.damping >= _MAX_DAMPING) | (old.plain > 0)
        point = jax.tree.map(lambda a, s: jnp.where(old.fresh, a - s.astype(a.dtype), a), x, step)
        turn = self.measures.turn(step)
        slow = old.gradual & (not self.twice)
        little = None
        if self.stages:
            little = (old.size < _SETTLED) | (~slow & (turn < _SETTLED))
        damping, applied = rules.attempt(old, little, plain, self.increments, self.levels)
        share = jnp.minimum(applied / self.increments, 1.0)
        if self.stages:
            share = share + jnp.maximum(applied - self.increments, 0.0) / self.stages
        damped = jnp.where(probe, _PROBE_DAMPING, damping)
        new = self.evaluate(point, damped, share, old.loose)
        if self.floor.dtype == jnp.float32:
            same = old.definite & new.doubtful & (new.size < _CLOSE)
            new = new._replace(definite=new.definite | same)
        left = self.measures.work(new.residual, step)
        # the stages that are nearly exact have no energy
        hard = (old.gradual | (not self.twice)) & (applied >= self.increments + SOFT_STAGES)
        if new.slides is not None:
            hard = hard | (new.slides & ~old.gradual)
        taken = rules.accepted(old, new, left, self.floor, plain | hard, applied, self.increments)
        slid = steep = cut = None
        if new.slides is not None:
            slid = cut = ~probe & rules.worse(old, new, applied, self.accepted)
            taken = taken & ~slid
        if self.stages:
            steep = ~(probe | plain | hard | slow) & rules.steep(old, taken, self.increments)
            cut = steep if slid is None else slid | steep
        taken, cut = once(taken), None if cut is None else once(cut)
        return _Trial(
            point, step, turn, probe, plain, slow, hard, damping, applied, new, left, taken,
            slid, steep, cut,
        )  # fmt: skip

    def _following(
        self, state: _State, trial: _Trial, guard: Guard, more: Array, shorter: Array | float
    ) -> tuple[Any, Earlier | None, Guard]:
        """The next step, from that found with a part `more` of the last one, or a part `shorter` of
        the last one again; the steps before it; and the state."""
        old, new, dot = state.guard, trial.new, self.measures.dot
        last, earlier = trial.step, state.earlier
        step = jax.tree.map(lambda s, last: s + more.astype(s.dtype) * last, new.step, last)
        if dot is not None:
            if self.stages:
                back = dot(step, last) < -0.5 * dot(last, last)
                half = jnp.where(trial.hard & ~old.clear & back, 0.5, 1.0)
                step = jax.tree.map(lambda s: half.astype(s.dtype) * s, step)
            assert earlier is not None
            tail = ~trial.probe & (trial.turn < _TAIL) & (new.size > self.small)
            linear = once(tail & rules.linear(old, guard))
            near = accelerated(new.step, last, earlier, linear & (old.whole > 0), dot)
            step = select(linear, near, step)
            guard = guard._replace(rate=rules.slowest(old, guard, linear))
            earlier = select(trial.taken, Earlier(new.step, last, earlier.proposed), earlier)
        if trial.cut is not None:
            part = jax.tree.map(lambda s: jnp.asarray(shorter, s.dtype) * s, last)
            step = select(trial.cut, part, step)
        return step, earlier, guard

    def _again(self, state: _State, old: Guard, trial: _Trial, go: Array) -> _State:
        """The state, or that of a second attempt where the first one has failed."""
        if not (self.twice or self.stages):
            return state
        x, step, earlier, guard = state
        failed = jnp.where(go, ~(trial.taken & trial.new.definite), old.definite & ~guard.definite)
        if trial.slid is not None:
            most = jnp.where(guard.size < _CLOSE, 2 * _SLIDING, _SLIDING)
            failed = (failed & ~(go & trial.slid)) | (go & (old.spent >= most))
        if self.stages:
            ended = ~self.busy(state)
            guard = rules.loosened(guard, trial.hard, ended, self.levels)
            if not self.twice:
                sound = guard.definite & self._sound(guard)
                failed = (ended & ~sound) | (guard.spent >= _FIRST_STAGES)
        again = once(~old.gradual & failed)
        guard = select(again, self.second._replace(spent=guard.spent), guard)
        step = jax.tree.map(lambda s: jnp.where(again, 0.0, s).astype(s.dtype), step)
        return _State(select(again, self.origin, x), step, earlier, guard)
