"""Newton steps of loaded solves over 1,000 random scenes, one arm at a time: a histogram.

    python benchmarks/newton_steps.py [--draws 100] [--against FOLDER] [--json FILE]

The structures are those of `ordinary_scenes`, 100 draws each with a fixed seed. Steps are
evaluations of the residual and its tangent, in the converged solves. Counts are free of noise.
`--against` takes the folder of another version of the repository and runs the same scenes with its
package, in a process of its own.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from ordinary_scenes import STRUCTURES, Numbers, Structure, built

import vsr_jax as vsr

SEED, STEPS = 19, 24
EDGES = (0, 4, 6, 8, 10, 15, 20, 30, 50, 100, 1000)
"""Bins of the histogram: more than the first and at most the second number of steps."""


@partial(jax.jit, static_argnums=0)
def solved(structure: Structure, draws: Numbers) -> tuple[jax.Array, jax.Array]:
    """Status and Newton steps of each draw, solved one after another."""

    def one(numbers: Numbers) -> tuple[jax.Array, jax.Array]:
        eq = vsr.solve(*built(structure, numbers), model=vsr.StrainDependent(STEPS))
        return eq.status, eq.steps

    return lax.map(one, draws)


def counted(draws: int) -> dict[str, Any]:
    """Steps of the converged draws of each structure, and the number of the others."""
    found = {}
    for name, structure in STRUCTURES.items():
        random = np.random.default_rng(SEED)
        drawn = [structure.numbers(random) for _ in range(draws)]
        stacked = {key: jnp.asarray([one[key] for one in drawn]) for key in drawn[0]}
        status, steps = (np.asarray(x) for x in solved(structure, stacked))
        found[name] = {
            "steps": sorted(steps[status == 0].tolist()),
            "not converged": int(np.sum(status != 0)),
        }
        print(f"{name}: {_summary(found[name]['steps'])}", file=sys.stderr)
    return found


def _summary(steps: list[int]) -> str:
    low, median, high = np.quantile(steps, [0.05, 0.5, 0.95])
    return f"mean {np.mean(steps):.1f}, median {median:.0f} (5 to 95 %: {low:.0f} to {high:.0f})"


def elsewhere(folder: Path, draws: int) -> dict[str, Any]:
    """The same by the package in a folder."""
    with tempfile.TemporaryDirectory() as place:
        out = Path(place) / "steps.json"
        command = [sys.executable, __file__, "--draws", str(draws), "--json", str(out)]
        subprocess.run(command, check=True, env={**os.environ, "PYTHONPATH": str(folder)})
        return json.loads(out.read_text())["now"]


def report(results: dict[str, dict[str, Any]]) -> str:
    """Table of both versions by structure, and the histograms."""
    lines = []
    for version, found in results.items():
        every = np.concatenate([one["steps"] for one in found.values()])
        failed = sum(one["not converged"] for one in found.values())
        lines.append(f"{version}: {len(every)} converged, {failed} not; {_summary(every.tolist())}")
        lines += [f"  {name}: {_summary(one['steps'])}" for name, one in found.items()]
        counts, _ = np.histogram(every, np.array(EDGES) + 0.5)
        for low, high, count in zip(EDGES, EDGES[1:], counts, strict=False):
            share = 100 * count / len(every)
            lines.append(f"  {low + 1:4d} to {high:4d} steps {share:5.1f} % {'#' * round(share)}")
    return "\n".join(lines)


def main() -> None:
    """Count and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=100, help="draws of each structure (100)")
    parser.add_argument("--against", type=Path, metavar="FOLDER")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    # nothing is timed
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    jax.config.update("jax_enable_x64", True)
    results = {"now": counted(options.draws)}
    if options.against:
        results = {"before": elsewhere(options.against.resolve(), options.draws), **results}
    print(report(results))
    if options.json:
        options.json.write_text(
            json.dumps({"seed": SEED, "jax": jax.__version__, **results}) + "\n"
        )


if __name__ == "__main__":
    main()
