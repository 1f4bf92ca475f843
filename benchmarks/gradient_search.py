r"""Search for gradients that are finite but wrong: forward mode, reverse mode and finite
differences of the solve, on random scenes.

    python benchmarks/gradient_search.py --json benchmarks/results/gradients.json

A structure is a subset of the effects below and where they act. Twelve structures are chosen so
that for any two effects all four combinations of on and off occur. Seventeen scenes are drawn for
each structure, with random sizes, moduli, base, rest strain, routings, loads, friction and inputs.
A function f of the tip's pose, the thread forces and the slack is differentiated with respect to
all numbers of scene and inputs, along a random direction v: in forward mode, in reverse mode (the
gradient times v), and by fourth-order central differences of the solve. The three must agree to
1e-7 of the derivative. NaN is counted separately; so are scenes without an equilibrium, whose
derivatives must be zero or NaN in both modes. The error of a difference is estimated from those of
other step sizes. Only points where the solve is smooth are used: points where other cables are
slack than at the centre, or where the steps are distributed differently over the pieces of the arm,
are left out. A scene with too few points left is counted as at a switch.
"""

import argparse
import json
import time
from collections.abc import Iterable
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import vsr_jax as vsr
from vsr_jax.cli.common import reduce_compile_time

SEED = 12
STEPS = 8
SAME = 1e-7
"""Largest difference between two derivatives that count as the same, as a share of the
derivative."""
WIDEST, HALVINGS = 0.02, 10
"""Largest step of the differences as a share of each number, and the number of halvings."""

EFFECTS = (
    "gravity",
    "fluid",
    "dead",
    "follower",
    "pull",
    "release",
    "length",
    "elastic",
    "chamber",
    "jumps",
    "free strains",
)
"""Gravity, in a fluid; dead wrenches; follower wrenches; friction of tendons that are pulled,
released; tendons driven by their length, elastic ones; a chamber; piecewise sections, threads that
end before the tip and wrenches between base and tip; only some of the strains free."""
NEEDS = {"fluid": "gravity", "elastic": "length"}
FREE = (
    ("bending_y", "bending_z"),
    ("torsion", "bending_y", "bending_z"),
    ("bending_y", "bending_z", "elongation"),
)


def stream(effects: Iterable[str]) -> np.random.Generator:
    """Random number generator seeded by the effects alone."""
    return np.random.default_rng([SEED, *(name in set(effects) for name in EFFECTS)])


class Structure(NamedTuple):
    """Effects, the tendons on which `pull`, `release` and `length` act, and the free strains."""

    effects: tuple[str, ...]
    pull: tuple[int, ...]
    release: tuple[int, ...]
    length: tuple[int, ...]
    free: tuple[str, ...] | None


def structure(effects: frozenset[str]) -> Structure:
    """The structure of a subset of the effects, with reproducible random places."""
    random = stream(effects)
    places = [((0,), (1,), (0, 1))[i] for i in random.integers(3, size=2)]
    pull, length = (
        place if name in effects else ()
        for name, place in zip(("pull", "length"), places, strict=True)
    )
    release = places[0] if "release" in effects else ()
    if pull and release:
        pull, release = [((0,), (1,)), ((1,), (0,))][random.integers(2)]
    free = FREE[random.integers(len(FREE))] if "free strains" in effects else None
    return Structure(
        tuple(name for name in EFFECTS if name in effects), pull, release, length, free
    )


def structures(number: int) -> list[Structure]:
    """All effects together, then repeatedly the one of a hundred random subsets that adds the most
    on-off combinations of three effects."""
    random, seen = np.random.default_rng(SEED), set()

    def triples(effects: frozenset[str]) -> set:
        return {
            (names, tuple(name in effects for name in names)) for names in combinations(EFFECTS, 3)
        }

    def candidate() -> frozenset[str]:
        chosen = {
            name for name, on in zip(EFFECTS, random.random(len(EFFECTS)) < 0.5, strict=True) if on
        }
        return frozenset(chosen | {NEEDS[name] for name in chosen & set(NEEDS)})

    found: list[frozenset[str]] = [frozenset(EFFECTS)]
    while len(found) < number:
        seen |= triples(found[-1])
        found.append(
            max((candidate() for _ in range(100)), key=lambda effects: len(triples(effects) - seen))
        )
    return [structure(effects) for effects in found[:number]]


