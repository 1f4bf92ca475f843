"""What arms that collapse cost the others of a batch: 1,024 arms of which none, one, 1 % and 10 %
are pulled with far more than they bear.

    python benchmarks/bench_collapse.py [--json FILE] [--rounds N]

One arm with three tendons, without loads, under its weight and with a force across its tip; all
batches of a scene run the same program, timed in turn in one run.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import Timed, machine, take_turns

BATCH = 1024
COLLAPSED = (0, 1, BATCH // 100, BATCH // 10)
MODEL = vsr.StrainDependent(24)
BORNE, FAR_TOO_MUCH = 1.0, 500.0
"""Largest tension of the others, and that of the arms that collapse [N]."""


def scenes() -> dict[str, vsr.Scene]:
    """The arm and its loads."""
    rod = vsr.Rod(0.2, vsr.Circular(0.005), vsr.Material(1e6, poisson=0.3, density=1000.0))
    ways = (0.0, 2 * np.pi / 3, 4 * np.pi / 3)
    tendons = [vsr.Tendon(vsr.Parallel(0.004 * np.cos(a), 0.004 * np.sin(a))) for a in ways]
    across = vsr.TipWrench(force=(0, 0, -0.025))
    loads = {"no loads": (), "gravity": (vsr.Gravity(),), "tip force": (across,)}
    return {name: vsr.Scene(rod, tendons, some) for name, some in loads.items()}


def measure(scene: vsr.Scene, rounds: int) -> list[dict[str, Any]]:
    """Times of the batches, by the number of arms that collapse, spread evenly."""

    def solved(tensions: jax.Array) -> tuple[jax.Array, jax.Array]:
        eq = vsr.solve(scene, tensions, model=MODEL)
        return eq.tip, eq.status

    borne = np.random.default_rng(0).uniform(0, BORNE, (BATCH, len(scene.actuators)))
    jobs = []
    for count in COLLAPSED:
        tensions = borne.copy()
        places = np.linspace(0, BATCH, count, endpoint=False, dtype=int) + BATCH // 3
        tensions[places % BATCH, 0] = FAR_TOO_MUCH
        job = Timed(jax.vmap(solved), jnp.asarray(tensions))
        assert np.sum(np.asarray(job.output[1]) == vsr.Status.COLLAPSED) == count
        jobs.append(job)
    take_turns(jobs, rounds)
    return [{"collapsed": n, **job.summary()} for n, job in zip(COLLAPSED, jobs, strict=True)]


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--rounds", type=int, default=9, help="timings per batch (9)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{machine()}, jax {jax.__version__}; ms per batch of {BATCH}: median (10 %-90 %), ratio")
    print(f"| scene | {' | '.join(f'{n} collapse' for n in COLLAPSED)} |")
    print("|" + "---|" * (len(COLLAPSED) + 1))
    rows = {}
    for name, scene in scenes().items():
        rows[name] = every = measure(scene, options.rounds)
        cells = (
            f"{row['median_us'] / 1e3:.0f} ({row['low_us'] / 1e3:.0f}-{row['high_us'] / 1e3:.0f}), "
            f"{row['median_us'] / every[0]['median_us']:.2f}"
            for row in every
        )
        print(f"| {name} | {' | '.join(cells)} |", flush=True)
    if options.json:
        report = {"machine": machine(), "jax": jax.__version__, "rows": rows}
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
