"""Two designs: one thread that bends an arm into a given S, and two threads that move the tip along
a straight line.

    pip install . && python benchmarks/designs.py [--out FOLDER]

The arm is a nitinol wire with discs that guide the threads, in a plane. The results are checked at
200 points of the curve, and at 200 tensions between those of the design, with 64 steps.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import machine
from vsr_jax.viz.plot import COLORS

LENGTH, KNOTS = 0.3, 8
MODEL, FINE = vsr.StrainDependent(16), vsr.StrainDependent(64)
INSIDE = vsr.constraint.Inside(wall=0.001)
LINE, REACH = 0.285, 0.05


def arm(*heights: float) -> vsr.Scene:
    """A nitinol wire with threads in its plane, initially at constant heights [m]."""
    wire = vsr.Rod(
        LENGTH,
        vsr.Circular(0.0007),
        vsr.Material(54e9, poisson=0.3),
        discs=vsr.Discs(20, radius=0.0101),
    )
    X = np.linspace(0, LENGTH, KNOTS)
    return vsr.Scene(
        wire, [vsr.Tendon(vsr.Spline(X, [height] * KNOTS, [0.0] * KNOTS)) for height in heights]
    )


def s_curve(points: int) -> np.ndarray:
    """Points [m] of a plane curve whose tangent turns to 69 degrees and back, evenly spaced along
    its length, shape (points, 3)."""
    s = np.linspace(0, LENGTH, 20 * 200 + 1)
    angle = 0.6 * (1 - np.cos(2 * np.pi * s / LENGTH))
    xy = [
        np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(s))])
        for f in (np.cos(angle), np.sin(angle))
    ]
    places = np.arange(1, points + 1) * (len(s) - 1) // points
    return np.stack([xy[0][places], xy[1][places], 0 * places], axis=-1)


def follow_the_s() -> tuple[vsr.Design, dict[str, Any]]:
    start = time.perf_counter()
    free = {"actuators[0].routing.y": (-0.01, 0.01), "inputs": (0.5, 40.0)}
    found = vsr.design(
        arm(0.004),
        free,
        vsr.objective.CurveError(s_curve(20)),
        [[5.0]],
        constraints=[INSIDE],
        model=MODEL,
        search=vsr.Search(steps=800),
    )
    seconds = time.perf_counter() - start
    X = LENGTH * jnp.arange(1, 201) / 200
    off = np.linalg.norm(
        np.asarray(vsr.solve(found.scene, found.inputs[0], model=FINE).position(X)) - s_curve(200),
        axis=1,
    )
    said = {"seconds": seconds, "tension [N]": found.inputs[0, 0]}
    said |= {"largest off the curve [m]": off.max(), "rms [m]": np.sqrt(np.mean(off**2))}
    return found, {key: float(value) for key, value in said.items()}


def off_the_line(arms: vsr.objective.Arms) -> Any:
    """Mean square distance of the tips from the line x = 0.285 m, plus that of the first and last
    tip from its ends, relative to the arm's length; with a small penalty on tensions that jump
    from one set to the next."""
    tips = arms.each(lambda eq: eq.tip[:2, 3]) / LENGTH
    ends = (tips[0, 1] + REACH / LENGTH) ** 2 + (tips[-1, 1] - REACH / LENGTH) ** 2
    jumps = jnp.mean(jnp.diff(arms.inputs[:, 1], n=2) ** 2)
    return jnp.mean((tips[:, 0] - LINE / LENGTH) ** 2) + ends + 1e-6 * jumps


def along_the_line() -> tuple[vsr.Design, dict[str, Any]]:
    start = time.perf_counter()
    pulled = np.linspace(2.0, 8.0, 13)
    low, high = (
        np.stack([pulled, 0 * pulled + 0.5], axis=1),
        np.stack([pulled, 0 * pulled + 14.0], axis=1),
    )
    free = {"actuators[*].routing.y": (-0.01, 0.01), "inputs": (low, high)}
    found = vsr.design(
        arm(0.004, -0.004),
        free,
        off_the_line,
        (low + high) / 2,
        constraints=[INSIDE],
        model=MODEL,
        search=vsr.Search(starts=16, steps=1500),
    )
    seconds = time.perf_counter() - start
    tips = line_tips(found, 200)
    at_its_own = np.abs(line_tips(found, 13)[:, 0] - LINE)
    said = {"seconds": seconds, "length [m]": np.ptp(tips[:, 1])}
    said |= {
        "largest off the line [m]": np.max(np.abs(tips[:, 0] - LINE)),
        "at the tensions of the design [m]": np.max(at_its_own),
    }
    return found, {key: float(value) for key, value in said.items()}


def between(found: vsr.Design, number: int) -> np.ndarray:
    """Tensions between those of the design; that of the second thread is a spline over that of the
    first."""
    first, second = np.asarray(found.inputs).T
    pulled = np.linspace(first[0], first[-1], number)
    spline = vsr.SplineProfile(first, second)
    return np.stack([pulled, jax.vmap(lambda x: spline(x, x))(jnp.asarray(pulled))], axis=1)


def line_tips(found: vsr.Design, number: int) -> np.ndarray:
    return np.asarray(
        jax.vmap(lambda u: vsr.solve(found.scene, u, model=FINE).tip[:3, 3])(
            jnp.asarray(between(found, number))
        )
    )


def shape(scene: vsr.Scene, inputs: Any) -> tuple[np.ndarray, np.ndarray]:
    """Axis and threads of an arm in its plane [mm], shapes (points, 2) and (threads, points, 2)."""
    X, eq = jnp.linspace(0, LENGTH, 121), vsr.solve(scene, jnp.asarray(inputs), model=FINE)
    threads = [np.asarray(eq.thread(i, X))[:, :2] for i in range(len(scene.actuators))]
    return 1e3 * np.asarray(eq.position(X))[:, :2], 1e3 * np.array(threads)


def draw(s: vsr.Design, line: vsr.Design, path: Path) -> None:
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4.2), layout="constrained")
    left.plot(
        *(1e3 * s_curve(200)[:, :2].T),
        color="0.75",
        linewidth=7,
        solid_capstyle="round",
        label="wanted",
    )
    for scene, inputs, color, style, name in (
        (arm(0.004), [5.0], "0.45", "--", "before"),
        (s.scene, s.inputs[0], COLORS[0], "-", "after"),
    ):
        axis, threads = shape(scene, inputs)
        left.plot(*axis.T, color=color, linestyle=style, label=name)
        left.plot(
            *threads[0].T,
            color=COLORS[1],
            linewidth=0.9,
            linestyle=style,
            label="its thread" if style == "-" else None,
        )
    left.set_title("One thread that makes an S")
    for i, inputs in enumerate(np.asarray(line.inputs)[::2]):
        axis, threads = shape(line.scene, inputs)
        right.plot(*axis.T, color=COLORS[0], linewidth=1.2, label="arm" if i == 0 else None)
        if i == 3:
            for thread, color in zip(threads, (COLORS[1], COLORS[2]), strict=True):
                right.plot(
                    *thread.T,
                    color=color,
                    linewidth=0.9,
                    label="its threads" if color == COLORS[1] else None,
                )
    right.plot(
        *(1e3 * line_tips(line, 200)[:, :2].T),
        color="black",
        linewidth=2.5,
        label="path of the tip",
    )
    right.set_title("Two threads that move the tip along a line")
    for ax in (left, right):
        ax.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal")
        ax.legend(frameon=False, loc="upper left", fontsize=9)
    figure.savefig(path, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", metavar="FOLDER", type=Path, default=Path("benchmarks/results"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_enable_x64", True)
    (s, s_said), (line, line_said) = follow_the_s(), along_the_line()
    for name, said in (("S", s_said), ("line", line_said)):
        print(f"{name}: " + ", ".join(f"{key} {value:.4g}" for key, value in said.items()))
    draw(s, line, out / "designs.png")
    record = {"machine": machine(), "jax": jax.__version__, "S": s_said, "line": line_said}
    (out / "designs.json").write_text(json.dumps(record, indent=1) + "\n")
    title = "One thread that bends the arm into an S"
    vsr.save(s.scene, out / "designed_s.toml", s.inputs[0], title)
    title = "Two threads that move the tip along a line"
    vsr.save(line.scene, out / "designed_line.toml", line.inputs[0], title)


if __name__ == "__main__":
    main()
