"""What tendons between discs cost over tendons along the section, on the robot that people build: a
nitinol wire of two sections with ten discs each, three tendons to the end of each section, its
weight and a camera at the tip.

    python benchmarks/bench_discs.py [--json FILE] [--rounds N] [--batch N]

Both sides in one run, in turn, driven by tensions and by lengths: one solve, a solve that starts
near, a batch, the gradient of one. Then the workspace of 5,000 samples and `vsr.sweep` of 100,000,
compiling included.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import Timed, machine, primitives, take_turns

LENGTH, OFFSET, DISCS = 0.2, 0.008, 20
MODEL = vsr.StrainDependent(DISCS)
CONTROLS = "tension", "length"
MOST_TENSION, MOST_BEND = 4.0, 1.0
"""Of each tendon [N]; of each section, in any direction [rad], where lengths are driven."""
CABLE = 5e3
"""Axial stiffness of the cables [N], where lengths are driven."""
ANGLES, SECTIONS = np.pi / 3 * np.arange(6), np.array([1, 2] * 3)
"""Places of the holes around the wire, and the last section of each tendon."""
SIDES = {"along the section": False, "between discs": True}
WORKSPACE, SWEEP = 5000, 100_000


def robot(straight: bool, control: Any) -> vsr.Scene:
    """The robot, with tendons that run straight or along the section."""
    discs = vsr.Discs(DISCS, radius=1.1 * OFFSET, mass=2e-4)
    nitinol = vsr.Material(60e9, poisson=0.3, density=6450.0)
    wire = vsr.Rod(LENGTH, vsr.Circular(5e-4), nitinol, discs=discs)
    stretch: dict[str, Any] = {"stiffness": CABLE} if control == "length" else {}
    tendons = [
        vsr.Tendon(
            vsr.Parallel(OFFSET * np.cos(a), OFFSET * np.sin(a)),
            end=None if sections == 2 else LENGTH / 2,
            control=control,
            straight=straight,
            **stretch,
        )
        for a, sections in zip(ANGLES, SECTIONS, strict=True)
    ]
    return vsr.Scene(wire, tendons, [vsr.Gravity(), vsr.Payload(0.02)])


def inputs(control: str, count: int) -> jax.Array:
    """Random tensions, or the lengths by which sections bend as arcs in random directions."""
    random = np.random.default_rng(0)
    if control == "tension":
        return jnp.asarray(random.uniform(0, MOST_TENSION, (count, 6)))
    bends, around = random.uniform(0, (MOST_BEND, 2 * np.pi), (count, 2, 2)).T
    pulls = OFFSET * bends[..., None] * np.cos(around[..., None] - ANGLES)
    return jnp.asarray(-pulls[0] - np.where(SECTIONS == 2, pulls[1], 0.0))


def calls(scene: vsr.Scene, control: str, batch: int) -> dict[str, tuple[Callable, tuple, int]]:
    """The functions that are timed, their arguments and the calls in a row."""
    many = inputs(control, batch)
    one, near = many[0], 1.005 * many[0]
    start = vsr.solve(scene, one, model=MODEL, throw=True)

    def solved(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        eq = vsr.solve(scene, u, model=MODEL)
        return eq.tip, eq.status

    def stepped(u: jax.Array, start: vsr.Equilibrium) -> jax.Array:
        return vsr.solve(scene, u, model=MODEL, start=start).tip

    def height(u: jax.Array) -> jax.Array:
        return vsr.solve(scene, u, model=MODEL).tip[2, 3]

    return {
        "one solve": (solved, (one,), 5),
        "step from near": (stepped, (near, start), 5),
        "gradient": (jax.grad(height), (one,), 5),
        f"batch of {batch}": (jax.vmap(solved), (many,), 1),
    }


def workspace(scene: vsr.Scene) -> tuple[float, float]:
    """Seconds for the tips of many random tensions, compiling included, and the share solved."""
    began = time.perf_counter()
    solve: Callable = jax.vmap(lambda u: vsr.solve(scene, u, model=MODEL))
    eqs = jax.jit(solve)(inputs("tension", WORKSPACE))
    solved = float(jnp.mean(eqs.status == vsr.Status.CONVERGED))
    return time.perf_counter() - began, solved


def sweep(scene: vsr.Scene) -> tuple[float, float]:
    """Seconds of a sweep of random tensions, compiling included, and the share solved."""
    began = time.perf_counter()
    found = vsr.sweep(scene, inputs("tension", SWEEP), model=MODEL, progress=False)
    return time.perf_counter() - began, float(np.mean(found.converged))


def measure(control: str, batch: int, rounds: int) -> list[dict[str, Any]]:
    """A row for each function: times of both sides and their ratio."""
    both = [calls(robot(straight, control), control, batch) for straight in SIDES.values()]
    rows, jobs = [], []
    for name in both[0]:
        sizes, jobs = [], []
        for side in both:
            function, arguments, count = side[name]
            sizes.append(sum(primitives(jax.make_jaxpr(function)(*arguments)).values()))
            jobs.append(Timed(function, *arguments, calls=count))
        take_turns(jobs, rounds)
        times = dict(zip(SIDES, [job.summary() for job in jobs], strict=True))
        rows.append({"control": control, "name": name, "equations": sizes, "times": times})
    solved = [float(np.mean(np.asarray(job.output[1]) == vsr.Status.CONVERGED)) for job in jobs]
    rows[-1]["converged"] = solved
    return rows


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--rounds", type=int, default=7, help="timings of each (7)")
    parser.add_argument("--batch", type=int, default=1024, help="size of the batch (1024)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(f"{machine()}, jax {jax.__version__}; ms, a batch us per shape: median (10 %-90 %)")
    print(
        "| driven by | what | along the section | between discs | ratio | compile s | ratio | "
        "equations |"
    )
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for control in CONTROLS:
        for row in measure(control, options.batch, options.rounds):
            rows.append(row)
            scale = options.batch if row["name"].startswith("batch") else 1e3
            sides = list(row["times"].values())
            cells = (
                f"{side['median_us'] / scale:.3g} ({side['low_us'] / scale:.3g}-"
                f"{side['high_us'] / scale:.3g})"
                for side in sides
            )
            times = [side["median_us"] for side in sides]
            compiled = [side["compile_s"] for side in sides]
            print(
                f"| {control} | {row['name']} | {' | '.join(cells)} | {times[1] / times[0]:.2f} | "
                f"{compiled[0]:.1f}, {compiled[1]:.1f} | {compiled[1] / compiled[0]:.2f} | "
                f"{row['equations'][0]}, {row['equations'][1]} |",
                flush=True,
            )
    seconds, share = workspace(robot(True, "tension"))
    print(f"workspace of {WORKSPACE} samples: {seconds:.1f} s, {share:.1%} solved")
    found = {"rows": rows, "workspace_s": seconds, "workspace_solved": share}
    seconds, share = sweep(robot(True, "tension"))
    print(f"sweep of {SWEEP} samples: {seconds:.0f} s, {share:.3%} solved")
    found |= {"sweep_s": seconds, "sweep_solved": share}
    if options.json:
        options.json.write_text(json.dumps({"machine": machine(), **found}, indent=1) + "\n")


if __name__ == "__main__":
    main()
