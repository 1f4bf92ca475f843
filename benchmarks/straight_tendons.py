"""Error of the usual assumption, a tendon along the section, for tendons that run straight from
disc to disc: distance of the tips over the number of discs.

The arm is one section of the robot in the published code of Rao et al. 2021 (see
docs/validation.md): a wire with a Young's modulus of 54 GPa, 1.4 mm thick and 200 mm long, with
holes at 10 mm from it. The whole robot, of two such sections with three tendons each, is compared
with the equations of that code and with an independent solution (see `rods_between_discs.py`). Run
it, in five to ten minutes, with

    python benchmarks/straight_tendons.py --plot benchmarks/results/straight_tendons.png
        --json benchmarks/results/straight_tendons.json
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import vsr_jax as vsr

try:
    from benchmarks import rods_between_discs as independent
except ModuleNotFoundError:  # as a script
    import rods_between_discs as independent

LENGTH, RADIUS, YOUNG, POISSON, OFFSET = 0.2, 0.7e-3, 54e9, 0.3, 0.01
BENDING = YOUNG * np.pi * RADIUS**4 / 4
DISCS = (2, 3, 5, 10, 20)
PARALLEL, HELIX = vsr.Parallel(OFFSET, 0.0), vsr.Helix(OFFSET, pitch=2 * LENGTH)
ASIDE = vsr.TipWrench(force=(0.0, 0.0, 0.2))


_BELOW: dict[str, Any] = {
    "frameon": False,
    "fontsize": "small",
    "loc": "upper center",
    "bbox_to_anchor": (0.5, -0.12),
}


class Case(NamedTuple):
    """A bend: the routing of the tendon, the loads, and the angle by which the tendon alone bends
    an arm with a parallel routing [degrees]."""

    routing: Any
    loads: tuple
    angle: float

    @property
    def tension(self) -> float:
        """Tension [N] for that angle, $T d L / EI$."""
        return np.deg2rad(self.angle) * BENDING / (OFFSET * LENGTH)


CASES = {
    "45 degrees": Case(PARALLEL, (), 45.0),
    "90 degrees": Case(PARALLEL, (), 90.0),
    "180 degrees": Case(PARALLEL, (), 180.0),
    "90 degrees, 0.2 N across the tip": Case(PARALLEL, (ASIDE,), 90.0),
    "half a turn of a helix, the tension of 180 degrees": Case(HELIX, (), 180.0),
}


def wire(length: float, discs: int | None) -> vsr.Rod:
    """The backbone of one section or of both, through whose discs tendons run straight,
    or as the section does for None."""
    material = vsr.Material(YOUNG, poisson=POISSON)
    guides = vsr.Discs(discs or 10, radius=1.01 * OFFSET)
    return vsr.Rod(length, vsr.Circular(RADIUS), material, discs=guides)


def shapes(discs: int | None) -> dict[str, np.ndarray]:
    """Positions [m] along the arm of every case, shape (stations, 3); NaN where there is no stable
    equilibrium."""
    X, model = jnp.linspace(0, LENGTH, 41), vsr.StrainDependent(max(24, discs or 0))
    rod, found = wire(LENGTH, discs), {}
    for name, case in CASES.items():
        scene = vsr.Scene(rod, [vsr.Tendon(case.routing, straight=discs is not None)], case.loads)
        found[name] = np.asarray(vsr.solve(scene, [case.tension], model=model).position(X))
    return found


class Inputs(NamedTuple):
    """Tensions [N] of the robot's tendons, three to the end of each section, and the force at its
    tip [N]."""

    tensions: tuple[float, ...]
    force: tuple[float, float, float]


ROBOT_CASES = {
    "4 N and 2 N, as in the published example": Inputs((4, 0, 0, 0, 2, 0), (0, 0, 0)),
    "4 N to the tip alone": Inputs((0, 0, 0, 0, 4, 0), (0, 0, 0)),
    "4 N and 2 N, 0.1 N across the tip": Inputs((4, 0, 0, 0, 2, 0), (0, 0.1, 0)),
    "6, 4 and 3 N, 0.12 N at the tip": Inputs((6, 0, 0, 0, 4, 3), (-0.05, 0.05, 0.1)),
}
ROBOT_DISCS = 5, 10
"""In each of its two sections."""
_PLACES = np.pi / 2, -np.pi / 6, 7 * np.pi / 6
SECTIONS = 1, 1, 1, 2, 2, 2
HOLES = OFFSET * np.array([[np.cos(angle), np.sin(angle)] for angle in 2 * _PLACES])


def robot(discs: int | None) -> vsr.Scene:
    """The robot with its discs, or with tendons along the section; the force is to be put in."""
    tendons = [
        vsr.Tendon(vsr.Parallel(*hole), end=sections * LENGTH, straight=discs is not None)
        for hole, sections in zip(HOLES, SECTIONS, strict=True)
    ]
    return vsr.Scene(wire(2 * LENGTH, discs and 2 * discs), tendons, [vsr.TipWrench()])


def rods(discs: int, inputs: Inputs) -> independent.Robot:
    """The same for the independent solution."""
    shear, area = YOUNG / (2 * (1 + POISSON)), np.pi * RADIUS**2
    return independent.Robot(
        np.full(2 * discs, LENGTH / discs),
        np.array([2 * shear * BENDING / YOUNG, *[BENDING] * 2, YOUNG * area, *[shear * area] * 2]),
        HOLES,
        discs * np.array(SECTIONS),
        np.array(inputs.tensions, float),
        np.array(inputs.force, float),
    )


def compared(discs: int) -> dict[str, dict[str, float]]:
    """Distances of the tips in percent of the robot's length, by case: of a tendon along the
    section from that of straight ones here and by the published equations; of straight ones here
    from the published equations, and from the same with the term that they leave out."""
    model = vsr.StrainDependent(8 * discs)

    def tips(scene: vsr.Scene) -> Any:
        def tip(tensions: jax.Array, force: jax.Array) -> jax.Array:
            loaded = scene.replace("loads[0].force", force)
            return vsr.solve(loaded, tensions, model=model).tip[:3, 3]

        return jax.jit(tip)

    usual, straight = tips(robot(None)), tips(robot(discs))
    found = {}
    for name, case in ROBOT_CASES.items():
        numbers = [jnp.array(x, float) for x in case]
        along, here = np.asarray(usual(*numbers)), np.asarray(straight(*numbers))
        published, whole = (
            independent.solve(rods(discs, case), axial=axial)[-1] for axial in (False, True)
        )
        pairs = {
            "along the section, straight": (along, here),
            "along the section, published": (along, published),
            "straight, published": (here, published),
            "straight, independent": (here, whole),
        }
        found[name] = {
            pair: float(f"{100 * np.linalg.norm(a - b) / (2 * LENGTH):.3g}")
            for pair, (a, b) in pairs.items()
        }
    return found


def record_of(usual: dict, straight: dict[int, dict]) -> dict[str, Any]:
    """Distance of the tips in percent of the length, and the order between the last two numbers of
    discs, by case."""
    record: dict[str, Any] = {"discs": list(DISCS)}
    for name in CASES:
        errors = [
            100 * np.linalg.norm(straight[n][name][-1] - usual[name][-1]) / LENGTH for n in DISCS
        ]
        order = np.log(errors[-2] / errors[-1]) / np.log(DISCS[-1] / DISCS[-2])
        record[name] = {
            "tension": float(f"{CASES[name].tension:.4g}"),
            "percent": [float(f"{x:.3g}") if np.isfinite(x) else None for x in errors],
            "order": round(float(order), 2),
        }
    return record


def draw(path: str, record: dict, usual: dict, straight: dict[int, dict]) -> None:
    """The errors over the number of discs, and the shapes of one bend."""
    figure = Figure(figsize=(10.5, 5.6), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1))
    _errors(left, record)
    name = "180 degrees"
    right.plot(*(1e3 * usual[name][:, :2].T), color="black", lw=1.2, label="along the section")
    for n, colour in zip((3, 5, 10), ("#d55e00", "#0072b2", "#009e73"), strict=True):
        right.plot(*(1e3 * straight[n][name][:, :2].T), color=colour, label=f"{n} discs")
    right.set(title=f"axis of the arm, {name}", xlabel="x [mm]", ylabel="y [mm]")
    right.set_aspect("equal")
    right.legend(**_BELOW)
    figure.savefig(path, dpi=150)


def _errors(ax: Axes, record: dict) -> None:
    colours = ("#56b4e9", "#0072b2", "#000000", "#d55e00", "#cc79a7")
    for name, colour in zip(CASES, colours, strict=True):
        percent = [np.nan if x is None else x for x in record[name]["percent"]]
        ax.loglog(DISCS, percent, "o-", color=colour, label=name, markersize=4)
    guide = np.array([5.0, 20.0])
    ax.loglog(guide, 0.2 * (guide / 5) ** -2.0, "--", color="grey", lw=1)
    ax.text(9, 0.03, "order 2", color="grey", ha="right")
    ax.set(
        title="error of a tendon along the section",
        xlabel="number of discs",
        ylabel="distance of the tips [% of the length]",
    )
    ax.set_xticks(DISCS, [str(n) for n in DISCS])
    ax.set_yticks([0.1, 1, 10, 100], ["0.1", "1", "10", "100"])
    ax.minorticks_off()
    ax.grid(alpha=0.3)
    ax.legend(**_BELOW)


def main() -> None:
    """Solves all cases; prints a table, writes JSON and the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--plot", metavar="FILE")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    usual = shapes(None)
    straight = {n: shapes(n) for n in DISCS}
    record = record_of(usual, straight)
    print("discs:", *DISCS)
    for name in CASES:
        print(
            f"{name}:", *record[name]["percent"], f"% of the length, order {record[name]['order']}"
        )
    record["robot"] = {str(n): compared(n) for n in ROBOT_DISCS}
    for n, cases in record["robot"].items():
        print(f"robot with {n} discs in each section, distance of the tips [% of the length]")
        for name, pairs in cases.items():
            print(f"  {name}:", ", ".join(f"{pair} {x}" for pair, x in pairs.items()))
    if options.json:
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if options.plot:
        draw(options.plot, record, usual, straight)


if __name__ == "__main__":
    main()
