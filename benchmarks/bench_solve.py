"""Time of a solve: compilation, single, in a batch of 1,024 and with the batched gradient, in
float32 and float64, in one run.

    python benchmarks/bench_solve.py [--json FILE] [--cold]

The batch draws tensions uniformly from [-15, 0] N. "gradient" is the derivative of a tip
coordinate, summed over the batch, with respect to every number of every routing. `--cold` adds the
times from a cold process to the first tip of B1, of a rod and of a catheter under load, to the
catheter's first gradient, and to the first derivatives of the tip that the package computes; the
same without `quick_compilation`, and with programs that a process before has compiled.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies import paper
from vsr_jax.studies.timing import Timed, machine, take_turns

BATCH = 1024
REPEATS = 15
COLD = """
import time; start = time.perf_counter()
import jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import vsr_jax as vsr
from vsr_jax.numerics import compiling
{options}
imported = time.perf_counter()
{scene}
built = time.perf_counter()
def tip(inputs):
    return vsr.solve(scene, inputs, model=model).tip[0, 3]
{job}.block_until_ready()
print(imported - start, built - imported, time.perf_counter() - built)
"""
COLD_SCENES = {
    "B1": """
arm = vsr.Rod(0.75, vsr.Circular(0.01), vsr.Material(5.93e5, shear=2.0e5))
scene, inputs = vsr.Scene(arm, [vsr.Thread(vsr.Helix(0.005, 1.529))]), jnp.array([-15.0])
model = None
""",
    "steel rod under load": """
arm = vsr.Rod(0.3, vsr.Circular(0.001), vsr.Material(200e9, poisson=0.3, density=7800.0))
forces = [vsr.PointWrench(0.15, force=(0, 0, -0.5)), vsr.TipWrench(force=(0, 0.3, 0))]
scene, inputs = vsr.Scene(arm, loads=[vsr.Gravity(), *forces]), jnp.zeros(0)
model = vsr.StrainDependent(24)
""",
    "catheter under load": """
arm = vsr.Rod(0.2, vsr.Circular(0.001), vsr.Material(60e9, poisson=0.3, density=6000.0))
tendons = [
    vsr.Tendon(vsr.Parallel(*(7e-4 * jnp.array([jnp.cos(a), jnp.sin(a)]))), end=end)
    for end, turn in ((0.1, 0.0), (0.2, 0.7)) for a in turn + jnp.pi / 2 * jnp.arange(4)
]
scene = vsr.Scene(arm, tendons, [vsr.Gravity(), vsr.TipWrench(force=(0, 0, 0.2))])
inputs, model = jnp.arange(8.0), vsr.StrainDependent(24)
""",
}
COLD_JOBS = {
    "B1, tip": ("B1", "tip(inputs)"),
    "steel rod under load, tip": ("steel rod under load", "tip(inputs)"),
    "catheter under load, tip": ("catheter under load", "tip(inputs)"),
    "catheter under load, gradient": (
        "catheter under load",
        "jax.jit(jax.grad(tip), compiler_options=compiling.quick_compilation())(inputs)",
    ),
    "steel rod under load, compliance": (
        "steel rod under load",
        "vsr.compliance(vsr.solve(scene, inputs, model=model))",
    ),
    "catheter under load, jacobian of the tip": (
        "catheter under load",
        "vsr.tip_jacobian(vsr.solve(scene, inputs, model=model))",
    ),
}
COLD_OPTIONS = {
    "as installed": "",
    "without quick_compilation": "compiling.quick_compilation = dict",
    "from the cache": """
