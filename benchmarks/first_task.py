"""A first task in vsr_jax and in SoRoMoX by the clock, each from a cold start.

    python benchmarks/first_task.py [--peers PYTHON]

A catheter in gravity with a force on its tip: its shape, a picture, the derivative of the tip's
height with respect to the distance of a tendon, and the tips for 10,000 random tensions. The
programs are `first_task_ours.py` and `first_task_soromox.py`, written as a user would write them,
at settings whose tips are within a micrometre. `# %%` starts a part. Each program runs
once in a new process, with nothing compiled before. PYTHON is an interpreter that has soromox and
optimistix (`pip install ".[bench]"`).

Lines are those with code. Errors are distances to vsr_jax at 48 steps of order 6, which is itself
compared with `Continuum`. Writes `results/first_task.json` and the table in docs/first_task.md.
"""

import argparse
import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).resolve().parent
PAGE = FOLDER.parent / "docs/first_task.md"
RECORD = FOLDER / "results/first_task.json"
PROGRAMS = {"vsr_jax": "first_task_ours.py", "SoRoMoX": "first_task_soromox.py"}
DISTRIBUTIONS = {"vsr_jax": "vsr-jax", "SoRoMoX": "soromox"}
PARTS = ("import", "arm", "solve", "picture", "gradient", "workspace")
SOME = 200
"""Tips of the workspace that are compared with the reference."""


def parts(program: Path) -> Iterator[tuple[str, str]]:
    """Name and code of each part of a program."""
    pieces = re.split(r"^# %% (\w+)\n", program.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return zip(pieces[1::2], pieces[2::2], strict=True)


def lines(program: Path) -> dict[str, int]:
    """Number of lines with code in each part."""
    return {
        name: sum(bool(line.split("#")[0].strip()) for line in code.splitlines())
        for name, code in parts(program)
    }


def run_parts(tool: str) -> None:
    """Runs a program in this process and writes seconds and results to the file `results.json`."""
    program, names = FOLDER / PROGRAMS[tool], {"__name__": "__main__"}
    seconds = {}
    for name, code in parts(program):
        start = time.perf_counter()
        exec(compile(code, f"{program.name}, {name}", "exec"), names)
        seconds[name] = time.perf_counter() - start
    results = {name: np.asarray(names[name]).tolist() for name in ("tip", "slope", "tips")}
    versions = {name: importlib.metadata.version(name) for name in ("jax", DISTRIBUTIONS[tool])}
    everything = {"seconds": seconds, "versions": versions, "results": results}
    Path("results.json").write_text(json.dumps(everything))


def measure(python: str, tool: str) -> dict[str, Any]:
    """Seconds and results of a program in a new process and an empty folder."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    command = [python, str(Path(__file__).resolve()), "--program", tool]
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        subprocess.run(command, cwd=folder, env=environment | {"MPLBACKEND": "Agg"}, check=True)
        total = time.perf_counter() - start
        return json.loads((Path(folder) / "results.json").read_text()) | {"total": total}


def reference() -> dict[str, Any]:
    """Tip, slope and some tips of the workspace at 48 steps; how far `Continuum` is from them."""
    import jax
    import jax.numpy as jnp

    import vsr_jax as vsr

    names: dict[str, Any] = {}
    code = dict(parts(FOLDER / PROGRAMS["vsr_jax"]))
    exec(code["import"] + code["arm"], names)
    scene, inputs, fine = names["scene"], jnp.array([2.0, 0.0, 0.5]), vsr.StrainDependent(48)
    distance = "actuators[0].routing.z"

    def tip(scene: vsr.Scene, inputs: jax.Array) -> jax.Array:
        return vsr.solve(scene, inputs, model=fine).tip[:3, 3]

    def height(z: jax.Array) -> jax.Array:
        return tip(scene.replace(distance, z), inputs)[2]

    tensions = np.random.default_rng(0).uniform(0.0, 4.0, (10_000, 3))[:SOME]
    by_integration = vsr.solve(scene, inputs, model=vsr.Continuum(rtol=1e-10, atol=1e-12)).tip
    found = np.asarray(tip(scene, inputs))
    return {
        "tip": found,
        "slope": float(jax.grad(height)(jnp.asarray(0.01))),
        "tips": np.asarray(jax.jit(jax.vmap(lambda u: tip(scene, u)))(tensions)),
        "off": float(np.linalg.norm(by_integration[:3, 3] - found)),
    }


def compared(run: dict[str, Any], program: str, truth: dict[str, Any]) -> dict[str, Any]:
    """The record of one program."""
    results = {name: np.asarray(value) for name, value in run.pop("results").items()}
    off = np.linalg.norm(results["tips"][:SOME] - truth["tips"], axis=1)
    return run | {
        "lines": lines(FOLDER / program),
        "tip error [m]": float(np.linalg.norm(results["tip"] - truth["tip"])),
        "gradient error": float(abs(results["slope"] / truth["slope"] - 1)),
        "workspace error [m]": float(off.max()),
        "workspace": int(np.isfinite(results["tips"]).all(axis=1).sum()),
    }


def table(record: dict[str, Any]) -> str:
    """The table of docs/first_task.md."""
    runs = record["runs"]
    rows = [f"| lines, seconds | {' | '.join(runs)} |", "| --- |" + " ---: |" * len(runs)]
    for part in PARTS:
        cells = [f"{r['lines'][part]}, {r['seconds'][part]:.1f} s" for r in runs.values()]
        rows.append(f"| {part} | {' | '.join(cells)} |")
    cells = [f"{sum(run['lines'].values())}, {run['total']:.0f} s" for run in runs.values()]
    rows.append(f"| **all**, from a cold start | {' | '.join(cells)} |")
    for name, key in (
        ("tip error", "tip error [m]"),
        ("largest error of 200 tips of the workspace", "workspace error [m]"),
    ):
        rows.append(f"| {name} | {' | '.join(f'{run[key]:.0e} m' for run in runs.values())} |")
    cells = [f"{run['gradient error']:.0e}" for run in runs.values()]
    rows.append(f"| relative error of the gradient | {' | '.join(cells)} |")
    load = " and ".join(f"{load:.1f}" for load in record["load"])
    load = f"load average before and after: {load}"
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    return "\n".join([*rows, "", f"*{record['machine']}; {load}; {versions}.*", ""])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--peers", metavar="PYTHON", default=sys.executable)
    parser.add_argument("--program", choices=PROGRAMS, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.program:
        run_parts(options.program)
        return
    load = [os.getloadavg()[0]]
    pythons = {"vsr_jax": sys.executable, "SoRoMoX": options.peers}
    runs = {tool: measure(pythons[tool], tool) for tool in PROGRAMS}
    load.append(os.getloadavg()[0])
    truth = reference()
    runs = {tool: compared(run, PROGRAMS[tool], truth) for tool, run in runs.items()}
    from vsr_jax.studies.timing import machine

    versions = {name: v for run in runs.values() for name, v in run.pop("versions").items()}
    record = {"machine": machine(), "load": load, "versions": versions}
    record |= {"reference off Continuum [m]": truth["off"], "runs": runs}
    RECORD.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    text = PAGE.read_text(encoding="utf-8")
    before, after = text.split("<!-- table -->\n")[::2]
    PAGE.write_text(
        f"{before}<!-- table -->\n{table(record)}<!-- table -->\n{after}", encoding="utf-8"
    )
    print(table(record))


if __name__ == "__main__":
    main()
