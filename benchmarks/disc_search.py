"""Search for false failures of robots with discs: a wire of one to three sections, three tendons
straight to the end of each, friction in the holes, weights of the discs, a force at the tip.

    python benchmarks/disc_search.py [--draws N] [--json FILE]

Each draw is solved for its tensions. Where that converges the forces at all discs must balance in
`rods_between_discs`, which shares no code with the package. Where it is refused, load steps there
look for the equilibrium from rest: it is a false failure if they arrive and the sign of their
determinant, which tells an arm that has lost its stability, never changes. Then the robot is driven
by the lengths of its elastic cables in the shape that was found, and must give back its tensions.
"""

import argparse
import json
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

try:
    from benchmarks import rods_between_discs as independent
except ModuleNotFoundError:  # as a script
    import rods_between_discs as independent

LENGTH, RADIUS, OFFSET = 0.2, 5e-4, 8e-3
YOUNG, POISSON, CABLE = 60e9, 0.3, 5e3
BENDING = YOUNG * np.pi * RADIUS**4 / 4
MOST_BEND, MOST_FORCE, MOST_WEIGHT, MOST_FRICTION = 1.5, 5.0, 5.0, 0.3
"""Of one tendon in each section [rad]; of the tip and of all discs [EI / L^2]; of the holes."""
SHARES = np.linspace(0, 1, 21)[1:]
BALANCED, SAME = 1e-3, 1e-3
"""Largest residual that confirms a shape [EI / L, EI / L^2], and error of tensions [EI / (L d)]."""


class Kind(NamedTuple):
    """Structure of a robot: its sections, the discs of each, and how its tendons move in the holes,
    None without friction."""

    sections: int
    discs: int
    motion: Any

    @property
    def last(self) -> np.ndarray:
        """Last section of each tendon."""
        return np.repeat(np.arange(1, self.sections + 1), 3)

    @property
    def holes(self) -> np.ndarray:
        """Where the tendons cross the discs [m]."""
        turned = np.pi / 3 / self.sections * np.arange(self.sections)[:, None]
        angle = (2 * np.pi / 3 * np.arange(3) + turned).ravel()
        return OFFSET * np.stack([np.cos(angle), np.sin(angle)], axis=1)


KINDS = [
    Kind(sections, discs, motion)
    for sections, discs in ((1, 10), (2, 6), (3, 4))
    for motion in (None, "pull", "release")
]


class Draw(NamedTuple):
    """Tensions [N], force at the tip [N], friction, and the mass of each disc [kg]."""

    tension: Any
    force: Any
    friction: Any
    mass: Any


def drawn(kind: Kind, random: np.random.Generator) -> Draw:
    """One draw: a share of the tendons pulls."""
    number, unit = len(kind.last), BENDING / LENGTH**2
    most = MOST_BEND * BENDING / (OFFSET * LENGTH / kind.sections)
    tension = most / kind.sections * random.random(number) * (random.random(number) < 0.7)
    force = random.normal(size=3)
    force *= MOST_FORCE * unit * random.random() / np.linalg.norm(force)
    weight = MOST_WEIGHT * unit * random.random() / (kind.sections * kind.discs)
    return Draw(tension, force, MOST_FRICTION * random.random(), weight / 9.81)


def scene(kind: Kind, draw: Draw, control: Any) -> vsr.Scene:
    """The robot; its wire has no weight, which acts at the discs in the other program."""
    material = vsr.Material(YOUNG, poisson=POISSON, density=1e-6)
    discs = vsr.Discs(kind.sections * kind.discs, radius=1.2 * OFFSET, mass=draw.mass)
    rod = vsr.Rod(LENGTH, vsr.Circular(RADIUS), material, discs=discs)
    options: dict[str, Any] = {"control": control, "straight": True}
    if kind.motion:
        options |= {"friction": draw.friction, "motion": kind.motion}
    if control == "length":
        options["stiffness"] = CABLE
    tendons = [
        vsr.Tendon(vsr.Parallel(*hole), end=LENGTH * last / kind.sections, **options)
        for hole, last in zip(kind.holes, kind.last, strict=True)
    ]
    return vsr.Scene(rod, tendons, [vsr.Gravity(), vsr.TipWrench(draw.force)])


def rods(kind: Kind, draw: Draw) -> independent.Robot:
    """The same for the independent program."""
    shear, area = YOUNG / (2 * (1 + POISSON)), np.pi * RADIUS**2
    factor = np.asarray(vsr.Circular(RADIUS).shear_correction)
    number = kind.sections * kind.discs
    stiffness = [2 * shear * BENDING / YOUNG, BENDING, BENDING, YOUNG * area]
    signs = {None: 0.0, "pull": 1.0, "release": -1.0}
    return independent.Robot(
        np.full(number, LENGTH / number),
        np.array([*stiffness, *(factor * shear * area)]),
        kind.holes,
        kind.discs * kind.last,
        np.asarray(draw.tension),
        np.asarray(draw.force),
        friction=signs[kind.motion] * float(draw.friction),
        weight=np.array([0.0, 0.0, -9.81 * float(draw.mass)]),
    )


