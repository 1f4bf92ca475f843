"""A silicone tentacle that somebody measured (`benchmarks/measured/tentacle`): calibrate on the
eight holds of series A, test on the eight of series B, compare models.

    pip install . && python benchmarks/measured_tentacle.py [--json FILE] [--plot PNG] [--free N]

For each model: root mean square distance of the four markers on A, which is fitted, and on B, of
which only the base is fitted, its position or its pose; and the evidence of A for the model, by
which models are chosen without B. `--free N` also runs Nelder-Mead and Powell with at most N solves
of the whole series.
"""

import argparse
import csv
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from scipy import optimize

import vsr_jax as vsr
from vsr_jax.studies.timing import machine

FOLDER = Path(__file__).parent
MODEL = vsr.StrainDependent(12)
STEPS = 100
LINK_1, LENGTH = 0.305, 0.360
X = [0.1291, 0.2195, 0.2800, 0.3600]
OFFSETS = np.array([[0, 0, 0.025], [0, 0, -0.021], [0, 0, 0.020], [0.008, 0, 0]])
MISFIT = np.array([4.0, 7.0, 4.0, 8.0])[:, None] * 1e-3 / np.sqrt(3)
"""What the model is expected to miss of each coordinate [m]; a marker is known to 0.2 mm."""
MODULI = "rod.material.young.values[*]"
PATH = "actuators[*].routing.function.parameters"
ANGLES = [f"actuators[{i}].routing.function.parameters[2]" for i in (0, 1)]


def path(X: jax.Array, offset: jax.Array, slope: jax.Array, angle: jax.Array) -> tuple:
    """A tendon at an angle that comes closer to the axis along link 1 and is parallel to it
    beyond."""
    distance = offset + slope * jnp.minimum(X, LINK_1)
    return distance * jnp.cos(angle), distance * jnp.sin(angle)


def link_1(X: jax.Array) -> jax.Array:
    return 0.01541 + (0.00642 - 0.01541) * X / LINK_1


def link_2(X: jax.Array) -> jax.Array:
    return 0.00642 + (0.00480 - 0.00642) * (X - LINK_1) / (LENGTH - LINK_1)


def tentacle(moduli: int = 2) -> vsr.Scene:
    """The arm as its makers state it, with some friction and, if it has a modulus of its own, a
    stiff link 2."""
    hanging = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    rod = vsr.Rod(
        LENGTH,
        vsr.Circular(vsr.Piecewise([LINK_1], [link_1, link_2])),
        vsr.Material(
            vsr.Piecewise([LINK_1], [3e5, 2.5e6 if moduli == 2 else 3e5]),
            poisson=0.45,
            density=1500.0,
        ),
        base=hanging,
        discs=vsr.Discs(10, radius=0.0125),
    )
    tendons = [
        vsr.Tendon(
            vsr.Function(path, 0.0114, -0.0295, np.deg2rad(angle)), friction=0.15, end=LENGTH
        )
        for angle in (30, 150)
    ]
    return vsr.Scene(rod, tendons, [vsr.Gravity()])


def unknowns(*, moduli: int = 2, place: float = 0.003) -> dict[str, vsr.Unknown]:
    """Unknowns with their priors; `place`: standard deviation of where a marker sits [m]."""

    def near(value: Any, sd: float, **options: Any) -> vsr.Unknown:
        mean = np.asarray(value, float)
        return vsr.Unknown(mean - 4 * sd, mean + 4 * sd, prior=(mean, sd), **options)

    return {
        MODULI: vsr.Unknown(5e4, 5e6, shared=moduli == 1),
        "rod.material.density": near(1500.0, 150.0),
        "actuators[*].friction": vsr.Unknown(0.0, 0.6),
        "actuators[*].end": vsr.Unknown(LENGTH, LENGTH, shared=True),
        "inputs.gain": near(1.0, 0.1),
        "base.position[*]": near(0.0, 0.01),
        "base.rotation[*]": near(0.0, 0.05, shared=True),
        f"{PATH}[0]": near(0.0114, 0.0005, shared=True),
        f"{PATH}[1]": near(-0.0295, 0.002, shared=True),
        ANGLES[0]: near(np.deg2rad(30), 0.05),
        ANGLES[1]: near(np.deg2rad(150), 0.05),
        "markers.offset": near(OFFSETS, place),
    }


