"""Time of a loaded solve in a prescribed basis: single, in a batch, two batches in one program, and
its gradient.

    python benchmarks/bench_prescribed.py [--json FILE]

A soft arm of 0.5 m on a horizontal clamp, under its weight and bent by one tendon: Legendre
polynomials of order 3 for both bending strains, eight coordinates, tensions from 0 to 5 N, float64.
`StrainDependent` with the same steps is timed in the same run.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import Timed, machine, take_turns

ARM = vsr.Rod(0.5, vsr.Circular(0.01), vsr.Material(5e5, poisson=0.45, density=1100.0))
SCENE = vsr.Scene(ARM, [vsr.Tendon(vsr.Parallel(0.006, 0.0))], [vsr.Gravity()])
MODELS = {
    "Prescribed, 8 coordinates": vsr.Prescribed(
        vsr.Basis.uniform(vsr.Legendre(3), ("bending_y", "bending_z"))
    ),
    "StrainDependent(32)": vsr.StrainDependent(),
}
BATCHES = (64, 256, 1024)
REPEATS = 9


def programs(
    model: vsr.Prescribed | vsr.StrainDependent,
) -> dict[str, tuple[Callable, jax.Array, int]]:
    """Functions by name, with their argument and the number of shapes per call."""

    def tip(tension: jax.Array) -> jax.Array:
        return vsr.solve(SCENE, tension, model=model).tip[:3, 3]

    def tensions(size: int) -> jax.Array:
        return jnp.linspace(0.0, 5.0, size)[:, None]

    side_by_side = jax.vmap(tip)
    found: dict[str, tuple[Callable, jax.Array, int]] = {"single": (tip, jnp.array([2.5]), 1)}
    found |= {f"{size} in a batch": (side_by_side, tensions(size), size) for size in BATCHES}
    found["two batches of 1024 in one program"] = (
        lambda x: (side_by_side(x), side_by_side(0.9 * x)),
        tensions(1024),
        2048,
    )
    found["gradient, 256 in a batch"] = (
        jax.vmap(jax.grad(lambda x: tip(x)[2])),
        tensions(256),
        256,
    )
    return found


def measure(model: vsr.Prescribed | vsr.StrainDependent) -> dict[str, Any]:
    """Times by program, and the Newton steps."""
    status, steps = jax.jit(
        jax.vmap(lambda x: (lambda eq: (eq.status, eq.steps))(vsr.solve(SCENE, x, model=model)))
    )(jnp.linspace(0.0, 5.0, 256)[:, None])
    row: dict[str, Any] = {
        "converged": float(np.mean(status == 0)),
        "steps": [int(np.min(steps)), int(np.max(steps))],
        "programs": {},
    }
    named = programs(model)
    jobs = {name: Timed(function, argument) for name, (function, argument, _) in named.items()}
    take_turns(list(jobs.values()), REPEATS)
    for name, job in jobs.items():
        row["programs"][name] = {**job.summary(), "shapes": named[name][2]}
    return row


def main() -> None:
    """Measures both models and prints milliseconds per shape."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record: dict[str, Any] = {"machine": machine()}
    for name, model in MODELS.items():
        record[name] = row = measure(model)
        print(
            f"{name}: {row['converged']:.0%} converged in {row['steps'][0]} to {row['steps'][1]} "
            f"steps"
        )
        for program, times in row["programs"].items():
            low, median, high = (
                times[key] / times["shapes"] / 1e3 for key in ("low_us", "median_us", "high_us")
            )
            print(
                f"  {program:36} {median:8.3f} ms per shape ({low:.3f}-{high:.3f}), compile "
                f"{times['compile_s']:.1f} s"
            )
    if options.json:
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
