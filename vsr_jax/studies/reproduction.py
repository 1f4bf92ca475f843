"""Section IV of the paper run anew: every case, tension and model against the reference solutions,
as a table and figures."""

import json
import os
import platform
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from tqdm import tqdm

from ..models.base import Model
from ..models.continuum import Continuum
from ..models.prescribed import Prescribed
from ..models.strain_dependent import StrainDependent
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..solution.summary import Summary
from ..validation import choice
from ..viz.plot import sample, sampling
from . import paper, paper_figures

STATIONS = np.linspace(0.0, paper.LENGTH, 61)
"""Where strains and poses are taken [m]; every third is a station of the reference solutions."""

_REPEATS = 5
_HEADER = """
| case | tau [N] | model | DOF | tip [m] | tip error [mm] | tip error [% of L] \
| strain error [-] | solve [ms] | compile [s] |
| --- | --- | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"""


class Row(NamedTuple):
    """One solve of a case against its reference solution.

    **Fields:** `case`, forces `tau` [N], name of the `model` and its degrees of freedom `dofs`
    (None: infinitely many); `status` in words; `tip` [m] and its error in mm and in percent of the
    length; `strain_error`, the largest over the reference's stations and over the six strains of
    |error| / max(1, largest |reference|); `solve_ms`, the median time of a solve and its tip;
    `compile_s`, None where an earlier solve had compiled the same program.
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
        """Whether the solve found an equilibrium."""
        return self.status == "converged"


class Result(NamedTuple):
    """A row of the table and the curves of its solution, None where the solve failed."""

    row: Row
    samples: Summary | None


def models(case: str) -> dict[str, Model]:
    """The models that the paper compares on a case, by name; the piecewise-constant one (PCS) on A2
    alone."""
    compared: dict[str, Model] = {
        "Continuum": Continuum(rtol=1e-10, atol=1e-12),
        "StrainDependent": StrainDependent(),
        "Prescribed": Prescribed(paper.basis(case)),
    }
    return compared | ({"PCS": Prescribed(paper.piecewise_basis())} if case == "A2" else {})


def compare(cases: Sequence[str] = tuple(paper.CASES), *, progress: bool = True) -> list[Result]:
    """Solves every tension of `cases` with every model; `progress` shows a bar.

    **Raises:** `ValueError` for a case that `paper.CASES` does not name.
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
    with (
        ThreadPoolExecutor(2) as pool
    ):  # compiling is most of it; programs that run side by side can wait for each other for ever
        programs = list(
            tqdm(pool.map(_program, groups), "curves", len(groups), disable=not progress)
        )
    samples = {
        index: curve
        for pair in zip(groups, programs, strict=True)
        for index, curve in _curves(*pair).items()
    }
    return [
        Result(_row(*item, s, samples[i]), samples[i])
        for i, (item, s) in enumerate(zip(work, solved, strict=True))
    ]


def _check_cases(cases: Sequence[str]) -> None:
    for case in cases:
        choice("cases", case, tuple(paper.CASES))


class _Solved(NamedTuple):
    """An equilibrium with the median time [s] of a warm solve, that of the first, and whether the
    first had to compile."""

    eq: Equilibrium
    program: Hashable
    warm: float
    first: float
    fresh: bool


def _timed(case: str, model: Model, solution: paper.Solution, seen: set) -> _Solved:
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
    """Equilibria by their place in `solved`, those that share a compiled program together."""
    groups: dict[Hashable, dict[int, Equilibrium]] = {}
    for index, one in enumerate(solved):
        groups.setdefault(one.program, {})[index] = one.eq
    return list(groups.values())


def _program(group: dict[int, Equilibrium]) -> Callable:
    return sampling(next(iter(group.values())), STATIONS)


def _curves(group: dict[int, Equilibrium], program: Callable) -> dict[int, Summary | None]:
    return {
        index: sample(eq, STATIONS, program=program) if bool(eq.converged) else None
        for index, eq in group.items()
    }


def _row(
    case: str,
    name: str,
    model: Model,
    solution: paper.Solution,
    solved: _Solved,
    samples: Summary | None,
) -> Row:
    tip = np.asarray(solved.eq.tip)[:3, 3]
    tip_error = float(np.linalg.norm(tip - solution.tip[:3, 3]))
    return Row(
        case=case,
        tau=tuple(solution.tau.tolist()),
        model=name,
        dofs=_dofs(model, len(solution.tau)),
        status=solved.eq.message,
        tip=tuple(tip.tolist()),
        tip_error_mm=1e3 * tip_error,
        tip_error_percent=100 * tip_error / paper.LENGTH,
        strain_error=_strain_error(samples, solution),
        solve_ms=1e3 * solved.warm,
        compile_s=max(solved.first - solved.warm, 0.0) if solved.fresh else None,
    )


def _dofs(model: Model, threads: int) -> int | None:
    return (
        model.basis.size
        if isinstance(model, Prescribed)
        else threads
        if isinstance(model, StrainDependent)
        else None
    )


def _strain_error(samples: Summary | None, solution: paper.Solution) -> float:
    if samples is None:
        return float("nan")
    scale = np.maximum(1.0, np.max(np.abs(solution.strain), axis=0))
    return float(np.max(np.abs(samples.strain[::3] - solution.strain) / scale))


def table(rows: Sequence[Row]) -> str:
    """The rows as a Markdown table, headed by what it was measured on and closed by the largest
    errors of each model."""
    lines = ["# The paper's cases", "", machine(), _HEADER]
    lines += ["| " + " | ".join(_cells(row)) + " |" for row in rows]
    return "\n".join([*lines, "", "## Largest errors by model", "", *summary(rows), ""])


def machine() -> str:
    """What the times were measured on, and how to read the table, in words."""
    device, bits = jax.devices()[0], 64 if jax.config.read("jax_enable_x64") else 32
    return (
        f"Run on {os.cpu_count()} CPU cores ({platform.machine()}), JAX {jax.__version__} on "
        f"{device.platform}, {bits}-bit precision. "
        f"Times are medians of {_REPEATS} warm calls that solve and take the tip; compile is how "
        f"much longer the first call took, "
        "and - where the program had been compiled before. Errors are against the reference "
        "solutions that the package ships. "
        "The strain error is the largest over stations and strains of |error| / max(1, largest "
        "|reference|)."
    )


def _cells(row: Row) -> tuple[str, ...]:
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


def summary(rows: Sequence[Row]) -> list[str]:
    """One line a model: its largest tip and strain errors with the case of each, and its median
    solve time."""
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
) -> list[Row]:
    """Runs section IV of the paper and writes `table.md`, `table.json`, Fig. 2 and Fig. 3 (PNG and
    PDF) to the folder `out`.

    Fig. 3 shows A2 and is left out where `cases` does not hold it. Precision is that of JAX: set
    `jax_enable_x64` first.

    **Returns:** the rows of the table.

    **Raises:** `ValueError` for a case that `paper.CASES` does not name. `OSError` if `out` cannot
    be written.
    """
    _check_cases(cases)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    results = compare(cases, progress=progress)
    rows = [result.row for result in results]
    (folder / "table.md").write_text(table(rows), encoding="utf-8")
    document = {
        "machine": machine(),
        "rows": [{name: _finite(x) for name, x in row._asdict().items()} for row in rows],
    }
    (folder / "table.json").write_text(
        json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8"
    )
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


def _finite(value: Any) -> Any:
    """`value` with None for NaN, which JSON has no word for."""
    if isinstance(value, tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
