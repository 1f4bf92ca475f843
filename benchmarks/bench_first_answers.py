"""CPU seconds until a first answer: twelve questions, each in a process of its own.

    python benchmarks/bench_first_answers.py [--questions NAME ...] [--rounds N] [--json FILE]

"first": as installed, with an empty cache. "cached": the same question once more. "defaults": each
program compiled once with XLA's default options, nothing kept. All three take turns, and count the
whole process: importing, tracing, compiling and running. "warm" is the median time of a call after
the second tier is ready, over that with XLA's defaults, where the question is a single solve.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent

START = """
import sys, time
import jax, jax.numpy as jnp, numpy as np
import vsr_jax as vsr
jax.config.update("jax_enable_x64", True)
"""

CATHETER = """
wire = vsr.Rod(0.3, vsr.Circular(0.0007), vsr.Material(54e9, poisson=0.3, density=6450.0),
               discs=vsr.Discs(10, radius=0.0101))
around = np.pi / 4 * np.arange(8)
tendons = [vsr.Tendon(vsr.Parallel(0.01 * np.cos(a), 0.01 * np.sin(a))) for a in around]
scene = vsr.Scene(wire, tendons, [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.05, 0.0))])
inputs = jnp.array([2.0, 0, 0.5, 0, 0, 0, 0, 0])
"""

SOLVED = "ask = lambda: vsr.solve(scene, inputs).tip\nask()\n"

QUESTIONS = {
    "bare arm": """
arm = vsr.Rod(0.75, vsr.Circular(vsr.Taper(0.012, 0.010)), vsr.Material(5.93e5, shear=2e5))
scene = vsr.Scene(arm, [vsr.Tendon(vsr.Helix(radius=0.005, angle=1.529))])
inputs = jnp.array([10.0])
"""
    + SOLVED,
    "loaded rod": """
rod = vsr.Rod(1.0, vsr.Circular(2e-3), vsr.Material(200e9, poisson=0.3, density=7800.0))
loads = [vsr.Gravity(), vsr.PointWrench(0.5, (0.0, 1.0, 0.0)), vsr.TipWrench((0.0, 0.0, 2.0))]
scene, inputs = vsr.Scene(rod, [], loads), jnp.zeros(0)
"""
    + SOLVED,
    "catheter": CATHETER + SOLVED,
    "its gradient": CATHETER
    + """
def height(inputs):
    return vsr.solve(scene, inputs).tip[2, 3]
options = {} if DEFAULTS else vsr.quick_compilation()
jax.jit(jax.grad(height), compiler_options=options)(inputs).block_until_ready()
""",
    "its Jacobian": CATHETER + "vsr.tip_jacobian(vsr.solve(scene, inputs))\n",
    "its stability": CATHETER + "float(vsr.solve(scene, inputs).stability)\n",
    "its picture": CATHETER
    + """
import matplotlib
matplotlib.use("Agg")
vsr.plot.arm(vsr.solve(scene, inputs)).figure.savefig("/dev/null", format="png")
""",
    "on a pillar": f"""
scene, inputs = vsr.load({str(HERE.parent / "notebooks/scenes/pillar.toml")!r})[:2]
inputs = jnp.asarray(inputs)
"""
    + SOLVED,
    "disc robot": """
wire = vsr.Rod(0.2, vsr.Circular(0.0005), vsr.Material(54e9, poisson=0.3, density=6450.0),
               discs=vsr.Discs(10, radius=0.009))
around = 2 * np.pi / 3 * np.arange(3)
holes = [vsr.Parallel(0.008 * np.cos(a), 0.008 * np.sin(a)) for a in around]
tendons = [vsr.Tendon(hole, straight=True) for hole in holes]
scene, inputs = vsr.Scene(wire, tendons, [vsr.Gravity()]), jnp.array([2.0, 0.0, 0.5])
"""
    + SOLVED,
    "path with friction": """
