"""500 statics under gravity and two wrenches, computed with SoroSim by others
(`benchmarks/reference/sorosim`), against this package.

    pip install . && python benchmarks/sorosim_statics.py [--json FILE]

The rod is clamped at the origin, along x, and has a dead wrench in the middle and one at the tip.
For each static: the largest distance of 14 positions along the rod. The inputs of the file are
rounded to 1e-4 N, N m and m/s^2; how far that moves the rod is estimated by random changes of half
a digit.
"""

import argparse
import csv
import json
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

FOLDER = Path(__file__).parent / "reference" / "sorosim"
RODS = {
    "steel": (0.6, 0.8e-3, 200e9, 0.33, 7870.0),
    "tpu": (0.4, 5e-3, 70e6, 0.4, 1200.0),
}
"""Length [m], radius [m], Young's modulus [Pa], Poisson's ratio and density [kg/m^3]."""
STEPS, DIGIT = 24, 1e-4


class Statics(NamedTuple):
    """Statics of a file: `loads`, gravity, moment and force in the middle, moment and force at the
    tip, shape (statics, 5, 3); `X` [m], shape (14,); `positions` [m], shape (statics, 14, 3)."""

    loads: np.ndarray
    X: np.ndarray
    positions: np.ndarray


def read(name: str) -> Statics:
    """The statics of a rod."""
    with (FOLDER / f"{name}.csv").open(newline="") as file:
        _, along, *rows = csv.reader(file)
    halves = np.array(along[4:], float).reshape(2, -1) + np.array([[0.0], [1.0]])
    table = np.array([row[1:] for row in rows], float).reshape(-1, 2, 3, 17)
    moments, forces = table[:, 0], table[:, 1]
    columns = [forces[..., 0], moments[..., 1], forces[..., 1], moments[..., 2], forces[..., 2]]
    return Statics(
        np.stack(columns, axis=1),
        halves.ravel() * RODS[name][0] / 2,
        forces[..., 3:].swapaxes(1, 2),
    )


def solver(name: str, X: np.ndarray) -> Any:
    """Positions and status for the loads of one static."""
    length, radius, young, poisson, density = RODS[name]
    material = vsr.Material(young, poisson=poisson, density=density)
    rod = vsr.Rod(length, vsr.Circular(radius), material)

    def one(loads: jax.Array) -> tuple[jax.Array, jax.Array]:
        gravity, moment, force, tip_moment, tip_force = loads
        middle = vsr.PointWrench(length / 2, force, moment)
        scene = vsr.Scene(
            rod, [], [vsr.Gravity(gravity), middle, vsr.TipWrench(tip_force, tip_moment)]
        )
        eq = vsr.solve(scene, jnp.zeros(0), model=vsr.StrainDependent(STEPS))
        return eq.position(jnp.asarray(X)), eq.status

    return jax.jit(jax.vmap(one))


def compare(name: str) -> dict[str, Any]:
    """Distances [m] to the file, and those that the rounding of its inputs explains."""
    statics = read(name)
    solve = solver(name, statics.X)
    found, status = (np.asarray(x) for x in solve(jnp.asarray(statics.loads)))
    distance = np.linalg.norm(found - statics.positions, axis=2).max(axis=1)
    rounding = np.random.default_rng(0).uniform(-0.5, 0.5, statics.loads.shape) * DIGIT
    moved, _ = solve(jnp.asarray(statics.loads + rounding))
    moves = np.linalg.norm(np.asarray(moved) - found, axis=2).max(axis=1)
    return {
        "statics": len(distance),
        "converged": int(np.sum(status == 0)),
        "median [m]": float(np.median(distance)),
        "largest [m]": float(np.max(distance)),
        "rounding of the inputs, median [m]": float(np.median(moves)),
        "rounding of the inputs, largest [m]": float(np.max(moves)),
    }


def main() -> None:
    """Compare and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    results = {name: compare(name) for name in RODS}
    for name, row in results.items():
        print(name, *(f"  {key}: {value:.3g}" for key, value in row.items()), sep="\n")
    if options.json:
        options.json.write_text(json.dumps({"steps": STEPS, **results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
