"""Speed of sweeps by samples, nodes, threads, sections, loads and cores; the limit of the
machine; a sweep of a million shapes, killed and resumed.

    pip install ".[sweep]" && python benchmarks/bench_sweep.py
        [--json FILE] [--plot FILE] [--million] [--by STUDY ...]

Unless a row states otherwise, the arm is the paper's B1 with one helical thread, at 16 steps of
order 6, with tensions from [0, 15] N. All rates are those of `vsr.sweep` without compilation,
including copies to and from the device: medians of several runs in turn, with the slowest and the
fastest; those by cores are of a process each. Other devices than CPUs get sixteen times as many
samples, and no rows by cores.

`--million` sweeps a million shapes to disk in a separate process, kills it at a random time,
resumes the sweep in another process, and compares the store with that of an uninterrupted sweep.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import vsr_jax as vsr
from vsr_jax.analysis.sweep_program import cores
from vsr_jax.mechanics.balance import newton_step
from vsr_jax.studies.timing import Timed, machine, take_turns

ON_CPU = jax.default_backend() == "cpu"
SAMPLES = 16_384 if ON_CPU else 262_144
STEPS = 16
ROUNDS = 5
MILLION = 1_000_000
CHILD = """
import re, sys
from pathlib import Path
import jax; jax.config.update("jax_enable_x64", True)
import bench_sweep as b
path, samples = sys.argv[1], int(sys.argv[2])
import vsr_jax as vsr
model = vsr.StrainDependent(b.STEPS)
result = vsr.sweep(b.helix(), b.tensions(samples), model=model, out=path, progress=False)
print(1024 * int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]))
"""

ON_CORES = """
import json, os, sys
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(sys.argv[1])])
import jax; jax.config.update("jax_enable_x64", True)
import bench_sweep as b
loads = {"no loads": (), "gravity": (b.vsr.Gravity(),)}
jobs = {
    f"{what}, {sys.argv[1]} cores": (b.job(b.helix(loads=each), b.tensions(n)), n)
    for (what, each), n in zip(loads.items(), (8 * b.SAMPLES, b.SAMPLES // 4))
}
print(json.dumps(b.rates(jobs)))
"""


def rod(sections: int = 1) -> vsr.Rod:
    """The paper's cylinder, in sections whose radii differ by 10 %."""
    radii = [0.01 * (1 + 0.1 * (i % 2)) for i in range(sections)]
    ends = [0.75 * (i + 1) / sections for i in range(sections - 1)]
    section = vsr.Circular(0.01) if sections == 1 else vsr.Circular(vsr.Piecewise(ends, radii))
    return vsr.Rod(0.75, section, vsr.Material(5.93e5, shear=2.0e5, density=120.0))


def helix(threads: int = 1, sections: int = 1, loads: tuple = ()) -> vsr.Scene:
    """An arm with helical tendons."""
    laid = [
        vsr.Tendon(vsr.Helix(0.005, 1.529, phase=2 * np.pi * i / threads)) for i in range(threads)
    ]
    return vsr.Scene(rod(sections), laid, list(loads)).astype("float64")


def tensions(samples: int, threads: int = 1, dtype: str = "float64") -> np.ndarray:
    """Tensions [N] whose sum over the threads lies in [0, 15]."""
    return np.random.default_rng(0).uniform(0, 15 / threads, (samples, threads)).astype(dtype)


def place(eq: vsr.Equilibrium) -> dict[str, Any]:
    """Position of the tip, the output that a workspace needs."""
    return {"tip": eq.tip[:3, 3]}


def job(scene: vsr.Scene, inputs: np.ndarray, steps: int = STEPS) -> Callable[[], Any]:
    """A sweep that has run once, so that it is compiled."""

    def run() -> Any:
        return vsr.sweep(
            scene, inputs, outputs=place, model=vsr.StrainDependent(steps), progress=False
        )

    run()
    return run


def rates(jobs: dict[str, tuple[Callable, int]], rounds: int = ROUNDS) -> list[dict[str, Any]]:
    """Shapes per second of each job, all timed in turn."""
    seconds: dict[str, list[float]] = {name: [] for name in jobs}
    for _ in range(rounds):
        for name, (run, _) in jobs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    rows = []
    for name, (_, samples) in jobs.items():
        low, median, high = (
            samples / x for x in (max(seconds[name]), np.median(seconds[name]), min(seconds[name]))
        )
        print(f"{name:34s} {median:>10,.0f} shapes/s ({low:,.0f}-{high:,.0f})", flush=True)
        rows.append(
            {
                "name": name,
                "samples": samples,
                "per_s": float(median),
                "low": float(low),
                "high": float(high),
            }
        )
    return rows


def by_samples() -> dict[str, tuple[Callable, int]]:
    """Sweeps of some to a million samples."""
    sizes = (1, 10, 100, 1_000, 10_000, 100_000, MILLION)
    return {f"{n:,} samples": (job(helix(), tensions(n)), n) for n in sizes}


def by_nodes() -> dict[str, tuple[Callable, int]]:
    """Coarse to fine arms."""
    many = tensions(SAMPLES)
    return {f"{3 * n} nodes": (job(helix(), many, n), SAMPLES) for n in (2, 4, 8, 16, 32, 64)}


def by_threads() -> dict[str, tuple[Callable, int]]:
    """One to six tendons."""
    return {f"{n} threads": (job(helix(n), tensions(SAMPLES, n)), SAMPLES) for n in (1, 2, 3, 4, 6)}


def by_sections() -> dict[str, tuple[Callable, int]]:
    """One to eight sections."""
    many = tensions(SAMPLES)
    return {f"{n} sections": (job(helix(1, n), many), SAMPLES) for n in (1, 2, 4, 8)}


def by_precision_and_loads() -> dict[str, tuple[Callable, int]]:
    """Double and single precision, without and with gravity."""
    found = {}
    for what, loads, samples in (("", (), SAMPLES), ("gravity, ", (vsr.Gravity(),), SAMPLES // 8)):
        for dtype in ("float64", "float32"):
            scene = helix(loads=loads).astype(dtype)
            found[what + dtype] = job(scene, tensions(samples, dtype=dtype)), samples
    return found


STUDIES: dict[str, Callable[[], dict[str, tuple[Callable, int]]]] = {
    "samples": by_samples,
    "nodes": by_nodes,
    "threads": by_threads,
    "sections": by_sections,
    "precision and loads": by_precision_and_loads,
}


def studies(chosen: list[str] | None) -> dict[str, list[dict[str, Any]]]:
    """Rates of each study, or of those that are chosen."""
    found = {}
    for name, study in STUDIES.items():
        if not chosen or name in chosen:
            print(f"\nby {name}")
            found[name] = rates(study(), 3 if name == "samples" else ROUNDS)
    if ON_CPU and (not chosen or "cores" in chosen):
        print("\nby cores")
        found["cores"] = [row for n in dict.fromkeys((1, cores())) for row in on_cores(n)]
    return found


def on_cores(number: int) -> list[dict[str, Any]]:
    """Rates with and without gravity in a process that uses some cores only."""
    done = subprocess.run(
        [sys.executable, "-c", ON_CORES, str(number)],
        env=environment(),
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    *printed, last = done.stdout.splitlines()
    print("\n".join(printed))
    return json.loads(last)


def environment() -> dict[str, str]:
    """Environment of a process that imports this file."""
    path = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    return {**os.environ, "PYTHONPATH": path}


def limit(batch_size: int = 512) -> dict[str, float]:
    """Floating-point operations per shape, and the highest rate of the machine per second.

    The operations per shape are those of one Newton step at all nodes times the number of steps,
    plus those of the rest, as counted by XLA. A division, a root and a sine count as one operation
    each, although a processor takes ten times as long for them.
    """
    machine_rate = _most_operations()
    scene, model, inputs = helix(), vsr.StrainDependent(STEPS), jnp.asarray(tensions(batch_size))

    def whole(inputs: jax.Array) -> Any:
        return jax.vmap(lambda u: vsr.solve(scene, u, model=model).tip[:3, 3])(inputs)

    def step(inputs: jax.Array) -> Any:
        def one(u: jax.Array) -> Any:
            sections = scene.sections(model.grid(scene).X)
            return newton_step(
                sections.rest, sections, sections.carry(scene.forces(u)), None, scene.free
            )

        return jax.vmap(one)(inputs)

    counted = [(Timed(f, inputs).operations or 0) / batch_size for f in (whole, step)]
    taken = float(jnp.mean(jax.vmap(lambda u: vsr.solve(scene, u, model=model).steps)(inputs)))
    operations = counted[0] + (taken - 1) * counted[1]
    return {"machine_flops": machine_rate, "newton_steps": taken, "operations_a_shape": operations}


def share_of_machine(rows: list[dict[str, Any]]) -> dict[str, float]:
    """`limit`, and the share of it that the fastest sweep reaches."""
    found = limit()
    fastest = max(row["per_s"] for row in rows)
    share = fastest * found["operations_a_shape"] / found["machine_flops"]
    print(
        "\n{operations_a_shape:,.0f} operations per shape, "
        "{machine_flops:.2e} per second at most".format(**found),
        end="",
    )
    print(f": the fastest sweep reaches {share:.0%} of that")
    return found | {"share": share}


def _most_operations(
    chains: int = 4, depth: int = 32, size: int = 65_536, times: int = 200
) -> float:
    """Operations per second of chains of fused multiply-adds that stay in the registers, on all
    cores at once."""

    def body(_: int, x: jax.Array) -> jax.Array:
        y = [x * (1 + 1e-3 * i) for i in range(chains)]
        for _ in range(depth):
            y = [0.999 * value + x for value in y]
        return 1e-3 * sum(y[1:], y[0])

    def chain(x: jax.Array) -> jax.Array:
        return jax.lax.fori_loop(0, times, body, x)

    x = jnp.linspace(0.9, 1.0, size * cores())
    job = Timed(jax.jit(chain), x)
    take_turns([job], 9)
    return 2e6 * chains * depth * times * x.size / job.summary()["median_us"]


def million(samples: int = MILLION) -> dict[str, Any]:
    """A sweep to disk that is killed and resumed, compared with an uninterrupted one."""

    def start(path: Path) -> subprocess.Popen:
        arguments = [sys.executable, "-c", CHILD, str(path), str(samples)]
        return subprocess.Popen(arguments, env=environment(), stdout=subprocess.PIPE, text=True)

    def finish(path: Path) -> tuple[float, int]:
        begun = time.perf_counter()
        out, _ = (process := start(path)).communicate()
        if process.returncode:
            raise RuntimeError(f"the sweep to {path} ended with {process.returncode}")
        return time.perf_counter() - begun, int(out)

    import zarr

    with tempfile.TemporaryDirectory() as folder:
        whole, killed = Path(folder) / "whole.zarr", Path(folder) / "killed.zarr"
        seconds, memory = finish(whole)
        process = start(killed)
        time.sleep(seconds * np.random.default_rng().uniform(0.3, 0.9))
        process.send_signal(signal.SIGKILL)
        process.wait()
        done = int(np.count_nonzero(np.asarray(zarr.open_group(killed, mode="r")["status"]) >= 0))
        rest, _ = finish(killed)
        groups = [zarr.open_group(path, mode="r") for path in (whole, killed)]
        same = all(
            np.asarray(groups[0][name]).tobytes() == np.asarray(groups[1][name]).tobytes()
            for name in ("tip", "status")
        )
    row = {
        "samples": samples,
        "seconds": seconds,
        "memory_bytes": memory,
        "done_when_killed": done,
        "rest_s": rest,
        "identical": same,
    }
    print(
        f"\n{samples:,} shapes to disk: {seconds:.1f} s including start-up and compilation, "
        f"{memory / 2**30:.2f} GiB at most; killed after {done:,}"
    )
    print(
        f"the rest took {rest:.1f} s; the stores are {'bit-identical' if same else 'NOT identical'}"
    )
    return row


def draw(found: dict[str, list[dict[str, Any]]], path: str) -> None:
    """One panel per study."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    for ax, (name, rows) in zip(figure.subplots(2, 3).flat, found.items(), strict=True):
        names = [row["name"].removesuffix(f" {name}") for row in rows]
        rate = np.array([[row[key] for key in ("per_s", "low", "high")] for row in rows]).T
        spread = np.abs(rate[1:] - rate[0])
        if name in ("samples", "nodes"):
            ax.errorbar(
                [float(text.replace(",", "")) for text in names],
                rate[0],
                spread,
                marker="o",
                capsize=3,
                color="#0072B2",
            )
            ax.set(xscale="log", yscale="log")
        else:
            ax.bar(names, rate[0], yerr=spread, color="#0072B2", capsize=3)
            ax.tick_params(axis="x", labelrotation=0 if all(map(str.isdigit, names)) else 20)
        ax.set(xlabel=name, ylabel="shapes per second")
        ax.grid(axis="y", alpha=0.3)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Runs all studies and the optional parts, and prints the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--plot", metavar="FILE", help="plot the rates")
    parser.add_argument(
        "--million", action="store_true", help="a million shapes to disk, killed once"
    )
    parser.add_argument(
        "--by", nargs="*", metavar="STUDY", choices=[*STUDIES, "cores"], help="only these studies"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    report: dict[str, Any] = {
        "machine": machine(),
        "jax": jax.__version__,
    }
    print(f"{report['machine']}, jax {report['jax']}")
    report["rates"] = studies(options.by)
    if "samples" in report["rates"]:
        report["limit"] = share_of_machine(report["rates"]["samples"])
    if options.million:
        report["million"] = million()
    if options.json:
        options.json.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    if options.plot:
        draw(report["rates"], options.plot)


if __name__ == "__main__":
    main()