class _Arm(NamedTuple):
    """Length [m], radius of the tip [m] and bending stiffness EI [N m^2] of an arm."""

    length: float
    radius: float
    bending: float


class Drawn(NamedTuple):
    """A scene, its inputs, and the size of its forces [N]."""

    scene: vsr.Scene
    inputs: jax.Array
    force: float


def drawn(made: Structure, random: np.random.Generator) -> Drawn:
    """A random scene and its inputs, without zeros."""
    on, uniform = set(made.effects), random.uniform
    L = uniform(0.2, 0.4)
    base, young = L / uniform(24, 50), 10 ** uniform(5.3, 6.3)
    EI = young * np.pi * base**4 / 4
    density = uniform(0.5, 6.0) * EI / (9.81 * np.pi * base**2 * L**3)
    rest = (*(uniform(-0.7, 0.7, 3) / L), 1 + uniform(-0.05, 0.05), *uniform(-0.03, 0.03, 2))
    stiff = (
        vsr.Piecewise([uniform(0.3, 0.7) * L], [young, uniform(0.5, 1.0) * young])
        if "jumps" in on
        else young
    )
    section = vsr.Circular(vsr.Taper(base, uniform(0.7, 1.0) * base))
    material = vsr.Material(stiff, poisson=uniform(0.3, 0.49), density=density)
    pose = vsr.se3.exp(jnp.asarray([*uniform(-1, 1, 3), *uniform(-0.1, 0.1, 3)]))
    rod = vsr.Rod(L, section, material, rest_strain=rest, base=pose)
    arm = _Arm(L, 0.7 * base, EI)
    threads: list[tuple[Any, float]] = [_tendon(made, i, arm, random) for i in range(2)]
    if "chamber" in on:
        y, z = uniform(0.2, 0.5, 2) * arm.radius * random.choice([-1, 1], 2)
        area = np.pi * (uniform(0.1, 0.3) * arm.radius) ** 2
        threads.append(
            (
                vsr.Chamber(vsr.Linear(y, z, *(uniform(-0.3, 0.3, 2) * arm.radius / L)), area),
                _pull(arm, random) / area,
            )
        )
    actuators, inputs = zip(*threads, strict=True)
    free: dict[str, Any] = {} if made.free is None else {"free_strains": made.free}
    scene = vsr.Scene(rod, actuators, _loads(on, arm, density, random), **free)
    return Drawn(scene, jnp.asarray(inputs), EI / (L * arm.radius))


def _pull(arm: _Arm, random: np.random.Generator) -> float:
    """Force [N] of a thread that bends the arm by about 0.2 to 1.5 radians."""
    return random.uniform(0.2, 1.5) * arm.bending / (arm.length * 0.6 * arm.radius)


def _tendon(
    made: Structure, place: int, arm: _Arm, random: np.random.Generator
) -> tuple[vsr.Tendon, float]:
    """A straight tendon or a helical one, and its input."""
    uniform = random.uniform
    radius, phase, force = uniform(0.4, 0.9) * arm.radius, uniform(0, 2 * np.pi), _pull(arm, random)
    path = vsr.Helix(radius, pitch=arm.length / uniform(0.3, 1.2), phase=phase)
    options: dict[str, Any] = {}
    if place == 0:
        path = vsr.Parallel(radius * np.cos(phase), radius * np.sin(phase))
    elif "jumps" in made.effects:
        options["end"] = uniform(0.75, 0.95) * arm.length
    if place in (*made.pull, *made.release):
        options |= {
            "friction": uniform(0.05, 0.5),
            "motion": "pull" if place in made.pull else "release",
        }
    if place not in made.length:
        return vsr.Tendon(path, **options), force
    axial = 4 * arm.bending / (arm.radius / 0.7) ** 2
    shortened = force * arm.length * (radius**2 / arm.bending + 1 / axial)
    if "elastic" in made.effects:
        options["stiffness"] = uniform(1, 8) * axial
        shortened += force * arm.length / options["stiffness"]
    loose = random.random() < 0.15
    return vsr.Tendon(path, control="length", **options), 2 * shortened if loose else -shortened


