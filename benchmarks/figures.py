"""Figures of arms, workspaces and designs in the style of the package, light and dark.

    python benchmarks/figures.py [--out docs/figures] [--themes light dark] [--dpi 110] [NAME ...]

`tests/test_figures.py` compares them with the images in tests/data/figures, which
`python benchmarks/figures.py --out tests/data/figures --themes light --dpi 50` writes.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.patches import Circle

import vsr_jax as vsr
from benchmarks import six_rods
from benchmarks.designs import arm as wire, s_curve
from vsr_jax import annotate, plot, plot_design
from vsr_jax.arm.placement import Direction
from vsr_jax.optimization.descent import History
from vsr_jax.optimization.problem import Terms
from vsr_jax.viz.space import equal_scale, fill, world_frame
from vsr_jax.viz.style import ink, mixed

FOLDER = Path(__file__).parents[1]
MODEL = vsr.StrainDependent(12)


def soft_scene() -> vsr.Scene:
    """A silicone cone with a pressure chamber, tendons, its weight and a force at its tip."""
    rod = vsr.Rod(
        0.3,
        vsr.Circular(vsr.Taper(0.012, 0.008)),
        vsr.Material(6e5, poisson=0.45, density=1080.0),
    )
    threads = [
        vsr.Chamber(vsr.Parallel(0.0, -0.004), area=2e-5),
        vsr.Tendon(vsr.Helix(radius=0.006, pitch=0.6)),
        vsr.Tendon(vsr.Parallel(0.006, 0.0)),
    ]
    return vsr.Scene(rod, threads, [vsr.Gravity(), vsr.TipWrench(force=(0.0, 0.05, 0.0))])


def soft_arm() -> Any:
    return plot.arm(vsr.solve(soft_scene(), [5e4, 4.0, 0.0], model=MODEL)).figure


def catheter() -> Any:
    file = vsr.load(FOLDER / "notebooks/scenes/catheter.toml")
    return plot.arm(vsr.solve(file.scene, jnp.asarray(file.inputs), model=MODEL)).figure


def thin_catheter() -> Any:
    """A tube of 2 mm that hangs, with a force and a moment at its tip."""
    rod = vsr.Rod(
        0.3,
        vsr.Annular(0.001, 0.0004),
        vsr.Material(2e8, poisson=0.4, density=1200.0),
        base=vsr.pose(pointing="down"),
    )
    tendons = [vsr.Tendon(vsr.Parallel(y, 0.0)) for y in (0.0007, -0.0007)]
    tip = vsr.TipWrench(force=(0.002, 0.0, 0.0), moment=(0.0, 0.0, 1e-4))
    scene = vsr.Scene(rod, tendons, [vsr.Gravity(), tip])
    return plot.arm(vsr.solve(scene, [0.6, 0.0], model=MODEL)).figure


def failed_solve() -> Any:
    scene = soft_scene()
    return plot.arm(vsr.solve(vsr.Scene(scene.rod, scene.actuators), [0.0, 500.0, 0.0])).figure


def strains() -> Any:
    return plot.strains(vsr.solve(soft_scene(), [5e4, 4.0, 0.0], model=MODEL))[0].figure


def _tips() -> tuple[np.ndarray, np.ndarray]:
    """Inputs and tips of the bare arm, 4,000 samples."""
    scene = soft_scene()
    inputs = np.random.default_rng(0).uniform(size=(4000, 3)) * np.array([1e5, 6.0, 6.0])
    bare = vsr.Scene(scene.rod, scene.actuators)
    tips = jax.jit(jax.vmap(lambda u: vsr.solve(bare, u, model=vsr.StrainDependent(8)).tip))
    return inputs, np.asarray(tips(jnp.asarray(inputs)))[:, :3, 3]


def workspace() -> Any:
    return plot.workspace(_tips()[1])[0].figure


def workspace_by_tension() -> Any:
    inputs, tips = _tips()
    return plot.workspace(tips, values=inputs[:, 1], label="tension [N]")[0].figure


def design() -> Any:
    """The wire that one thread bends into an S, as designed by `benchmarks/designs.py`."""
    file = vsr.load(FOLDER / "benchmarks/results/designed_s.toml")
    none = History(np.zeros((0, 1)), np.zeros((0, 1)))
    inputs = jnp.asarray(file.inputs)[None]
    asked = vsr.objective.CurveError(s_curve(20))
    problem = Terms(wire(0.004), jnp.array([[5.0]]), MODEL, asked, (), {})
    found = vsr.Design(file.scene, inputs, 0.0, True, {}, (), (), 0, none, problem)
    return plot_design.before_after(found).figure


def frame() -> Any:
    """The world's frame, the frames of sections, and the words of `vsr.pose`."""
    figure = plt.figure(figsize=(9.0, 3.6))
    left, right = (figure.add_subplot(1, 2, i, projection="3d") for i in (1, 2))
    rod = vsr.Rod(0.3, vsr.Circular(0.012), vsr.Material(6e5, poisson=0.45))
    eq = vsr.solve(vsr.Scene(rod, [vsr.Tendon(vsr.Parallel(0.0, 0.006))]), [4.0], model=MODEL)
    for ax in (left, right):
        ax.view_init(22, -60)
    plot.arm(eq, left, color="0.5", threads=False)
    annotate.frames(eq, left, stations=4, size=0.045)
    for word in get_args(Direction):
        base = vsr.pose(pointing=word)
        arm = vsr.Rod(0.3, rod.section, rod.material, base=base)
        straight = vsr.solve(vsr.Scene(arm), [], model=MODEL)
        plot.arm(straight, right, color="0.5")
        x, y, z = 0.38 * np.asarray(base)[:3, 0]
        right.text(x, y, z, word, ha="center", va="center", fontsize=8)
    for ax, area, name in (
        (left, (0.0, 0.0, 0.47, 0.93), "sections: x along the arm, y and z across it"),
        (right, (0.5, 0.0, 0.47, 0.93), 'base=vsr.pose(pointing="...")'),
    ):
        equal_scale(ax, thinnest=0.25)
        fill(ax, area)
        world_frame(ax, np.array([0.0, 0.0, -9.81]))
        figure.text(area[0] + area[2] / 2, 0.95, name, ha="center", va="center")
    return figure


