"""Accuracy against time: errors of tip, strain and gradient of a scene with every model, and times
per solve."""

import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..arm.scene import Scene
from ..models.base import Model
from ..models.basis import AbstractBasis, Basis, Legendre, PiecewiseConstant
from ..models.continuum import Continuum
from ..models.prescribed import Prescribed
from ..models.strain_dependent import StrainDependent
from ..numerics.compiling import quick_compilation
from ..solution.solver import solve
from ..solution.step_choice import gradient_error
from ..typing import cast
from .timing import Timed, take_turns

STEPS = {2: (64,), 4: (8, 32), 6: (4, 8, 16, 32, 64)}
"""Numbers of steps that are measured, by order."""

TOLERANCES = {1e-3: "1 mm", 1e-6: "1 um", 1e-9: "1 nm"}
"""Errors [m] for which `advice` recommends a setting."""

GROUPS = ("steps", "bases", "continuum")
"""Groups of `settings`."""

STATIONS, FEW = 41, 8
"""Stations at which strains are compared, and shapes whose errors are computed."""

_SINGLES = 5
"""Single solves per round: one alone is close to the resolution of the clock."""


class Setting(NamedTuple):
    """A model and a precision, with the family and the label under which they are reported."""

    family: str
    label: str
    model: Model
    dtype: str = "float64"


