"""Search for wrong shapes with a converged status: hypothesis draws arms of all sizes, threads,
loads and forces.

For each solve that converges, independent code computes the residual from the strains and the
numbers of the scene; the gradient must be finite; and a solve with twice the steps must give the
same shape. A solve that fails must have a status and return NaN. Run it with

    python benchmarks/hard_search.py --json benchmarks/results/hard_search.json

The tests run two hundred examples, with threads alone.
"""

import argparse
import json
import math
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, given, settings, strategies as st

import vsr_jax as vsr
from vsr_jax.mechanics.resolution import COARSE

STEPS = 16
SAME = COARSE
"""Largest distance between the tips of a solve and of one with twice the steps, as a share of the
length: the error that a converged status allows."""
BALANCED = 1e-9, 0.05
"""Largest imbalance as a share of the wrenches: for threads alone, due to rounding; with loads, due
to the steps along the arm."""
STATIONS = 401


class Draw(NamedTuple):
    """An arm in dimensionless numbers, except for its length [m] and modulus [Pa]: ratio of length
    to diameter, ratio of the radii of tip and base, curvature at rest in units of 1 / L, threads
    (place relative to the radius, phase, turns), forces in units of $EI / (L d)$ or EA, weight
    $\\rho g A L^3 / EI$, direction of gravity, force and moment at the tip in units of $EI / L^2$
    and $EI / L$."""

    length: float
    young: float
    slenderness: float
    tip: float
    curved: float
    place: tuple[float, float]
    phase: tuple[float, float]
    turns: tuple[float, float]
    force: tuple[float, float]
    weight: float
    down: float
    tip_force: tuple[float, float, float]
    tip_moment: tuple[float, float, float]


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """Powers of ten with exponents between two bounds."""
    return st.floats(low, high).map(lambda exponent: 10.0**exponent)


def signed(low: float, high: float) -> st.SearchStrategy[float]:
    """Powers of ten with either sign, or zero."""
    return st.one_of(st.just(0.0), powers(low, high), powers(low, high).map(lambda x: -x))


def draws(loaded: bool) -> st.SearchStrategy[Draw]:
    """Arms, with loads or without."""
    load = signed(-3, 1.5) if loaded else st.just(0.0)
    pair = st.tuples(st.floats(0.01, 0.95), st.floats(0.01, 0.95))
    return st.builds(
        Draw,
        length=powers(-3, 1),
        young=powers(3, 11.3),
        slenderness=powers(0.5, 3),
        tip=powers(-1.3, 0),
        curved=st.floats(-6, 6),
        place=pair,
        phase=st.tuples(st.floats(0, 6.3), st.floats(0, 6.3)),
        turns=st.tuples(powers(-6, 1.7), powers(-6, 1.7)),
        force=st.tuples(signed(-6, 1.5), signed(-6, 1.5)),
        weight=powers(-3, 2.5) if loaded else st.just(0.0),
        down=st.floats(0, 3.2),
        tip_force=st.tuples(load, load, load),
        tip_moment=st.tuples(load, load, load),
    )


def built(draw: Draw) -> tuple[vsr.Scene, np.ndarray]:
    """Scene and thread forces [N]."""
    L, radius = draw.length, draw.length / (2 * draw.slenderness)
    axial = draw.young * math.pi * radius**2
    bending = axial * radius**2 / 4
    weight = 9.81 * math.pi * radius**2 * L**3 / bending  # of a density of one
    material = vsr.Material(draw.young, poisson=0.45, density=max(draw.weight, 1e-12) / weight)
    rest = (0.0, 0.0, draw.curved / L, 1.0, 0.0, 0.0)
    rod = vsr.Rod(
        L,
        vsr.Circular(vsr.Taper(radius, draw.tip * radius)),
        material,
        rest_strain=rest,
        discs=vsr.Discs(10, radius=2 * radius),
    )
    threads = [
        vsr.Thread(vsr.Helix(place * radius, pitch=L / turns, phase=phase))
        for place, phase, turns in zip(draw.place, draw.phase, draw.turns, strict=True)
    ]
    loads = []
    if draw.weight > 0:
        loads.append(vsr.Gravity((9.81 * math.sin(draw.down), 0.0, -9.81 * math.cos(draw.down))))
        force = tuple(bending / L**2 * x for x in draw.tip_force)
        loads.append(
            vsr.TipWrench(force=force, moment=tuple(bending / L * x for x in draw.tip_moment))
        )
    forces = [
        min(axial, bending / (L * place * radius)) * f
        for f, place in zip(draw.force, draw.place, strict=True)
    ]
    return vsr.Scene(rod, threads, loads), np.array(forces)


