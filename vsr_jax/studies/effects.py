"""Cost of each effect of a scene: effects are added to one arm, one at a time."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arm.actuator import Tendon
from ..arm.loads import Gravity, PointWrench, TipWrench
from ..arm.material import Material
from ..arm.profile import Piecewise
from ..arm.rod import Rod
from ..arm.routing import Helix, Parallel
from ..arm.scene import Scene
from ..arm.section import Circular
from ..models.base import Status
from ..models.strain_dependent import StrainDependent
from ..solution.solver import solve
from .timing import Timed, take_turns

PULLED, SHORTENED = (4.0, 2.0), (4.0, -0.003)
"""Inputs: tensions [N] of both tendons; tension [N] of the first and change of length [m] of the
second."""


class Rung(NamedTuple):
    """One scene of the ladder: its name, the scene, the inputs, and whether the tip pose is
    computed or only the strains."""

    name: str
    scene: Scene
    inputs: tuple[float, float] = PULLED
    pose: bool = True


class Cost(NamedTuple):
    """Cost of a rung: effects of the scene, operations of the compiled single solve, summaries of
    `Timed` for a single solve and for a batch, share of the batch that converged."""

    name: str
    effects: tuple[str, ...]
    operations: int | None
    single: dict[str, float]
    batch: dict[str, float]
    batch_size: int
    converged: float


def ladder() -> list[Rung]:
    """Tendons only, + poses, + gravity, + tip wrench, + follower, + second section, + length
    control, + friction."""
    soft, hard = 4.0e5, 8.0e5
    arm = Rod(0.3, Circular(0.01), Material(hard, poisson=0.45, density=1000.0))
    jointed = Rod(
        0.3,
        Circular(0.01),
        Material(Piecewise((0.15,), (hard, soft)), poisson=0.45, density=1000.0),
    )
    helix, straight = Helix(0.007, 1.5), Parallel(0.0, 0.007)
    tendons = [Tendon(helix), Tendon(straight)]
    gravity, tool = Gravity((0.0, 0.0, -9.81)), TipWrench((0.0, 0.05, 0.0))
    jet = PointWrench(0.2, force=(0.0, 0.0, 0.05), frame="body")
    loads = [gravity, tool, jet]
    ended = [Tendon(helix), Tendon(straight, end=0.15)]
    driven = [Tendon(helix), Tendon(straight, end=0.15, control="length")]
    tendons_with_friction = [
        Tendon(helix, friction=0.1),
        Tendon(straight, end=0.15, control="length"),
    ]
    return [
        Rung("tendons only", Scene(arm, tendons), pose=False),
        Rung("+ poses", Scene(arm, tendons)),
        Rung("+ gravity", Scene(arm, tendons, loads[:1])),
        Rung("+ tip wrench", Scene(arm, tendons, loads[:2])),
        Rung("+ follower", Scene(arm, tendons, loads)),
        Rung("+ second section", Scene(jointed, ended, loads)),
        Rung("+ length control", Scene(jointed, driven, loads), SHORTENED),
        Rung("+ friction", Scene(jointed, tendons_with_friction, loads), SHORTENED),
    ]


def measure(
    batch_size: int = 256,
    rounds: int = 5,
    model: StrainDependent | None = None,
    report: Callable[[str], object] = lambda message: None,
) -> list[Cost]:
    """Costs of all rungs; rounds of timing cover all rungs in turn.

    **Arguments:** `batch_size`: shapes in a batch; `rounds`: number of rounds of timing;
    `model`: 16 steps by default; `report`: called with a message before each rung is compiled.
    """
    model = StrainDependent(16) if model is None else model
    scale = np.random.default_rng(0).uniform(0.5, 1.5, (batch_size, 1))
    rungs, jobs = ladder(), []
    for rung in rungs:
        report(f"compiling {rung.name}")
        jobs.append(_jobs(rung, model, scale))
    take_turns((job for pair in jobs for job in pair), rounds)
    costs = []
    for rung, (single, batch) in zip(rungs, jobs, strict=True):
        share = float(np.mean(np.asarray(batch.output[1])))
        costs.append(
            Cost(
                rung.name,
                rung.scene.effects,
                single.operations,
                single.summary(),
                batch.summary(),
                batch_size,
                share,
            )
        )
    return costs


def _jobs(rung: Rung, model: StrainDependent, scale: np.ndarray) -> tuple[Timed, Timed]:
    values, fixed = eqx.partition(rung.scene, eqx.is_array)

    def one(values: PyTree, inputs: Array) -> tuple[PyTree, Array]:
        scene = eqx.combine(values, fixed)
        if not rung.pose:
            outcome = model.solve(scene, inputs)
            return outcome.state.xi, outcome.status == Status.CONVERGED
        eq = solve(scene, inputs, model=model)
        return eq.tip, eq.converged

    inputs = jnp.asarray(rung.inputs)
    return Timed(one, values, inputs, calls=3), Timed(
        jax.vmap(one, (None, 0)), values, inputs * jnp.asarray(scale)
    )


def table(costs: Sequence[Cost]) -> list[str]:
    """Lines of a Markdown table; each number with its ratio to the row above."""
    lines = [
        "| scene | operations | compile [s] | single [us] | batch [us per shape] | converged |",
        "|" + "---|" * 6,
    ]
    for above, cost in zip((None, *costs), costs, strict=False):
        cells = [
            cost.name,
            _cell(f"{cost.operations or 0:,}", cost.operations, above and above.operations),
            _cell(
                f"{cost.single['compile_s']:.1f}",
                cost.single["compile_s"],
                above and above.single["compile_s"],
            ),
            _timed_cell(cost.single, 1, above and above.single),
            _timed_cell(cost.batch, cost.batch_size, above and above.batch),
            f"{100 * cost.converged:.0f} %",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _timed_cell(summary: dict[str, float], batch_size: int, above: dict[str, float] | None) -> str:
    low, median, high = (summary[key] / batch_size for key in ("low_us", "median_us", "high_us"))
    return _cell(
        f"{median:.3g} ({low:.3g}-{high:.3g})",
        summary["median_us"],
        None if above is None else above["median_us"],
    )


def _cell(text: str, value: float | None, above: float | None) -> str:
    return text if not value or not above else f"{text}, x {value / above:.2g}"
