"""Random arms among obstacles: how many contact problems are solved, and how well.

    python benchmarks/contact_search.py [--draws 1000] [--obstacles 1 3 10] [--json FILE]

Arms with gravity, a force at the tip and some spheres that do not touch the arm at rest. For each
number of obstacles all arms are solved in batches. Printed: how many have a solution that was
found, the deepest penetration anywhere on the outline (from the positions of the solution, not from
the solver's gaps), the largest `min(gap, force)`, and the imbalance of forces: the reaction at the
base against the sum of all loads and contact forces.
"""

import argparse
import json
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

jax.config.update("jax_enable_x64", True)

LENGTH, RADIUS, YOUNG, STEPS, BATCH = 0.2, 0.005, 2e5, 24, 100


def drawn(rng: np.random.Generator, count: int) -> dict[str, Any]:
    """Numbers of one arm: density, force, centres and radii of spheres beside the straight arm."""
    centres, radii = [], []
    while len(radii) < count:
        radius = rng.uniform(0.01, 0.04)
        X, angle = rng.uniform(0.2, 1.1) * LENGTH, rng.uniform(0, 2 * np.pi)
        apart = RADIUS + radius + rng.uniform(0.001, 0.05)
        centres.append([X, apart * np.cos(angle), apart * np.sin(angle)])
        radii.append(radius)
    return {
        "density": rng.uniform(0, 2000),
        "force": rng.normal(size=3) * rng.uniform(0, 0.05),
        "centres": np.array(centres),
        "radii": np.array(radii),
    }


def solved(count: int, numbers: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """What is compared of one arm."""
    material = vsr.Material(young=YOUNG, poisson=0.4, density=numbers["density"])
    rod = vsr.Rod(length=LENGTH, section=vsr.Circular(radius=RADIUS), material=material)
    obstacles = [vsr.Sphere(numbers["centres"][i], numbers["radii"][i]) for i in range(count)]
    scene = vsr.Scene(
        rod, (), [vsr.Gravity(), vsr.TipWrench(numbers["force"])], obstacles=obstacles
    )
    eq = vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(STEPS))
    X = jnp.linspace(0.0, LENGTH, 401)
    positions = eq.position(X)
    gaps = [jnp.min(jax.vmap(o.distance)(positions)) - RADIUS for o in obstacles]
    contacts = eq.contacts
    scale = 3 * YOUNG * np.pi * RADIUS**4 / 4 / LENGTH**2
    weight = 9.81 * numbers["density"] * np.pi * RADIUS**2 * LENGTH
    pushed = jnp.sum(contacts.force[..., None] * contacts.normal, axis=(0, 1))
    total = pushed + numbers["force"] - jnp.array([0.0, 0.0, 1.0]) * weight
    base = eq.pose(0.0)[:3, :3] @ eq.reaction(0.0)[3:]
    return {
        "status": eq.status,
        "steps": eq.steps,
        "gap": jnp.min(jnp.stack(gaps)),
        "product": jnp.max(jnp.minimum(jnp.abs(contacts.gap) / LENGTH, contacts.force / scale)),
        "imbalance": jnp.max(jnp.abs(base - total)),
        "touching": jnp.sum(contacts.force > 1e-6 * scale),
    }


def main() -> None:
    """Run the search."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--obstacles", type=int, nargs="+", default=[1, 3, 10])
    parser.add_argument("--json")
    options = parser.parse_args()
    record = {}
    for count in options.obstacles:
        rng, found, begin = np.random.default_rng(count), [], time.perf_counter()
        draws = [drawn(rng, count) for _ in range(options.draws)]
        program = jax.jit(jax.vmap(partial(solved, count)))
        for first in range(0, options.draws, BATCH):
            part = jax.tree.map(lambda *x: np.stack(x), *draws[first : first + BATCH])
            found.append(jax.tree.map(np.asarray, program(part)))
        result = jax.tree.map(lambda *x: np.concatenate(x), *found)
        good = result["status"] == 0
        touching = good & (result["touching"] > 0)
        record[count] = {
            "arms": options.draws,
            "solved": int(np.sum(good)),
            "statuses": {
                vsr.Status(int(s)).name: int(n)
                for s, n in zip(*np.unique(result["status"], return_counts=True), strict=True)
            },
            "touching": int(np.sum(touching)),
            "steps_median": float(np.median(result["steps"][touching])),
            "steps_largest": int(np.max(result["steps"][touching], initial=0)),
            "penetration_of_radius": float(np.max(-result["gap"][good]) / RADIUS),
            "min_of_gap_and_force": float(np.max(result["product"][good])),
            "imbalance_N": float(np.max(result["imbalance"][good])),
            "seconds": time.perf_counter() - begin,
        }
        print(count, json.dumps(record[count], indent=1))
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(record, file, indent=1)


if __name__ == "__main__":
    main()
