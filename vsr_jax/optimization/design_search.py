r"""Design by gradient: numbers of a scene and its inputs that minimise an objective under
constraints.

$\min_p f(p) \quad \text{subject to} \quad g_k(p) \ge 0, \quad p_0 \le p \le p_1$

Every evaluation solves the scene for several sets of inputs. The derivatives are the implicit
derivatives of the equilibria.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float
from tqdm import tqdm

from ..analysis.arms import Arms
from ..analysis.constraint import Constraint
from ..arm.scene import Scene
from ..arm.scene_numbers import parameters
from ..models.base import Model
from ..numerics.compiling import messages
from ..typing import ArrayLike, PathLike, Scalar
from ..validation import instance, is_traced
from .checkpoint import Checkpoint
from .descent import (
    DescentState,
    DesignProblem,
    History,
    begin,
    best_start,
    descend,
    penalty_weight,
)
from .objective import Objective
from .problem import INPUTS, Bounds, Terms, formulate
from .search import Search

_CHUNK = 25
"""Steps between two checkpoints and between two tests of when to stop: each of them waits for the
device."""


class Start(NamedTuple):
    """Result of one start: its best scene and inputs, their objective, and the largest violation of
    a constraint, 0 if feasible."""

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    objective: float
    violation: float


class Design(NamedTuple):
    """Result of `design`; `print` it for a summary.

    - `scene`, `inputs` (sets, actuators): the best; the scene can be solved, saved and designed
      further.
    - `objective`: its value there. `feasible`: whether all constraints are satisfied.
    - `margins`: least margin of each constraint by name, dimensionless, negative if violated.
    - `free`: names of the free numbers.
    - `starts`: the best of each start, in order, and `best`, the index of the best of them.
    - `history`: objective, violation and free numbers of each start at each step.
    - `problem`: what was asked: the initial `scene` and `inputs`, the `model`, the `objective` and
      the `constraints`.
    """

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    objective: float
    feasible: bool
    margins: dict[str, float]
    free: tuple[str, ...]
    starts: tuple[Start, ...]
    best: int
    history: History
    problem: Terms

    @property
    def numbers(self) -> dict[str, Array]:
        """Free numbers of the best scene by name, without the inputs."""
        known = parameters(self.scene)
        return {name: known[name].value for name in self.free if name != INPUTS}

    def __str__(self) -> str:
        known = parameters(self.scene)
        lines = [
            f"objective  {self.objective:.6g} after {len(self.history.objective)} steps of "
            f"{len(self.starts)} starts"
        ]
        lines += [
            f"{name} = {_text(known[name].value)} [{known[name].unit or '?'}]"
            for name in self.free
            if name in known
        ]
        if INPUTS in self.free:
            lines.append(f"inputs     {_rows(self.inputs)}")
        lines += [
            f"{name}: {'satisfied' if margin >= 0 else 'VIOLATED'}, margin {margin:.3g}"
            for name, margin in self.margins.items()
        ]
        return "\n".join(lines)

    __repr__ = __str__


def _text(value: Array) -> str:
    if is_traced(value) or not eqx.is_array_like(value):
        return str(value)
    return np.array2string(np.asarray(value), precision=6, separator=", ")


def _rows(inputs: Array) -> str:
    if is_traced(inputs) or not eqx.is_array_like(inputs) or np.ndim(inputs) != 2:
        return _text(inputs)
    return "; ".join(", ".join(f"{x:.6g}" for x in row) for row in np.asarray(inputs))


def design(
    scene: Scene,
    free: Mapping[str, Bounds],
    objective: Objective | Callable[[Arms], Scalar],
    inputs: ArrayLike,
    *,
    constraints: Sequence[Constraint] = (),
    uncertain: Mapping[str, float] | None = None,
    model: Model | None = None,
    search: Search | None = None,
    out: PathLike | None = None,
    progress: bool = True,
) -> Design:
    r"""Numbers of a scene that minimise an objective: routings, tapers, moduli, lengths, rest
    curvature, inputs.

        free = {
            "actuators[0].routing.radius": (0.002, 0.009),
            "actuators[0].routing.angle": (1.3, 1.55),
        }
        found = vsr.design(
            scene,
            free,
            vsr.objective.CurveError(points),
            [[8.0]],
            constraints=[vsr.constraint.Inside(wall=0.001)],
            search=vsr.Search(starts=16),
        )
        vsr.save(found.scene, "designed.toml", found.inputs[0])

    The map $p = p_0 + (p_1 - p_0) \sin^2(z / 2)$ keeps free numbers between their bounds.
    Constraints enter as penalties; the result is the best of the feasible points. All starts run in
    parallel in one compiled program.

    **Arguments:**
    - `scene`: the initial scene; its numbers are the first start.
    - `free`: bounds by name, see `vsr_jax.parameters`: a pair of numbers, or of arrays of the
      number's shape. `[*]` stands for every index, `inputs` for all inputs. None leaves a phase
      without bounds.
    - `objective`: an `Objective`, or a function of `Arms`.
    - `inputs`: sets of inputs, shape (sets, actuators). Their dtype is the precision.
    - `constraints`: `Inside()`, threads inside the section, is always added if it is missing.
    - `uncertain`: relative standard deviations by name; the objective becomes its mean over eight
      random scenes.
    - `model`: as for `solve`.
    - `search`: number of starts and steps, optimizer, when to stop; `Search()` by default.
    - `out`: checkpoint file; the same call resumes from it.
    - `progress`: whether to show a progress bar, which says "compiling" until the first step.

    **Returns:** a `Design`.

    **Raises:** `ValueError` if nothing is free, for unknown names, contradictory bounds, targets
    that do not match the sets of inputs, inputs out of range, and if no start finds an equilibrium.
    """
    problem, terms, given = formulate(
        scene, free, objective, inputs, constraints, uncertain or {}, model
    )
    search = Search() if search is None else search
    instance("search", search, Search, "a Search")
    rule, settings = search.update_rule, (search.starts, search.candidates, search.seed)
    checkpoint = Checkpoint(out, problem, rule, (*settings, search.steps))
    bar = tqdm(total=search.steps, unit=" steps", disable=not progress, desc="compiling")
    with bar, messages(False):
        states = begin(problem, rule, given, *settings)
        states, history = _run(problem, rule, search, checkpoint, states, bar)
    return _result(problem, terms, states, history)


def _run(
    problem: DesignProblem,
    rule: optax.GradientTransformationExtraArgs,
    search: Search,
    checkpoint: Checkpoint,
    states: DescentState,
    bar: tqdm,
) -> tuple[DescentState, History]:
    states, history = checkpoint.read(states)
    bar.initial = bar.n = len(history.objective)
    while not search.finished(history):
        first, rows = len(history.objective), []
        for done in range(first, min(first + _CHUNK, search.steps)):
            point = states.z
            states, row = descend(problem, rule, states, penalty_weight(done, search.steps))
            bar.set_description("designing", refresh=done == first)  # compiled by the first step
            rows.append((*row, point))
        objective, violation, points = jax.tree.map(lambda *x: np.stack(x), *rows)
        numbers = problem.at(jax.tree.map(jnp.asarray, points))
        new = History(objective, violation, jax.tree.map(np.asarray, numbers))
        history = jax.tree.map(lambda old, more: np.concatenate([old, more]), history, new)
        checkpoint.write(states, history)
        best = best_start(states.best)
        feasible = int(np.sum(np.asarray(states.best.violation) <= 0))
        bar.set_postfix_str(
            f"objective {float(states.best.objective[best]):.3g}, {feasible} feasible",
            refresh=False,
        )
        bar.update(len(rows))
    return states, history


def _result(problem: DesignProblem, terms: Terms, states: DescentState, history: History) -> Design:
    best = best_start(states.best)
    if not np.isfinite(states.best.objective[best]):
        raise ValueError(
            "design: no start found an equilibrium, need bounds and inputs for which the scene can "
            "be solved"
        )
    free = problem.at(states.best.z)
    starts = tuple(
        Start(
            *terms.substitute(jax.tree.map(lambda x, i=i: x[i], free)),
            float(objective),
            float(violation),
        )
        for i, (objective, violation) in enumerate(
            zip(states.best.objective, states.best.violation, strict=True)
        )
    )
    margins = [float(x) for x in states.best.margins[best]]
    names = [str(constraint) for constraint in terms.constraints]
    one = starts[best]
    return Design(
        one.scene,
        one.inputs,
        one.objective,
        one.violation <= 0,
        dict(zip(names, margins, strict=True)),
        tuple(name for name in (*parameters(one.scene), INPUTS) if name in problem.low),
        starts,
        best,
        history,
        terms,
    )
