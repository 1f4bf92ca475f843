"""Reliability of error estimates and tolerances on 200 random arms, with a fixed seed.

    pip install . && python benchmarks/honest_errors.py [--scenes 50] [--json FILE]

Four kinds of arms, each drawn 50 times: one helical thread; a helix and an oblique thread; a
polynomial and a straight thread; a helix under gravity with a force and a moment at the tip.
Length, taper, modulus, routing, forces and loads are drawn. True errors are distances of the tip to
a solution of 160 steps (96 under loads); errors at the level of rounding are counted separately.
The tolerance of each arm is drawn between 1e-7 and 1e-2 of its length; the error of
`solve(..., tolerance=...)` is compared with it.
"""

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

SEED = 6
ROUNDED = 1e-11
"""Tip error, as a share of the length, below which only rounding remains."""
MODELS = {
    "8 steps": vsr.StrainDependent(8),
    "16 steps": vsr.StrainDependent(16),
    "32 steps": vsr.StrainDependent(32),
    "16 steps of order 4": vsr.StrainDependent(16, 4),
    "Legendre 6": vsr.Prescribed(vsr.Basis.uniform(vsr.Legendre(6))),
}


class Drawn(NamedTuple):
    """Scenes stacked along their first axis, inputs [N] of each, and a tolerance [m] for each."""

    scenes: vsr.Scene
    inputs: jax.Array
    tolerances: np.ndarray


def arm(random: np.random.Generator) -> tuple[vsr.Rod, float, float]:
    """An arm, its base radius, and the force [N] by which a thread on half that radius bends it by
    one radian."""
    length, slender = 10 ** random.uniform(-1.5, 0.5), random.uniform(10, 80)
    radius, young = length / (2 * slender), 10 ** random.uniform(5, 7)
    rod = vsr.Rod(
        length,
        vsr.Circular(vsr.Taper(radius, random.uniform(0.5, 1.0) * radius)),
        vsr.Material(young, poisson=0.45, density=1000.0),
    )
    return rod, radius, young * np.pi * radius**4 / 4 / (length * radius / 2)


def helix(random: np.random.Generator, rod: vsr.Rod, radius: float) -> vsr.Helix:
    turns = 10 ** random.uniform(-0.5, 0.9)
    return vsr.Helix(
        random.uniform(0.1, 0.45) * radius,
        pitch=float(rod.length) / turns,
        phase=random.uniform(0, 6),
    )


def one(random: np.random.Generator) -> tuple[vsr.Scene, list[float]]:
    rod, radius, force = arm(random)
    return vsr.Scene(rod, [vsr.Tendon(helix(random, rod, radius))]), [
        force * random.uniform(0.3, 4)
    ]


def two(random: np.random.Generator) -> tuple[vsr.Scene, list[float]]:
    rod, radius, force = arm(random)
    y, z = random.uniform(-0.25, 0.25, 2) * radius
    oblique = vsr.Linear(y, z, *(random.uniform(-0.2, 0.2, 2) * radius / float(rod.length)))
    return vsr.Scene(rod, [vsr.Tendon(helix(random, rod, radius)), vsr.Tendon(oblique)]), list(
        force * random.uniform(0.3, 2, 2)
    )


def bent(random: np.random.Generator) -> tuple[vsr.Scene, list[float]]:
    rod, radius, force = arm(random)
    powers = float(rod.length) ** -np.arange(4.0)
    y, z = (0.1 * radius * random.uniform(-1, 1, 4) * powers for _ in range(2))
    threads = [vsr.Tendon(vsr.Polynomial(y, z)), vsr.Tendon(vsr.Parallel(0.0, 0.3 * radius))]
    return vsr.Scene(rod, threads), list(force * random.uniform(0.3, 2, 2))


def loaded(random: np.random.Generator) -> tuple[vsr.Scene, list[float]]:
    rod, radius, force = arm(random)
    bending = force * radius / 2 * float(rod.length)  # EI
    weight = 1000 * 9.81 * np.pi * radius**2 * float(rod.length) ** 3 / bending
    gravity = vsr.Gravity(tuple(9.81 * min(1.0, 3 / weight) * x for x in _direction(random)))
    tip = vsr.TipWrench(
        force=tuple(bending / float(rod.length) ** 2 * random.uniform(-1, 1, 3)),
        moment=tuple(bending / float(rod.length) * random.uniform(-0.5, 0.5, 3)),
    )
    return vsr.Scene(rod, [vsr.Tendon(helix(random, rod, radius))], [gravity, tip]), [
        force * random.uniform(0.3, 2)
    ]


def _direction(random: np.random.Generator) -> np.ndarray:
    way = random.normal(size=3)
    return way / np.linalg.norm(way)