jax.config.update("jax_compilation_cache_dir", {folder!r})
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
""",
}


def timed(function: Callable, *args: Any) -> dict[str, float]:
    """Compile time [s], and median and spread (10 to 90 %) of warm calls [us]."""
    job = Timed(function, *args)
    take_turns([job], REPEATS)
    return job.summary()


def measure(name: str, scene: vsr.Scene, model: vsr.StrainDependent, dtype: str) -> dict[str, Any]:
    """Row of the table for one scene in one precision."""
    scene = scene.astype(dtype)
    threads = len(scene.actuators)
    taus = jnp.asarray(np.random.default_rng(0).uniform(-15, 0, (BATCH, threads)), dtype)

    def tip(scene: vsr.Scene, tau: jax.Array) -> jax.Array:
        return vsr.solve(scene, tau, model=model).tip[:3, 3]

    def tips(scene: vsr.Scene, taus: jax.Array) -> jax.Array:
        return jax.vmap(tip, in_axes=(None, 0))(scene, taus)

    def strains(scene: vsr.Scene, taus: jax.Array) -> Any:
        return jax.vmap(lambda tau: model.solve(scene, tau).state)(taus)

    def height(actuators: Any, scene: vsr.Scene, taus: jax.Array) -> jax.Array:
        return jnp.sum(tips(eqx.tree_at(lambda s: s.actuators, scene, actuators), taus)[:, 2])

    nodes = model.steps * model.order // 2
    row = {
        "scene": name,
        "threads": threads,
        "steps": model.steps,
        "order": model.order,
        "nodes": nodes,
        "dtype": dtype,
    }
    row["single"] = timed(tip, scene, taus[0])
    row["strains only"] = timed(strains, scene, taus)
    row["batch"] = timed(tips, scene, taus)
    row["gradient"] = timed(jax.grad(height), scene.actuators, scene, taus)
    row["gradient_over_batch"] = row["gradient"]["median_us"] / row["batch"]["median_us"]
    return row


def cold_start(runs: int = 3) -> dict[str, dict[str, float]]:
    """Median times [s] of import, build and solve up to the first answer: with and without the
    compiler options of the package, and with compiled programs kept by a run before. In turn, each
    run in a new process."""
    rows: dict[str, list[list[str]]] = {}
    with TemporaryDirectory() as folder:
        for i in range(runs + 1):  # the first round fills the folder and is not counted
            for answer, name in product(COLD_JOBS, COLD_OPTIONS):
                scene, job = COLD_JOBS[answer]
                options = COLD_OPTIONS[name].format(folder=folder)
                program = COLD.format(scene=COLD_SCENES[scene], options=options, job=job)
                command = [sys.executable, "-c", program]
                done = subprocess.run(command, capture_output=True, text=True, check=True)
                if i:
                    rows.setdefault(f"{answer}, {name}", []).append(done.stdout.split())
    found = {}
    for name, times in rows.items():
        parts = [*map(float, np.median(np.array(times, float), axis=0))]
        keys = ("import_s", "build_s", "solve_s", "total_s")
        found[name] = dict(zip(keys, [*parts, sum(parts)], strict=True))
    return found


def cell(entry: dict[str, float], per: int = 1) -> str:
    """Median and spread per shape, and compile time, as text."""
    low, mid, high = (entry[k] / per for k in ("low_us", "median_us", "high_us"))
    return f"{mid:.1f} ({low:.1f}-{high:.1f}), {entry['compile_s']:.1f} s"


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--cold", action="store_true", help="measure cold starts as well")
    options = parser.parse_args()
    report: dict[str, Any] = {
        "machine": machine(),
        "jax": jax.__version__,
    }
    if options.cold:
        report["cold"] = cold_start()
        print("first answer of a cold process [s]:")
        for name, times in report["cold"].items():
            print(f"{name}: {', '.join(f'{k} {v:.2f}' for k, v in times.items())}", flush=True)
    jax.config.update("jax_enable_x64", True)
    jobs = [
        ("A3, three threads", "A3", vsr.StrainDependent(32, 4)),
        ("B1, one helix", "B1", vsr.StrainDependent(16, 6)),
    ]
    print(
        f"{report['machine']}, jax {report['jax']}; us per shape: median (10 %-90 %), compile time"
    )
    print(
        "| scene | nodes | dtype | single | strains, 1,024 | tips, 1,024 | gradient, 1,024 | "
        "gradient / tips |"
    )
    print("|" + "---|" * 8)
    report["rows"] = []
    for name, case, model in jobs:
        for dtype in ("float64", "float32"):
            row = measure(name, paper.scene(case), model, dtype)
            report["rows"].append(row)
            cells = [
                cell(row["single"]),
                *(cell(row[k], BATCH) for k in ("strains only", "batch", "gradient")),
            ]
            print(
                f"| {name} | {row['nodes']} | {dtype} | {' | '.join(cells)} | "
                f"{row['gradient_over_batch']:.2f} |",
                flush=True,
            )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