arm = vsr.Rod(0.2, vsr.Circular(6e-3), vsr.Material(5e5, poisson=0.4, density=1100.0))
tendons = [vsr.Tendon(vsr.Parallel(y, z), friction=0.1) for y, z in ((4e-3, 0.0), (-2e-3, 4e-3))]
scene = vsr.Scene(arm, tendons, [vsr.Gravity()])
there = np.linspace(0.0, 1.0, 10)[:, None] * np.array([0.6, 0.2])
jax.block_until_ready(vsr.follow(scene, np.concatenate([there, there[::-1]])))
""",
    "fit of a tentacle": f"""
sys.path.insert(0, {str(HERE)!r})
import measured_tentacle as measured
fit = vsr.fit(measured.tentacle(), measured.unknowns(), measured.holds("A"), model=measured.MODEL,
              steps=measured.STEPS, progress=False)
""",
    "sensitivities": CATHETER + "str(vsr.sensitivity(vsr.solve(scene, inputs)))\n",
}

WARM = """
import threading
for thread in threading.enumerate():
    if thread.name == "vsr_jax compiler":
        thread.join()
times = []
for _ in range(200):
    start = time.perf_counter()
    jax.block_until_ready(ask())
    times.append(time.perf_counter() - start)
print("warm", float(np.median(times)))
"""

END = """
print("cpu", cpu)
"""


def measured(name: str, cache: str, *, defaults: bool, warm: bool) -> dict[str, float]:
    """CPU seconds of a question in a new process; with `warm` the time of a call too [s]."""
    code = QUESTIONS[name].replace("DEFAULTS", str(defaults))
    start = START + (
        "from vsr_jax.numerics import compiling\ncompiling.LONG = -1.0\n" if warm else ""
    )
    code = f"{start}{code}\ncpu = time.process_time()\n{WARM if warm else ''}{END}"
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"VSR_JAX_CACHE": cache} | ({"VSR_JAX_TIERS": "off"} if defaults else {})
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr}")
    rows = [line.split() for line in done.stdout.splitlines()]
    return {row[0]: float(row[1]) for row in rows if len(row) == 2 and row[0] in ("cpu", "warm")}


def question(name: str) -> dict[str, float]:
    """One round of a question."""
    single = "ask()" in QUESTIONS[name]
    with tempfile.TemporaryDirectory() as cache:
        first = measured(name, cache, defaults=False, warm=False)
        cached = measured(name, cache, defaults=False, warm=False)
    defaults = measured(name, "off", defaults=True, warm=single)
    row = {"first": first["cpu"], "cached": cached["cpu"], "defaults": defaults["cpu"]}
    if single:
        best = measured(name, "off", defaults=False, warm=True)
        row["warm"] = best["warm"] / defaults["warm"]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, default=list(QUESTIONS))
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    rows: dict[str, dict[str, Any]] = {}
    print(f"{'CPU seconds':20}{'first':>8}{'cached':>8}{'defaults':>10}{'ratio':>7}{'warm':>7}")
    for name in options.questions:
        rounds = [question(name) for _ in range(options.rounds)]
        row = {key: statistics.median(one[key] for one in rounds) for key in rounds[0]}
        rows[name] = row | {"rounds": rounds}
        print(line(name, row), flush=True)
    keys = ("first", "cached", "defaults")
    print(line("all", {key: sum(row[key] for row in rows.values()) for key in keys}))
    if options.json:
        import jax

        from vsr_jax.studies.timing import machine

        record = {"machine": machine(), "jax": jax.__version__, "questions": rows}
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def line(name: str, row: dict[str, Any]) -> str:
    """A row of the table."""
    seconds = f"{row['first']:8.1f}{row['cached']:8.1f}{row['defaults']:10.1f}"
    ratio, warm = row["first"] / row["defaults"], row.get("warm")
    return f"{name:20}{seconds}{ratio:7.2f}" + ("" if warm is None else f"{warm:7.2f}")


if __name__ == "__main__":
    main()
