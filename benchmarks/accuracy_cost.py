"""Cost of accuracy on seven arms for every model: tip, strain and gradient errors against times,
single and in a batch.

    pip install . && python benchmarks/accuracy_cost.py [--scenes B2 ...] [--batch-size 128]
        [--json FILE] [--plots FOLDER]

Errors are the largest over eight shapes, against 256 steps of order 6 (96 under loads). Times are
medians over rounds in which all settings of a scene take turns. Scenes already in the JSON file are
not measured again. The points of the peer on B1 come from a separate run of `bench_peers.py`;
`--peers` names its JSON file.
"""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies import accuracy, accuracy_figures, paper
from vsr_jax.studies.timing import Timed, machine, take_turns

BATCH_SIZE = 128
SPARSE = {
    *(("steps of order 6", steps) for steps in ("8", "16", "32")),
    ("steps of order 4", "32"),
    ("Legendre", "6"),
    ("continuum, Dopri8", "rtol 1e-06"),
}
FIGURES = {
    "accuracy_tip": ("tip", "batch_us"),
    "accuracy_single": ("tip", "single_us"),
    "accuracy_gradient": ("gradient", "batch_us"),
    "accuracy_strain": ("strain", "batch_us"),
}


class Study(NamedTuple):
    """An arm, the bounds of its inputs, a basis made for it, and whether to measure only the
    settings in `SPARSE`, because each takes a minute to compile."""

    scene: vsr.Scene
    low: tuple[float, ...]
    high: tuple[float, ...]
    own: vsr.Basis | None = None
    sparse: bool = False


def of_the_paper(case: str) -> Study:
    scene = paper.scene(case)
    threads = len(scene.actuators)
    return Study(scene, (-15.0,) * threads, (-1.0,) * threads, paper.basis(case))


def fast_helix() -> Study:
    arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2.0e5))
    return Study(vsr.Scene(arm, [vsr.Tendon(vsr.Helix(0.005, pitch=0.75 / 12))]), (1.0,), (15.0,))


def two_sections() -> Study:
    """A base section twice as stiff as the tip section, with one tendon to the end of the base
    section and one to the tip."""
    arm = vsr.Rod(
        0.3, vsr.Circular(0.01), vsr.Material(vsr.Piecewise((0.15,), (8e5, 4e5)), poisson=0.45)
    )
    tendons = [vsr.Tendon(vsr.Parallel(0.0, 0.007), end=0.15), vsr.Tendon(vsr.Helix(0.007, 1.5))]
    return Study(vsr.Scene(arm, tendons), (0.5, 0.5), (4.0, 4.0))


def loaded() -> Study:
    """A helical tendon under gravity and a force at the tip."""
    arm = vsr.Rod(
        0.3, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(8e5, poisson=0.45, density=1000.0)
    )
    scene = vsr.Scene(
        arm,
        [vsr.Tendon(vsr.Helix(0.007, 1.5))],
        [vsr.Gravity((0.0, 0.0, -9.81)), vsr.TipWrench(force=(0.0, 0.05, 0.0))],
    )
    return Study(scene, (0.5,), (4.0,), sparse=True)


STUDIES: dict[str, Callable[[], Study]] = {
    "A1": lambda: of_the_paper("A1"),
    "B1": lambda: of_the_paper("B1"),
    "B2": lambda: of_the_paper("B2"),
    "C2": lambda: of_the_paper("C2"),
    "12 turns": fast_helix,
    "two sections": two_sections,
    "loaded": loaded,
}


def run(name: str, batch_size: int) -> list[accuracy.AccuracyRow]:
    """The rows of one scene; progress and the table are printed."""
    study = STUDIES[name]()
    inputs = jnp.asarray(
        np.random.default_rng(0).uniform(study.low, study.high, (batch_size, len(study.low)))
    )
    ways = accuracy.settings(study.scene, own=study.own)
    if study.sparse:
        ways = [way for way in ways if (way.family, way.label) in SPARSE]
    rows = accuracy.measure(
        study.scene, inputs, ways, report=lambda way: print(f"{name}: {way}", file=sys.stderr)
    )
    print(
        "\n".join([f"\n## {name}\n", *accuracy.table(rows), "", *accuracy.advice(rows)]), flush=True
    )
    return rows


def peers(path: str | None) -> dict[str, dict[str, Any]]:
    """Times per shape [us] and largest errors of SoRoMoX on B1, from the JSON file of
    `bench_peers.py`."""
    if path is None:
        return {}
    rows = [
        row
        for row in json.loads(Path(path).read_text())["scenes"]["B1"]["rows"]
        if row["tool"] == "SoRoMoX"
    ]
    found: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        tool = "SoRoMoX, Newton" if "Newton" in row["setting"] else "SoRoMoX, BFGS"
        found.setdefault(tool, []).append((row["batch"]["median_us"] / 1024, row["tip_error_max"]))
    return {
        "B1": {tool: tuple(zip(*sorted(points), strict=True)) for tool, points in found.items()}
    }


