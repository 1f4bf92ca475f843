"""Random arms among or inside obstacles: how many are solved, and how well.

    python benchmarks/contact_search.py [--draws 1000] [--obstacles 1 3 10] [--json FILE]
    python benchmarks/contact_search.py --tubes 100 [--steps 24] [--json FILE]
    python benchmarks/contact_search.py --paths 200 [--steps 24] [--json FILE]

The first form: arms with gravity, a force at the tip and some spheres that do not touch the arm at
rest. The second: arms in straight tubes, in tubes bent in space, and in such tubes of varying
width, as many of each. The arm fills 0.3 to 0.8 of the width; it starts in the middle of the tube,
along it, and has a force at the tip, gravity in any direction or two tendons. The third: stout arms
that a tendon bends onto a cylinder across their way, where the contact slides along the arm, at 21
tensions each, every one solved from rest.

All arms of a kind are solved in batches. Printed: how many have a solution that was found, the
deepest penetration anywhere on the outline (from the positions of the solution, not from the
solver's gaps), the largest `min(gap, force)`, and the imbalance of forces: the reaction at the base
against the sum of all loads and contact forces. In tubes also the arms that are not solved, by
load. Of paths, how many samples are refused, and of them those between two solved ones with nearly
the same tip, where the shape between them exists.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.arm.tube import curve_through

jax.config.update("jax_enable_x64", True)

LENGTH, RADIUS, YOUNG, BATCH = 0.2, 0.005, 2e5, 100
TUBES = {"straight": "a straight tube", "bent": "a bent tube", "varying": "a bent tube that varies"}
LOADS = ("force", "gravity", "tendons")
BEND, PIECES = 1.6, 5
"""Angle [rad] by which the line of a bent tube turns at most, in each of two directions, and the
number of pieces between its points."""
SAMPLES, NEAR = 21, 0.2
"""Tensions of a path, and the distance of two tips, as a share of the length, below which the
samples belong to one branch."""


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


def drawn_tube(rng: np.random.Generator, kind: str) -> dict[str, Any]:
    """Numbers of one arm in a tube: its load, the tube's line and its radii at both ends."""
    load = rng.integers(len(LOADS))
    direction = rng.normal(size=3)
    turns = np.zeros((PIECES, 2)) if kind == "straight" else rng.uniform(-BEND, BEND, (PIECES, 2))
    # each piece turns from the one before; the first is along x
    yaw, pitch = np.cumsum(turns / PIECES, axis=0).T * np.minimum(np.arange(PIECES), 1)
    ahead = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], 1)
    line = 1.1 * LENGTH / PIECES * np.concatenate([np.zeros((1, 3)), np.cumsum(ahead, axis=0)])
    share = rng.uniform(0.3, 0.8, 2)
    return {
        "load": load,
        "force": rng.normal(size=3) * rng.uniform(0, 0.05) * (load == 0),
        "density": rng.uniform(0, 2000) * (load == 1),
        "gravity": 9.81 * direction / np.linalg.norm(direction),
        "tensions": rng.uniform(0, 1.0, 2) * (load == 2),
        "line": line,
        "radii": RADIUS / (share if kind == "varying" else share[[0, 0]]),
    }


def drawn_path(rng: np.random.Generator) -> dict[str, Any]:
    """Numbers of one stout arm, its largest tension, and a cylinder across the way of a point of
    the arm, on the inner side, beside the straight arm."""
    radius = LENGTH / rng.uniform(7, 40)
    place, bend = 0.6 * radius, rng.uniform(1.0, 2.5)
    turn, X = bend * rng.uniform(0.3, 0.8), LENGTH * rng.uniform(0.5, 1.0)
    at, heading = turn * X / LENGTH, LENGTH / turn
    point = heading * np.array([np.sin(at), 1 - np.cos(at), 0.0])
    inner, wide = np.array([-np.sin(at), np.cos(at), 0.0]), rng.uniform(0.3, 3.0) * radius
    axis = np.array([*rng.uniform(-1, 1, 2), 1.0])
    centre = point + inner * (wide + radius)
    across = np.cross(axis, np.array([1.0, 0.0, 0.0]))
    if abs(centre @ across) / np.linalg.norm(across) < 1.05 * (wide + radius):
        return drawn_path(rng)  # the straight arm touches it
    bending = YOUNG * np.pi * radius**4 / 4
    down = rng.normal(size=3)
    return {
        "radius": radius,
        "place": place,
        "tension": bend * bending / (place * LENGTH),
        "centre": centre,
        "axis": axis / np.linalg.norm(axis),
        "wide": wide,
        "weight": down / np.linalg.norm(down) * rng.uniform(0, 1) * bending / LENGTH**3,
    }


