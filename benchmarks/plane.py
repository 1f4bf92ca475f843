"""Stability margin and convergence of one arm over a plane of tension and pressure, and the results
of SoRoMoX for the same inputs.

The arm is a stout silicone arm with a tendon that converges towards the axis and a chamber opposite
to it. Run it, after `pip install ".[bench]"`, with

    python benchmarks/plane.py --plot benchmarks/results/plane.png
        --json benchmarks/results/plane.json

SoRoMoX (0.5) has no static solver. It is used as its authors do: Newton's method from rest on its
own forces, K q = A(q) u, with Legendre polynomials of order 6 for all six strains. A shape counts
as right if its tip is within 1 % of the length of that of vsr_jax with 96 steps, which is exact in
the strain. Both tools use float64.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Patch

import vsr_jax as vsr

LENGTH, RADIUS, YOUNG, POISSON = 0.12, 0.015, 6e5, 0.45
AREA = 2e-4
TENDON, CHAMBER = (0.008, -0.05), (-0.008, 0.0)
"""Position of tendon and chamber at the base [m], and their slope [m/m]."""
MOST_TENSION, MOST_PRESSURE = 220.0, 12e5
SAME = 0.01
RIGHT, SILENT, UNSAID, DIVERGED = (
    "right",
    "wrong shape",
    "a shape where none is stable",
    "residual left, or NaN",
)


def planes(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Tensions [N] and pressures [Pa], `size` of each."""
    return np.linspace(0, MOST_TENSION, size), np.linspace(0, MOST_PRESSURE, size)


def ours(inputs: np.ndarray) -> tuple[np.ndarray, ...]:
    """Status, margin and tip [m] for tension and pressure, shape (n, 2)."""
    material = vsr.Material(YOUNG, poisson=POISSON)
    paths = [vsr.Linear(y=0.0, z=z, slope_y=0.0, slope_z=slope) for z, slope in (TENDON, CHAMBER)]
    scene = vsr.Scene(
        vsr.Rod(LENGTH, vsr.Circular(RADIUS), material),
        [vsr.Tendon(paths[0]), vsr.Chamber(paths[1], area=AREA)],
    )

    def at(inputs: jax.Array) -> tuple:
        eq = vsr.solve(scene, inputs, model=vsr.StrainDependent(96))
        return eq.status, eq.stability, eq.tip[:3, 3]

    return tuple(np.asarray(x) for x in jax.jit(jax.vmap(at))(jnp.asarray(inputs)))


def soromox(inputs: np.ndarray, order: int = 6, points: int = 40) -> tuple[np.ndarray, ...]:
    """Dimensionless residual and tip [m] of SoRoMoX's own forces, solved by Newton's method from
    rest."""
    from soromox.actuation import ThreadlikeActuator, ThreadlikeRouting  # pyright: ignore[reportMissingImports]
    from soromox.systems.components import JointSpec, LinkSpec  # pyright: ignore[reportMissingImports]
    from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec  # pyright: ignore[reportMissingImports]
    from soromox.utils.geometry.poses import spatial_mounting_pose  # pyright: ignore[reportMissingImports]

    shear = YOUNG / (2 * (1 + POISSON))
    straight = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]
    link = LinkSpec.circular(
        length=LENGTH,
        radius=RADIUS,
        density=1000.0,
        reference_strain=straight,
        young_modulus=YOUNG,
        shear_modulus=shear,
    )
    basis = StrainBasisSpec(type="legendre", strain_selector=[1] * 6, basis_order=order)
    segment = GVSSegment(
        link=link, joint=JointSpec(type="fixed"), basis=basis, num_gauss_points=points
    )
    starts, slopes = (
        jnp.array([[0.0, 0.0, path[i]] for path in (TENDON, CHAMBER)]) for i in (0, 1)
    )
    tendons = ThreadlikeActuator.tendons(ThreadlikeRouting.linear(intercept=starts, slope=slopes))
    mounting = spatial_mounting_pose("horizontal")
    robot = GVS.from_segments(
        [segment], gravity=jnp.zeros(3), base_pose=mounting, actuators=tendons
    )
    K = robot.stiffness_matrix()

    def at(inputs: jax.Array) -> tuple:
        tensions = inputs * jnp.array([1.0, -AREA])

        def residual(q: jax.Array) -> jax.Array:
            return robot.elastic_force(q) - robot.actuation_force(q, tensions)

        def step(q: jax.Array, _: None) -> tuple[jax.Array, None]:
            return q - jnp.linalg.solve(jax.jacfwd(residual)(q), residual(q)), None

        q, _ = jax.lax.scan(step, jnp.zeros(len(K)), None, 50)
        r = residual(q)
        left = jnp.sqrt(r @ jnp.linalg.solve(K, r) / (YOUNG * jnp.pi * RADIUS**2 * LENGTH))
        return left, robot._forward_kinematics_gauss(robot._min_size_gathered(q))[0, -1, :3, 3]

    return tuple(
        np.asarray(x) for x in jax.lax.map(jax.jit(at), jnp.asarray(inputs), batch_size=64)
    )