def asked_for(rounds: int = 30, batch_size: int = 1024) -> list[dict[str, Any]]:
    """Times on B2 with the steps that `vsr.plan` chooses for each of `accuracy.TOLERANCES`, all
    timed in turn."""
    study = STUDIES["B2"]()
    inputs = jnp.asarray(np.random.default_rng(0).uniform(study.low, study.high, (batch_size, 2)))
    exact = _tips(study.scene, vsr.StrainDependent(256))(inputs)
    plans = {
        tolerance: vsr.plan(study.scene, tolerance, (study.low, study.high))
        for tolerance in accuracy.TOLERANCES
    }
    jobs = []
    for plan in (
        plans.values()
    ):  # several calls per turn: the first one after the longest job has to allocate memory again
        jobs.append(
            Timed(
                _tips(study.scene.astype(plan.dtype), plan.model),
                inputs.astype(plan.dtype),
                calls=5,
            )
        )
    take_turns(jobs, rounds)
    found = []
    for (tolerance, plan), job in zip(plans.items(), jobs, strict=True):
        error = float(jnp.max(jnp.linalg.norm(job.output - exact, axis=1)))
        found.append(
            {
                "tolerance": tolerance,
                "steps": plan.model.steps,
                "dtype": plan.dtype,
                "error": error,
                **job.summary(),
            }
        )
        median = job.summary()["median_us"] / batch_size
        print(
            f"{tolerance:g} m: {plan.model.steps} steps, {plan.dtype}, error {error:.1e} m, "
            f"{median:.1f} us per shape"
        )
    return found


def _tips(scene: vsr.Scene, model: vsr.StrainDependent) -> Callable:
    return jax.vmap(lambda inputs: vsr.solve(scene, inputs, model=model).tip[:3, 3])


def estimates(rounds: int = 30, batch_size: int = 256) -> dict[str, Any]:
    """Time that `eq.error` adds to a solve with the tip, at 16 steps, in a batch."""
    found = {}
    for name in ("B2", "loaded"):
        study, model = STUDIES[name](), vsr.StrainDependent(16)
        inputs = jnp.asarray(
            np.random.default_rng(0).uniform(study.low, study.high, (batch_size, len(study.low)))
        )

        def with_error(
            u: jax.Array, scene: vsr.Scene = study.scene, model: vsr.StrainDependent = model
        ) -> tuple[jax.Array, jax.Array]:
            eq = vsr.solve(scene, u, model=model)
            return eq.tip[:3, 3], eq.error.tip

        jobs = Timed(_tips(study.scene, model), inputs), Timed(jax.vmap(with_error), inputs)
        take_turns(jobs, rounds)
        alone, both = (job.summary()["median_us"] / batch_size for job in jobs)
        found[name] = {"tip_us": alone, "tip_and_error_us": both}
        print(
            f"{name}: tip {alone:.1f} us per shape, with its error {both:.1f}: "
            f"{both / alone:.2f} times"
        )
    return found


def stiff(calls: int = 5) -> dict[str, Any]:
    """One solve of B2 by an explicit solver and by an implicit one; the equations are not stiff."""
    study, found = STUDIES["B2"](), {}
    inputs = jnp.asarray(study.low)
    exact = vsr.solve(study.scene, inputs, model=vsr.StrainDependent(256)).tip[:3, 3]
    for solver in (diffrax.Dopri8(), diffrax.Kvaerno5()):
        model = vsr.Continuum(solver, 1e-5, 1e-7)
        job = Timed(
            lambda u, model=model: vsr.solve(study.scene, u, model=model).tip[:3, 3],
            inputs,
            calls=calls,
        )
        job.run()
        error = float(jnp.linalg.norm(job.output - exact))
        found[type(solver).__name__] = {"error": error, **job.summary()}
        print(
            f"{type(solver).__name__}, rtol 1e-5: error {error:.1e} m, "
            f"{job.summary()['median_us'] / 1e3:.1f} ms per shape"
        )
    return found


def draw(
    rows: dict[str, list[accuracy.AccuracyRow]], folder: Path, others: dict[str, dict[str, Any]]
) -> None:
    for file, (error, time) in FIGURES.items():
        known = others if (error, time) == ("tip", "batch_us") else None
        accuracy_figures.work_precision(rows, error=error, time=time, others=known).savefig(
            folder / f"{file}.png", dpi=130
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", nargs="+", choices=list(STUDIES), default=list(STUDIES))
    parser.add_argument("--batch-size", type=int, default=BATCH_SIZE)
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--plots", metavar="FOLDER")
    parser.add_argument("--peers", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    file = Path(options.json) if options.json else None
    content = (
        json.loads(file.read_text())
        if file and file.exists()
        else {"machine": machine(), "jax": jax.__version__, "scenes": {}}
    )
    done: dict[str, Any] = content["scenes"]
    for name in options.scenes:
        if name not in done:
            done[name] = [row._asdict() for row in run(name, options.batch_size)]
            if file:
                file.write_text(json.dumps(content, indent=1) + "\n")
    for title, measured in (
        ("asked for on B2", asked_for),
        ("price of an estimate", estimates),
        ("stiff solver on B2", stiff),
    ):
        if title not in content:
            content[title] = measured()
    if file:
        file.write_text(json.dumps(content, indent=1) + "\n")
    if options.plots:
        rows = {name: [accuracy.AccuracyRow(**row) for row in some] for name, some in done.items()}
        draw(rows, Path(options.plots), peers(options.peers))


if __name__ == "__main__":
    main()
