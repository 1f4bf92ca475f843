"""Time of a solve: compilation, single, in a batch of 1,024 and with the batched gradient, in
float32 and float64, in one run.

    python benchmarks/bench_solve.py [--json FILE]

The batch draws tensions uniformly from [-15, 0] N. "gradient" is the derivative of a tip
coordinate, summed over the batch, with respect to every number of every routing.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
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
    options = parser.parse_args()
    report: dict[str, Any] = {
        "machine": machine(),
        "jax": jax.__version__,
    }
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