def verdicts(
    status: np.ndarray, tip: np.ndarray, left: np.ndarray, other: np.ndarray
) -> np.ndarray:
    """Verdicts on the results of SoRoMoX, given those of vsr_jax."""
    converged = left < 1e-6
    same = np.linalg.norm(tip - other, axis=-1) < SAME * LENGTH
    known = status == vsr.Status.CONVERGED
    return np.where(~converged, DIVERGED, np.where(~known, UNSAID, np.where(same, RIGHT, SILENT)))


COLOURS = {RIGHT: "#dddddd", SILENT: "#d55e00", UNSAID: "#cc79a7", DIVERGED: "#0072b2"}
FAILED = {
    vsr.Status.COLLAPSED: "#f0e442",
    vsr.Status.UNSTABLE: "#009e73",
    vsr.Status.UNDER_RESOLVED: "#e69f00",
    vsr.Status.NOT_CONVERGED: "#000000",
}


def draw(
    path: str, size: int, status: np.ndarray, margin: np.ndarray, said: np.ndarray | None
) -> None:
    """The two planes side by side."""
    tensions, pressures = planes(size)
    pressures = pressures / 1e5
    figure = Figure(figsize=(10, 5), layout=ConstrainedLayoutEngine(rect=(0, 0.17, 1, 0.83)))
    axes = figure.subplots(1, 2, sharey=True)

    def cells(ax: Axes, labels: np.ndarray, colours: dict) -> None:
        for label, colour in colours.items():
            mine = np.ma.masked_where(labels.reshape(size, size) != label, np.ones((size, size)))
            ax.pcolormesh(
                tensions, pressures, mine, cmap=ListedColormap([colour]), shading="nearest"
            )

    def below(ax: Axes, names: list[Patch]) -> None:
        ax.legend(
            handles=names,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.12),
            ncols=1 if len(names) > 2 else 2,
            frameon=False,
        ).set_in_layout(False)

    cells(axes[0], status, FAILED)
    shown = np.where(status == vsr.Status.CONVERGED, margin, np.nan).reshape(size, size)
    image = axes[0].pcolormesh(
        tensions, pressures, shown, cmap="Blues_r", vmin=0, vmax=1, shading="nearest"
    )
    figure.colorbar(image, ax=axes[0], label="stability margin")
    axes[0].contour(tensions, pressures, shown, levels=[0.1, 0.3], colors="white", linewidths=0.8)
    names = [
        Patch(color=colour, label=key.name.lower().replace("_", " "))
        for key, colour in FAILED.items()
        if np.any(status == key)
    ]
    below(axes[0], names)
    axes[0].set(title="vsr_jax", xlabel="tension [N]", ylabel="pressure [bar]")
    if said is not None:
        cells(axes[1], said, COLOURS)
        shares = {key: np.mean(said == key) for key in COLOURS}
        names = [
            Patch(color=COLOURS[key], label=f"{key}: {share:.0%}")
            for key, share in shares.items()
            if share > 0
        ]
        below(axes[1], names)
    axes[1].set(title="SoRoMoX 0.5, Newton from rest", xlabel="tension [N]")
    figure.savefig(path, dpi=150)


def main() -> None:
    """Runs both tools on the same inputs; prints counts, writes JSON and the figure."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=41, help="points per side (%(default)s)")
    parser.add_argument("--plot", metavar="FILE")
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    tensions, pressures = planes(options.size)
    inputs = np.stack(np.meshgrid(tensions, pressures), -1).reshape(-1, 2)
    status, margin, tip = ours(inputs)
    record: dict = {"vsr_jax": dict(Counter(vsr.Status(int(x)).name.lower() for x in status))}
    try:
        said = verdicts(status, tip, *soromox(inputs))
    except ImportError:
        print('SoRoMoX is not installed, need pip install ".[bench]"')
        said = None
    else:
        record["soromox"] = dict(Counter(said.tolist()))
    for name, counts in record.items():
        print(f"{name}: " + ", ".join(f"{count} {what}" for what, count in counts.items()))
    if options.json:
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    if options.plot:
        draw(options.plot, options.size, status, margin, said)


if __name__ == "__main__":
    main()
