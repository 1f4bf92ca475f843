"""Inverse statics in a batch: 1,024 targets, reachable because they are tips for random inputs, on
three arms.

    pip install . && python benchmarks/bench_reach.py [--targets 1024] [--json FILE]

For each arm: the number of targets reached within 1 um, the largest miss, compile time and targets
per second; and the same for targets beyond the arm's length, none of which may be reported as
reached. Then a loaded arm follows a target that moves by 1 mm, a hundred times, from the result
before and without it, in one program each.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import Timed, machine, take_turns

MODEL = vsr.StrainDependent(12)
MOST, MISS = 12.0, 1e-6
BATCH = 64
"""Targets per batch; each batch takes as long as its slowest target."""


def arms() -> dict[str, vsr.Scene]:
    rod = vsr.Rod(0.75, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2.0e5))

    def ring(number: int) -> list[vsr.Tendon]:
        angles = 2 * np.pi * np.arange(number) / number
        return [vsr.Tendon(vsr.Parallel(0.005 * np.cos(a), 0.005 * np.sin(a))) for a in angles]

    helices = [vsr.Tendon(vsr.Helix(0.005, angle)) for angle in (1.529, 1.487)]
    return {
        "three tendons": vsr.Scene(rod, ring(3)),
        "four tendons": vsr.Scene(rod, ring(4)),
        "two helices": vsr.Scene(rod, helices),
    }


def run(scene: vsr.Scene, number: int, rounds: int) -> dict[str, Any]:
    inputs = jnp.asarray(
        np.random.default_rng(0).uniform(0.1, MOST, (number, len(scene.actuators)))
    )
    tips = jax.vmap(lambda u: vsr.solve(scene, u, model=MODEL).tip[:3, 3])(inputs)

    def reach(target: jax.Array) -> vsr.Reach:
        return vsr.reach(scene, target, (0.0, MOST), model=MODEL, allowed_miss=MISS)

    job = Timed(lambda targets: jax.lax.map(reach, targets, batch_size=BATCH), tips)
    take_turns([job], rounds)
    start = time.perf_counter()
    far = jax.block_until_ready(job.compiled(tips / jnp.linalg.norm(tips, axis=1, keepdims=True)))
    beyond_s = time.perf_counter() - start
    found, times = job.output, job.summary()
    return {
        "targets": number,
        "reached": int(jnp.sum(found.reached)),
        "largest miss": float(jnp.max(found.miss)),
        "effort, by that of the inputs drawn": float(
            jnp.median(jnp.linalg.norm(found.inputs, axis=1) / jnp.linalg.norm(inputs, axis=1))
        ),
        "out of reach, called reached": int(jnp.sum(far.reached)),
        "targets a second": 1e6 * number / times["median_us"],
        "out of reach, targets a second": number / beyond_s,
        **times,
    }


def follow(rounds: int) -> dict[str, Any]:
    """Times per target of a path, each result found from the one before, and without it."""
    rod = vsr.Rod(0.3, vsr.Circular(0.01), vsr.Material(8e5, poisson=0.45, density=800.0))
    angles = 0.3 + np.pi / 2 * np.arange(4)
    around = [vsr.Tendon(vsr.Parallel(0.007 * np.cos(a), 0.007 * np.sin(a))) for a in angles]
    scene, tense = vsr.Scene(rod, around, [vsr.Gravity()]), jnp.array([6.0, 3.0, 2.0, 2.0])
    eq, zero = vsr.solve(scene, tense, model=MODEL), jnp.zeros(())
    first = vsr.Reach(tense, eq, zero, jnp.array(True), zero, zero)
    angle = 0.1 * jnp.arange(100)[:, None]  # on a circle of 1 cm
    circle = 0.01 * jnp.concatenate([0 * angle, jnp.sin(angle), jnp.cos(angle) - 1], axis=1)
    targets = eq.tip[:3, 3] + circle

    def reach(target: jax.Array, start: vsr.Reach | None) -> vsr.Reach:
        return vsr.reach(scene, target, (0.0, MOST), model=MODEL, start=start)

    def tracked(targets: jax.Array) -> jax.Array:
        def proceed(start: vsr.Reach, target: jax.Array) -> tuple[vsr.Reach, jax.Array]:
            found = reach(target, start)
            return found._replace(allowed_miss=zero), found.reached

        return jax.lax.scan(proceed, first, targets)[1]

    warm = Timed(tracked, targets)
    cold = Timed(lambda targets: jax.lax.map(lambda t: reach(t, None).reached, targets), targets)
    take_turns([warm, cold], rounds)
    return {
        name: {
            "reached": int(jnp.sum(job.output)),
            "compile_s": job.compile_s,
            "ms per target": job.summary()["median_us"] / 1e3 / len(targets),
        }
        for name, job in (("from the result before", warm), ("without it", cold))
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", type=int, default=1024)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = {}
    for name, scene in arms().items():
        results[name] = run(scene, options.targets, options.rounds)
        print(
            f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in results[name].items()),
            flush=True,
        )
    results["a moving target"] = follow(options.rounds)
    print(f"a moving target: {results['a moving target']}", flush=True)
    if options.json:
        Path(options.json).write_text(
            json.dumps({"machine": machine(), "jax": jax.__version__, "arms": results}, indent=1)
            + "\n"
        )


if __name__ == "__main__":
    main()
