"""Time of an assembly: six rods that carry a plate, followed along a path of their lengths.

    python benchmarks/bench_assembly.py [--poses N] [--steps N] [--json FILE]

Both sides start each pose from the one before: `solve_assembly(start=)` in a compiled function, and
shooting in SciPy (`six_rods.py`) with the same accuracy. Prints the time of compiling, the median
per pose with its quartiles, the greatest distance between both, and the time of a gradient of the
height by all lengths.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import vsr_jax as vsr
from benchmarks.six_rods import HEIGHT, anchors, guess_from, hexapod, shooting

RADIUS, TURNS = 0.01, 0.25
"""Largest change of the lengths [m], and how far the path goes around."""


def path(poses: int) -> np.ndarray:
    """Lengths of the rods [m], shape (poses, 6): a wave that goes around."""
    angle = 2 * np.pi * TURNS * np.linspace(0, 1, poses)[:, None]
    return HEIGHT + RADIUS * np.sin(angle + np.pi / 3 * np.arange(6))


def quartiles(seconds: list[float]) -> list[float]:
    return statistics.quantiles(seconds, n=4)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--steps", type=int, default=12)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    model, assembly = vsr.StrainDependent(options.steps), hexapod()
    lengths, places = path(options.poses), [q for _, q in anchors()]

    step = jax.jit(lambda u, start: vsr.solve_assembly(assembly, u, model=model, start=start))
    slope = jax.jit(
        jax.grad(
            lambda u, start: vsr.solve_assembly(assembly, u, model=model, start=start).poses[
                0, 2, 3
            ]
        )
    )

    def timed(function, *given):
        begin = time.perf_counter()
        found = jax.block_until_ready(function(*given))
        return found, time.perf_counter() - begin

    eq, first = timed(
        lambda u: vsr.solve_assembly(assembly, u, model=model), jnp.asarray(lengths[0])
    )
    _, compiling = timed(step, jnp.asarray(lengths[0]), eq)
    _, compiling_slope = timed(slope, jnp.asarray(lengths[0]), eq)
    z, ours, gradients, theirs, apart = guess_from(eq), [], [], [], []
    for row in lengths[1:]:
        _, seconds = timed(slope, jnp.asarray(row), eq)
        gradients.append(seconds)
        eq, seconds = timed(step, jnp.asarray(row), eq)
        ours.append(seconds)
        begin = time.perf_counter()
        z, _ = shooting(assembly, row, z, places)
        theirs.append(time.perf_counter() - begin)
        apart.append(float(np.linalg.norm(np.asarray(eq.poses[0, :3, 3]) - z[39:])))
    record = {
        "poses": options.poses,
        "steps": options.steps,
        "first_s": first,
        "compile_s": compiling,
        "compile_gradient_s": compiling_slope,
        "pose_s": quartiles(ours),
        "gradient_s": quartiles(gradients),
        "scipy_pose_s": quartiles(theirs),
        "ratio": statistics.median(theirs) / statistics.median(ours),
        "apart_m": max(apart),
        "device": jax.devices()[0].device_kind,
    }
    print(
        f"first solve {first:.1f} s, compiling a step {compiling:.1f} s, a gradient "
        f"{compiling_slope:.1f} s"
    )
    for name, key in (("pose", "pose_s"), ("gradient", "gradient_s"), ("SciPy", "scipy_pose_s")):
        low, middle, high = (1e3 * x for x in record[key])
        print(f"{name:9} {middle:8.1f} ms  ({low:.1f} to {high:.1f})")
    print(f"SciPy takes {record['ratio']:.1f} times as long; at most {max(apart):.1e} m apart")
    if options.json:
        options.json.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
