"""Search for false failures: random ordinary scenes are solved, and an independent program searches
for the equilibria of those that fail.

For each draw that does not converge, load steps in NumPy (see `load_steps`), which share no code
with the package, follow the equilibrium from zero load. If they reach the full load through stable
equilibria, on two meshes, with the arm bent by one turn at most, the draw is a false failure: it is
printed and stored with all its numbers. If stability is lost on the way, the arm snaps; such draws
are counted separately. For each draw that converges the same code starts from the returned shape
and has to stay there. With `--gradients` the derivative of the tip with respect to the share of all
loads and inputs has to be finite. Run it with

    python benchmarks/false_failures.py --json benchmarks/results/false_failures.json

`ordinary_scenes.built(STRUCTURES[case["structure"]], case["numbers"])` rebuilds a case of that
file.
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

os.environ.setdefault("OMP_NUM_THREADS", "1")  # the systems are small

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.mechanics.resolution import COARSE

try:
    from benchmarks import load_steps
    from benchmarks.energy_minimum import DiscArm, HeldArm
    from benchmarks.ordinary_scenes import STRUCTURES, Numbers, Structure, built
except ModuleNotFoundError:  # as a script
    import load_steps
    from energy_minimum import DiscArm, HeldArm
    from ordinary_scenes import STRUCTURES, Numbers, Structure, built

STEPS = 16
A_TURN = 2 * math.pi
"""Largest bending of an ordinary arm [rad]."""
SAME = 0.02
"""Largest distance between the tips of one equilibrium on two meshes, as a share of the length;
`COARSE` is the error that a converged status allows."""


class Answer(NamedTuple):
    """Status, tip [m], strains at the middles of the elements, forces [N] of the tendons, and force
    [N] and moment [N m] of the support, zero without one."""

    status: Any
    tip: Any
    strain: Any
    forces: Any
    support: Any


@partial(jax.jit, static_argnums=0)
def answers(structure: Structure, draws: dict[str, jax.Array]) -> Answer:
    """Solutions of draws in a batch."""

    def answer(numbers: Numbers) -> Answer:
        eq = vsr.solve(*built(structure, numbers), model=vsr.StrainDependent(STEPS))
        X = (jnp.arange(load_steps.ELEMENTS) + 0.5) / load_steps.ELEMENTS * eq.scene.rod.length
        held = jnp.roll(eq.supports[0], 3) if structure.held else jnp.zeros(6)
        return Answer(eq.status, eq.tip[:3, 3], eq.strain(X), eq.forces, held)

    return jax.vmap(answer)(draws)


@partial(jax.jit, static_argnums=0)
def slopes(structure: Structure, draws: dict[str, jax.Array]) -> jax.Array:
    """Reverse-mode derivatives of the sum of the tip's coordinates with respect to the share of
    loads and inputs; they need all adjoints of a solve."""

    def tip(share: jax.Array, numbers: Numbers) -> jax.Array:
        return jnp.sum(
            vsr.solve(*built(structure, numbers, share), model=vsr.StrainDependent(STEPS)).tip[
                :3, 3
            ]
        )

    return jax.vmap(jax.grad(tip), (None, 0))(jnp.ones(()), draws)


def drawn(structure: Structure, count: int, seed: int) -> list[Numbers]:
    """Reproducible draws; a longer list starts with the same draws as a shorter one."""
    return [structure.numbers(np.random.default_rng((seed, i))) for i in range(count)]


def sought(structure: Structure, numbers: Numbers) -> tuple[str, dict[str, Any]]:
    """Verdict of the independent path on a draw that failed, and where the path ended."""
    if structure.held or structure.discs:
        return _sought_minimum(structure, numbers)
    arm = load_steps.Arm(structure, numbers)
    path = arm.follow()
    turn, tip = arm.turn(path.strain), arm.tip(path.strain)
    record = {
        "turn": turn,
        "share": path.share,
        "margin": path.margin.all,
        "least margin": path.least,
    }
    record["tip"] = (numbers["length"] * tip).tolist()
    if turn > A_TURN:
        return "beyond a turn", record
    if not path.arrived:
        return "snaps", record
    if path.margin.all <= 0:
        return "flutters", record
    fine = load_steps.Arm(structure, numbers, 2 * load_steps.ELEMENTS)
    found = fine.balance(np.repeat(path.strain, 2, axis=0), path.tension, 1.0)
    sure = (
        found is not None and found[2].all > 0 and np.linalg.norm(fine.tip(found[0]) - tip) < SAME
    )
    return ("false failure" if sure else "in doubt"), record


def confirmed(structure: Structure, numbers: Numbers, answer: Answer) -> tuple[str, dict[str, Any]]:
    """Verdict on a converged shape: whether the independent code stays there, if necessary on a
    finer mesh; and the bending of the arm."""
    if structure.held or structure.discs:
        return _confirmed_minimum(structure, numbers, answer)
    L, record = numbers["length"], {}
    unit = numbers["young"] * np.pi * numbers["radius"] ** 4 / 4 / L**2
    for finer in (1, 4):
        arm = load_steps.Arm(structure, numbers, finer * load_steps.ELEMENTS)
        strain = np.repeat(answer.strain * np.array([L, L, L, 1, 1, 1]), finer, axis=0)
        record = {"turn": arm.turn(strain)}
        found = arm.balance(strain, -answer.forces[arm.driven] / unit, 1.0)
        if found is None or np.linalg.norm(arm.tip(found[0]) - answer.tip / L) > COARSE:
            continue
        record["margin"] = found[2].all
        said = (
            "converged"
            if found[2].all > 0
            else "converged, flutters"
            if found[2].real > 0
            else "wrong: not stable"
        )
        return (
            f"{said}, beyond a turn" if said == "converged" and record["turn"] > A_TURN else said
        ), record
    return "wrong: another shape", record


def _sought_minimum(structure: Structure, numbers: Numbers) -> tuple[str, dict[str, Any]]:
    """Verdict of the independent minima on a draw that failed."""
    kind = HeldArm if structure.held else DiscArm
    arm = kind(structure, numbers)
    found = arm.search()
    if found is None:
        return "no minimum found", {"turn": math.nan}
    record = {"turn": arm.turn(found.strain), "margin": found.margin}
    if record["turn"] > A_TURN:
        return "beyond a turn", record
    fine = kind(structure, numbers, 2 * arm.count)
    there = fine.finished(np.repeat(found.strain, 2, axis=0), found.force)
    same = there is not None and there.margin > 0
    return ("false failure" if same else "in doubt"), record


def _confirmed_minimum(
    structure: Structure, numbers: Numbers, answer: Answer
) -> tuple[str, dict[str, Any]]:
    """Verdict on a converged shape that minimizes an energy, if necessary on a finer mesh."""
    L, record = numbers["length"], {}
    kind, elements = (HeldArm, load_steps.ELEMENTS) if structure.held else (DiscArm, 24)
    unit = numbers["young"] * np.pi * numbers["radius"] ** 4 / 4 / L**2
    force = answer.support / unit / np.array([1, 1, 1, L, L, L])
    said = "wrong: another shape"
    for finer in (1, 3):
        arm = kind(structure, numbers, finer * elements)
        strain = np.repeat(answer.strain * np.array([L, L, L, 1, 1, 1]), finer, axis=0)
        strain = strain[:: load_steps.ELEMENTS // elements]
        record = {"turn": arm.turn(strain)}
        found = arm.finished(strain, force[: 3 if structure.held == "pinned" else 6])
        if found is None or np.max(np.abs(arm.places(found.strain) - arm.places(strain))) > COARSE:
            continue
        record["margin"] = found.margin
        if found.margin > 0:
            return ("converged, beyond a turn" if record["turn"] > A_TURN else "converged"), record
        said = "wrong: not stable"
    return said, record


def search(name: str, count: int, seed: int, gradients: bool = False) -> dict[str, Any]:
    """Verdicts on the draws of a structure, and the draws that are false failures, in doubt or
    wrong."""
    structure, begin = STRUCTURES[name], time.perf_counter()
    draws = drawn(structure, count, seed)
    stacked = {key: jnp.asarray(np.array([draw[key] for draw in draws])) for key in draws[0]}
    found = jax.tree.map(np.asarray, answers(structure, stacked))
    slope = np.asarray(slopes(structure, stacked)) if gradients else np.zeros(count)
    solved = time.perf_counter() - begin
    verdicts, statuses, cases = Counter(), Counter(), []
    for i, numbers in enumerate(draws):
        answer = jax.tree.map(lambda x, i=i: x[i], found)
        status = vsr.Status(int(answer.status)).name
        statuses[status] += 1
        if status == "CONVERGED":
            said, where = confirmed(structure, numbers, answer)
            said = said if np.isfinite(slope[i]) else "wrong: no gradient"
            verdicts[said] += 1
        else:
            said, where = sought(structure, numbers)
            verdicts[f"{status}: {said}"] += 1
        if said.startswith(("false", "wrong", "in doubt")):
            cases.append(
                {
                    "name": f"{name} {i}",
                    "verdict": said,
                    "status": status,
                    **where,
                    "structure": name,
                    "numbers": numbers,
                }
            )
    false, there = (
        sum(verdicts[v] for v in verdicts if v.endswith(end))
        for end in ("false failure", "converged")
    )
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
    """Prints the verdicts on a structure."""
    verdicts = ", ".join(f"{count} {said}" for said, count in record["verdicts"].items())
    there = record["have a stable equilibrium"]
    print(
        f"{name}: {record['false failures']} of {there} refused ({100 * record['rate']:.1f} %); "
        f"{verdicts}",
        flush=True,
    )
    for case in record["cases"]:
        print(
            f"  {case['name']}: {case['status']}, {case['verdict']}, bent by {case['turn']:.2f} rad"
        )


def main() -> None:
    """Searches all structures, or some."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--draws", type=int, default=200, help="draws per structure (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--structures",
        nargs="*",
        default=list(STRUCTURES),
        choices=list(STRUCTURES),
        metavar="NAME",
    )
    parser.add_argument("--json", metavar="FILE", type=Path)
    parser.add_argument(
        "--gradients",
        action="store_true",
        help="also check the gradients, which takes three times as long to compile",
    )
    options = parser.parse_args()
    # nothing is timed
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    jax.config.update("jax_enable_x64", True)
    record = {}
    for name in options.structures:
        record[name] = search(name, options.draws, options.seed, options.gradients)
        told(name, record[name])
        if options.json:
            options.json.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    false, there = (
        sum(r[key] for r in record.values())
        for key in ("false failures", "have a stable equilibrium")
    )
    print(f"all: {false} of {there} refused ({100 * false / max(there, 1):.2f} %)")


if __name__ == "__main__":
    main()