def _loads(on: set[str], arm: _Arm, density: float, random: np.random.Generator) -> list:
    """The loads of the effects that are on."""
    uniform, loads = random.uniform, []
    unit = arm.bending / arm.length**2

    def wrench(frame: Any) -> Any:
        parts = {
            "force": uniform(-1, 1, 3) * unit,
            "moment": uniform(-0.3, 0.3, 3) * unit * arm.length,
            "frame": frame,
        }
        return (
            vsr.PointWrench(uniform(0.4, 0.9) * arm.length, **parts)
            if "jumps" in on
            else vsr.TipWrench(**parts)
        )

    if "gravity" in on:
        way = random.normal(size=3)
        loads.append(
            vsr.Gravity(
                9.81 * way / np.linalg.norm(way),
                uniform(0.2, 0.8) * density if "fluid" in on else None,
            )
        )
    if "dead" in on:
        loads.append(wrench("world"))
    if "follower" in on:
        loads += [
            wrench("body"),
            vsr.DistributedWrench(tuple(uniform(-1, 1, 3) * unit / arm.length), frame="body"),
        ]
    return loads


class Program:
    """Compiled functions for the scenes of a structure: f, and its derivatives."""

    def __init__(self, like: Drawn, model: Any, random: np.random.Generator):
        _, rebuild = ravel_pytree(like[:2])
        mix = jnp.asarray(random.normal(size=12 + 2 * like.inputs.size))

        def value(x: jax.Array, force: jax.Array) -> tuple[jax.Array, tuple]:
            scene, inputs = rebuild(x)
            eq = vsr.solve(scene, inputs, model=model)
            grid = vsr.StrainDependent(STEPS).grid(scene)
            pieces = jnp.searchsorted(scene.edges(), grid.start + 0.5 * grid.h)
            parts = jnp.concatenate(
                [eq.tip[:3, 3] / 0.3, eq.tip[:3, :3].ravel(), eq.forces / force, eq.slack / 0.01]
            )
            return mix @ parts, (eq.status, eq.forces == 0, pieces)

        def derivatives(x: jax.Array, force: jax.Array, v: jax.Array) -> tuple[jax.Array, ...]:
            _, push = jax.linearize(lambda x: value(x, force)[0], x)
            (gradient,) = jax.linear_transpose(push, x)(jnp.ones(()))
            return push(v), gradient @ v

        self.value, self.derivatives = jax.jit(jax.vmap(value)), jax.jit(jax.vmap(derivatives))


class Found(NamedTuple):
    """Results of one scene: its status, the three derivatives, and the estimated error of the
    difference (NaN at a switch)."""

    status: int
    forward: float
    reverse: float
    difference: float
    error: float


def search(made: Structure, draws: int, model: Any = None) -> list[Found]:
    """Derivatives of reproducible random scenes of a structure."""
    random = stream(made.effects)
    scenes = [drawn(made, random) for _ in range(draws)]
    program = Program(scenes[0], vsr.StrainDependent(STEPS) if model is None else model, random)
    x, force = (
        jnp.stack([ravel_pytree(one[:2])[0] for one in scenes]),
        jnp.asarray([one.force for one in scenes]),
    )
    v = random.normal(size=x.shape) * np.where(x == 0, 1e-3, np.abs(x))
    forward, reverse = (np.asarray(part) for part in program.derivatives(x, force, v))
    steps = WIDEST * 0.5 ** np.arange(HALVINGS + 1)
    places = np.concatenate([[0.0], steps, -steps])
    points = (x[:, None] + places[:, None] * v[:, None]).reshape(-1, x.shape[1])
    values, (status, *switches) = program.value(points, jnp.repeat(force, len(places)))
    values, status = np.asarray(values).reshape(draws, -1), np.asarray(status).reshape(draws, -1)
    for switch in switches:
        told = np.asarray(switch).reshape(*values.shape, -1)
        values = np.where(np.all(told == told[:, :1], axis=2), values, np.nan)
    odd = values[:, 1 : len(steps) + 1] - values[:, len(steps) + 1 :]
    found = [difference(*pair) for pair in zip(odd, np.broadcast_to(steps, odd.shape), strict=True)]
    return [
        Found(int(s[0]), float(f), float(r), *d)
        for s, f, r, d in zip(status, forward, reverse, found, strict=True)
    ]


