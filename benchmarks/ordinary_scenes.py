"""Random scenes of ordinary size, which a solver should solve whenever they have a stable
equilibrium.

A `Structure` defines the tendons of a scene (driven by tension or length, elastic or not, with
friction, ending before the tip) and its loads. It is static: all draws of a structure are solved by
one compiled program. A draw is a dictionary of numbers in SI units, each a float or a list, that
`built` turns into a scene and its inputs. A test only needs a copy of the dictionary.

Sizes: $L / r$ from 10 to 3000; taper to half the radius; curved at rest in half of the draws;
weight $\\rho g A L^3 / EI$ up to 30 in any direction; forces up to $10\\,EI / L^2$, moments up to
$5\\,EI / L$; tendons at 0.2 to 0.9 of the guide radius that together bend the arm by about half a
turn.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import vsr_jax as vsr

Numbers = dict[str, Any]
DENSITY = 1000.0
DISCS = 6
PARALLEL = 1e-9
"""Turns of a helix that stands for a parallel path."""
MOST_WEIGHT, MOST_FORCE, MOST_MOMENT = 30.0, 10.0, 5.0
MOST_BEND = np.pi
COLLAPSE_SHARE = 0.2
"""Largest tensions, as a share of those at which the section at the tip collapses."""


class Laid(NamedTuple):
    """A tendon of a structure, or a chamber: how it is driven, and whether it is elastic, has
    friction, is helical or ends before the tip."""

    control: Literal["tension", "length", "pressure"] = "tension"
    elastic: bool = False
    motion: Literal["pull", "release"] | None = None
    winds: bool = False
    ends: bool = False


class Structure(NamedTuple):
    """Structure of a scene: tendons; gravity; wrenches by name, see `_loads`; the function that
    draws its numbers; how its tip is held; whether there are obstacles that it cannot reach;
    whether its tendons run straight between `DISCS` even discs; and whether it is of rubber."""

    tendons: tuple[Laid, ...] = ()
    gravity: bool = False
    wrenches: tuple[str, ...] = ()
    draw: Callable[["Structure", np.random.Generator], Numbers] | None = None
    held: Literal["pinned", "clamped"] | None = None
    beside: bool = False
    discs: bool = False
    rubber: bool = False

    def numbers(self, random: np.random.Generator) -> Numbers:
        """One draw."""
        return (self.draw or ordinary)(self, random)


def built(structure: Structure, numbers: Numbers, share: Any = 1.0) -> tuple[vsr.Scene, Any]:
    """Scene and inputs of a draw, with loads and inputs scaled by `share`."""
    n = {name: jnp.asarray(value) for name, value in numbers.items()}
    section = vsr.Circular(vsr.Taper(n["radius"], n["tip_radius"]))
    material = (
        vsr.NeoHookean(n["young"], DENSITY)
        if structure.rubber
        else vsr.Material(n["young"], poisson=n["poisson"], density=DENSITY)
    )
    rest = (0.0, n["curvature"][0], n["curvature"][1], 1.0, 0.0, 0.0)
    discs = vsr.Discs(DISCS, radius=n["rim"])
    rod = vsr.Rod(n["length"], section, material, rest_strain=rest, discs=discs)
    tendons = []
    for i, laid in enumerate(structure.tendons):
        path = vsr.Helix(n["place"][i], pitch=n["length"] / n["turns"][i], phase=n["phase"][i])
        if laid.control == "pressure":
            tendons.append(vsr.Chamber(path, area=n["area"]))
            continue
        tendons.append(
            vsr.Tendon(
                path,
                end=n["end"][i] if laid.ends else None,
                control=laid.control,
                stiffness=n["stiffness"][i] if laid.elastic else None,
                friction=n["friction"][i] if laid.motion else None,
                motion=laid.motion or "pull",
                straight=structure.discs,
            )
        )
    around: dict[str, Any] = {}
    if structure.held:
        clamped = structure.held == "clamped"
        turn = n["end rotation"] if clamped else None
        around["held"] = vsr.Held(position=n["length"] * n["end"], orientation=turn)
    if structure.beside:
        L = n["length"]
        side = jnp.array([0.0, 0.0, -3.0])
        around["obstacles"] = [vsr.Plane((0, 0, 1), side * L), vsr.Sphere(-side * L, L)]
    scene = vsr.Scene(rod, tendons, _loads(structure, n, share), **around)
    return scene, share * n["inputs"] if tendons else jnp.zeros(0)


def _loads(structure: Structure, n: Numbers, share: Any) -> list[Any]:
    loads: list[Any] = [vsr.Gravity(share * n["gravity"])] if structure.gravity else []
    for name in structure.wrenches:
        kind, frame = name.split()[0], "body" if name.endswith("body") else "world"
        force, moment = share * n[f"{name} force"], share * n[f"{name} moment"]
        if kind == "tip":
            loads.append(vsr.TipWrench(force, moment, frame))
        elif kind == "point":
            loads.append(vsr.PointWrench(n["point"], force, moment, frame))
        else:
            loads.append(vsr.DistributedWrench(tuple(force), tuple(moment), frame))
    return loads


def ordinary(structure: Structure, random: np.random.Generator) -> Numbers:
    """Numbers of an ordinary scene."""
    length, slender = 10 ** random.uniform(-1.3, 0.0), 10 ** random.uniform(1, np.log10(3000))
    radius, young, taper = length / slender, 10 ** random.uniform(5, 11.3), random.uniform(0.5, 1.0)
    bending = young * np.pi * radius**4 / 4
    numbers = {
        "length": length,
        "radius": radius,
        "tip_radius": taper * radius,
        "young": young,
        "poisson": random.uniform(0.2, 0.49),
        "rim": radius * random.uniform(1.0, 2.0),
        "curvature": random.uniform(-2, 2, 2) / length * (random.random() < 0.5),
        "gravity": _direction(random)
        * MOST_WEIGHT
        * random.random() ** 2
        * bending
        / length**3
        / (DENSITY * np.pi * radius**2),
        "point": length * random.uniform(0.3, 0.9),
    }
    for name in structure.wrenches:
        unit = bending / length if name.startswith("spread") else bending
        numbers[f"{name} force"] = (
            _direction(random) * MOST_FORCE * random.random() ** 2 * unit / length**2
        )
        numbers[f"{name} moment"] = (
            _direction(random) * MOST_MOMENT * random.random() ** 2 * unit / length
        )
    return plain(numbers | _tendons(structure, random, numbers))


def _tendons(structure: Structure, random: np.random.Generator, numbers: Numbers) -> Numbers:
    """Numbers of the tendons: routings, stiffness, friction and inputs."""
    count, length, taper = (
        len(structure.tendons),
        numbers["length"],
        numbers["tip_radius"] / numbers["radius"],
    )
    if not count:
        return {}
    place = numbers["rim"] * random.uniform(0.2, 0.9, count)
    phase = (
        random.uniform(0, 2 * np.pi)
        + 2 * np.pi * np.arange(count) / count
        + random.uniform(-0.3, 0.3, count)
    )
    winds = np.array([laid.winds for laid in structure.tendons])
    axial = numbers["young"] * np.pi * numbers["tip_radius"] ** 2
    compliance = (taper**-3 - 1) / (3 * (1 - taper)) if taper < 0.999 else 1.0
    bend = numbers["young"] * np.pi * numbers["radius"] ** 4 / 4 / (place * length * compliance)
    collapse = 1 / (1 / axial + place**2 / (axial * numbers["tip_radius"] ** 2 / 4))
    share = np.minimum(1.0, 2.0 / count)
    tension = random.random(count) * share * np.minimum(MOST_BEND * bend, COLLAPSE_SHARE * collapse)
    driven = np.array([laid.control == "length" for laid in structure.tendons])
    # lengths for an arm bent in one plane, each with a small random change, limited to the stretch
    # under the tension above
    angle, plane = MOST_BEND * random.random(), random.uniform(0, 2 * np.pi)
    wound = np.where(winds, 0.3, 1.0)
    more = np.minimum(
        0.1 * place * random.uniform(-1, 1, count),
        share * COLLAPSE_SHARE * collapse * length / axial,
    )
    change = np.maximum(
        -place * angle * np.cos(phase - plane) * wound + more, -COLLAPSE_SHARE * length
    )
    return {
        "place": place,
        "phase": phase,
        "turns": np.where(winds, random.uniform(0.2, 2.0, count), PARALLEL),
        "end": length * random.uniform(0.4, 1.0, count),
        "stiffness": axial * 10 ** random.uniform(-2, 1, count),
        "friction": random.uniform(0, 0.3, count),
        "inputs": np.where(driven, change, tension),
    }


def catheter(structure: Structure, random: np.random.Generator) -> Numbers:
    """A stiff slender catheter with four tendons near its wall, 0 to 3 N each, and 0.5 N at the tip
    in a random direction."""
    return plain(
        {
            "length": 0.2,
            "radius": 5e-4,
            "tip_radius": 5e-4,
            "young": 60e9,
            "poisson": 0.3,
            "rim": 5e-4,
            "curvature": np.zeros(2),
            "place": np.full(4, 4.5e-4),
            "phase": np.arange(4) * np.pi / 2,
            "turns": np.full(4, PARALLEL),
            "tip world force": 0.5 * _direction(random),
            "tip world moment": np.zeros(3),
            "inputs": random.uniform(0, 3, 4),
        }
    )


def upright(structure: Structure, random: np.random.Generator) -> Numbers:
    """An upright silicone arm with a weight from half to several times its buckling load, and a
    chamber at zero pressure."""
    gravity = np.array([-9.81, 0.0, 0.0])
    return plain(
        {
            "length": 0.3,
            "radius": 0.010,
            "tip_radius": 0.004,
            "young": 10 ** random.uniform(5.5, 6.2),
            "poisson": 0.45,
            "rim": 0.010,
            "curvature": np.zeros(2),
            "gravity": gravity,
            "place": np.full(1, 0.003),
            "phase": np.full(1, random.uniform(0, 2 * np.pi)),
            "turns": np.full(1, PARALLEL),
            "area": 1e-5,
            "inputs": np.zeros(1),
        }
    )


def taut(structure: Structure, random: np.random.Generator) -> Numbers:
    """A straight arm of any slenderness whose tip is held where it is at rest or up to 0.1 %
    farther away, with its weight and a load across."""
    numbers = _held(structure, random, random.uniform(np.log10(5), np.log10(15_800)))
    stretch = 10 ** random.uniform(-9, -3)
    return plain(numbers | {"end": np.array([1 + stretch, 0, 0]), "end rotation": np.eye(3)})


def slack(structure: Structure, random: np.random.Generator) -> Numbers:
    """A straight arm whose tip is held nearer to its base and aside, turned by up to a third of a
    turn where it is clamped, with its weight and a load across; in half of the draws all of it in
    one plane."""
    numbers = _held(structure, random, random.uniform(1, np.log10(3000)))
    aside = np.array([1.0, *(0.5 * random.uniform(-1, 1, 2))])
    turn, short = _direction(random) * random.uniform(0, 2), random.uniform(0.01, 0.4)
    if random.random() < 0.5:
        aside[1], turn[::2] = 0.0, 0.0
        for name in ("gravity", *(f"{wrench} force" for wrench in structure.wrenches)):
            numbers[name] = numbers[name] * np.array([1.0, 0.0, 1.0])
    end = (1 - short) * aside / np.linalg.norm(aside)
    turned = Rotation.from_rotvec(turn).as_matrix()
    return plain(numbers | {"end": end, "end rotation": turned})


def _held(structure: Structure, random: np.random.Generator, slender: float) -> Numbers:
    """Numbers of an arm without curvature or moments, its loads up to 20 EI / L^3 per length."""
    numbers = {name: np.asarray(value) for name, value in ordinary(structure, random).items()}
    length = numbers["length"]
    radius, young = length / 10**slender, numbers["young"]
    bending = young * np.pi * radius**4 / 4
    unit = bending / length**3
    weight = _direction(random) * MOST_WEIGHT * random.random() ** 2 * unit
    numbers |= {
        "radius": radius,
        "tip_radius": radius,
        "rim": radius,
        "curvature": np.zeros(2),
        "gravity": weight / (DENSITY * np.pi * radius**2),
    }
    for name in structure.wrenches:
        numbers[f"{name} force"] = _direction(random) * random.uniform(0, 20) * unit
        numbers[f"{name} moment"] = np.zeros(3)
    return numbers


def limp(structure: Structure, random: np.random.Generator) -> Numbers:
    """A hanging rope with a weight from 10 to 1e5 EI / L^3 and a small force across its tip. It is
    so slender that the weight stretches it by a tenth at most: beyond, the linear law of the
    sections means nothing."""
    numbers = {name: np.asarray(value) for name, value in ordinary(structure, random).items()}
    length, load = numbers["length"], 10 ** random.uniform(1, 5)
    stoutest = max(10.0, (load / 0.8) ** 0.5)
    radius = length / np.exp(random.uniform(np.log(stoutest), np.log(3000)))
    weight = load * numbers["young"] * np.pi * radius**4 / 4 / length**3
    across = np.array([0.0, *random.normal(size=2)])
    return plain(
        numbers
        | {
            "radius": radius,
            "tip_radius": radius,
            "rim": radius,
            "curvature": np.zeros(2),
            "gravity": np.array([weight / (DENSITY * np.pi * radius**2), 0, 0]),
            "tip world force": 1e-3 * weight * length * across,
            "tip world moment": np.zeros(3),
        }
    )


def antagonistic(structure: Structure, random: np.random.Generator) -> Numbers:
    """Elastic cables around an arm that are all taut: each shorter by its own stretch and that of
    the arm under a common tension, up to half of what buckles the arm."""
    numbers = {name: np.asarray(value) for name, value in ordinary(structure, random).items()}
    count, length, radius = len(structure.tendons), numbers["length"], numbers["radius"]
    young, place = numbers["young"], np.full(count, 0.9 * numbers["rim"])
    axial, bending = young * np.pi * radius**2, young * np.pi * radius**4 / 4
    phase = 2 * np.pi * np.arange(count) / count
    angle, plane = 2.5 * random.random(), random.uniform(0, 2 * np.pi)
    tension = 0.5 * random.random() * min(np.pi**2 * bending / length**2, 0.2 * axial) / count
    stiffness = axial * 10 ** random.uniform(-2, 1, count)
    taut = tension * length * (1 / stiffness + count / axial)
    return plain(
        numbers
        | {
            "tip_radius": radius,
            "curvature": np.zeros(2),
            "place": place,
            "phase": phase,
            "turns": np.full(count, PARALLEL),
            "stiffness": stiffness,
            "inputs": -place * angle * np.cos(phase - plane) - taut,
        }
    )


def stretched(structure: Structure, random: np.random.Generator) -> Numbers:
    """Numbers of a thick arm of rubber whose tip is pulled by up to half of EA in any direction."""
    numbers = ordinary(structure, random)
    radius = numbers["length"] / random.uniform(6, 20)
    taper = numbers["tip_radius"] / numbers["radius"]
    size = {"radius": radius, "tip_radius": taper * radius, "poisson": 0.5}
    axial = numbers["young"] * np.pi * (taper * radius) ** 2
    force = 0.5 * random.random() ** 2 * axial * _direction(random)
    return plain(numbers | size | {"tip world force": force})


def _direction(random: np.random.Generator) -> np.ndarray:
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)


def plain(numbers: Numbers) -> Numbers:
    """The numbers as floats and lists, which JSON can store."""
    return {name: np.asarray(value, float).tolist() for name, value in numbers.items()}


TENSION, WOUND, LENGTH = Laid(), Laid(winds=True), Laid("length")
ELASTIC, SPREAD = Laid("length", elastic=True), ("spread world",)

STRUCTURES = {
    "tip wrench and gravity": Structure((), True, ("tip world",)),
    "catheter": Structure((TENSION,) * 4, False, ("tip world",), catheter),
    "upright, chamber at rest": Structure((Laid("pressure"),), True, (), upright),
    "follower wrenches": Structure((), True, ("tip body", "spread body")),
    "dead wrenches, three tendons": Structure(
        (TENSION, WOUND, Laid(ends=True)), True, ("point world", "spread world")
    ),
    "nine tendons": Structure((TENSION, WOUND, Laid(ends=True)) * 3, True, ("tip body",)),
    "three lengths": Structure((LENGTH,) * 3, True, ("tip world",)),
    "lengths and tensions": Structure(
        (LENGTH, Laid("length", elastic=True, winds=True), TENSION, Laid(ends=True)),
        False,
        ("tip world",),
    ),
    "friction": Structure(
        (Laid(motion="pull"), Laid(motion="pull", winds=True), Laid(motion="release")),
        True,
        ("tip world",),
    ),
    "friction, lengths": Structure(
        (Laid("length", motion="pull"), Laid("length", motion="pull", winds=True), TENSION), True
    ),
    "antagonistic lengths": Structure((ELASTIC,) * 4, True, (), antagonistic),
    "antagonistic lengths, discs": Structure((ELASTIC,) * 3, True, (), antagonistic, discs=True),
    "stretched rubber": Structure((), True, ("tip world",), stretched, rubber=True),
    "rubber, tendons": Structure((TENSION, WOUND), True, ("spread world",), rubber=True),
    "beside obstacles": Structure((TENSION,) * 2, True, ("tip world",), beside=True),
    "limp ropes beside obstacles": Structure((), True, ("tip world",), limp, beside=True),
    "held, taut, pinned": Structure((), True, SPREAD, taut, "pinned"),
    "held, taut, clamped": Structure((), True, SPREAD, taut, "clamped"),
    "held, slack, pinned": Structure((), True, SPREAD, slack, "pinned"),
    "held, slack, clamped": Structure((), True, SPREAD, slack, "clamped"),
}
