"""Cost of each effect of a scene: effects are added to one arm, one after another, and others alone
to the arm under gravity."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..analysis.following import follow
from ..arm.actuator import Tendon
from ..arm.composite import Composite, Inclusion
from ..arm.discs import Discs
from ..arm.held import Held
from ..arm.loads import Gravity, PointWrench, TipWrench
from ..arm.material import Material
from ..arm.obstacles import Cylinder
from ..arm.placement import pose
from ..arm.pose_loads import Payload, Spring
from ..arm.profile import Piecewise
from ..arm.rigid_piece import RigidPiece
from ..arm.rod import Rod
from ..arm.routing import Helix, Parallel
from ..arm.rubber import NeoHookean
from ..arm.scene import Scene
from ..arm.section import Circular
from ..models.base import Status
from ..models.strain_dependent import StrainDependent
from ..solution.solver import solve
from .timing import Timed, take_turns

PULLED, SHORTENED = (4.0, 2.0), (4.0, -0.003)
"""Inputs: tensions [N] of both tendons; tension [N] of the first and change of length [m] of the
second."""


SAMPLES = 2
"""Samples of a path of inputs."""


class EffectScene(NamedTuple):
    """A scene whose cost is measured: its name, the scene, the inputs, whether the tip pose is
    computed or only the strains, whether the inputs are approached along a path of `SAMPLES`, and
    the name of the scene to which the effect is added, by default the one before."""

    name: str
    scene: Scene
    inputs: tuple[float, float] = PULLED
    pose: bool = True
    followed: bool = False
    base: str | None = None


class Cost(NamedTuple):
    """Cost of a scene: its effects, operations of the compiled single solve, summaries of
    `Timed` for a single solve and for a batch, share of the batch that converged, and the name of
    the scene with which it is compared, by default the one before."""

    name: str
    effects: tuple[str, ...]
    operations: int | None
    single: dict[str, float]
    batch: dict[str, float]
    batch_size: int
    converged: float
    base: str | None = None


def scenes() -> list[EffectScene]:
    """All scenes: the effects that are added to those before, then those that are added alone."""
    return added_scenes() + single_scenes()


def added_scenes() -> list[EffectScene]:
    """Tendons only, + poses, + gravity, + tip wrench, + follower, + second section, + length
    control, + friction, + payload, + spring."""
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
    carrying = [*loads, Payload(0.005, offset=(0.0, 0.0, -0.02))]
    tied = [*carrying, Spring((0.3, 0.0, -0.1), 0.5)]
    return [
        EffectScene("tendons only", Scene(arm, tendons), pose=False),
        EffectScene("+ poses", Scene(arm, tendons)),
        EffectScene("+ gravity", Scene(arm, tendons, loads[:1])),
        EffectScene("+ tip wrench", Scene(arm, tendons, loads[:2])),
        EffectScene("+ follower", Scene(arm, tendons, loads)),
        EffectScene("+ second section", Scene(jointed, ended, loads)),
        EffectScene("+ length control", Scene(jointed, driven, loads), SHORTENED),
        EffectScene("+ friction", Scene(jointed, tendons_with_friction, loads), SHORTENED),
        EffectScene("+ payload", Scene(jointed, tendons_with_friction, carrying), SHORTENED),
        EffectScene("+ spring", Scene(jointed, tendons_with_friction, tied), SHORTENED),
    ]


def single_scenes() -> list[EffectScene]:
    """The arm under gravity with straight tendons, of rubber, with bores, with a rigid piece, a tip
    that slides along a line, a pillar that it does not touch, or one on which it lies; the last one
    along a path, without and with friction."""
    material = Material(8.0e5, poisson=0.45, density=1000.0)
    arm = Rod(0.3, Circular(0.01), material)
    tooled = Rod(0.3, Circular(0.01), material, rigid=[RigidPiece(0.25)])
    guided_by_discs = Rod(0.3, Circular(0.01), material, discs=Discs(8))
    rubber = Rod(0.3, Circular(0.01), NeoHookean(8.0e5, density=1000.0))
    bores = [Inclusion(Parallel(y, 0.0), 0.002) for y in (-0.006, 0.006)]
    bored = Rod(0.3, Circular(0.01), Composite(material, bores))
    paths, gravity = (Helix(0.007, 1.5), Parallel(0.0, 0.007)), Gravity((0.0, 0.0, -9.81))
    tendons = [Tendon(path) for path in paths]
    straight = [Tendon(path, straight=True) for path in paths]
    guided = Held(position=(0.2, 0.0, -0.1), along=(1.0, 0.0, 0.0))
    touched = Scene(arm, tendons, gravity, obstacles=_pillar(-0.035))
    rough = Scene(arm, tendons, gravity, obstacles=_pillar(-0.035, friction=0.3))
    on_path = f"touched, path of {SAMPLES}"
    return [
        EffectScene(
            "straight tendons", Scene(guided_by_discs, straight, gravity), base="+ gravity"
        ),
        EffectScene("rubber", Scene(rubber, tendons, gravity), base="+ gravity"),
        EffectScene("bores", Scene(bored, tendons, gravity), base="+ gravity"),
        EffectScene("rigid piece", Scene(tooled, tendons, gravity), base="+ gravity"),
        EffectScene("held tip", Scene(arm, tendons, gravity, held=guided), base="+ gravity"),
        EffectScene(
            "pillar, not touched",
            Scene(arm, tendons, gravity, obstacles=_pillar(0.2)),
            base="+ gravity",
        ),
        EffectScene("pillar, touched", touched, base="+ gravity"),
        EffectScene(on_path, touched, followed=True, base="pillar, touched"),
        EffectScene("+ friction of contact", rough, followed=True, base=on_path),
    ]


def _pillar(height: float, *, friction: float | None = None) -> Cylinder:
    """A pillar across the arm, whose axis is at a height [m] above the base."""
    across = pose((0.1, 0.0, height), pointing=(0.0, 1.0, 0.0))
    return Cylinder(0.02, pose=across, friction=friction)


def measure(
    batch_size: int = 256,
    rounds: int = 5,
    model: StrainDependent | None = None,
    report: Callable[[str], object] = lambda message: None,
    compared: Sequence[EffectScene] | None = None,
) -> list[Cost]:
    """Costs of scenes; rounds of timing cover all scenes in turn.

    **Arguments:** `batch_size`: shapes in a batch; `rounds`: number of rounds of timing;
    `model`: 16 steps by default; `report`: called with a message before each scene is compiled;
    `compared`: `scenes` by default.
    """
    model = StrainDependent(16) if model is None else model
    scale = np.random.default_rng(0).uniform(0.5, 1.5, (batch_size, 1))
    compared, jobs = scenes() if compared is None else compared, []
    for one in compared:
        report(f"compiling {one.name}")
        jobs.append(_jobs(one, model, scale))
    take_turns((job for pair in jobs for job in pair), rounds)
    costs = []
    for one, (single, batch) in zip(compared, jobs, strict=True):
        share = float(np.mean(np.asarray(batch.output[1])))
        costs.append(
            Cost(
                one.name,
                one.scene.effects,
                single.operations,
                single.summary(),
                batch.summary(),
                batch_size,
                share,
                one.base,
            )
        )
    return costs


def _jobs(compared: EffectScene, model: StrainDependent, scale: np.ndarray) -> tuple[Timed, Timed]:
    values, fixed = eqx.partition(compared.scene, eqx.is_array)

    def one(values: PyTree, inputs: Array) -> tuple[PyTree, Array]:
        scene = eqx.combine(values, fixed)
        if not compared.pose:
            outcome = model.solve(scene, inputs)
            return outcome.state.xi, outcome.status == Status.CONVERGED
        if compared.followed:
            share = jnp.arange(1, SAMPLES + 1)[:, None] / SAMPLES
            path = follow(scene, share * inputs, model=model)
            return jax.vmap(lambda eq: eq.tip)(path), jnp.all(path.status == Status.CONVERGED)
        eq = solve(scene, inputs, model=model)
        return eq.tip, eq.converged

    inputs = jnp.asarray(compared.inputs)
    return Timed(one, values, inputs, calls=3), Timed(
        jax.vmap(one, (None, 0)), values, inputs * jnp.asarray(scale)
    )


def table(costs: Sequence[Cost]) -> list[str]:
    """Lines of a Markdown table; each number with its ratio to the row above, or to the row whose
    name is in brackets."""
    lines = [
        "| scene | operations | compile [s] | single [us] | batch [us per shape] | converged |",
        "|" + "---|" * 6,
    ]
    named = {cost.name: cost for cost in costs}
    for before, cost in zip((None, *costs), costs, strict=False):
        above = before if cost.base is None else named[cost.base]
        cells = [
            cost.name if cost.base is None else f"{cost.name} (over {cost.base})",
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
