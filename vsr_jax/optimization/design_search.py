r"""Design by gradient: numbers of a scene and its inputs that make an objective least under
constraints.

$$\min_p f(p) \quad \text{with} \quad g_k(p) \ge 0, \quad p_0 \le p \le p_1,$$

where every evaluation solves the scene for several sets of inputs, and the derivatives are those of
the equilibria.
"""

import os
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
import optax
from jaxtyping import Array, Float
from tqdm import tqdm

from ..arm.scene import Scene
from ..models.base import Model
from ..validation import count, positive
from .checkpoint import Checkpoint
from .constraint import Constraint
from .descent import Problem, State, Trace, adam, begin, chosen, descend, weight
from .problem import Terms, posed

_CHUNK = 25
_LEVEL = 1e-4


class Start(NamedTuple):
    """What one start came to: its best scene and inputs, their objective, and the greatest
    violation of a constraint, 0 if feasible."""

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    objective: float
    violation: float


class Design(NamedTuple):
    """What `design` found.

    - `scene`, `inputs` (sets, actuators): the best; a scene like any other, which can be solved,
      saved and designed further.
    - `objective`: its value there. `feasible`: whether it keeps all constraints.
    - `margins`: the least margin of each constraint by name, without unit, negative where it is
      violated.
    - `starts`: the best of each start, in order. `trace`: objective and violation of each start at
      each step taken.
    """

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    objective: float
    feasible: bool
    margins: dict[str, float]
    starts: tuple[Start, ...]
    trace: Trace


def design(
    scene: Scene,
    free: Mapping[str, Any],
    objective: Any,
    inputs: Any,
    *,
    constraints: Sequence[Constraint] = (),
    uncertain: Mapping[str, float] | None = None,
    model: Model | None = None,
    starts: int = 8,
    steps: int = 400,
    learning_rate: float = 0.05,
    optimizer: optax.GradientTransformation | None = None,
    candidates: int = 64,
    seed: int = 0,
    enough: float | None = None,
    patience: int | None = None,
    out: str | os.PathLike | None = None,
    progress: bool = True,
) -> Design:
    r"""Numbers of a scene that make an objective least: routings, tapers, moduli, lengths, rest
    curvature, inputs.

        free = {
            "actuators[0].routing.radius": (0.002, 0.009),
            "actuators[0].routing.angle": (1.3, 1.55),
        }
        kept = [vsr.constraint.Inside(wall=0.001)]
        found = vsr.design(
            scene, free, vsr.objective.CurveError(points), [[8.0]], constraints=kept
        )
        vsr.save(found.scene, "designed.toml", found.inputs[0])

    Free numbers are kept between their bounds by $p = p_0 + (p_1 - p_0) \sin^2(z / 2)$, constraints
    by penalties on their way and by the choice among what keeps them in the end. All starts go side
    by side in one compiled program.

    **Arguments:**
    - `scene`: where the design begins; its numbers are the first start.
    - `free`: bounds by name, as `vsr_jax.parameters` tells of them: a pair of numbers, or of arrays
      of the number's shape. `[*]` stands for every index; `inputs` for all inputs. A phase may have
      None, to turn without end.
    - `objective`: an `Objective`, or a function of `Arms`.
    - `inputs`: the sets of inputs, shape (sets, actuators), one row for one set. Their dtype is the
      precision.
    - `constraints`: `Inside()`, threads inside the section, is kept in any case.
    - `uncertain`: relative standard deviations by name; the objective becomes its mean over eight
      scenes drawn so.
    - `model`: as for `solve`.
    - `starts`: the first is the scene itself, each other the best of `candidates` that are drawn
      between the bounds from `seed`.
    - `steps`, `learning_rate`: of Adam, whose learning_rate falls along a cosine; `optimizer`:
      another one of optax.
    - `enough`: value of the objective to stop at; `patience`: steps without gain of a
      ten-thousandth after which to stop.
    - `out`: a file to keep what is reached in; the same call goes on from there.
    - `progress`: whether to show a bar.

    **Returns:** a `Design`.

    **Raises:** `ValueError` if nothing is free, for unknown names, bounds that contradict each
    other, targets that do not fit the sets of inputs, inputs out of range, and if not one start is
    in equilibrium anywhere.
    """
    problem, terms, given = posed(
        scene, free, objective, inputs, constraints, uncertain or {}, model
    )
    total = count("design.steps", steps)
    method = (
        adam(positive("design.learning_rate", learning_rate), total)
        if optimizer is None
        else optax.with_extra_args_support(optimizer)
    )
    many = count("design.starts", starts)
    kept = Checkpoint(
        out, problem, method, (many, count("design.candidates", candidates), seed, total)
    )
    states = begin(problem, method, given, many, candidates, seed)
    states, trace = _run(problem, method, kept, states, total, _Stop(enough, patience), progress)
    return _result(problem, terms, states, trace)


class _Stop(NamedTuple):
    """When a descent has done enough."""

    enough: float | None
    patience: int | None

    def says(self, trace: Trace) -> bool:
        reached = np.minimum.accumulate(
            np.min(np.where(trace.violation <= 0, trace.objective, np.inf), axis=1)
        )
        if self.enough is not None and reached[-1] <= self.enough:
            return True
        if (
            self.patience is None
            or len(reached) <= self.patience
            or not np.isfinite(reached[-1 - self.patience])
        ):
            return False
        before = reached[-1 - self.patience]
        return before - reached[-1] <= _LEVEL * abs(before)


def _run(
    problem: Problem,
    method: Any,
    kept: Checkpoint,
    states: State,
    total: int,
    stop: _Stop,
    progress: bool,
) -> tuple[State, Trace]:
    states, trace = kept.begun(states)
    with tqdm(
        total=total, initial=len(trace.objective), unit=" steps", disable=not progress
    ) as bar:
        while len(trace.objective) < total and not (len(trace.objective) and stop.says(trace)):
            first, rows = len(trace.objective), []
            for done in range(first, min(first + _CHUNK, total)):
                states, row = descend(problem, method, states, weight(done, total))
                rows.append(row)
            trace = Trace(
                *(
                    np.concatenate([old, np.stack(new)])
                    for old, new in zip(trace, zip(*rows, strict=True), strict=True)
                )
            )
            kept.write(states, trace)
            best = chosen(states.best)
            feasible = int(np.sum(np.asarray(states.best.violation) <= 0))
            bar.set_postfix_str(
                f"objective {float(states.best.objective[best]):.3g}, {feasible} feasible",
                refresh=False,
            )
            bar.update(len(rows))
    return states, trace


def _result(problem: Problem, terms: Terms, states: State, trace: Trace) -> Design:
    best = chosen(states.best)
    if not np.isfinite(states.best.objective[best]):
        raise ValueError(
            "design: not one start found an equilibrium, need bounds and inputs for which the "
            "scene can be solved"
        )
    free = problem.at(states.best.z)
    found = []
    for i, (objective, violation) in enumerate(
        zip(states.best.objective, states.best.violation, strict=True)
    ):
        found.append(
            Start(
                *terms.placed(jax.tree.map(lambda x, i=i: x[i], free)),
                float(objective),
                float(violation),
            )
        )
    margins = [float(x) for x in states.best.margins[best]]
    names = [str(constraint) for constraint in terms.constraints]
    one = found[best]
    return Design(
        one.scene,
        one.inputs,
        one.objective,
        one.violation <= 0,
        dict(zip(names, margins, strict=True)),
        tuple(found),
        trace,
    )
