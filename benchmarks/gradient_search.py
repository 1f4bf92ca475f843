r"""Search for gradients that are finite but wrong: forward mode, reverse mode and finite
differences of the solve, on random scenes.

    python benchmarks/gradient_search.py --json benchmarks/results/gradients.json

A structure is a subset of the effects below and where they act. Twelve structures are chosen so
that for any two effects all four combinations of on and off occur. Seventeen scenes are drawn for
each structure, with random sizes, moduli, base, rest strain, routings, loads, friction and inputs.
A function of the tip's pose, the thread forces and the slack is differentiated as in
`gradient_check.py`. Points where other cables are slack than at the centre, or where the steps are
distributed differently over the pieces of the arm, are left out.
"""

from collections.abc import Iterable
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

try:
    from benchmarks import gradient_check as check
except ModuleNotFoundError:  # as a script
    import gradient_check as check

SEED = 12
STEPS = 8

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
    """All effects together, then those that cover the on-off combinations of three effects."""
    random = np.random.default_rng(SEED)

    def candidate() -> frozenset[str]:
        chosen = {
            name for name, on in zip(EFFECTS, random.random(len(EFFECTS)) < 0.5, strict=True) if on
        }
        return frozenset(chosen | {NEEDS[name] for name in chosen & set(NEEDS)})

    every = check.covering(EFFECTS, 3, candidate, number, [frozenset(EFFECTS)])
    return [structure(effects) for effects in every]


class Arm(NamedTuple):
    """Length [m], radius of the tip [m] and bending stiffness EI [N m^2] of an arm."""

    length: float
    radius: float
    bending: float


def material_of(name: str, young: Any, modulus: float, poisson: float, density: float) -> Any:
    """A material by its name: for those of one modulus, the one at the base."""
    if name == "neo-Hookean":
        return vsr.NeoHookean(young, density)
    if name == "Ogden":
        return vsr.Ogden((modulus / 3.3, -modulus / 33), (2.0, -2.0), density)
    return vsr.Material(young, poisson=poisson, density=density)


def drawn(made: Structure, random: np.random.Generator, of: str = "linear") -> check.Drawn:
    """A random scene and its inputs, without zeros, of a material by its name."""
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
    material = material_of(of, stiff, young, uniform(0.3, 0.49), density)
    pose = vsr.se3.exp(jnp.asarray([*uniform(-1, 1, 3), *uniform(-0.1, 0.1, 3)]))
    rod = vsr.Rod(L, section, material, rest_strain=rest, base=pose)
    arm = Arm(L, 0.7 * base, EI)
    threads: list[tuple[Any, float]] = [tendon(made, i, arm, random) for i in range(2)]
    if "chamber" in on:
        y, z = uniform(0.2, 0.5, 2) * arm.radius * random.choice([-1, 1], 2)
        area = np.pi * (uniform(0.1, 0.3) * arm.radius) ** 2
        threads.append(
            (
                vsr.Chamber(vsr.Linear(y, z, *(uniform(-0.3, 0.3, 2) * arm.radius / L)), area),
                pull(arm, random) / area,
            )
        )
    actuators, inputs = zip(*threads, strict=True)
    free: dict[str, Any] = {} if made.free is None else {"free_strains": made.free}
    scene = vsr.Scene(rod, actuators, loads(on, arm, density, random), **free)
    return check.Drawn(scene, jnp.asarray(inputs), EI / (L * arm.radius))


def pull(arm: Arm, random: np.random.Generator) -> float:
    """Force [N] of a thread that bends the arm by about 0.2 to 1.5 radians."""
    return random.uniform(0.2, 1.5) * arm.bending / (arm.length * 0.6 * arm.radius)


def tendon(
    made: Structure, place: int, arm: Arm, random: np.random.Generator
) -> tuple[vsr.Tendon, float]:
    """A straight tendon or a helical one, and its input."""
    uniform = random.uniform
    radius, phase, force = uniform(0.4, 0.9) * arm.radius, uniform(0, 2 * np.pi), pull(arm, random)
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


def loads(on: set[str], arm: Arm, density: float, random: np.random.Generator) -> list:
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


def search(
    made: Structure, draws: int, model: Any = None, material: str = "linear"
) -> list[check.Found]:
    """Derivatives of reproducible random scenes of a structure."""
    random = stream(made.effects)
    scenes = [drawn(made, random, material) for _ in range(draws)]
    model = vsr.StrainDependent(STEPS) if model is None else model
    return check.compared(
        scenes,
        check.Program(scenes[0], model, random, partial(check.observed, steps=STEPS)),
        random,
    )


def job(made: Structure, draws: int, *, basis: bool, material: str = "linear") -> check.Job:
    """The search of a structure, in a prescribed `basis` too."""

    def found() -> list[check.Found]:
        family = vsr.Basis.uniform(vsr.Legendre(2), *(() if made.free is None else (made.free,)))
        model = vsr.Prescribed(family, steps=STEPS) if basis else None
        return search(made, draws, model, material)

    name = (", ".join(made.effects) or "tendons alone") + " (Prescribed)" * basis
    model = "Prescribed" if basis else "StrainDependent"
    return check.Job(name, {"model": model, "material": material, **made._asdict()}, found)


def main() -> None:
    """Run the search."""
    parser = check.parser(__doc__, draws=17)
    parser.add_argument(
        "--prescribed",
        type=int,
        default=2,
        help="structures to solve also in a prescribed basis (default: %(default)s)",
    )
    parser.add_argument("--material", choices=("linear", "neo-Hookean", "Ogden"), default="linear")
    options = parser.parse_args()
    chosen = structures(options.structures)
    of = options.material
    jobs = [job(made, options.draws, basis=False, material=of) for made in chosen]
    jobs += [
        job(made, options.draws, basis=True, material=of) for made in chosen[: options.prescribed]
    ]
    check.run(jobs, {"seed": SEED, "steps": STEPS}, options.json)


if __name__ == "__main__":
    main()