class Answer(NamedTuple):
    """Status, strains at the starts of the pieces, lengths of the tendons at rest and in the shape
    that was found [m], mean tension of each over its length [N]."""

    status: Any
    strain: Any
    rest: Any
    length: Any
    mean: Any


@partial(jax.jit, static_argnums=0)
def by_tensions(kind: Kind, draws: Draw) -> Answer:
    """Solutions for tensions, in a batch."""
    number = kind.sections * kind.discs
    starts = LENGTH / number * (jnp.arange(number) + 1e-9)

    def answer(draw: Draw) -> Answer:
        robot = scene(kind, draw, "tension")
        eq = vsr.solve(robot, draw.tension, model=vsr.StrainDependent(2 * number))
        rest = jnp.stack([robot.rest_length(i) for i in range(len(kind.last))])
        weight, means = eq.nodes.grid.weight, []
        for i, last in enumerate(kind.last):
            share = eq.nodes.shares[i]
            along = LENGTH * last / kind.sections
            means.append(
                -eq.forces[i] if share is None else -eq.forces[i] * jnp.sum(weight * share) / along
            )
        return Answer(eq.status, eq.strain(starts), rest, eq.lengths, jnp.stack(means))

    return jax.vmap(answer)(draws)


@partial(jax.jit, static_argnums=0)
def by_lengths(kind: Kind, draws: Draw, changes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Status and tensions for lengths, in a batch."""

    def answer(draw: Draw, change: jax.Array) -> tuple[jax.Array, jax.Array]:
        model = vsr.StrainDependent(2 * kind.sections * kind.discs)
        eq = vsr.solve(scene(kind, draw, "length"), change, model=model)
        return eq.status, -eq.forces

    return jax.vmap(answer)(draws, changes)


def lengths(draws: Draw, found: Answer) -> jax.Array:
    """Changes of length of the cables in the shapes that were found; those without tension get
    some slack."""
    change = jnp.asarray(found.length / (1 + found.mean / CABLE) - found.rest)
    return jnp.where(draws.tension > 0, change, change + 1e-2 * OFFSET)


def confirmed(robot: independent.Robot, strain: np.ndarray) -> str:
    """Whether the forces of a shape balance at all discs."""
    wrench = (strain - np.array([0, 0, 0, 1, 0, 0])) * robot.stiffness
    off = np.abs(independent.residual(robot, (wrench / robot.units).ravel(), True)).max()
    return "confirmed" if off < BALANCED else "wrong"


def sought(robot: independent.Robot) -> str:
    """What load steps from rest find of a draw that is refused."""
    x, sign = np.zeros(6 * len(robot.lengths)), 0.0
    moves = independent.DIFFERENCE * np.eye(len(x))
    for share in SHARES:
        part = independent.scaled(robot, share)
        try:
            x = independent.newton(part, x, True)
        except RuntimeError:
            return "snaps"
        slopes = independent.residual(part, x + moves, True)
        now = np.linalg.slogdet(slopes - independent.residual(part, x - moves, True))[0]
        if sign and now != sign:
            return "snaps"
        sign = now
    return "false failure"


def search(kind: Kind, count: int, seed: int) -> dict[str, Any]:
    """The verdicts on some draws."""
    each = [drawn(kind, np.random.default_rng((seed, i))) for i in range(count)]
    draws = jax.tree.map(lambda *x: jnp.asarray(np.stack(x)), *each)
    found = jax.tree.map(np.asarray, by_tensions(kind, draws))
    solved = found.status == vsr.Status.CONVERGED
    verdicts = [
        confirmed(rods(kind, draw), found.strain[i]) if solved[i] else sought(rods(kind, draw))
        for i, draw in enumerate(each)
    ]
    tension = np.asarray(draws.tension)
    status, tensions = map(np.asarray, by_lengths(kind, draws, lengths(draws, found)))
    unit = BENDING / (LENGTH * OFFSET)
    same = np.all(np.abs(tensions - tension) < SAME * unit, axis=1)
    driven = np.where(status != vsr.Status.CONVERGED, "refused", np.where(same, "same", "others"))
    names = {int(s): s.name.lower() for s in vsr.Status}
    return {
        "kind": kind._asdict(),
        "tensions": dict(Counter(verdicts)),
        "refused as": dict(Counter(names[int(s)] for s in found.status[~solved])),
        "lengths": dict(Counter(driven[solved].tolist())),
        "false failures": [
            {
                "draw": i,
                "numbers": {k: np.asarray(v).tolist() for k, v in each[i]._asdict().items()},
            }
            for i, verdict in enumerate(verdicts)
            if verdict in ("false failure", "wrong")
        ],
        "refused lengths": [i for i in range(count) if solved[i] and driven[i] != "same"],
    }


def main() -> None:
    """Run the search and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--draws", type=int, default=112, help="draws of each kind (112)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print("| sections | discs | friction | by tensions | by lengths |\n|---|---|---|---|---|")
    rows = []
    for kind in KINDS:
        row = search(kind, options.draws, options.seed)
        rows.append(row)
        cells = (
            ", ".join(f"{count} {name}" for name, count in row[side].items())
            for side in ("tensions", "lengths")
        )
        print(
            f"| {kind.sections} | {kind.discs} each | {kind.motion or 'none'} | "
            f"{' | '.join(cells)} |",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps({"draws": options.draws, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