KINDS: dict[str, Callable[[np.random.Generator], tuple[vsr.Scene, list[float]]]] = {
    "helix": one,
    "helix and oblique thread": two,
    "polynomial and straight thread": bent,
    "helix under loads": loaded,
}


def draw(kind: str, number: int, random: np.random.Generator) -> Drawn:
    """Arms of a kind."""
    scenes, inputs = zip(*(KINDS[kind](random) for _ in range(number)), strict=True)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *scenes)
    lengths = np.array([float(scene.rod.length) for scene in scenes])
    return Drawn(stacked, jnp.asarray(inputs), lengths * 10 ** random.uniform(-7, -2, number))


def tips(
    drawn: Drawn, model: vsr.StrainDependent | vsr.Prescribed, *, error: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Position of each tip [m], and the estimated error."""

    def of(scene: vsr.Scene, inputs: jax.Array) -> tuple[jax.Array, jax.Array]:
        eq = vsr.solve(scene, inputs, model=model)
        return eq.tip[:3, 3], eq.error.tip if error else jnp.zeros_like(inputs[0])

    place, estimate = jax.jit(jax.vmap(of))(drawn.scenes, drawn.inputs)
    return np.asarray(place), np.asarray(estimate)


def study(kind: str, number: int, random: np.random.Generator) -> dict[str, Any]:
    """Ratios of estimated to true errors by model, and ratios of the errors at the chosen steps to
    the tolerances."""
    drawn = draw(kind, number, random)
    exact, _ = tips(
        drawn, vsr.StrainDependent(96 if kind == "helix under loads" else 160), error=False
    )
    length = np.asarray(drawn.scenes.rod.length)
    found: dict[str, Any] = {}
    for name, model in MODELS.items():
        place, estimate = tips(drawn, model, error=True)
        true = np.linalg.norm(place - exact, axis=1)
        solved = np.isfinite(true)
        counts = solved & (true > ROUNDED * length)
        found[name] = {
            "solved": int(solved.sum()),
            "at most the estimate": int(np.sum(true[solved] <= estimate[solved])),
            "above rounding": int(counts.sum()),
            "ratios": sorted((estimate[counts] / true[counts]).tolist()),
        }
    return {"estimates": found, "tolerances": _tolerances(drawn, exact)}


def _tolerances(drawn: Drawn, exact: np.ndarray) -> dict[str, Any]:
    steps: list[int] = []
    errors: list[float] = []
    for i, tolerance in enumerate(drawn.tolerances):
        scene = jax.tree.map(lambda leaf, i=i: leaf[i], drawn.scenes)
        eq = vsr.solve(scene, drawn.inputs[i], tolerance=float(tolerance))
        steps.append(getattr(eq.model, "steps", 0))
        errors.append(float(np.linalg.norm(np.asarray(eq.tip)[:3, 3] - exact[i])))
    shares = np.array(errors) / drawn.tolerances
    solved = np.isfinite(shares)
    return {
        "steps": steps,
        "error by tolerance": shares[solved].tolist(),
        "solved": int(solved.sum()),
        "met": int(np.sum(shares[solved] <= 1)),
    }


def summary(results: dict[str, Any]) -> list[str]:
    """The results as lines of text."""
    text = []
    for name in MODELS:
        rows = [kind["estimates"][name] for kind in results.values()]
        solved, honest = (
            sum(row[key] for row in rows) for key in ("solved", "at most the estimate")
        )
        ratios = np.concatenate([row["ratios"] for row in rows])
        low, median, high = np.quantile(ratios, [0.05, 0.5, 0.95])
        text.append(
            f"{name}: {honest} of {solved} true errors at most the estimate; above rounding that "
            f"is {median:.2f} times the true error "
            f"(5 to 95 %: {low:.2f} to {high:.2f}), at most 20 times in "
            f"{100 * np.mean(ratios <= 20):.1f} %"
        )
    met = [kind["tolerances"] for kind in results.values()]
    return [
        *text,
        f"tolerances met: {sum(row['met'] for row in met)} of {sum(row['solved'] for row in met)} "
        f"solved",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenes", type=int, default=50, help="scenes of each kind")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    # nothing is timed
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
    jax.config.update("jax_enable_x64", True)
    random = np.random.default_rng(SEED)
    results = {kind: study(kind, options.scenes, random) for kind in KINDS}
    print("\n".join(summary(results)))
    if options.json:
        Path(options.json).write_text(
            json.dumps({"seed": SEED, "jax": jax.__version__, "kinds": results}, indent=1) + "\n"
        )


if __name__ == "__main__":
    main()