def difference(odd: np.ndarray, steps: np.ndarray) -> tuple[float, float]:
    r"""Fourth-order central difference $(8 (f_h - f_{-h}) - (f_{2h} - f_{-2h})) / 12 h$ and its
    error, from $f_h - f_{-h}$ at successively halved steps.

    The chosen step is the one whose difference is closest to those of twice and of half the step;
    the error is four times that distance.
    """
    slopes = (8 * odd[1:] - odd[:-1]) / (12 * steps[1:])
    changes = np.abs(np.diff(slopes))
    errors = np.maximum(changes[1:], changes[:-1])
    if np.all(np.isnan(errors)):
        return float("nan"), float("nan")
    best = int(np.nanargmin(errors))
    return float(slopes[best + 1]), 4 * float(errors[best])


def verdict(found: Found) -> str:
    """Verdict on a draw; it starts with `wrong` if a derivative is wrong."""
    nan = np.isnan(found.forward), np.isnan(found.reverse)
    if found.status != vsr.Status.CONVERGED:
        none = all(nan) or found.forward == found.reverse == 0
        return "not converged" if none else "wrong: not converged, with a derivative"
    if any(nan):
        return "NaN in both" if all(nan) else "NaN in one mode"
    if abs(found.forward - found.reverse) > SAME * abs(found.forward):
        return "wrong: the modes differ"
    if np.isnan(found.error):
        return "at a switch"
    if abs(found.forward - found.difference) > SAME * abs(found.forward) + found.error:
        return "wrong: not the difference"
    return "agrees" if found.error <= SAME * abs(found.forward) else "difference too rough"


def summary(found: list[Found]) -> dict[str, Any]:
    """The row of a structure: counts, and the largest relative differences."""
    said = [verdict(one) for one in found]
    counts = {words: said.count(words) for words in sorted(set(said))}
    solved = [
        one
        for one in found
        if one.status == vsr.Status.CONVERGED and not np.isnan(one.forward + one.reverse)
    ]
    modes = [abs(one.forward - one.reverse) / abs(one.forward) for one in solved]
    apart = [
        abs(one.forward - one.difference) / abs(one.forward)
        for one in solved
        if one.error <= SAME * abs(one.forward)
    ]
    return {
        "draws": len(found),
        "converged": sum(one.status == vsr.Status.CONVERGED for one in found),
        "verdicts": counts,
        "forward - reverse": max(modes, default=None),
        "forward - differences": max(apart, default=None),
    }


def line(name: str, row: dict[str, Any]) -> str:
    """A line of the table."""
    said = row["verdicts"]
    worst = (
        "-" if row[key] is None else f"{row[key]:.0e}"
        for key in ("forward - reverse", "forward - differences")
    )
    wrong = sum(number for words, number in said.items() if words.startswith("wrong"))
    counts = (
        said.get(words, 0)
        for words in ("NaN in both", "NaN in one mode", "at a switch", "difference too rough")
    )
    cells = (name, row["draws"], row["converged"], *counts, wrong, *worst)
    return f"| {' | '.join(str(cell) for cell in cells)} |"


HEADER = (
    "| effects | draws | converged | NaN in both | NaN in one mode | at a switch | difference too "
    "rough | wrong "
    "| forward - reverse | forward - differences |\n|" + "---|" * 10
)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--structures", type=int, default=12)
    parser.add_argument(
        "--draws", type=int, default=17, help="draws per structure (default: %(default)s)"
    )
    parser.add_argument(
        "--prescribed",
        type=int,
        default=2,
        help="structures to solve also in a prescribed basis (default: %(default)s)",
    )
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    reduce_compile_time(optimise=False)  # nothing is timed
    jax.config.update("jax_enable_x64", True)
    print(HEADER)
    rows = []
    chosen = structures(options.structures)
    for made, basis in [
        *((made, False) for made in chosen),
        *((made, True) for made in chosen[: options.prescribed]),
    ]:
        began = time.perf_counter()
        # the programs of a structure are used once and take hundreds of megabytes
        jax.clear_caches()
        family = vsr.Basis.uniform(vsr.Legendre(2), *(() if made.free is None else (made.free,)))
        found = search(made, options.draws, vsr.Prescribed(family, steps=STEPS) if basis else None)
        name = ", ".join(made.effects) or "tendons alone"
        row = {
            "model": "Prescribed" if basis else "StrainDependent",
            **made._asdict(),
            **summary(found),
        }
        print(
            line(name + " (Prescribed)" * basis, row),
            f"{time.perf_counter() - began:.0f} s",
            flush=True,
        )
        rows.append({**row, "found": [[verdict(one), *one] for one in found]})
    if options.json:
        record = {"seed": SEED, "steps": STEPS, "jax": jax.__version__, "structures": rows}
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
