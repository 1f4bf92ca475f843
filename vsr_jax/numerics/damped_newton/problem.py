"""What `damped_newton` solves: one evaluation, the measures of steps, tolerances and load
levels."""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array


class Damped(NamedTuple):
    """Evaluation of one point and one damping.

    **Fields:** the step to subtract and its norm; the residual and its norm, the merit; whether the
    damped tangent is positive definite, and whether that is doubtful, since the tangent is far from
    symmetric; with constraints, whether they hold by a wide margin; with friction, whether
    something slides, so that there is no energy; whether the point is `out` of what the problem is
    stated for, so that nothing follows from it.
    """

    step: Any
    size: Array
    residual: Any
    merit: Array
    definite: Array
    doubtful: Array
    clear: Array | None = None
    slides: Array | None = None
    out: Array | None = None


class Measures(NamedTuple):
    """Measures of steps, with one entry per problem: `work`, the scalar product of a residual and a
    step; `turn`, a norm of a step; a step that `stirs` all motions, of size 1 or so; and `dot`, the
    scalar product of two, where convergence may be linear."""

    work: Callable[[Any, Any], Array]
    turn: Callable[[Any], Array]
    stirs: Any
    dot: Callable[[Any, Any], Array] | None = None


class Tolerance(NamedTuple):
    """Largest residual norm that is `rounding`, largest `accepted` one, and norm of a negligible
    `step`."""

    rounding: Array
    accepted: Array
    step: float


class Stage(NamedTuple):
    """The problem that is evaluated: `share` of the loads, and above 1 that of the stages; whether
    it is the `loose` one, and whether it is one of a second attempt, `restarted`."""

    share: Array
    loose: Array
    restarted: Array


class Schedule(NamedTuple):
    """Levels of a problem: the loads come in equal `increments`, then constraints harden in some
    `stages`, in the first `soft` of which the problem has an energy. In a `direct` first attempt
    all of this is applied at once, first with a `damping`."""

    increments: int = 1
    stages: int = 0
    soft: int = 0
    direct: bool = False
    damping: float = 0.0

    @property
    def last(self) -> int:
        """The level of the whole problem."""
        return self.increments + self.stages


class Setting(NamedTuple):
    """What does not change in the iteration."""

    measures: Measures
    tolerance: Tolerance
    schedule: Schedule
