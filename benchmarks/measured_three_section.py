"""A three-section arm that somebody measured (`benchmarks/measured/three_section`), nine tendons
driven by their lengths, tip by motion capture: calibrate on the first four fifths of the recording,
test on the last fifth.

    pip install . && python benchmarks/measured_three_section.py [--json FILE] [--plot PNG]

For each model: root mean square distance of the tip, also after the mean offset is removed. The
fit of 400 samples is timed; models are compared on 120 of them.
"""

import argparse
import csv
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

FOLDER = Path(__file__).parent
MODEL = vsr.StrainDependent(3)
"""The strain of each section is constant, as parallel tendons without loads bend it: a step each is
exact."""
ENDS = (0.060, 0.1225, 0.1865)
FIRST_ANGLES = (-3.06, -2.56, -2.05)
ANGLES = [first + turn * 2 * np.pi / 3 for first in FIRST_ANGLES for turn in range(3)]
SECTIONS = np.repeat(np.arange(3), 3)
CABLE = 7000.0
"""Stiffness of every cable from servo to end [N/m]; without loads only its ratio to that of the
backbone counts, so that it is fixed."""
SD = 0.003
"""What the model is expected to miss of each coordinate [m]."""
TRAIN, FEW, FOLDS = 400, 120, 4
STEPS = 60
PATH = "actuators[{}].routing.function.parameters[{}]"
LAG = 0.1
"""Time [s] by which the tip follows the servos as recorded, found by `delay`."""
PAUSE = 1.5
"""Time [s] between samples beyond which the servos have stood still."""


def path(X: jax.Array, radius: jax.Array, angle: jax.Array) -> tuple:
    """A tendon parallel to the axis."""
    return radius * jnp.cos(angle) + 0 * X, radius * jnp.sin(angle) + 0 * X


