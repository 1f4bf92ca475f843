"""Batches of arms on the device in use, and on the CPU beside it: shapes per second by the number
of arms, for arms without and with loads, with friction, straight tendons and contact.

    python benchmarks/bench_device.py [--json FILE] [--rounds N] [--scenes NAME ...]

Float64, cold starts; "B1" and "loaded" are the scenes of `bench_peers` at 16 steps of order 6, the
others those of `vsr_jax.studies.effects`. Each solve returns the position of the tip and whether it
converged. The CPU solves `ON_CPU` arms in one program, in the same run; the tips of both are
compared. Where SoRoMoX is installed, its arm "loaded" (16 modes, 48 points) is a row of its own.
"""

import argparse
import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from peer_scenes import CASES, our_scene

import vsr_jax as vsr
from vsr_jax.studies import effects
from vsr_jax.studies.timing import Timed, machine, take_turns

SIZES = (1, 1024, 16_384, 131_072)
ON_CPU = 1024
EFFECTS = ("+ gravity", "+ friction", "straight tendons", "pillar, touched")


class Job(NamedTuple):
    """A scene's name, its solve by one vector of inputs, and a source of random inputs."""

    name: str
    solve: Callable[[jax.Array], tuple[jax.Array, jax.Array]]
    inputs: Callable[[int], np.ndarray]


def ours(name: str, scene: vsr.Scene, inputs: Callable[[int], np.ndarray]) -> Job:
    """A scene solved by vsr_jax."""
    model = vsr.StrainDependent(16)

    def solve(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        eq = vsr.solve(scene, u, model=model)
        return eq.tip[:3, 3], eq.converged

    return Job(name, solve, inputs)


def theirs() -> list[Job]:
    """The loaded arm solved by SoRoMoX, if it is installed."""
    try:
        import peer_soromox as peer
    except ModuleNotFoundError:
        return []
    case = CASES["loaded"]
    setting = peer.Setting(*case.theirs[3])
    arm, path = peer.build(setting, case.numbers)

    def solve(u: jax.Array) -> tuple[jax.Array, jax.Array]:
        solved = peer.UNLOADED[setting.way](arm, path, u, setting.tolerance)
        tip = peer.tip(arm, solved)
        return tip, jnp.all(jnp.isfinite(tip))

    return [Job("loaded, SoRoMoX", solve, paper_tensions)]


def paper_tensions(size: int) -> np.ndarray:
    """Tensions [N] of the paper's sign."""
    return np.random.default_rng(0).uniform(-15.0, 0.0, (size, 1))


def jobs() -> list[Job]:
    """All scenes."""
    found = [
        ours(name, our_scene(CASES[name].numbers), paper_tensions) for name in ("B1", "loaded")
    ]
    for one in effects.scenes():
        if one.name in EFFECTS:

            def inputs(size: int, most: tuple = one.inputs) -> np.ndarray:
                return np.random.default_rng(0).uniform(0.5, 1.0, (size, len(most))) * most

            found.append(ours(one.name, one.scene.astype("float64"), inputs))
    return found + theirs()


def compiled(job: Job, size: int, device: Any) -> Timed:
    """The solve of a number of arms on a device."""
    inputs = job.inputs(size)
    with jax.default_device(device):
        if size == 1:
            return Timed(job.solve, jnp.asarray(inputs[0]))
        return Timed(jax.vmap(job.solve), jnp.asarray(inputs))


def row(job: Job, timed: dict[int, Timed], beside: Timed) -> dict[str, Any]:
    """Times by the number of arms, the same on the CPU, and the largest distance of the tips."""
    largest = timed[max(timed)].output
    away = np.asarray(largest[0])[:ON_CPU] - np.asarray(beside.output[0])[: len(largest[0])]
    cpu_us = beside.summary()["median_us"] / ON_CPU
    found = {
        "name": job.name,
        "converged": float(np.mean(np.asarray(largest[1]))),
        "tip_away_from_cpu": float(np.max(np.linalg.norm(away, axis=1))),
        "cpu": beside.summary() | {"size": ON_CPU},
        "device": {str(size): one.summary() for size, one in timed.items()},
    }
    cells = [
        "{:,.0f} ({:,.0f}-{:,.0f})".format(
            *(1e6 * size / one.summary()[key] for key in ("median_us", "high_us", "low_us"))
        )
        for size, one in timed.items()
    ]
    best = min(one.summary()["median_us"] / size for size, one in timed.items())
    print(
        f"| {job.name} | {' | '.join(cells)} | {1e6 / cpu_us:,.0f} | {cpu_us / best:.1f} | "
        f"{found['tip_away_from_cpu']:.0e} | {found['converged']:.4f} | "
        f"{max(one.compile_s for one in timed.values()):.0f} |",
        flush=True,
    )
    return found


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--rounds", type=int, default=5, help="timings per solve (5)")
    parser.add_argument("--scenes", nargs="*", help="names of scenes, all by default")
    parser.add_argument("--sizes", nargs="*", type=int, default=SIZES, help="numbers of arms")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    device, cpu = jax.devices()[0], jax.devices("cpu")[0]
    chosen = [job for job in jobs() if not options.scenes or job.name in options.scenes]
    started = time.perf_counter()
    wanted = [(job, size, device) for job in chosen for size in options.sizes]
    wanted += [(job, ON_CPU, cpu) for job in chosen]
    with ThreadPoolExecutor() as pool:
        every = list(pool.map(lambda one: compiled(*one), wanted))
    print(
        f"{machine()}, jax {jax.__version__}; {len(every)} programs compiled side by side in "
        f"{time.perf_counter() - started:.0f} s; shapes per second, median (10 %-90 %)\n"
    )
    sizes = " | ".join(f"{size:,}" for size in options.sizes)
    print(
        f"| scene | {sizes} | {ON_CPU:,} on the CPU | most / CPU | tips away [m] | converged | "
        f"compile [s] |"
    )
    print("|" + "---|" * (6 + len(options.sizes)))
    rows = []
    for i, job in enumerate(chosen):
        first = i * len(options.sizes)
        timed = dict(zip(options.sizes, every[first:], strict=False))
        beside = every[len(chosen) * len(options.sizes) + i]
        take_turns([*timed.values(), beside], options.rounds)
        rows.append(row(job, timed, beside))
        if options.json:  # after each scene: the time on a device may end
            report = {"machine": machine(), "jax": jax.__version__, "rows": rows}
            options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
