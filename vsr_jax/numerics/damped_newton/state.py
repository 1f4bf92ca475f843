"""Variables of `damped_newton`; every array has one entry per problem."""

from typing import Any, NamedTuple

from jaxtyping import Array

from ..acceleration import Earlier
from .problem import Damped


class Local(NamedTuple):
    """What is known at the current point. Changed by `termination`.

    **Fields:** norm of the step proposed there; norm of the residual; estimated `error`, the sum of
    all steps to come; `definite`, `doubtful`, `clear` and `out` as in `Damped`.
    """

    step_norm: Array
    residual_norm: Array
    error: Array
    definite: Array
    doubtful: Array
    clear: Array
    out: Array


class Control(NamedTuple):
    """Control of the step. Changed by `acceptance`.

    **Fields:** `damping` $\\mu$; whether the step is `ready` to be tried, since the tangent with
    this damping is positive definite; `slope` $r(x) \\cdot s$ of the energy along the step s;
    number of `cuts` in a row by which the step was shortened.
    """

    damping: Array
    ready: Array
    slope: Array
    cuts: Array


class Convergence(NamedTuple):
    """How fast full steps shrink: undamped ones at one load level. Changed by `convergence`.

    **Fields:** number of `full` steps in a row; ratio of the norms of the last two; `rate` of
    linear convergence, 0 if there is none; number of `rises` of an accepted residual.
    """

    full: Array
    ratio: Array
    rate: Array
    rises: Array


class Path(NamedTuple):
    """Where the problem is on its way to all loads. Changed by `continuation`.

    **Fields:** load `level`; whether the problem has `restarted`; whether it is the `loose` one;
    number of evaluations `without_energy`.
    """

    level: Array
    restarted: Array
    loose: Array
    without_energy: Array


class Probe(NamedTuple):
    """Number of `steps` of the stability probe, and `growth` of the motion in them. Changed by
    `probe`."""

    steps: Array
    growth: Array


class State(NamedTuple):
    """State of the iteration.

    **Fields:** the `point` x; the `step` s to subtract; the `earlier` steps, where linear
    convergence is accelerated, else None; numbers of `evaluations` and of `plain` Newton steps; the
    parts above.
    """

    point: Any
    step: Any
    earlier: Earlier | None
    evaluations: Array
    plain: Array
    local: Local
    control: Control
    convergence: Convergence
    path: Path
    probe: Probe


class Trial(NamedTuple):
    """One evaluation.

    **Fields:** whether it is one of a problem that is still to be solved, `solving`, one of the
    probe, `probing`, and one of a `plain` Newton step; the point; the step to it, and its `turn`;
    `damping` and load `level`; what was found, `new`; `work` $r(x - s) \\cdot s$ of the new
    residual over the step; whether there is no energy, so that every step is accepted.
    """

    solving: Array
    probing: Array
    plain: Array
    point: Any
    step: Any
    turn: Array
    damping: Array
    level: Array
    new: Damped
    work: Array
    without_energy: Array

    @property
    def forced(self) -> Array:
        """Whether the step is accepted wherever the residual is finite."""
        return self.plain | self.without_energy


class Verdict(NamedTuple):
    """What becomes of a step.

    **Fields:** whether it is `accepted`; whether it is shortened since something is `sliding`, and
    since springs are too `steep` for it; whether it is `cut` for one of both, all None where that
    cannot be; what `part` of it is left then.
    """

    accepted: Array
    sliding: Array | None = None
    steep: Array | None = None
    cut: Array | None = None
    part: Array | float = 1.0
