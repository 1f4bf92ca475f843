"""What accuracy costs: errors of tip, strain and gradient of a scene by every model, and the time
each takes."""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.scene import Scene
from ..models.base import Model
from ..models.basis import AbstractBasis, Basis, Legendre, PiecewiseConstant
from ..models.continuum import Continuum
from ..models.prescribed import Prescribed
from ..models.strain_dependent import StrainDependent
from ..solution.solver import solve
from ..solution.step_choice import gradient_error
from ..typing import cast
from .timing import Timed, take_turns

STEPS = {2: (64,), 4: (8, 32), 6: (4, 8, 16, 32, 64)}
"""Numbers of steps that are measured, by the steps' order."""

TOLERANCES = {1e-3: "1 mm", 1e-6: "1 um", 1e-9: "1 nm"}
"""Errors [m] for which `advice` names what to use."""

GROUPS = ("steps", "bases", "continuum")
"""What `settings` may be asked for."""

STATIONS, FEW = 41, 8
"""Stations at which strains are compared, and of how many shapes errors are taken."""

_SINGLES = 5
_QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""For programs that are not timed."""


class Setting(NamedTuple):
    """A way to solve: its family, what sets it apart there, the model and the precision."""

    family: str
    label: str
    model: Model
    dtype: str = "float64"


class Row(NamedTuple):
    """What a setting costs and gives.

    - `tip` [m], `strain` [-], `gradient` [-]: the largest errors over the shapes; of strain the
      energy norm $\\sqrt{\\delta \\xi^T \\Sigma \\delta \\xi / \\Sigma_{44}}$, largest over the
      stations; of gradient the relative one of `plan`. None where a shape was lost.
    - `single_us`, `batch_us`: medians for one shape, alone and in a batch [us].
    - `lost`: share of the batch that was not solved.
    """

    family: str
    label: str
    dtype: str
    tip: float | None
    strain: float | None
    gradient: float | None
    single_us: float
    batch_us: float
    lost: float

    @property
    def name(self) -> str:
        """Family, label and precision in words."""
        return f"{self.family}, {self.label}" + (", float32" if self.dtype == "float32" else "")


def settings(
    scene: Scene, *, groups: Iterable[str] = GROUPS, own: AbstractBasis | None = None
) -> list[Setting]:
    """Settings that span each model's range for a scene; `own`: a basis made for it, measured
    too."""
    found: list[Setting] = []
    if "steps" in groups:
        found += [
            Setting(f"steps of order {order}", str(n), StrainDependent(n, order))
            for order, many in STEPS.items()
            for n in many
        ]
        found += [
            Setting("steps of order 6", str(n), StrainDependent(n), "float32")
            for n in STEPS[6][1:3]
        ]
    if "bases" in groups:
        free = scene.free_strains
        bases = {
            ("Legendre", str(k)): Prescribed(Basis.uniform(Legendre(k), free), 64, 64)
            for k in (6, 12)
        }
        bases |= {
            ("piecewise constant", str(n)): Prescribed(
                Basis.uniform(PiecewiseConstant(n), free), max(2, 64 // n), n, 2
            )
            for n in (3, 20)
        }
        if own is not None:
            bases["basis of the paper", f"{own.size} DOF"] = Prescribed(own, 64, 64)
        found += [Setting(family, label, model) for (family, label), model in bases.items()]
    if "continuum" in groups:
        solvers = (diffrax.Tsit5(), (1e-4,)), (diffrax.Dopri8(), (1e-6, 1e-10))
        for solver, tolerances in solvers:
            family = f"continuum, {type(solver).__name__}"
            found += [
                Setting(family, f"rtol {rtol:g}", Continuum(solver, rtol, 0.01 * rtol))
                for rtol in tolerances
            ]
    return found


class _Shapes(NamedTuple):
    """Tip [m], strains at the stations and derivatives of the tip, of a few shapes."""

    tip: np.ndarray
    strain: np.ndarray
    slopes: np.ndarray


class _Task(NamedTuple):
    """What a few shapes are computed by: compiled beforehand, since that goes side by side, and
    running does not."""

    program: Callable
    inputs: Array

    def shapes(self) -> _Shapes:
        return _Shapes(*(np.asarray(x, float) for x in self.program(self.inputs)))


def _task(scene: Scene, inputs: Array, model: Model) -> _Task:
    numbers, rest = eqx.partition(scene, eqx.is_inexact_array)
    X = jnp.linspace(0, 1, STATIONS, dtype=inputs.dtype) * scene.rod.length

    def tip(values: tuple[Any, Array]) -> Array:
        return solve(eqx.combine(values[0], rest), values[1], model=model).tip[:3, 3]

    def of(u: Array) -> tuple[Array, Array, Array]:
        eq = solve(scene, u, model=model)
        slopes = jax.tree.leaves(jax.jacfwd(tip)((numbers, u)))
        return (
            eq.tip[:3, 3],
            eq.strain(X),
            jnp.concatenate([leaf.reshape(3, -1) for leaf in slopes], axis=1),
        )

    options = _QUICK if jax.default_backend() == "cpu" and jax.__version_info__ < (0, 11) else None
    return _Task(jax.jit(jax.vmap(of)).lower(inputs).compile(compiler_options=options), inputs)


def _errors(
    scene: Scene, inputs: Array, found: _Shapes, true: _Shapes
) -> tuple[float | None, float | None, float | None]:
    """Largest error of tip, strain and gradient; None where a shape was lost."""
    X = np.linspace(0, 1, STATIONS) * float(scene.rod.length)
    stiffness = np.stack(
        [np.broadcast_to(s, X.shape) for s in scene.sections(jnp.asarray(X)).stiffness], axis=-1
    )
    strain = np.sqrt(
        np.sum(stiffness / stiffness[:, 3:4] * (found.strain - true.strain) ** 2, axis=-1)
    )
    numbers = eqx.filter(scene, eqx.is_inexact_array)
    slopes = jnp.asarray(found.slopes), jnp.asarray(true.slopes)
    slope = jax.vmap(lambda a, b, u: gradient_error(a, b, (numbers, u)))(*slopes, inputs)
    tip = np.max(np.linalg.norm(found.tip - true.tip, axis=1))
    if not np.isfinite(tip):
        return None, None, None
    return float(tip), _known(np.max(strain)), _known(jnp.max(slope))


def _known(error: Any) -> float | None:
    return float(error) if np.isfinite(error) else None


def measure(
    scene: Scene,
    inputs: Array,
    ways: Sequence[Setting],
    *,
    reference: Model | None = None,
    rounds: int = 5,
    say: Callable[[str], Any] = lambda name: None,
) -> list[Row]:
    """Errors and times of each setting, all timed in turn.

    **Arguments:**
    - `inputs`: the batch, shape (shapes, inputs), double precision. Errors are those of the first
      eight.
    - `ways`: what to measure, see `settings`.
    - `reference`: what errors are taken against; `StrainDependent(256)`, or with loads, lengths or
      friction `StrainDependent(96)`.
    - `rounds`: how often everything is timed.
    - `say`: told the name of each setting when its turn to be compiled has come.
    """
    exact = reference or StrainDependent(96 if scene.coupled else 256)
    true = _task(scene, inputs[:FEW], exact).shapes()

    def prepare(way: Setting) -> tuple[tuple[Timed, Timed], _Task]:
        say(f"{way.family}, {way.label}, {way.dtype}")
        dtype = jnp.dtype(way.dtype)
        arm, batch = cast(scene, dtype), inputs.astype(dtype)

        def tip(u: Array) -> Array:
            return solve(arm, u, model=way.model).tip[:3, 3]

        jobs = Timed(tip, batch[0], calls=_SINGLES), Timed(jax.vmap(tip), batch)
        return jobs, _task(arm, batch[:FEW], way.model)

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # while one is traced another compiles
        prepared = list(pool.map(prepare, ways))
    errors = [_errors(scene, inputs[:FEW], task.shapes(), true) for _, task in prepared]
    say("all of them are timed")
    take_turns([job for jobs, _ in prepared for job in jobs], rounds)
    return [
        _row(way, jobs, found) for way, (jobs, _), found in zip(ways, prepared, errors, strict=True)
    ]


def _row(
    way: Setting, jobs: tuple[Timed, Timed], errors: tuple[float | None, float | None, float | None]
) -> Row:
    single, batch = (job.summary() for job in jobs)
    tips = np.asarray(jobs[1].output)
    lost = float(np.mean(~np.isfinite(tips[:, 0])))
    return Row(
        way.family,
        way.label,
        way.dtype,
        *errors,
        single["median_us"],
        batch["median_us"] / len(tips),
        lost,
    )


def cheapest(
    rows: Iterable[Row], limit: float, *, of: str = "tip", by: str = "batch_us"
) -> Row | None:
    """The row that takes least of `by` among those whose error `of` is at most `limit`; None if
    there is none."""
    fits = [row for row in rows if (error := getattr(row, of)) is not None and error <= limit]
    return min(fits, key=lambda row: getattr(row, by), default=None)


def advice(rows: Sequence[Row]) -> list[str]:
    """What to use for an error of a millimetre, a micrometre and a nanometre, in a batch, alone,
    and for gradients."""
    text = []
    for limit, name in TOLERANCES.items():
        batch, single = (cheapest(rows, limit, by=by) for by in ("batch_us", "single_us"))
        if batch is None or single is None:
            text.append(f"for {name}: nothing measured here")
            continue
        alone = "" if single is batch else f"; alone {single.name} ({single.single_us:.0f} us)"
        text.append(
            f"for {name} use {batch.name} ({batch.batch_us:.1f} us a shape in a batch, "
            f"{batch.single_us:.0f} alone{alone})"
        )
    slope = cheapest(rows, 0.01, of="gradient")
    text.append(
        "for gradients within 1 %: "
        + ("nothing measured here" if slope is None else f"{slope.name} ({slope.batch_us:.1f} us)")
    )
    return text


def table(rows: Iterable[Row]) -> list[str]:
    """The rows as Markdown."""

    def number(value: float | None) -> str:
        return "lost" if value is None else f"{value:.1e}"

    head = [
        "| model | tip [m] | strain | gradient | one [us] | in a batch [us] |",
        "| --- |" + " ---: |" * 5,
    ]
    return head + [
        f"| {row.name} | {number(row.tip)} | {number(row.strain)} | {number(row.gradient)} | "
        f"{row.single_us:.0f} | {row.batch_us:.1f} |"
        for row in rows
    ]
