"""Time of the stability margin of a loaded catheter, compared with that of its solve and of a dense
eigenvalue problem.

    python benchmarks/bench_stability.py [--json FILE] [--rounds N]

Two sections, eight tendons, gravity and a force on the tip; all programs are timed in turn in one
run. "dense" differentiates the residual with respect to every strain and computes all eigenvalues
by LAPACK. It leaves out nodes on pieces of zero length, where it would compute 0 / 0. "gradient" is
that of the margin with respect to the tensions, through the solve.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.elements.problem import loading
from vsr_jax.mechanics.balance import residual
from vsr_jax.mechanics.reaction import react
from vsr_jax.solution.equilibrium import Equilibrium
from vsr_jax.solution.stability import extreme
from vsr_jax.studies.timing import Timed, machine, primitives, take_turns

TENSIONS = [3.0, 1.0, 0.0, 0.5, 2.0, 0.0, 1.0, 0.5]


def catheter() -> vsr.Scene:
    """Nitinol wire of 0.4 m with discs of 10 mm radius, four tendons to its middle and four to its
    tip."""
    rod = vsr.Rod(
        0.4,
        vsr.Circular(0.0007),
        vsr.Material(54e9, poisson=0.3, density=6450),
        discs=vsr.Discs(10, radius=0.0101),
    )
    places = [(0.01, 0.0), (0.0, 0.01), (-0.01, 0.0), (0.0, -0.01)]
    tendons = [vsr.Tendon(vsr.Parallel(y, z), end=end) for end in (0.2, None) for y, z in places]
    return vsr.Scene(rod, tendons, [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.0, 0.1))])


def dense(eq: Equilibrium, there: np.ndarray) -> jax.Array:
    """Least and greatest eigenvalue of the symmetric part of the scaled tangent, without the
    Lanczos method; `there`: indices of the unknowns at nodes with a positive weight."""
    nodes, tau = eq.nodes, eq.nodes.tau(eq.sound_forces)
    grid, loads = nodes.grid, loading(eq.scene, nodes.grid)
    assert loads is not None
    still = jnp.stack(nodes.xi)

    def imbalance(values: jax.Array) -> jax.Array:
        xi = tuple(values.reshape(still.shape))
        wrench = tuple(react(xi, grid, loads).wrench)
        return jnp.stack(residual(xi, nodes.sections, tau, wrench)).reshape(-1)

    jacobian = jax.jacfwd(imbalance)(still.reshape(-1))
    weight = jnp.broadcast_to(grid.weight, still.shape).reshape(-1)
    stiffness = jnp.stack(
        [jnp.broadcast_to(s, grid.X.shape) for s in nodes.sections.stiffness]
    ).reshape(-1)
    root = jnp.sqrt(weight * stiffness)[there]
    scaled = (weight[:, None] * jacobian)[there][:, there] / (root[:, None] * root[None, :])
    return jnp.linalg.eigvalsh(0.5 * (scaled + scaled.T))[jnp.array([0, -1])]


def main() -> None:
    """Run the benchmark and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path, help="also write the results to this file")
    parser.add_argument("--rounds", type=int, default=15)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scene, model, inputs = catheter(), vsr.StrainDependent(), jnp.array(TENSIONS)
    eq = vsr.solve(scene, inputs, model=model)
    there = np.flatnonzero(np.tile(np.asarray(model.grid(scene).weight).reshape(-1), 6))

    def solved(scene: vsr.Scene, inputs: jax.Array) -> Any:
        return eqx.filter(vsr.solve(scene, inputs, model=model), eqx.is_array)

    def margin(eq: Equilibrium) -> Any:
        return extreme(eq.scene, eq.inputs, eq.sound_forces, eq.nodes)

    def slope(scene: vsr.Scene, inputs: jax.Array) -> Any:
        return jax.grad(lambda inputs: vsr.solve(scene, inputs, model=model).stability)(inputs)

    programs = {
        "solve": (solved, (scene, inputs), 10),
        "margin": (margin, (eq,), 10),
        "dense": (lambda eq: dense(eq, there), (eq,), 1),
        "gradient": (slope, (scene, inputs), 3),
    }
    jobs = {
        name: Timed(function, *args, calls=calls)
        for name, (function, args, calls) in programs.items()
    }
    take_turns(jobs.values(), options.rounds)
    equations = {
        name: primitives(jax.make_jaxpr(function)(*args)).total()
        for name, (function, args, _) in programs.items()
    }
    rows = {name: job.summary() | {"equations": equations[name]} for name, job in jobs.items()}
    difference = float(
        np.max(np.abs(np.array(jobs["margin"].output) - np.asarray(jobs["dense"].output)[0]))
    )
    report = {
        "machine": machine(),
        "jax": jax.__version__,
        "tensions": TENSIONS,
        "margin": float(eq.stability),
        "rows": rows,
    }
    report |= {"difference from dense": difference}
    for name in ("margin", "dense", "gradient"):
        report[f"{name} / solve"] = rows[name]["median_us"] / rows["solve"]["median_us"]
    print(
        f"{report['machine']}, jax {report['jax']}; margin {report['margin']:.6f}, differs from "
        f"the dense one by {difference:.1e}"
    )
    print(
        "| program | ms, median (10 %-90 %) | per solve time | compile [s] | equations |\n|"
        + "---|" * 5
    )
    for name, row in rows.items():
        low, mid, high = (1e-3 * row[key] for key in ("low_us", "median_us", "high_us"))
        share = row["median_us"] / rows["solve"]["median_us"]
        print(
            f"| {name} | {mid:.2f} ({low:.2f}-{high:.2f}) | {share:.2f} | {row['compile_s']:.1f} "
            f"| {row['equations']} |"
        )
    if options.json:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
