"""Random arms along paths of inputs against obstacles with friction: how many samples are solved.

    python benchmarks/friction_search.py [--arms 64] [--steps 24] [--json FILE]

"pillar": a light arm that gravity and two tendons press on a pillar across it, bent and
straightened in 12 samples. "floor": a heavy arm above a tilted floor, on which it comes to lie,
moved to and fro by two tendons in 21 samples; coefficients from 0.1 to 2. A sample that fails
leaves the next one to start from the last one solved, so that failures come in rows; "paths" counts
those without any.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import vsr_jax as vsr
from vsr_jax.studies import effects

jax.config.update("jax_enable_x64", True)

LENGTH, RADIUS, OFFSET = 0.2, 0.005, 0.004


def on_pillar(rng: np.random.Generator, arms: int) -> tuple[Callable, dict[str, Array], Array]:
    """The pillar of the ladder of effects: scene, numbers and paths."""
    rough, samples = effects.scenes()[-1], 12
    ends = rng.uniform(0.5, 1.5, (arms, 2)) * np.array(rough.inputs)
    share = np.minimum(np.arange(1, samples + 1), np.arange(samples, 0, -1)) / (samples / 2)
    return lambda numbers: rough.scene, {}, jnp.asarray(share[:, None] * ends[:, None])


def on_floor(rng: np.random.Generator, arms: int) -> tuple[Callable, dict[str, Array], Array]:
    """Arms that do not touch their floor at rest: scene, numbers and paths."""
    found = []
    while len(found) < arms:
        normal = np.array([0.3, 0.3, 0.0]) * rng.normal(size=3) + np.array([0.0, 0.0, 1.0])
        normal, height = normal / np.linalg.norm(normal), rng.uniform(-0.06, -0.015)
        apart = np.array([0.0, LENGTH]) * normal[0] - height * normal[2]
        if apart.min() > RADIUS + 1e-3:
            found.append((rng.uniform(0.1, 2.0), normal, height))
    friction, normal, height = map(np.array, zip(*found, strict=True))
    share = np.linspace(0, 1, 13)
    share = np.concatenate([share, share[-2:3:-1]])
    tension, rate = rng.uniform(0.5, 1.5, (arms, 1, 2)), rng.uniform(0, 2, (arms, 1, 2))
    rate[..., 0] = 1.0
    path = tension * np.abs(np.sin(1.5 * share[:, None] * rate))

    def scene(numbers: dict[str, Array]) -> vsr.Scene:
        rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), vsr.Material(1e6, poisson=0.3, density=1000.0))
        place = numbers["height"] * jnp.array([0.0, 0.0, 1.0])
        floor = vsr.Plane(numbers["normal"], place, friction=numbers["friction"])
        threads = [vsr.Parallel(0.0, -OFFSET), vsr.Parallel(OFFSET, 0.0)]
        return vsr.Scene(rod, list(map(vsr.Tendon, threads)), vsr.Gravity(), obstacles=[floor])

    numbers = {"friction": friction, "normal": normal, "height": height}
    return scene, jax.tree.map(jnp.asarray, numbers), jnp.asarray(path)


def summary(scene: Callable, numbers: dict[str, Array], paths: Array, steps: int) -> dict[str, Any]:
    """How many samples of all paths are solved, side by side, and in how many steps."""

    @jax.jit
    @jax.vmap
    def solved(numbers: dict[str, Array], path: Array) -> tuple[Array, Array]:
        found = vsr.follow(scene(numbers), path, model=vsr.StrainDependent(steps))
        return found.status, found.steps

    began = time.perf_counter()
    status, evaluations = map(np.asarray, solved(numbers, paths))
    good = status == vsr.Status.CONVERGED
    return {
        "samples": good.size,
        "solved": int(good.sum()),
        "paths": len(good),
        "paths_solved": int(good.all(axis=1).sum()),
        "mean_steps": round(float(evaluations.mean()), 1),
        "median_steps": int(np.median(evaluations)),
        "seconds_with_compiling": round(time.perf_counter() - began, 1),
    }


def main() -> None:
    """Run the search."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--arms", type=int, default=64)
    parser.add_argument("--steps", type=int, default=24, help="steps of the grid along the arm")
    parser.add_argument("--json")
    options = parser.parse_args()
    record = {}
    for name, drawn in {"pillar": on_pillar, "floor": on_floor}.items():
        scene, numbers, paths = drawn(np.random.default_rng(0), options.arms)
        record[name] = summary(scene, numbers, paths, options.steps)
        print(name, record[name], flush=True)
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump({"steps": options.steps, **record}, file, indent=1)


if __name__ == "__main__":
    main()