def arm(stiffness: np.ndarray) -> vsr.Scene:
    """The arm as its makers state it, upright, with cables of given axial stiffness [N]."""
    upright = np.array([[0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
    rod = vsr.Rod(
        ENDS[-1],
        vsr.Circular(0.0005),
        vsr.Material(5e10, poisson=0.3),
        base=upright,
        discs=vsr.Discs(10, radius=0.006),
    )
    tendons = [
        vsr.Tendon(
            vsr.Function(path, 0.0045, angle), control="length", stiffness=one, end=ENDS[section]
        )
        for angle, one, section in zip(ANGLES, stiffness, SECTIONS, strict=True)
    ]
    return vsr.Scene(rod, tendons)


OUTSIDE = CABLE * np.array(ENDS)[SECTIONS]
"""Cables that stretch by the same length under the same tension: servo, spool and the part outside
the arm."""
INSIDE = np.full(9, CABLE * ENDS[1])
"""Cables that stretch in proportion to their length in the arm."""


def unknowns() -> dict[str, vsr.Unknown]:
    def near(value: Any, sd: float, **options: Any) -> vsr.Unknown:
        mean = np.asarray(value, float)
        return vsr.Unknown(mean - 5 * sd, mean + 5 * sd, prior=(mean, sd), **options)

    free = {
        "rod.material.young": vsr.Unknown(1e8, 1e12),
        "inputs.offset": near(0.0, 5e-4),
        "inputs.gain": near(1.0, 0.02),
        "markers.offset": near([[0.008, 0.0, 0.0]], 0.003),
        # shared, so that a test on other samples does not fit them
        "base.position": near(0.0, 0.005, shared=True),
        # about the axis of the straight arm it is no other than the angles of all tendons
        "base.rotation": vsr.Unknown(
            [-0.2, -0.2, 0.0], [0.2, 0.2, 0.0], prior=(0.0, 0.05), shared=True
        ),
        PATH.format("*", 0): near(0.0045, 2e-4),
    }
    return free | {PATH.format(i, 1): near(angle, 0.1) for i, angle in enumerate(ANGLES)}


GAIN, RADIUS = "inputs.gain", PATH.format("*", 0)
ANGLE = {PATH.format(i, 1): angle for i, angle in enumerate(ANGLES)}
BASE: dict[str, float] = {GAIN: 1.0}
MODELS: dict[str, dict[str, float]] = {
    "calibrated": BASE,
    "with gains": {},
    "radii as stated": BASE | {RADIUS: 0.0045},
    "radii and angles as stated": BASE | {RADIUS: 0.0045} | ANGLE,
    "zeros as recorded": BASE | {"inputs.offset": 0.0},
    "cables that do not stretch": BASE | {"rod.material.young": 1e8},
}
"""What is fixed in each model. A backbone of a five-hundredth of the stiffness does not stretch its
cables."""


class Recording:
    """Time [s], cable let out [m], shape (samples, 9), tip [m] and motion of each sample."""

    def __init__(self) -> None:
        with (FOLDER / "measured/three_section/train.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        servos = [name for name in rows[0] if name.startswith("servo")]
        self.time = np.array([float(row["timestamp"]) for row in rows])
        self.inputs = -1e-3 * np.array([[float(row[name]) for name in servos] for row in rows])
        self.tip = 1e-3 * np.array([[float(row[f"tip_{axis}"]) for axis in "xyz"] for row in rows])
        self.pattern = [row["pattern_label"].removesuffix("_hold") for row in rows]
        self.seen = len(rows) * 4 // 5

    def delayed(self, lag: float) -> np.ndarray:
        """Inputs at an earlier time, by linear interpolation between samples."""
        found = self.inputs.copy()
        step = np.diff(self.time)
        share = np.where(step < PAUSE, np.minimum(lag / step, 1.0), 0.0)
        found[1:] += share[:, None] * (self.inputs[:-1] - self.inputs[1:])
        return found

    def measurements(self, index: np.ndarray, lag: float = LAG) -> vsr.Measurements:
        inputs = self.delayed(lag)[index]
        markers = vsr.Markers(self.tip[index], offset=[0.008, 0, 0], sd=SD, labels=["tip"])
        return vsr.Measurements(inputs, markers)

    def train(self, number: int) -> np.ndarray:
        """Samples of the first four fifths, evenly."""
        return np.linspace(0, self.seen - 1, number).astype(int)

    @property
    def test(self) -> np.ndarray:
        """The last fifth."""
        return np.arange(self.seen, len(self.time))


def distances(fit: vsr.Fit) -> dict[str, float]:
    """Root mean square distance of the tip [mm], and after the mean offset is removed."""
    gap = 1e3 * fit.residuals["tip"]
    gap = gap[np.isfinite(gap).all(axis=1)]
    size = [np.sqrt(np.mean(np.sum((gap - m) ** 2, axis=1))) for m in (0.0, gap.mean(axis=0))]
    return {"rms [mm]": round(float(size[0]), 2), "aligned [mm]": round(float(size[1]), 2)}


def fitted(scene: vsr.Scene, data: vsr.Measurements, fixed: dict[str, float]) -> vsr.Fit:
    free = unknowns()
    for name, value in fixed.items():
        free[name] = free[name]._replace(low=value, high=value)
    return vsr.fit(scene, free, data, model=MODEL, steps=STEPS, progress=False)


def delay(fit: vsr.Fit, recording: Recording, index: np.ndarray) -> float:
    """Time [s] that the tip is further behind than the fit says: least squares of the residuals by
    the rates of the cables."""
    rate = np.zeros_like(recording.inputs)
    step = np.diff(recording.time)[:, None]
    rate[1:] = np.where(step < PAUSE, np.diff(recording.inputs, axis=0) / step, 0.0)
    offsets = [i for i, name in enumerate(fit.names) if name.startswith("inputs.offset")]
    slopes = fit.adjusted.minimum.residuals.source.slopes[..., offsets]
    along = np.einsum("srk,sk->sr", slopes, rate[index])
    gap = fit.residuals["tip"]
    return float(np.sum(along * gap) / np.sum(along**2))


def repeatability(fit: vsr.Fit, recording: Recording) -> dict[str, Any]:
    """How much the tip differs between visits of the same inputs (all within 0.3 mm, or slack) in
    different motions, less what the fit of all samples says about that, over the square root of
    two: a model of the inputs alone misses as much on average. The arm nearly straight (the tip
    within 20 mm of the median at inputs near zero) and bent."""
    inputs = np.minimum(fit.problem.data.inputs, 2e-3)
    motion = np.array([recording.pattern.index(name) for name in recording.pattern])
    apart = np.max(np.abs(inputs[:, None] - inputs[None]), axis=2)
    first, second = np.nonzero(np.triu(apart < 3e-4) & (motion[:, None] != motion[None]))
    straight = np.median(recording.tip[np.max(np.abs(inputs), axis=1) < 3e-4], axis=0)
    away = np.linalg.norm(recording.tip - straight, axis=1)
    residual = 1e3 * fit.residuals["tip"]
    gap = np.sum((residual[first] - residual[second]) ** 2, axis=1)
    found = {}
    for name, here in {"nearly straight": away < 0.02, "bent": away >= 0.02}.items():
        pairs = gap[here[first] & here[second]]
        found[name] = {
            "pairs": len(pairs),
            "difference per visit [mm]": float(np.sqrt(np.nanmean(pairs) / 2)),
            "residual [mm]": float(np.sqrt(np.nanmean(np.sum(residual[here] ** 2, axis=1)))),
        }
    return found


def record_of(fit: vsr.Fit, test: vsr.Fit) -> dict[str, Any]:
    return {
        "fitted": distances(fit),
        "last fifth, held out": distances(test),
        "status": fit.reason,
        "steps": fit.steps,
        "failed": [list(fit.failed), list(test.failed)],
        "undetermined": fit.undetermined,
    }


def numbers_of(fit: vsr.Fit) -> dict[str, Any]:
    return {
        name: {"value": one.value, "error": one.error, "unit": one.unit}
        for name, one in fit.numbers.items()
        if not np.isnan(one.error) or one.at_bound
    }


def plotted(fit: vsr.Fit, test: vsr.Fit, recording: Recording, file: str) -> None:
    """Measured and predicted tips of the last fifth, and residuals by time."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 4.5), layout="constrained")
    index = recording.test
    seen = 1e3 * recording.tip[index]
    found = seen + 1e3 * test.residuals["tip"]
    for color, (name, motion) in zip(
        ("C0", "C1"), (("same side", "same"), ("opposite sides", "opp")), strict=True
    ):
        here = np.array([f"pair23_{motion}" in recording.pattern[i] for i in index])
        axes[0].plot(*seen[here].T[:2], ".", color=color, markersize=4, label=f"{name}, measured")
        axes[0].plot(*found[here].T[:2], "x", color=color, markersize=4, label="predicted")
    axes[0].set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title="Last fifth, held out")
    axes[0].legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    begin = recording.time[0]
    pairs = ((fit, recording.train(TRAIN), "fitted"), (test, index, "held out"))
    for one, rows, name in pairs:
        size = 1e3 * np.linalg.norm(one.residuals["tip"], axis=1)
        axes[1].plot(recording.time[rows] - begin, size, ".", markersize=4, label=name)
    axes[1].set(xlabel="time [s]", ylabel="distance of the tip [mm]", ylim=(0, None))
    axes[1].legend(frameon=False)
    figure.savefig(file, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--plot", metavar="PNG")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    recording, record = Recording(), {"machine": machine()}

    def write(name: str, value: Any) -> None:
        record[name] = value
        print(name, json.dumps(value), flush=True)
        if options.json:
            text = json.dumps(record, indent=1) + "\n"
            Path(options.json).write_text(text, encoding="utf-8")

    start, index = time.perf_counter(), recording.train(TRAIN)
    fit = fitted(arm(OUTSIDE), recording.measurements(index), BASE)
    seconds = time.perf_counter() - start
    held = recording.measurements(recording.test)
    test = fit.on(held)
    write("400 samples", record_of(fit, test) | {"seconds with compiling": seconds})
    write("numbers", numbers_of(fit))
    write("further delay [s]", delay(fit, recording, index))
    everything = fit.on(recording.measurements(np.arange(len(recording.time))))
    write("repeatability", repeatability(everything, recording))
    if options.plot:
        plotted(fit, test, recording, options.plot)
    compare(recording, held, write)


def compare(recording: Recording, held: vsr.Measurements, write: Any) -> None:
    """Other models, by the same compiled program."""
    few = recording.measurements(recording.train(FEW))
    fits = {}
    for name, fixed in MODELS.items():
        fits[name] = fitted(arm(OUTSIDE), few, fixed)
        write(name, record_of(fits[name], fits[name].on(held)))
    stretch = fitted(arm(INSIDE), few, BASE)
    write("cables that stretch inside the arm only", record_of(stretch, stretch.on(held)))
    index = recording.train(FEW)
    prompt = fitted(arm(OUTSIDE), recording.measurements(index, 0.0), BASE)
    late = recording.measurements(recording.test, 0.0)
    write("without delay", record_of(prompt, prompt.on(late)))
    folds = vsr.compare(fits, FOLDS)
    write("rms of held-out folds", {k: v.held_out.rms()["tip"] for k, v in folds.models.items()})


if __name__ == "__main__":
    main()