def among_spheres(count: int, numbers: dict[str, jax.Array]) -> tuple[vsr.Scene, jax.Array]:
    """Scene and inputs of one arm among spheres."""
    obstacles = [vsr.Sphere(numbers["centres"][i], numbers["radii"][i]) for i in range(count)]
    loads = [vsr.Gravity(), vsr.TipWrench(numbers["force"])]
    rod = _rod(numbers["density"])
    return vsr.Scene(rod, (), loads, obstacles=obstacles), jnp.zeros(0)


def in_tube(numbers: dict[str, jax.Array]) -> tuple[vsr.Scene, jax.Array]:
    """Scene and inputs of one arm in a tube, whose base is in the middle and along it."""
    width, line = numbers["radii"], numbers["line"]
    tube = vsr.Tube(vsr.Taper(width[0], width[1]), line)
    ahead = curve_through(line, tube.radius).at(jnp.zeros(()))[1]
    loads = [vsr.Gravity(numbers["gravity"]), vsr.TipWrench(numbers["force"])]
    tendons = [vsr.Tendon(vsr.Parallel(y, z)) for y, z in ((0.003, 0.0), (0.0, 0.003))]
    rod = _rod(numbers["density"], vsr.pose(line[0], pointing=ahead))
    return vsr.Scene(rod, tendons, loads, obstacles=tube), numbers["tensions"]


def onto_cylinder(numbers: dict[str, jax.Array], share: jax.Array) -> tuple[vsr.Scene, jax.Array]:
    """Scene and inputs of one arm at a share of its largest tension."""
    rod = _rod(jnp.zeros(()), radius=numbers["radius"])
    tendon = vsr.Tendon(vsr.Parallel(numbers["place"], 0.0))
    weight = vsr.DistributedWrench(force=numbers["weight"])
    along = vsr.pose(numbers["centre"], pointing=numbers["axis"])
    cylinder = vsr.Cylinder(numbers["wide"], pose=along)
    scene = vsr.Scene(rod, tendon, weight, obstacles=cylinder)
    return scene, share[None] * numbers["tension"]


def _rod(
    density: jax.Array, base: jax.Array | None = None, radius: jax.Array | float = RADIUS
) -> vsr.Rod:
    material = vsr.Material(young=YOUNG, poisson=0.4, density=density)
    return vsr.Rod(length=LENGTH, section=vsr.Circular(radius=radius), material=material, base=base)