STATED = {f"{PATH}[0]": 0.0114, f"{PATH}[1]": -0.0295} | dict(
    zip(ANGLES, np.deg2rad([30, 150]).tolist(), strict=True)
)
MODELS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "calibrated": ({}, {}),
    "markers within 1 mm": ({"place": 0.001}, {}),
    "markers within 2 mm": ({"place": 0.002}, {}),
    "markers within 4 mm": ({"place": 0.004}, {}),
    "markers where stated": ({}, {"markers.offset": OFFSETS}),
    "one modulus, tendons end at 314 mm": ({"moduli": 1}, {"actuators[*].end": 0.314}),
    "without friction": ({}, {"actuators[*].friction": 0.0}),
    "gains of one": ({}, {"inputs.gain": 1.0}),
    "base not turned": ({}, {"base.rotation[*]": 0.0}),
    "tendon paths as stated": ({}, STATED),
    "one modulus": ({"moduli": 1}, {}),
}
"""Arguments of `unknowns` for each model, and what is fixed in it."""


def holds(series: str) -> vsr.Measurements:
    with (FOLDER / "measured/tentacle/holds.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["series"] == series]
    inputs = [[float(row[f"tension{i}_N"]) for i in (1, 2)] for row in rows]
    places = [
        [[float(row[f"p{i}_{axis}_m"]) for axis in "xyz"] for i in range(1, 5)] for row in rows
    ]
    markers = vsr.Markers(
        places, X, offset=OFFSETS, sd=MISFIT, labels=[f"p{i}" for i in range(1, 5)]
    )
    return vsr.Measurements(inputs, markers, series=[series] * len(rows))


def millimetres(fit: vsr.Fit) -> list[float]:
    return [round(1e3 * value, 2) for value in fit.rms().values()]


def turned(fit: vsr.Fit) -> vsr.Fit:
    """The fit with a base rotation for each series."""
    columns = [
        c._replace(shared=False) if c.label.startswith("base.rotation") else c
        for c in fit.problem.columns
    ]
    return vsr.Fit(replace(fit.problem, columns=tuple(columns)), fit.adjusted)


def evidence(fit: vsr.Fit) -> float:
    r"""Logarithm of the probability density of the data, by Laplace's approximation at the minimum,
    up to what all models share: $-F - \sum_k \ln s_k - \sum_j \ln (h_j - l_j) / \sqrt{2 \pi} +
    \frac12 \ln \det C$ for unknowns with normal priors (k) and with bounds alone (j). Unknowns at a
    bound count as fixed."""
    free = np.isfinite(np.diag(fit.covariance))
    box, sd = fit.problem.box, np.sqrt(np.diag(fit.covariance)[free])
    width = ((box.high - box.low) / np.sqrt(2 * np.pi))[free]
    prior = np.where(np.isfinite(box.sd[free]), box.sd[free], width)
    turns = np.linalg.slogdet(fit.correlation[np.ix_(free, free)])[1] / 2
    return float(-fit.adjusted.minimum.cost + np.sum(np.log(sd / prior)) + turns)


def record_of(fit: vsr.Fit, data: vsr.Measurements) -> dict[str, Any]:
    """What a fit of A says about A, and about B, the `data`."""
    test = fit.on(data)
    return {
        "rms on A [mm]": millimetres(fit),
        "log evidence of A": round(evidence(fit), 2),
        "rms on B, held out [mm]": millimetres(test),
        "rms on B with the base turned [mm]": millimetres(turned(fit).on(data)),
        "held-out chi squared": test.chi_squared,
        "status": fit.reason,
        "failed": [list(fit.failed), list(test.failed)],
        "undetermined": fit.undetermined,
        "numbers": {
            name: {"value": one.value, "error": one.error, "unit": one.unit}
            for name, one in fit.numbers.items()
            if not np.isnan(one.error) or one.at_bound
        },
    }


def compared(
    train: vsr.Measurements, test: vsr.Measurements, records: dict, write: Callable[[], None]
) -> dict[str, vsr.Fit]:
    """The fit of each model, all by one compiled program; their records are written one by one."""
    fits = {}
    for name, (options, fixed) in MODELS.items():
        free = unknowns(**options)
        for label, value in fixed.items():
            free = held(free, label, value)
        start = time.perf_counter()
        scene = tentacle(options.get("moduli", 2))
        fit = vsr.fit(scene, free, train, model=MODEL, steps=STEPS, progress=False)
        seconds = time.perf_counter() - start
        fits[name] = fit
        records[name] = record_of(fit, test) | {"seconds": seconds, "steps": fit.steps}
        found = {k: v for k, v in records[name].items() if k not in ("numbers", "undetermined")}
        print(f"{name}: {json.dumps(found)}", flush=True)
        write()
    return fits


def held(free: dict[str, vsr.Unknown], label: str, value: Any) -> dict[str, vsr.Unknown]:
    """The unknowns with one, or all that its name matches, fixed."""
    name = label if label in free else label.rsplit("[", 1)[0]
    return free | {name: free[name]._replace(low=value, high=value)}


def gradient_free(fit: vsr.Fit, most: int) -> dict[str, Any]:
    """Cost over that of the fit, minus one, that Nelder-Mead and Powell reach with a number of
    solves of all shapes from the same start, and their time without compiling."""
    problem, box = fit.problem, fit.problem.box
    free = box.high > box.low

    def cost(share: np.ndarray) -> float:
        x = fit.x.copy()
        x[free] = box.low[free] + (box.high - box.low)[free] * np.clip(share, 0, 1)
        return min(fit.cost(x), 1e9)

    start = ((problem.start - box.low)[free] / (box.high - box.low)[free]).clip(0, 1)
    cost(start)
    found = {}
    for method in ("Nelder-Mead", "Powell"):
        began = time.perf_counter()
        best = optimize.minimize(
            cost, start, method=method, bounds=[(0, 1)] * start.size, options={"maxfev": most}
        )
        found[method] = {
            "solves of all shapes": int(best.nfev),
            "seconds": time.perf_counter() - began,
            "cost over that of the fit - 1": best.fun / fit.adjusted.minimum.cost - 1,
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--free", type=int, default=0, metavar="N")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--plot", metavar="PNG")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    train, test = holds("A"), holds("B")
    record: dict[str, Any] = {"machine": machine(), "models": {}}

    def write() -> None:
        if options.json:
            text = json.dumps(record, indent=1) + "\n"
            Path(options.json).write_text(text, encoding="utf-8")

    compared(train, test, record["models"], write)
    start = time.perf_counter()
    again = vsr.fit(tentacle(), unknowns(), train, model=MODEL, steps=STEPS, progress=False)
    record["seconds without compiling"] = time.perf_counter() - start
    print(again, flush=True)
    write()
    if options.free:
        record["without gradients"] = gradient_free(again, options.free)
        print(record["without gradients"])
    if options.plot:
        figure, axes = plt.subplots(1, 3, figsize=(13, 5), layout="constrained")
        vsr.plot_fit.shapes(again, axes[0], axes="yz")
        vsr.plot_fit.shapes(again.on(test), axes[1], axes="xz")
        vsr.plot_fit.residuals(again, axes[2])
        figure.savefig(options.plot, dpi=130)
    write()


if __name__ == "__main__":
    main()
