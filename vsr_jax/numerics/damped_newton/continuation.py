"""The way to the whole problem: load increments, stages of constraints, loosening and a second
attempt."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from ..component import select
from . import convergence, probe, termination
from .problem import Schedule, Setting, Stage
from .state import Path, State, Trial, Verdict

LOAD_INCREMENTS = 5
"""Increments in which `damped_newton` applies the loads where they cannot be applied at once: the
tangent is often indefinite at the start under all loads."""
SOFT_STAGES, HARDENING_STAGES = 1, 4
"""Number of levels after the loads with springs in place of constraints, which have an energy, and
of all by which constraints harden in `damped_newton`."""
FIRST_DAMPING = 1.0
"""Damping to begin with where all loads are one increment."""
_FIRST_STAGES = 100
"""Bound on the evaluations of the first careful attempt where there are stages."""
_SLOW_DAMPING, _HARDER = 100.0, 0.25
"""Damping with which the second one begins, and by how much of a stage its springs are harder."""
_SETTLED = 0.3
"""Norm of an undamped step, or angle [rad] by which it turns the arm, below which the next stage
begins."""
_DIRECT = 30
"""Bound on the evaluations of a direct attempt."""
_SLIDING, _CLOSE = 20, 1e-3
"""The same where something slides with friction, and norm of a step below which the attempt may
take twice as many."""
_JUMPING, _BACK = 40, 2
"""Number of evaluations without an energy after which the problem is loosened, and by how many
stages it goes back then."""


class Attempt(NamedTuple):
    """Damping and path with which an attempt begins."""

    damping: Array
    path: Path


def attempts(like: Array, schedule: Schedule) -> tuple[Attempt, Attempt]:
    """The first and the second attempt.

    Without direct attempts, paths with friction of tendons take 53 % more evaluations. Without load
    increments in the second one, the hard arms of `TABLE` in tests/test_hard_loads.py take 12 %
    more.

    A second attempt after a careful one is slow, loosened, and has harder springs. If it is not
    loosened, or its springs are not harder, arms in a tube end on unstable shapes
    (`test_an_arm_that_would_snap_aside_is_found_aside` in tests/test_contact_tube.py).
    """
    no = jnp.zeros(like.shape, bool)
    path = Path(jnp.ones_like(like), no, no, jnp.zeros(like.shape, jnp.int32))
    first = 0.0 if schedule.increments > 1 else FIRST_DAMPING
    careful = Attempt(jnp.full_like(like, first), path)
    again = path._replace(restarted=~no)
    if schedule.direct:
        whole = path._replace(level=jnp.full_like(like, schedule.last))
        return Attempt(jnp.full_like(like, schedule.damping), whole), careful._replace(path=again)
    slow = again._replace(level=again.level + _HARDER, loose=~no)
    return careful, Attempt(jnp.full_like(like, _SLOW_DAMPING), slow)


def is_slow(path: Path, schedule: Schedule) -> Array:
    """Which problems are in a second attempt that follows a careful one.

    If their steps are cut, with the slope of what is left, and their stages end as in the first
    one, `test_an_arm_that_would_snap_aside_is_found_aside` in tests/test_contact_tube.py fails.
    """
    return path.restarted & (not schedule.direct)


def next_level(state: State, turn: Array, schedule: Schedule) -> Array:
    """Level of the next evaluation, after a step that turns the arm by some angle: one more than
    before if the step is ready to be tried. A stage ends with a small undamped step, and all of
    them where the constraints hold by a wide margin.

    Without that jump, and with steps that go back halved there too, a light arm on a floor ends
    loosened (`test_an_arm_on_a_floor_says_that_its_contacts_are_loosened` in
    tests/test_contact.py).
    """
    level, ready, last = state.path.level, state.control.ready, schedule.last
    following = jnp.where(ready, jnp.minimum(level + 1, schedule.increments), level)
    if not schedule.stages:
        return following
    turns_little = ~is_slow(state.path, schedule) & (turn < _SETTLED)
    small = (state.local.step_norm < _SETTLED) | turns_little
    settled = ready & (state.control.damping == 0) & small
    harder = jnp.where(state.local.clear, last, jnp.minimum(level + 1, last))
    harder = jnp.where(settled, harder, level)
    return jnp.where(level >= schedule.increments, harder, following)


def stage(path: Path, level: Array, schedule: Schedule) -> Stage:
    """The problem at a level of a path."""
    share = jnp.minimum(level / schedule.increments, 1.0)
    if schedule.stages:
        share = share + jnp.maximum(level - schedule.increments, 0.0) / schedule.stages
    return Stage(share, path.loose, path.restarted)


def without_energy(path: Path, level: Array, schedule: Schedule) -> Array:
    """Which problems have no energy at a level: careful attempts with nearly exact constraints.
    Every finite step is then accepted.

    Where these are judged by the energy too, arms that lie along a floor take 56 % more
    evaluations.
    """
    careful = path.restarted | (not schedule.direct)
    return careful & (level >= schedule.increments + schedule.soft)


def updated(path: Path, trial: Trial, verdict: Verdict) -> Path:
    """Path after a trial."""
    return path._replace(level=jnp.where(verdict.accepted, trial.level, path.level))


def loosened(state: State, trial: Trial, busy: Array, schedule: Schedule) -> State:
    """The state, or that of the loosened problem where nearly exact constraints have jumped without
    end: it goes on from where it is.

    Without it, an arm that lies along a floor is not solved with loosened contacts
    (`test_an_arm_on_a_floor_says_that_its_contacts_are_loosened` in tests/test_contact.py).
    """
    path = state.path
    counted = trial.without_energy & ~trial.probing
    path = path._replace(without_energy=path.without_energy + counted.astype(jnp.int32))
    jumping = (path.without_energy >= _JUMPING) & busy & ~path.loose
    back = state._replace(
        path=path._replace(
            level=jnp.full_like(path.level, schedule.last - _BACK),
            loose=~jnp.zeros_like(path.loose),
        ),
        convergence=convergence.begin(path.level),
    )
    return select(jumping, back, state._replace(path=path))


def fails(
    state: State, trial: Trial, verdict: Verdict, busy: Array | None, setting: Setting
) -> Array:
    """Which first attempts fail, so that the second one begins. Careful ones fail where they end
    without a stable solution, or take too many evaluations.

    Where unstable solutions are kept, arms in a tube end on them
    (`test_an_arm_that_would_snap_aside_is_found_aside` in tests/test_contact_tube.py).
    """
    if setting.schedule.direct:
        return _direct_fails(state, trial, verdict)
    assert busy is not None
    unsolved = ~busy & ~(probe.stable(state) & termination.converged(state, setting))
    return unsolved | (state.evaluations >= _FIRST_STAGES)


def _direct_fails(state: State, trial: Trial, verdict: Verdict) -> Array:
    """Which direct attempts fail: at the first step that is not accepted, at the first tangent that
    is not positive definite, as unstable, or after some evaluations.

    Without that bound, three cables that make each other slack in turn do so
    without end (`test_lengths_of_a_shape_give_back_its_tensions` in tests/test_discs.py).

    Where an indefinite tangent is damped instead, the hard arms of `TABLE` in
    tests/test_hard_loads.py take 10 % more evaluations. Without the bound for what slides, one of
    336 samples on floors fails (benchmarks/friction_search.py --arms 16 --steps 12); if it does
    not double near the solution, they take 6 % more.
    """
    stopped = ~(verdict.accepted & trial.new.definite)
    if trial.new.out is not None:
        stopped = stopped | trial.new.out
    failed = jnp.where(trial.solving, stopped, probe.unstable(state.probe))
    if verdict.sliding is None:
        return failed | (trial.solving & (state.evaluations > _DIRECT))
    most = jnp.where(state.local.step_norm < _CLOSE, 2 * _SLIDING, _SLIDING)
    late = trial.solving & (state.evaluations > most)
    return (failed & ~(trial.solving & verdict.sliding)) | late