class Answer(NamedTuple):
    """Status, tip [m], strains at the stations and gradient of the tip of a solve; status and tip
    with twice the steps."""

    status: np.ndarray
    tip: np.ndarray
    strain: np.ndarray
    gradient: np.ndarray
    fine_status: np.ndarray
    fine_tip: np.ndarray


@jax.jit
def answer(scene: vsr.Scene, forces: jax.Array) -> Answer:
    """Both solves of a scene."""

    def tip(forces: jax.Array, steps: int) -> tuple:
        eq = vsr.solve(scene, forces, model=vsr.StrainDependent(steps))
        return eq.tip[:3, 3], eq

    place, pull, eq = jax.vjp(lambda f: tip(f, STEPS), forces, has_aux=True)
    fine, other = tip(forces, 2 * STEPS)
    strain = eq.strain(jnp.linspace(0.0, 1.0, STATIONS) * scene.rod.length)
    return Answer(eq.status, place, strain, pull(jnp.ones(3))[0], other.status, fine)


def rotation(k: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector, by Rodrigues' formula."""
    angle = math.sqrt(k @ k)
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    a, b = (
        (1 - angle**2 / 6, 0.5 - angle**2 / 24)
        if angle < 1e-4
        else (math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2)
    )
    return np.eye(3) + a * K + b * K @ K


def shape(strain: np.ndarray, length: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and positions at the stations, by midpoint steps."""
    h, R, r = length / (len(strain) - 1), np.eye(3), np.zeros(3)
    rotations, positions = [R], [r]
    for a, b in pairwise(strain):
        xi = 0.5 * (a + b)
        r = r + h * R @ rotation(0.5 * h * xi[:3]) @ xi[3:]
        R = R @ rotation(h * xi[:3])
        rotations.append(R)
        positions.append(r)
    return np.array(rotations), np.array(positions)


def residual(draw: Draw, forces: np.ndarray, strain: np.ndarray) -> float:
    """Largest imbalance of a cross-section between the first and the last node, as a share of the
    wrenches in balance there."""
    L, base = draw.length, draw.length / (2 * draw.slenderness)
    X = np.linspace(0, L, len(strain))
    radius = base * (1 + (draw.tip - 1) * X / L)
    area, second = math.pi * radius**2, math.pi * radius**4 / 4
    shear = draw.young / 2.9
    stiffness = np.stack(
        [2 * shear * second, *[draw.young * second] * 2, draw.young * area, *[shear * area] * 2], 1
    )
    elastic = stiffness * (strain - np.array([0, 0, draw.curved / L, 1, 0, 0]))
    sizes, total = np.abs(elastic), elastic.copy()
    for place, phase, turns, force in zip(draw.place, draw.phase, draw.turns, forces, strict=True):
        turn = 2 * math.pi * turns / L
        d = place * base * np.stack([0 * X, np.cos(phase + turn * X), np.sin(phase + turn * X)], 1)
        slope = (
            turn
            * place
            * base
            * np.stack([0 * X, -np.sin(phase + turn * X), np.cos(phase + turn * X)], 1)
        )
        t = np.cross(strain[:, :3], d) + strain[:, 3:] + slope
        t /= np.linalg.norm(t, axis=1, keepdims=True)
        wrench = force * np.concatenate([np.cross(d, t), t], 1)
        total, sizes = total - wrench, sizes + np.abs(wrench)
    if draw.weight > 0:
        asked = reaction(draw, strain)
        total, sizes = total - asked, sizes + np.abs(asked)
    scale = np.sqrt(stiffness)
    rounding = 1e-3 * np.sqrt(stiffness[0, 3])  # a billionth of that is 1e-12 as a strain
    seen = np.abs(X / L - 0.5) < 0.5 - 0.12 / STEPS
    return float(
        np.max(np.linalg.norm(total / scale, axis=1)[seen])
        / (np.max(np.linalg.norm(sizes / scale, axis=1)) + rounding)
    )


def reaction(draw: Draw, strain: np.ndarray) -> np.ndarray:
    """Internal wrench at each station that balances the loads beyond it, in the body frame."""
    L, base = draw.length, draw.length / (2 * draw.slenderness)
    bending = draw.young * math.pi * base**4 / 4
    R, r = shape(strain, L)
    X = np.linspace(0, L, len(strain))
    weight = draw.weight * bending / L**3 * (1 + (draw.tip - 1) * X / L) ** 2
    down = np.array([math.sin(draw.down), 0, -math.cos(draw.down)])
    mass = np.concatenate(
        [np.cumsum((0.5 * (weight[1:] + weight[:-1]) * L / (len(X) - 1))[::-1])[::-1], [0.0]]
    )
    moments = 0.5 * (weight[1:, None] * r[1:] + weight[:-1, None] * r[:-1]) * L / (len(X) - 1)
    first = np.concatenate([np.cumsum(moments[::-1], axis=0)[::-1], np.zeros((1, 3))])
    tip = bending / L**2 * np.array(draw.tip_force)
    force = mass[:, None] * down + tip
    moment = (
        bending / L * np.array(draw.tip_moment)
        + np.cross(r[-1] - r, tip)
        + np.cross(first - mass[:, None] * r, down)
    )
    return np.concatenate(
        [np.einsum("nji,nj->ni", R, moment), np.einsum("nji,nj->ni", R, force)], 1
    )


def verdict(draw: Draw) -> str:
    """Verdict on a draw: the name of its status, or the fault of a converged solve."""
    scene, forces = built(draw)
    found = jax.tree.map(np.asarray, answer(scene, jnp.asarray(forces)))
    status = vsr.Status(int(found.status))
    if status != vsr.Status.CONVERGED:
        return status.name.lower() if np.all(np.isnan(found.tip)) else "wrong: failed, with a shape"
    if not np.all(np.isfinite(found.gradient)):
        return "wrong: no gradient"
    if found.fine_status != vsr.Status.CONVERGED:
        return (
            f"converged, but twice the steps say {vsr.Status(int(found.fine_status)).name.lower()}"
        )
    known = not np.any(np.isnan(found.strain))
    if known and not residual(draw, forces, found.strain) < BALANCED[draw.weight > 0]:
        return "wrong: not in balance"
    if not np.linalg.norm(found.fine_tip - found.tip) <= SAME * draw.length:
        return "wrong: another shape with twice the steps"
    return "converged" if known else "converged, but no strain between two nodes"


def search(examples: int, loaded: bool) -> tuple[Counter, list[tuple[str, Draw]]]:
    """Verdicts on reproducible random draws, and the draws that are wrong or in doubt."""
    counts, wrong = Counter(), []

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(draws(loaded))
    def look(draw: Draw) -> None:
        said = verdict(draw)
        counts[said] += 1
        if said.startswith(("wrong", "converged, but")):
            wrong.append((said, draw))

    look()
    return counts, wrong


def main() -> None:
    """Searches without and with loads, and prints the verdicts."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--examples", type=int, default=10_000, help="with threads alone (default: %(default)s)"
    )
    parser.add_argument(
        "--loaded",
        type=int,
        default=1_000,
        help="with loads, each about forty times slower (default: %(default)s)",
    )
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record = {}
    for loaded, examples in ((False, options.examples), (True, options.loaded)):
        counts, wrong = search(examples, loaded)
        name = "with loads" if loaded else "threads alone"
        record[name] = {
            "verdicts": dict(counts.most_common()),
            "draws": [[said, draw._asdict()] for said, draw in wrong],
        }
        print(f"{name}: " + ", ".join(f"{count} {said}" for said, count in counts.most_common()))
        for said, draw in wrong[:20]:
            print(f"  {said}: {draw}")
    if options.json:
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