def finger() -> Any:
    """The finger of `notebooks/scenes/finger.toml`: shapes with the forces of the ball, and the
    force that it presses with while it closes and opens."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 3.9), width_ratios=(1.15, 1.0))
    file, colors = vsr.load(FOLDER / "notebooks/scenes/finger.toml"), plot.COLORS
    up = np.arange(0.3, 7.3, 0.3)
    tensions = np.concatenate([up, up[-2:7:-1]])
    shown = {1.2: ink(0.4), 3.0: colors[2], 4.8: colors[0], 7.2: colors[1]}
    held = _pressed(file.scene, 0.7, tensions)
    smooth = _pressed(file.scene, 0.0, up[up < 5.5])  # it slips off at 5.4 N
    left.add_patch(Circle((36.0, -60.0), 20.0, color=mixed(ink(0.0), colors[5], 0.35)))
    for tension, color in shown.items():
        i = int(np.argmin(np.abs(up - tension)))
        outline = 1e3 * _outline(held.axis[i][:, [0, 2]], 0.006)
        left.fill(*outline.T, facecolor=(color, 0.12), edgecolor=color)
        start, force = 1e3 * held.points[i][[0, 2]], _PER_NEWTON * held.forces[i][[0, 2]]
        if held.pressed[i] > 0.01:
            left.quiver(*start, *force, color=color, **_ARROW)
        left.plot([], [], color=color, label=f"{tension:.1f} N")
    left.legend(title="tension", loc="upper right")
    left.set(aspect="equal", xlabel="x [mm]", ylabel="z [mm]", xlim=(-4, 116), ylim=(-84, 10))
    turn = up.size
    right.plot(up, held.pressed[:turn], color=colors[1], marker=".", label="closing")
    right.plot(
        tensions[turn - 1 :], held.pressed[turn - 1 :], color=colors[0], marker=".", label="opening"
    )
    lost = int(np.argmin(np.isfinite(smooth.pressed)))
    right.plot(up[:lost], smooth.pressed[:lost], color=ink(0.5), label="without friction")
    right.plot(up[lost - 1], smooth.pressed[lost - 1], "x", color=ink(0.5))
    right.annotate("slips off", (up[lost - 1], smooth.pressed[lost - 1]), (6, -4), **_OFFSET)
    right.set(xlabel="tension [N]", ylabel="force on the ball [N]")
    right.legend()
    figure.tight_layout()
    return figure


_OFFSET: dict[str, Any] = {"textcoords": "offset points", "va": "top"}
_PER_NEWTON = 60.0
"""Length of an arrow [mm/N]."""
_ARROW: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": 1.0, "zorder": 5}
_ARROW |= {"units": "xy", "width": 1.4}


def hexapod() -> Any:
    """The six rods and the plate of the guide."""
    return plot.assembly(
        vsr.solve_assembly(six_rods.hexapod(), six_rods.LENGTHS, model=MODEL)
    ).figure


class _Held(NamedTuple):
    """A finger at several tensions: points of its axis, the force that it presses with, the point
    of its surface where most of it acts, and the force on it, with friction."""

    axis: Any
    pressed: Any
    points: Any
    forces: Any


def _pressed(scene: vsr.Scene, friction: float, tensions: np.ndarray) -> _Held:
    scene = scene.replace("obstacles[0].friction", friction)

    def seen(eq: vsr.Equilibrium) -> _Held:
        one = jax.tree.map(lambda x: x[0], eq.contacts)
        most = one.position - 0.006 * one.normal
        forces = one.force[:, None] * one.normal + one.friction
        axis = eq.position(jnp.linspace(0.0, 0.1, 81))
        place = most[jnp.argmax(one.force)]
        return _Held(axis, one.force.sum(), place, forces.sum(0))

    path = vsr.follow(scene, jnp.asarray(tensions)[:, None], model=MODEL)
    return jax.tree.map(np.asarray, jax.jit(jax.vmap(seen))(path))


def _outline(axis: np.ndarray, radius: float) -> np.ndarray:
    """Outline of a round-ended finger in a plane, from points of its axis (points, 2)."""
    along = np.gradient(axis, axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], 1) / np.linalg.norm(along, axis=1)[:, None]
    turn = np.linspace(0.0, np.pi, 15)[:, None]
    end, side = along[-1] / np.linalg.norm(along[-1]), across[-1]
    cap = axis[-1] + radius * (np.cos(turn) * side + np.sin(turn) * end)
    return np.concatenate([axis + radius * across, cap, (axis - radius * across)[::-1]])


FIGURES: dict[str, Callable[[], Any]] = {
    function.__name__: function
    for function in (
        soft_arm,
        catheter,
        thin_catheter,
        failed_solve,
        strains,
        workspace,
        workspace_by_tension,
        design,
        frame,
        finger,
        hexapod,
    )
}
"""Functions that draw a figure, by name."""


def write(name: str, path: Path, theme: str, dpi: float) -> None:
    """Draws one figure into a file."""
    with plot.theme(theme):  # pyright: ignore[reportArgumentType] (one of two words)
        figure = FIGURES[name]()
        figure.savefig(path, dpi=dpi, metadata={"Software": None})
        plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"some of {', '.join(FIGURES)}")
    parser.add_argument("--out", metavar="FOLDER", type=Path, default=FOLDER / "docs/figures")
    parser.add_argument("--themes", nargs="+", choices=("light", "dark"), default=["light", "dark"])
    parser.add_argument("--dpi", type=float, default=110.0)
    options = parser.parse_args()
    if unknown := set(options.names) - set(FIGURES):
        parser.error(f"got {', '.join(sorted(unknown))}, need some of {', '.join(FIGURES)}")
    jax.config.update("jax_enable_x64", True)
    mpl.use("Agg")
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names or FIGURES:
        for theme in options.themes:
            ending = "" if len(options.themes) == 1 else f"_{theme}"
            write(name, options.out / f"{name}{ending}.png", theme, options.dpi)


if __name__ == "__main__":
    main()
