"""Cost of contact: an arm without obstacles, with obstacles that it does not touch, and with one on
which it lies.

    python benchmarks/bench_contact.py [--rounds N] [--json FILE]

One arm in 24 steps under gravity and a force at its tip. "single" is one solve with its tip,
"batch" 128 forces in one call, "gradient" the derivative of a single tip by the force. All programs
are compiled first and then timed in turn; ratios are those to the arm without obstacles.
"equations" are those of the program of a single solve, loops counted once.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import Timed, machine, primitives, take_turns

jax.config.update("jax_enable_x64", True)

MODEL, BATCH = vsr.StrainDependent(24), 128
PILLAR = vsr.Cylinder(0.02, pose=vsr.pose((0.1, 0.0, -0.03), pointing=(0.0, 1.0, 0.0)))


def obstacles() -> dict[str, list[Any]]:
    """Obstacles by the name of the case; those that are far are never touched."""
    far = [vsr.Sphere((0.05 * i, 0.3, 0.0), 0.02) for i in range(10)]
    return {
        "none": [],
        "one, not touched": far[:1],
        "one, touched": [PILLAR],
        "ten, one touched": [*far[:9], PILLAR],
    }


def tip(around: list[Any], force: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Height of the tip and Newton steps for a force down [N]."""
    rod = vsr.Rod(0.2, vsr.Circular(0.005), vsr.Material(1e6, poisson=0.3, density=1000.0))
    load = vsr.TipWrench(force=jnp.stack([0.0 * force, 0.005 + 0.0 * force, -force]))
    scene = vsr.Scene(rod, (), [vsr.Gravity(), load], obstacles=around)
    eq = vsr.solve(scene, jnp.zeros(0), model=MODEL)
    return eq.tip[2, 3], eq.steps


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    force, forces = jnp.array(0.03), jnp.linspace(0.01, 0.04, BATCH)
    jobs, sizes = {}, {}
    for name, around in obstacles().items():

        def one(force: jax.Array, around: Any = around) -> Any:
            return tip(around, force)

        def slope(force: jax.Array, around: Any = around) -> jax.Array:
            return jax.grad(lambda force: tip(around, force)[0])(force)

        sizes[name] = sum(primitives(jax.make_jaxpr(one)(force)).values())
        jobs[name] = {
            "single": Timed(one, force, calls=3),
            "batch": Timed(jax.vmap(one), forces),
            "gradient": Timed(slope, force, calls=3),
        }
    take_turns((job for parts in jobs.values() for job in parts.values()), options.rounds)
    record: dict[str, Any] = {"machine": machine(), "cases": {}}
    bare = {kind: job.summary()["median_us"] for kind, job in jobs["none"].items()}
    print("| obstacles | equations | steps | " + " | ".join(f"{k} [ms]" for k in bare) + " |")
    print("|" + "---|" * (3 + len(bare)))
    for name, parts in jobs.items():
        rows = {kind: job.summary() for kind, job in parts.items()}
        steps = int(parts["single"].output[1])
        mean = float(np.mean(np.asarray(parts["batch"].output[1])))
        record["cases"][name] = {
            "equations": sizes[name],
            "steps": steps,
            "steps_batch": mean,
            **rows,
        }
        cells = [
            f"{row['median_us'] / 1e3:.3g} ({row['median_us'] / bare[kind]:.1f}x, compile "
            f"{row['compile_s']:.1f} s)"
            for kind, row in rows.items()
        ]
        print(f"| {name} | {sizes[name]} | {steps}, {mean:.0f} | " + " | ".join(cells) + " |")
    if options.json:
        Path(options.json).write_text(json.dumps(record, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