class AccuracyRow(NamedTuple):
    """Errors and times of a setting.

    - `tip` [m], `strain` [-], `gradient` [-]: largest errors over the shapes: for the strain the
      energy norm $\\sqrt{\\delta \\xi^T \\Sigma \\delta \\xi / \\Sigma_{44}}$, largest over the
      stations; for the gradient the relative error as in `plan`. None if a shape was not solved.
    - `single_us`, `batch_us`: median times per shape, single and in a batch [us].
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
    """Settings that cover the range of each model for a scene; `own`: an additional basis made for
    it."""
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
    """Tips [m], strains at the stations and derivatives of the tips of a few shapes."""

    tip: np.ndarray
    strain: np.ndarray
    slopes: np.ndarray


class _ShapeProgram(NamedTuple):
    """Compiled program for a few shapes. Programs are compiled in parallel and run one after
    another."""

    program: Callable
    inputs: Array

    def shapes(self) -> _Shapes:
        return _Shapes(*(np.asarray(x, float) for x in self.program(self.inputs)))


def _shape_program(scene: Scene, inputs: Array, model: Model) -> _ShapeProgram:
    numbers, rest = eqx.partition(scene, eqx.is_inexact_array)
    X = jnp.linspace(0, 1, STATIONS, dtype=inputs.dtype) * scene.rod.length

    def tip(values: tuple[PyTree, Array]) -> Array:
        return solve(eqx.combine(values[0], rest), values[1], model=model).tip[:3, 3]

    def of(u: Array) -> tuple[Array, Array, Array]:
        eq = solve(scene, u, model=model)
        slopes = jax.tree.leaves(jax.jacfwd(tip)((numbers, u)))
        return (
            eq.tip[:3, 3],
            eq.strain(X),
            jnp.concatenate([leaf.reshape(3, -1) for leaf in slopes], axis=1),
        )

    return _ShapeProgram(
        jax.jit(jax.vmap(of)).lower(inputs).compile(compiler_options=quick_compilation()), inputs
    )


def _errors(
    scene: Scene, inputs: Array, found: _Shapes, true: _Shapes
) -> tuple[float | None, float | None, float | None]:
    """Largest errors of tip, strain and gradient; None if a shape was not solved."""
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


def _known(error: np.ndarray | Array) -> float | None:
    return float(error) if np.isfinite(error) else None


def measure(
    scene: Scene,
    inputs: Array,
    measured: Sequence[Setting],
    *,
    reference: Model | None = None,
    rounds: int = 5,
    report: Callable[[str], object] = lambda message: None,
) -> list[AccuracyRow]:
    """Errors and times of each setting; rounds of timing cover all settings in turn.

    **Arguments:**
    - `inputs`: the batch, shape (shapes, inputs), double precision. Errors are those of the first
      eight.
    - `measured`: settings to measure, see `settings`.
    - `reference`: model of the reference solution, by default `StrainDependent(256)`; with loads,
      lengths or friction `StrainDependent(96)`.
    - `rounds`: number of rounds of timing.
    - `report`: called with a message before each setting is compiled, and before timing.
    """
    exact = reference or StrainDependent(96 if scene.coupled else 256)
    true = _shape_program(scene, inputs[:FEW], exact).shapes()

    def prepare(setting: Setting) -> tuple[tuple[Timed, Timed], _ShapeProgram]:
        report(f"compiling {setting.family}, {setting.label}, {setting.dtype}")
        dtype = jnp.dtype(setting.dtype)
        arm, batch = cast(scene, dtype), inputs.astype(dtype)

        def tip(u: Array) -> Array:
            return solve(arm, u, model=setting.model).tip[:3, 3]

        jobs = Timed(tip, batch[0], calls=_SINGLES), Timed(jax.vmap(tip), batch)
        return jobs, _shape_program(arm, batch[:FEW], setting.model)

    # one program is traced while another is compiled
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        prepared = list(pool.map(prepare, measured))
    errors = [_errors(scene, inputs[:FEW], program.shapes(), true) for _, program in prepared]
    report("timing all settings")
    take_turns([job for jobs, _ in prepared for job in jobs], rounds)
    return [
        _row(setting, jobs, found)
        for setting, (jobs, _), found in zip(measured, prepared, errors, strict=True)
    ]


def _row(
    setting: Setting,
    jobs: tuple[Timed, Timed],
    errors: tuple[float | None, float | None, float | None],
) -> AccuracyRow:
    single, batch = (job.summary() for job in jobs)
    tips = np.asarray(jobs[1].output)
    lost = float(np.mean(~np.isfinite(tips[:, 0])))
    return AccuracyRow(
        setting.family,
        setting.label,
        setting.dtype,
        *errors,
        single["median_us"],
        batch["median_us"] / len(tips),
        lost,
    )


def cheapest(
    rows: Iterable[AccuracyRow], limit: float, *, of: str = "tip", by: str = "batch_us"
) -> AccuracyRow | None:
    """The row with the least `by` among those whose error `of` is at most `limit`; None if there is
    none."""
    fits = [row for row in rows if (error := getattr(row, of)) is not None and error <= limit]
    return min(fits, key=lambda row: getattr(row, by), default=None)


def advice(rows: Sequence[AccuracyRow]) -> list[str]:
    """Recommended settings for errors of 1 mm, 1 um and 1 nm, in a batch and for single solves, and
    for gradients."""
    text = []
    for limit, name in TOLERANCES.items():
        batch, single = (cheapest(rows, limit, by=by) for by in ("batch_us", "single_us"))
        if batch is None or single is None:
            text.append(f"for {name}: no measured setting is accurate enough")
            continue
        alone = "" if single is batch else f"; single {single.name} ({single.single_us:.0f} us)"
        text.append(
            f"for {name} use {batch.name} ({batch.batch_us:.1f} us per shape in a batch, "
            f"{batch.single_us:.0f} us single{alone})"
        )
    slope = cheapest(rows, 0.01, of="gradient")
    text.append(
        "for gradients within 1 %: "
        + (
            "no measured setting is accurate enough"
            if slope is None
            else f"{slope.name} ({slope.batch_us:.1f} us)"
        )
    )
    return text


def table(rows: Iterable[AccuracyRow]) -> list[str]:
    """Lines of a Markdown table."""

    def number(value: float | None) -> str:
        return "not solved" if value is None else f"{value:.1e}"

    head = [
        "| model | tip [m] | strain | gradient | single [us] | per shape in a batch [us] |",
        "| --- |" + " ---: |" * 5,
    ]
    return head + [
        f"| {row.name} | {number(row.tip)} | {number(row.strain)} | {number(row.gradient)} | "
        f"{row.single_us:.0f} | {row.batch_us:.1f} |"
        for row in rows
    ]
