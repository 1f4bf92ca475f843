"""The iteration of `damped_newton`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..acceleration import Earlier
from ..batching import Iteration
from ..component import select
from ..newton import Root
from ..once import once
from . import acceptance, continuation, convergence, descent, probe, termination
from .problem import Damped, Measures, Schedule, Setting, Stage, Tolerance
from .state import State, Trial, Verdict

_ACCEPTED = 64
"""Largest accepted residual, in multiples of its rounding level."""


def damped_newton(
    evaluate: Callable[[Any, Array, Stage], Damped],
    measures: Measures,
    start: Any,
    floor: Array,
    schedule: Schedule,
    origin: Any = None,
) -> Iteration:
    r"""Root of a residual that is the gradient of an energy, or nearly so, by Newton's method with
    Levenberg damping.

    The step s from a point x, $(H + \mu \Sigma) s = r(x)$ with the tangent H, is subtracted: an
    implicit time step of a creeping arm. The damping $\mu$ rises until the tangent is positive
    definite and the step is accepted, and falls with every accepted step.

    In a direct first attempt all loads are applied at once, without damping. Where it fails, the
    problem begins again from `origin`, and load increments lead to it (see `continuation`). A
    careful one begins with a damping. With stages, springs stand for constraints first; they harden
    level by level, and are exact at the last one.

    The iteration ends where the step is undamped, the residual is accepted, and the sum of all
    steps to come is negligible (see `termination`). A residual that is not accepted never ends it
    before a bound does. Where the tangent of a solution is doubtful, a `probe` finds out whether it
    is stable.

    Several problems can be solved together, in the last axes of all arrays. Each has its own
    damping and level, and stops when it is done.

    **Arguments:**
    - `evaluate`: maps a point, a damping $\mu$ and a stage of the problem to `Damped`.
    - `measures`: of steps.
    - `floor`: size of the residual that counts as rounding, one entry per problem.
    - `schedule`: load increments, and stages after them, each of which begins once the problem
      before it is nearly solved.
    - `origin`: where the second attempt begins, the start by default.

    **Returns:** the `Iteration`, whose result is a `Root`: it is converged if the residual is
    rounding or as small as a negligible step.
    """
    small = float(jnp.finfo(floor.dtype).eps ** 0.75)
    setting = Setting(
        measures,
        Tolerance(rounding=floor, accepted=jnp.maximum(_ACCEPTED * floor, small), step=small),
        schedule,
    )
    method = _Method(
        jax.jit(evaluate, inline=True),  # traced once for its shapes and in the loop
        setting,
        start,
        start if origin is None else origin,
        *continuation.attempts(floor, setting.schedule),
    )
    return Iteration(method.begin, method.advance, method.busy, method.root)


class _Method(NamedTuple):
    """The method with its arguments, and how the `first` and the `second` attempt begin."""

    evaluate: Callable[[Any, Array, Stage], Damped]
    setting: Setting
    start: Any
    origin: Any
    first: continuation.Attempt
    second: continuation.Attempt

    def begin(self, like: State | None) -> State:
        """The first state; `like`: any other one, None if there is none yet."""
        if like is None:
            nothing = jnp.zeros_like(self.first.damping)
            stage = continuation.stage(self.first.path, nothing, self.setting.schedule)
            step = jax.eval_shape(self.evaluate, self.start, nothing, stage).step
        else:
            step = like.step
        step = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), step)
        earlier = None if self.setting.measures.dot is None else Earlier(step, step, step)
        none = jnp.zeros(self.first.damping.shape, jnp.int32)
        return _beginning(self.first, self.start, step, earlier, none)

    def busy(self, state: State) -> Array:
        """Which problems are not done."""
        solving = termination.solving(state, self.setting)
        return solving | probe.pending(state, solving, self.setting.tolerance)

    def root(self, state: State) -> Root:
        """The result."""
        return Root(
            state.point,
            termination.converged(state, self.setting),
            probe.stable(state),
            state.evaluations,
            state.path.loose,
            state.path.restarted,
        )

    def advance(self, state: State) -> State:
        """The state after one evaluation: of a Newton step, or of a step of the probe."""
        setting, tolerance = self.setting, self.setting.tolerance
        trial = self._trial(state)
        verdict = acceptance.judge(state, trial, setting)
        control = acceptance.updated(state.control, trial, verdict)
        contraction = convergence.measured(state, trial, verdict, control, setting)
        step = descent.next_step(state, trial, verdict, contraction, setting)

        last, local = termination.local(state, trial, contraction, tolerance)
        slope = setting.measures.work(trial.new.residual, step)
        newton = state._replace(
            plain=state.plain + trial.plain.astype(jnp.int32),
            local=select(verdict.accepted, local, state.local),
            control=control._replace(slope=jnp.where(verdict.accepted, slope, control.slope)),
            convergence=convergence.updated(state, trial, contraction, tolerance),
            path=continuation.updated(state.path, trial, verdict),
        )
        # in place of a Newton step, a problem that is solved may take a step of the probe
        growth = setting.measures.turn(step) / trial.turn
        probed = state._replace(probe=probe.updated(state.probe, trial, growth))
        moved = trial.solving & verdict.accepted
        state = select(trial.solving, newton, probed)._replace(
            point=select(moved, descent.finished(trial, last), state.point),
            step=step,
            earlier=descent.remembered(state.earlier, trial, verdict),
            evaluations=state.evaluations + (trial.solving | trial.probing).astype(jnp.int32),
        )
        return self._continued(state, trial, verdict)

    def _trial(self, state: State) -> Trial:
        """The next evaluation: of the point after the step, where that is ready to be tried, else
        of the same point with more damping."""
        measures, tolerance, schedule = self.setting
        solving = once(termination.solving(state, self.setting))
        probing = probe.pending(state, solving, tolerance)
        step = probe.displaced(state, probing, measures)
        point = descent.ahead(state, step)
        turn = measures.turn(step)
        plain = termination.takes_plain_steps(state, schedule)
        damping = jnp.where(plain, 0.0, acceptance.next_damping(state.control))
        level = continuation.next_level(state, turn, schedule)
        level = jnp.where(plain, schedule.last, level)
        new = self.evaluate(
            point,
            jnp.where(probing, probe.DAMPING, damping),
            continuation.stage(state.path, level, schedule),
        )
        return Trial(
            solving=solving,
            probing=probing,
            plain=plain,
            point=point,
            step=step,
            turn=turn,
            damping=damping,
            level=level,
            new=probe.left_to_it(new, state.local),
            work=measures.work(new.residual, step),
            without_energy=continuation.without_energy(state.path, level, schedule),
        )

    def _continued(self, state: State, trial: Trial, verdict: Verdict) -> State:
        """The state, that of the loosened problem, or the beginning of the second attempt."""
        schedule = self.setting.schedule
        if not (schedule.direct or schedule.stages):
            return state
        busy = None
        if schedule.stages:
            busy = self.busy(state)
            state = continuation.loosened(state, trial, busy, schedule)
        failed = continuation.fails(state, trial, verdict, busy, self.setting)
        again = once(~state.path.restarted & failed)
        none = jax.tree.map(jnp.zeros_like, state.step)
        second = _beginning(self.second, self.origin, none, state.earlier, state.evaluations)
        return select(again, second, state)


def _beginning(
    attempt: continuation.Attempt,
    point: Any,
    none: Any,
    earlier: Earlier | None,
    evaluations: Array,
) -> State:
    """State before the first evaluation of an attempt; `none` is a step of zero."""
    zero = jnp.zeros_like(attempt.damping)
    return State(
        point,
        none,
        earlier,
        evaluations,
        plain=jnp.zeros(zero.shape, jnp.int32),
        local=termination.begin(zero),
        control=acceptance.begin(attempt.damping),
        convergence=convergence.begin(zero),
        path=attempt.path,
        probe=probe.begin(zero),
    )
