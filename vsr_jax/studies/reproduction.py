"""Reproduction of section IV of the paper: every case, tension and model against the reference
solutions, as a table and figures."""

import os
import platform
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

from ..files.output import write_json
from ..models.base import Model
from ..models.continuum import Continuum
from ..models.prescribed import Prescribed
from ..models.strain_dependent import StrainDependent
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..solution.summary import Summary, compiled_summary
from ..validation import choice
from . import paper, paper_figures

STATIONS = np.linspace(0.0, paper.LENGTH, 61)
"""Stations [m] of strains and poses; every third is a station of the reference solutions."""

_REPEATS = 5
"""Warm solves per case, of which the median time is reported."""
_HEADER = """
| case | tau [N] | model | DOF | tip [m] | tip error [mm] | tip error [% of L] \
| strain error [-] | solve [ms] | compile [s] |
| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


class ReproductionRow(NamedTuple):
    """One solve of a case against its reference solution.

    **Fields:** `case`, forces `tau` [N], name of the `model` and its degrees of freedom `dofs`
    (None: infinitely many); `status` in words; `tip` [m] and its error in mm and in percent of the
    length; `strain_error`, the largest |error| / max(1, largest |reference|) over the stations of
    the reference and the six strains; `solve_ms`, the median time of a solve with its tip;
    `compile_s`, None if an earlier solve had compiled the same program.
    """

    case: str
    tau: tuple[float, ...]
    model: str
    dofs: int | None
    status: str
    tip: tuple[float, ...]
    tip_error_mm: float
    tip_error_percent: float
    strain_error: float
    solve_ms: float
    compile_s: float | None

    @property
    def converged(self) -> bool:
        """Whether the solve converged."""
        return self.status == "converged"


class Comparison(NamedTuple):
    """A row of the table, and samples of the solution, None if the solve failed."""

    row: ReproductionRow
    samples: Summary | None


def models(case: str) -> dict[str, Model]:
    """Models that the paper compares on a case, by name; the piecewise-constant model (PCS) only on
    A2."""
    compared: dict[str, Model] = {
        "Continuum": Continuum(rtol=1e-10, atol=1e-12),
        "StrainDependent": StrainDependent(),
        "Prescribed": Prescribed(paper.basis(case)),
    }
    return compared | ({"PCS": Prescribed(paper.piecewise_basis())} if case == "A2" else {})


def compare(
    cases: Sequence[str] = tuple(paper.CASES), *, progress: bool = True
) -> list[Comparison]:
    """Solves every tension of `cases` with every model; `progress` shows a progress bar.

    **Raises:** `ValueError` for a case that is not in `paper.CASES`.
    """
    _check_cases(cases)
    work = [
        (case, *named, solution)
        for case in cases
        for named in models(case).items()
        for solution in paper.reference(case)
    ]
    seen: set = set()
    solved = [
        _timed(case, model, solution, seen)
        for case, _, model, solution in tqdm(work, "solves", disable=not progress)
    ]
    groups = _by_program(solved)
    # two threads, since compiling dominates; more programs that run in parallel could deadlock
    with ThreadPoolExecutor(2) as pool:
        programs = list(
            tqdm(pool.map(_program, groups), "curves", len(groups), disable=not progress)
        )
    samples = {
        index: curve
        for pair in zip(groups, programs, strict=True)
        for index, curve in _curves(*pair).items()
    }
    return [
        Comparison(_row(*item, s, samples[i]), samples[i])
        for i, (item, s) in enumerate(zip(work, solved, strict=True))
    ]


def _check_cases(cases: Sequence[str]) -> None:
    for case in cases:
        choice("cases", case, tuple(paper.CASES))


class _Solved(NamedTuple):
    """An equilibrium, its program, the median time [s] of a warm solve, the time of the first
    solve, and whether that one compiled."""

    eq: Equilibrium
    program: Hashable
    warm: float
    first: float
    fresh: bool


def _timed(case: str, model: Model, solution: paper.ReferenceSolution, seen: set) -> _Solved:
    scene, inputs = paper.scene(case), jnp.asarray(solution.tau)

    def run() -> tuple[Equilibrium, float]:
        start = time.perf_counter()
        eq = solve(scene, inputs, model=model)
        jax.block_until_ready(eq.tip)
        return eq, time.perf_counter() - start

    leaves, structure = jax.tree.flatten((scene, model))
    program = (structure, tuple(np.shape(leaf) for leaf in leaves))
    fresh = program not in seen
    seen.add(program)
    eq, first = run()
    return _Solved(eq, program, float(np.median([run()[1] for _ in range(_REPEATS)])), first, fresh)


def _by_program(solved: Sequence[_Solved]) -> list[dict[int, Equilibrium]]:
    """Equilibria by their index in `solved`, grouped by compiled program."""
    groups: dict[Hashable, dict[int, Equilibrium]] = {}
    for index, one in enumerate(solved):
        groups.setdefault(one.program, {})[index] = one.eq
    return list(groups.values())


def _program(group: dict[int, Equilibrium]) -> Callable[[Equilibrium], Summary]:
    return compiled_summary(next(iter(group.values())), STATIONS)


def _curves(
    group: dict[int, Equilibrium], program: Callable[[Equilibrium], Summary]
) -> dict[int, Summary | None]:
    return {
        index: jax.tree.map(np.asarray, program(eq)) if bool(eq.converged) else None
        for index, eq in group.items()
    }


def _row(
    case: str,
    name: str,
    model: Model,
    solution: paper.ReferenceSolution,
    solved: _Solved,
    samples: Summary | None,
) -> ReproductionRow:
    tip = np.asarray(solved.eq.tip)[:3, 3]
    tip_error = float(np.linalg.norm(tip - solution.tip[:3, 3]))
    return ReproductionRow(
        case=case,
        tau=tuple(solution.tau.tolist()),
        model=name,
        dofs=model.dofs(solved.eq.scene),
        status=solved.eq.message,
        tip=tuple(tip.tolist()),
        tip_error_mm=1e3 * tip_error,
        tip_error_percent=100 * tip_error / paper.LENGTH,
        strain_error=_strain_error(samples, solution),
        solve_ms=1e3 * solved.warm,
        compile_s=max(solved.first - solved.warm, 0.0) if solved.fresh else None,
    )


def _strain_error(samples: Summary | None, solution: paper.ReferenceSolution) -> float:
    if samples is None:
        return float("nan")
    scale = np.maximum(1.0, np.max(np.abs(solution.strain), axis=0))
    return float(np.max(np.abs(samples.strain[::3] - solution.strain) / scale))


def table(rows: Sequence[ReproductionRow]) -> str:
    """The rows as a Markdown table, with the conditions of the run above and the largest errors of
    each model below."""
    lines = ["# The paper's cases", "", conditions(), _HEADER]
    lines += ["| " + " | ".join(_cells(row)) + " |" for row in rows]
    return "\n".join([*lines, "", "## Largest errors by model", "", *summary(rows), ""])


def conditions() -> str:
    """Machine and precision of the run, and explanations of the table."""
    device, bits = jax.devices()[0], 64 if jax.config.read("jax_enable_x64") else 32
    return (
        f"Run on {os.cpu_count()} CPU cores ({platform.machine()}), JAX {jax.__version__} on "
        f"{device.platform}, {bits}-bit precision. "
        f"Times are medians of {_REPEATS} warm calls that solve and evaluate the tip; compile is "
        "the additional time of the first call, - if the program had been compiled before. Errors "
        "are relative to the reference solutions that the package contains. The strain error is "
        "the largest |error| / max(1, largest |reference|) over stations and strains."
    )


def _cells(row: ReproductionRow) -> tuple[str, ...]:
    if not row.converged:
        outcome = (row.status, "-", "-", "-")
    else:
        tip = ", ".join(f"{x:.6f}" for x in row.tip)
        outcome = (
            f"({tip})",
            f"{row.tip_error_mm:.2e}",
            f"{row.tip_error_percent:.2e}",
            f"{row.strain_error:.1e}",
        )
    dofs = "∞" if row.dofs is None else str(row.dofs)
    compile_time = "-" if row.compile_s is None else f"{row.compile_s:.2f}"
    tau = ", ".join(f"{t:g}" for t in row.tau)
    return (row.case, tau, row.model, dofs, *outcome, f"{row.solve_ms:.2f}", compile_time)


def summary(rows: Sequence[ReproductionRow]) -> list[str]:
    """One line per model: largest tip and strain errors with their cases, and median solve time."""
    lines = []
    for name in dict.fromkeys(row.model for row in rows):
        solved = [row for row in rows if row.model == name and row.converged]
        failed = sum(row.model == name for row in rows) - len(solved)
        failure = f"; {failed} did not converge" if failed else ""
        if not solved:
            lines.append(f"- {name}: no solve{failure}")
            continue
        tip, strain = (
            max(solved, key=key)
            for key in (lambda row: row.tip_error_mm, lambda row: row.strain_error)
        )
        median = np.median([row.solve_ms for row in solved])
        lines.append(
            f"- {name}: tip error at most {tip.tip_error_mm:.2g} mm ({tip.tip_error_percent:.2g} "
            f"% of L, {tip.case}), "
            f"strain error at most {strain.strain_error:.2g} ({strain.case}), median solve "
            f"{median:.2f} ms{failure}"
        )
    return lines


def run(
    out: str | Path = "paper", cases: Sequence[str] = tuple(paper.CASES), *, progress: bool = True
) -> list[ReproductionRow]:
    """Reproduces section IV of the paper: writes `table.md`, `table.json`, Fig. 2 and Fig. 3 (PNG
    and PDF) to the folder `out`.

    Fig. 3 shows A2 and is omitted if `cases` does not contain it. The precision is that of JAX: set
    `jax_enable_x64` first.

    **Returns:** the rows of the table.

    **Raises:** `ValueError` for a case that is not in `paper.CASES`. `OSError` if `out` cannot
    be written.
    """
    _check_cases(cases)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    results = compare(cases, progress=progress)
    rows = [result.row for result in results]
    (folder / "table.md").write_text(table(rows), encoding="utf-8")
    document = {"machine": conditions(), "rows": [row._asdict() for row in rows]}
    write_json(folder / "table.json", document)
    curves = {
        (r.row.case, r.row.tau, r.row.model): r.samples for r in results if r.samples is not None
    }
    for name, draw in (("fig2", paper_figures.figure_2), ("fig3", paper_figures.figure_3)):
        figure = draw(curves)
        if figure is not None:
            for ending in ("png", "pdf"):
                figure.savefig(folder / f"{name}.{ending}", dpi=150)
            plt.close(figure)
    return rows
