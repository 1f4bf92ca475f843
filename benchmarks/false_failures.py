"""A search for equilibria that are refused: ordinary scenes are drawn and solved, and an independent path looks for what was not found.

For each draw that does not converge, load steps in NumPy (see `load_steps`), which share nothing with the package, follow the
equilibrium from no load. Where they get to the end by stable equilibria, on two meshes, with the arm bent by a turn at most, the refusal is a
false failure: it is printed and kept with all its numbers. Where stability is lost on the way the arm snaps, and counts apart. Of
each draw that converges the same code starts from the shape that was returned and has to stay there; the gradient has to be finite. Run it with

    python benchmarks/false_failures.py --json benchmarks/results/false_failures.json

`ordinary_scenes.built(STRUCTURES[case["structure"]], case["numbers"])` builds a case of that file again.
"""

import argparse
import json
import math
import os
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0")  # nothing is timed

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

try:
    from benchmarks import load_steps
    from benchmarks.ordinary_scenes import STRUCTURES, Numbers, Structure, built
except ModuleNotFoundError:  # as a script
    import load_steps
    from ordinary_scenes import STRUCTURES, Numbers, Structure, built

STEPS = 16
A_TURN = 2 * math.pi
"""How far an ordinary arm is bent at most [rad]."""
SAME = 0.02
"""Largest distance of tips of one equilibrium by two programs, as a share of the length: both are coarse."""


class Answer(NamedTuple):
    """Status, tip [m], strains at the middles of the elements, forces [N] of the tendons, and the gradient of the tip by all numbers."""

    status: Any
    tip: Any
    strain: Any
    forces: Any
    gradient: Any


@partial(jax.jit, static_argnums=0)
def answers(structure: Structure, draws: dict[str, jax.Array]) -> Answer:
    """Solutions of draws side by side."""

    def answer(numbers: Numbers) -> Answer:
        eq = vsr.solve(*built(structure, numbers), model=vsr.StrainDependent(STEPS))
        X = (jnp.arange(load_steps.ELEMENTS) + 0.5) / load_steps.ELEMENTS * eq.scene.rod.length
        return Answer(eq.status, eq.tip[:3, 3], eq.strain(X), eq.forces, jnp.zeros(1))

    return jax.vmap(answer)(draws)


def drawn(structure: Structure, count: int, seed: int) -> list[Numbers]:
    """The same draws each time; a longer list begins with a shorter one."""
    return [structure.numbers(np.random.default_rng((seed, i))) for i in range(count)]


def sought(structure: Structure, numbers: Numbers) -> tuple[str, load_steps.Path]:
    """What the independent path says of a draw that was refused, and where it ended."""
    path = load_steps.Arm(structure, numbers).follow()
    if not path.stable:
        return ("beyond a turn" if path.turn > A_TURN else "snaps"), path
    fine = load_steps.Arm(structure, numbers, 2 * load_steps.ELEMENTS).follow()
    if not fine.stable or np.linalg.norm(fine.tip - path.tip) > SAME:
        return "in doubt", fine
    return ("beyond a turn" if fine.turn > A_TURN else "false failure"), fine


def confirmed(structure: Structure, numbers: Numbers, answer: Answer) -> tuple[str, float]:
    """Whether a converged shape is what the independent code stays at, and how far the arm is bent [rad]."""
    arm, L = load_steps.Arm(structure, numbers), numbers["length"]
    strain = answer.strain * np.array([L, L, L, 1, 1, 1])
    turn = float(np.sum(np.linalg.norm((strain - arm.rest)[:, 1:3], axis=1)) * arm.h)
    if not np.all(np.isfinite(answer.gradient)):
        return "wrong: no gradient", turn
    unit = numbers["young"] * np.pi * numbers["radius"] ** 4 / 4 / L**2
    found = arm.balance(strain, -answer.forces[arm.driven] / unit, 1.0)
    if found is None:
        return "wrong: not in balance", turn
    ends, _ = arm.poses(found[0])
    if np.linalg.norm(ends[-1, :3, 3] - answer.tip / L) > SAME:
        return "wrong: another shape", turn
    return ("converged" if found[2] > 0 else "wrong: not stable"), turn


def search(name: str, count: int, seed: int) -> dict[str, Any]:
    """Verdicts on the draws of a structure, and the draws that are false failures, in doubt or wrong."""
    structure, begin = STRUCTURES[name], time.perf_counter()
    draws = drawn(structure, count, seed)
    stacked = {key: jnp.asarray(np.array([draw[key] for draw in draws])) for key in draws[0]}
    found = jax.tree.map(np.asarray, answers(structure, stacked))
    solved = time.perf_counter() - begin
    verdicts, statuses, cases = Counter(), Counter(), []
    for i, numbers in enumerate(draws):
        answer = jax.tree.map(lambda x, i=i: x[i], found)
        status = vsr.Status(int(answer.status)).name
        statuses[status] += 1
        if status == "CONVERGED":
            said, turn = confirmed(structure, numbers, answer)
            verdicts["converged, beyond a turn" if said == "converged" and turn > A_TURN else said] += 1
            record = {"turn": turn}
        else:
            said, path = sought(structure, numbers)
            verdicts[f"{status}: {said}"] += 1
            tip = (path.tip * numbers["length"]).tolist()
            record = {"turn": path.turn, "share": path.share, "margin": path.margin, "least margin": path.least, "tip": tip}
        if said.startswith(("false", "wrong", "in doubt")):
            cases.append({"name": f"{name} {i}", "verdict": said, "status": status, **record, "structure": name, "numbers": numbers})
    false, there = (sum(verdicts[v] for v in verdicts if v.endswith(end)) for end in ("false failure", "converged"))
    return {
        "draws": count,
        "statuses": dict(statuses.most_common()),
        "verdicts": dict(verdicts.most_common()),
        "false failures": false,
        "have a stable equilibrium": there + false,
        "rate": false / max(there + false, 1),
        "seconds": [round(solved), round(time.perf_counter() - begin - solved)],
        "cases": cases,
    }


def told(name: str, record: dict[str, Any]) -> None:
    """Prints what came out."""
    verdicts = ", ".join(f"{count} {said}" for said, count in record["verdicts"].items())
    print(f"{name}: {record['false failures']} of {record['have a stable equilibrium']} refused ({100 * record['rate']:.1f} %); {verdicts}")
    for case in record["cases"]:
        print(
            f"  {case['name']}: {case['status']}, {case['verdict']}, bent by {case['turn']:.2f} rad, margin {case.get('margin', math.nan):.3f}"
        )


def main() -> None:
    """Searches all structures, or some."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=200, help="of each structure (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--structures", nargs="*", default=list(STRUCTURES), choices=list(STRUCTURES), metavar="NAME")
    parser.add_argument("--json", metavar="FILE", type=Path)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record = {}
    for name in options.structures:
        record[name] = search(name, options.draws, options.seed)
        told(name, record[name])
        if options.json:
            options.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    false, there = (sum(r[key] for r in record.values()) for key in ("false failures", "have a stable equilibrium"))
    print(f"all: {false} of {there} refused ({100 * false / max(there, 1):.2f} %)")


if __name__ == "__main__":
    main()
