"""Size of the programs of bare and loaded arms, time to trace and to compile them, and time of a
solve; of two checkouts in one run.

    python benchmarks/bench_compile.py [--against DIR] [--scenes NAME ...] [--rounds N]
        [--json FILE]

Each measurement is made in a process of its own, so that nothing is compiled already. With
`--against` another checkout of the package is measured in turn with this one, and the last column
is the ratio of this one to it. "equations" are those of the jaxpr, with the body of a loop counted
once; they do not depend on the machine. "one" is a solve with its tip, "batch" 512 of them in one
call, "gradient" the derivative of one by the inputs, "gradients" 64 of these in one call. "trace_s"
includes the lowering for XLA; "run_ms" is the median of the calls of one process.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies import paper
from vsr_jax.studies.timing import machine, primitives

STEPS, BATCH, GRADIENTS = 24, 512, 64
KINDS = ("one", "batch", "gradient", "gradients")
HERE = Path(__file__).resolve().parent.parent


def scenes() -> dict[str, tuple[vsr.Scene, Any]]:
    """Scenes and inputs by name."""
    steel = vsr.Rod(1.0, vsr.Circular(2e-3), vsr.Material(200e9, poisson=0.3, density=7800.0))
    loads = [
        vsr.Gravity(),
        vsr.PointWrench(0.5, (0.0, 1.0, 0.0)),
        vsr.TipWrench((0.0, 0.0, 2.0)),
    ]
    nitinol = vsr.Rod(0.2, vsr.Circular(1e-3), vsr.Material(60e9, poisson=0.3, density=6000.0))
    angles = [
        (end, k * np.pi / 2 + turn) for end, turn in ((0.1, 0.0), (0.2, 0.7)) for k in range(4)
    ]
    tendons = [
        vsr.Tendon(vsr.Parallel(7e-4 * np.cos(angle), 7e-4 * np.sin(angle)), end=end)
        for end, angle in angles
    ]
    tip = [vsr.Gravity(), vsr.TipWrench((0.0, 0.0, 0.2))]
    rubber = vsr.Rod(0.2, vsr.Circular(6e-3), vsr.Material(5e5, poisson=0.4, density=1100.0))
    rubbing = [
        vsr.Tendon(vsr.Parallel(y, z), friction=0.1) for y, z in ((4e-3, 0.0), (-2e-3, 4e-3))
    ]
    one, end = jnp.array([1.0]), (0.18, 0.0, 0.02)

    def pulled(**beside: Any) -> tuple[vsr.Scene, Any]:
        return vsr.Scene(rubber, vsr.Tendon(vsr.Parallel(4e-3, 0.0)), vsr.Gravity(), **beside), one

    return {
        "B1": (paper.scene("B1"), jnp.array([-10.0])),
        "steel rod": (
            vsr.Scene(steel, [vsr.Tendon(vsr.Parallel(1e-3, 0.0))], loads),
            jnp.array([10.0]),
        ),
        "catheter": (vsr.Scene(nitinol, tendons, tip), jnp.arange(8.0)),
        "friction": (vsr.Scene(rubber, rubbing, vsr.Gravity()), jnp.array([1.0, 2.0])),
        "contact": pulled(obstacles=vsr.Sphere((0.15, 0.0, -0.05), 0.03)),
        "pinned": pulled(held=vsr.Held(position=end)),
        "clamped": pulled(held=vsr.Held(position=end, orientation=np.eye(3))),
    }


def program(name: str, kind: str) -> dict[str, float]:
    """Size and times of one program, of one of the `KINDS`."""
    scene, inputs = scenes()[name]

    def tip(inputs: jax.Array) -> jax.Array:
        return vsr.solve(scene, inputs, model=vsr.StrainDependent(STEPS)).tip[1, 3]

    slope, sizes = jax.grad(tip), {"batch": BATCH, "gradients": GRADIENTS}
    functions: dict[str, Callable] = dict(
        zip(KINDS, (tip, jax.vmap(tip), slope, jax.vmap(slope)), strict=True)
    )
    function = functions[kind]
    if kind in sizes:
        inputs = jnp.linspace(0.5, 1.0, sizes[kind])[:, None] * inputs
    start = time.perf_counter()
    traced = jax.jit(function).trace(inputs)
    lowered, first = traced.lower(), time.perf_counter()
    compiled, second = lowered.compile(), time.perf_counter()
    jax.block_until_ready(compiled(inputs))
    runs = []
    for _ in range(15 if kind in sizes else 50):
        begin = time.perf_counter()
        jax.block_until_ready(compiled(inputs))
        runs.append(time.perf_counter() - begin)
    return {
        "equations": primitives(traced.jaxpr).total(),
        "trace_s": first - start,
        "compile_s": second - first,
        "run_ms": 1e3 * statistics.median(runs),
    }


def measured(checkout: Path, *arguments: str) -> dict[str, float]:
    """One measurement in a process of its own that imports the package from a checkout."""
    environment = os.environ | {"PYTHONPATH": str(checkout), "VSR_JAX_CACHE": "off"}
    command = [sys.executable, __file__, "--measure", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def compare(options: argparse.Namespace) -> None:
    """All measurements, in turn between the checkouts; saved after each program."""
    checkouts = {"this": HERE} | ({"other": options.against} if options.against else {})
    jobs = [(name, kind) for name in options.scenes for kind in KINDS]
    rows = []
    for name, kind in jobs:
        taken: dict[str, list[dict[str, float]]] = {side: [] for side in checkouts}
        for _ in range(options.rounds):
            for side, checkout in checkouts.items():
                taken[side].append(measured(checkout, name, kind))
        for key in taken["this"][0]:
            values = {s: statistics.median(one[key] for one in taken[s]) for s in checkouts}
            spread = {
                s: max(one[key] for one in taken[s]) - min(one[key] for one in taken[s])
                for s in checkouts
            }
            rows.append({"name": name, "kind": kind, "quantity": key, **values, "spread": spread})
            ratio = values["this"] / values["other"] if options.against else float("nan")
            texts = [f"{values[s]:12.4g} +-{spread[s] / 2:8.2g}" for s in checkouts]
            print(f"{name:24} {kind:9} {key:10} {'  '.join(texts)}  {ratio:6.2f}", flush=True)
        if options.json:
            save(options.json, rows)


def save(file: str, rows: list[dict[str, Any]]) -> None:
    """Writes the figures measured so far."""
    sizes = {"steps": STEPS, "batch": BATCH, "gradients": GRADIENTS}
    content = {"machine": machine(), **sizes, "rows": rows}
    Path(file).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--against", type=Path, metavar="DIR", help="another checkout")
    parser.add_argument(
        "--scenes", nargs="+", default=list(scenes()), choices=list(scenes()), help="default: all"
    )
    parser.add_argument("--rounds", type=int, default=3, help="processes per program (default: 3)")
    parser.add_argument("--json", metavar="FILE", help="save the figures")
    parser.add_argument("--measure", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.measure:
        print(json.dumps(program(*options.measure)))
        return
    compare(options)


if __name__ == "__main__":
    main()