def solved(scene_of: Callable, steps: int, numbers: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """What is compared of one arm."""
    scene, inputs = scene_of(numbers)
    eq = vsr.solve(scene, inputs, model=vsr.StrainDependent(steps))
    X = jnp.linspace(0.0, LENGTH, 401)
    positions = eq.position(X)
    gaps = [jnp.min(jax.vmap(o.distance)(positions)) - RADIUS for o in scene.obstacles]
    contacts = eq.contacts
    scale = 3 * YOUNG * np.pi * RADIUS**4 / 4 / LENGTH**2
    mass = numbers["density"] * np.pi * RADIUS**2 * LENGTH
    pushed = jnp.sum(contacts.force[..., None] * contacts.normal, axis=(0, 1))
    gravity = numbers.get("gravity", jnp.array([0.0, 0.0, -9.81]))
    total = pushed + numbers["force"] + gravity * mass
    base = eq.pose(0.0)[:3, :3] @ eq.reaction(0.0)[3:]
    return {
        "status": eq.status,
        "steps": eq.steps,
        "gap": jnp.min(jnp.stack(gaps)),
        "product": jnp.max(jnp.minimum(jnp.abs(contacts.gap) / LENGTH, contacts.force / scale)),
        "imbalance": jnp.max(jnp.abs(base - total)),
        "touching": jnp.sum(contacts.force > 1e-6 * scale),
    }


def in_batches(
    scene_of: Callable, steps: int, draws: list[dict[str, Any]]
) -> dict[str, np.ndarray]:
    """What is compared of all arms."""
    program, found = jax.jit(jax.vmap(partial(solved, scene_of, steps))), []
    for first in range(0, len(draws), BATCH):
        part = jax.tree.map(lambda *x: np.stack(x), *draws[first : first + BATCH])
        found.append(jax.tree.map(np.asarray, program(part)))
    return jax.tree.map(lambda *x: np.concatenate(x), *found)


def statuses(found: np.ndarray) -> dict[str, int]:
    """Number of arms with each status."""
    each = zip(*np.unique(found, return_counts=True), strict=True)
    return {vsr.Status(int(status)).name: int(arms) for status, arms in each}


def summary(result: dict[str, np.ndarray], seconds: float) -> dict[str, Any]:
    """The record of one kind of arms."""
    good = result["status"] == 0
    touching = good & (result["touching"] > 0)
    return {
        "arms": len(good),
        "solved": int(np.sum(good)),
        "statuses": statuses(result["status"]),
        "touching": int(np.sum(touching)),
        "steps_median": float(np.median(result["steps"][touching])) if touching.any() else None,
        "steps_largest": int(np.max(result["steps"][touching], initial=0)),
        "penetration_of_radius": float(np.max(-result["gap"][good], initial=0.0) / RADIUS),
        "min_of_gap_and_force": float(np.max(result["product"][good], initial=0.0)),
        "imbalance_N": float(np.max(result["imbalance"][good], initial=0.0)),
        "seconds": seconds,
    }


def tubes(arms: int, steps: int) -> dict[str, Any]:
    """The records of arms in tubes, for each kind of tube."""
    record = {}
    for i, kind in enumerate(TUBES):
        rng, begin = np.random.default_rng(i), time.perf_counter()
        draws = [drawn_tube(rng, kind) for _ in range(arms)]
        result = in_batches(in_tube, steps, draws)
        record[kind] = summary(result, time.perf_counter() - begin)
        load = np.array([draw["load"] for draw in draws])
        record[kind]["loads"] = {
            name: statuses(result["status"][load == j]) for j, name in enumerate(LOADS)
        }
        print(TUBES[kind], json.dumps(record[kind], indent=1), flush=True)
    return record


def paths(arms: int, steps: int) -> dict[str, Any]:
    """The record of arms that are bent onto a cylinder."""
    rng, begin = np.random.default_rng(0), time.perf_counter()
    draws = [drawn_path(rng) for _ in range(arms)]

    def sample(numbers: dict[str, jax.Array], share: jax.Array) -> tuple[jax.Array, ...]:
        eq = vsr.solve(*onto_cylinder(numbers, share), model=vsr.StrainDependent(steps))
        return eq.status, eq.tip[:3, 3], jnp.sum(eq.contacts.force > 1e-6 * numbers["tension"])

    every = jax.vmap(jax.vmap(sample, (None, 0)), (0, None))
    numbers = jax.tree.map(lambda *x: np.stack(x), *draws)
    found = jax.jit(every)(numbers, jnp.linspace(0.0, 1.0, SAMPLES))
    status, tip, touching = map(np.asarray, found)
    good = status == 0
    refused = [(arm, i) for arm in range(arms) for i in range(SAMPLES) if not good[arm, i]]
    between = []
    for arm, i in refused:
        before, after = np.flatnonzero(good[arm, :i]), i + 1 + np.flatnonzero(good[arm, i + 1 :])
        if before.size and after.size:
            moved = np.linalg.norm(tip[arm, after[0]] - tip[arm, before[-1]])
            if moved < NEAR * LENGTH:
                between.append((arm, i))
    record = {
        "paths": arms,
        "samples": int(good.size),
        "solved": int(np.sum(good)),
        "statuses": statuses(status.reshape(-1)),
        "touching": int(np.sum(good & (touching > 0))),
        "refused between solved ones": len(between),
        "which": between,
        "seconds": time.perf_counter() - begin,
    }
    print("paths", json.dumps(record), flush=True)
    return record


def spheres(arms: int, counts: list[int], steps: int) -> dict[int, Any]:
    """The records of arms among spheres, for each number of them."""
    record = {}
    for count in counts:
        rng, begin = np.random.default_rng(count), time.perf_counter()
        draws = [drawn(rng, count) for _ in range(arms)]
        result = in_batches(partial(among_spheres, count), steps, draws)
        record[count] = summary(result, time.perf_counter() - begin)
        print(count, json.dumps(record[count], indent=1), flush=True)
    return record


def main() -> None:
    """Run the search."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=1000)
    parser.add_argument("--obstacles", type=int, nargs="+", default=[1, 3, 10])
    parser.add_argument("--tubes", type=int, help="arms in each kind of tube, in place of spheres")
    parser.add_argument("--paths", type=int, help="arms bent onto a cylinder, in place of spheres")
    parser.add_argument("--steps", type=int, default=24, help="steps of the grid along the arm")
    parser.add_argument("--json")
    options = parser.parse_args()
    if options.tubes:
        record = tubes(options.tubes, options.steps)
    elif options.paths:
        record = paths(options.paths, options.steps)
    else:
        record = spheres(options.draws, options.obstacles, options.steps)
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(record, file, indent=1)


if __name__ == "__main__":
    main()
