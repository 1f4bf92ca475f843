"""A silicone tentacle that somebody measured (`benchmarks/measured/tentacle`): calibrate on the
eight holds of series A, test on the eight of series B, compare models.

    pip install . && python benchmarks/measured_tentacle.py [--json FILE] [--plot PNG] [--free N]

For each model: root mean square distance of the four markers on A, which is fitted, and on B, of
which only the position of the base is fitted. `--free N` also runs Nelder-Mead and Powell with at
most N solves of the whole series.
"""

import argparse
import csv
import json
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies.timing import machine

FOLDER = Path(__file__).parent
MODEL = vsr.StrainDependent(12)
LINK_1, LENGTH = 0.305, 0.360
X = [0.1291, 0.2195, 0.2800, 0.3600]
OFFSETS = np.array([[0, 0, 0.025], [0, 0, -0.021], [0, 0, 0.020], [0.008, 0, 0]])
MISFIT = np.array([4.0, 7.0, 4.0, 8.0])[:, None] * 1e-3 / np.sqrt(3)
"""What the model is expected to miss of each coordinate [m]; a marker is known to 0.2 mm."""
TO_THE_TIP = 0.3599
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


def tentacle() -> vsr.Scene:
    """The arm as its makers state it, with some friction and tendons that end within link 2."""
    hanging = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]])
    rod = vsr.Rod(
        LENGTH,
        vsr.Circular(vsr.Piecewise([LINK_1], [link_1, link_2])),
        vsr.Material(vsr.Piecewise([LINK_1], [3e5, 3e5]), poisson=0.45, density=1500.0),
        base=hanging,
        guide_radius=0.0125,
    )
    tendons = [
        vsr.Tendon(vsr.Function(path, 0.0114, -0.0295, np.deg2rad(angle)), friction=0.15, end=0.314)
        for angle in (30, 150)
    ]
    return vsr.Scene(rod, tendons, [vsr.Gravity()])


def unknowns() -> dict[str, vsr.Unknown]:
    def near(value: float, sd: float, **options: Any) -> vsr.Unknown:
        return vsr.Unknown(value - 4 * sd, value + 4 * sd, prior=(value, sd), **options)

    return {
        MODULI: vsr.Unknown(5e4, 5e6),
        "rod.material.density": near(1500.0, 150.0),
        "actuators[*].friction": vsr.Unknown(0.0, 0.6),
        "actuators[*].end": vsr.Unknown(0.3055, TO_THE_TIP, shared=True),
        "inputs.gain": near(1.0, 0.1),
        "base.position[*]": near(0.0, 0.01),
        "base.rotation[*]": near(0.0, 0.05, shared=True),
        f"{PATH}[0]": near(0.0114, 0.0005, shared=True),
        f"{PATH}[1]": near(-0.0295, 0.002, shared=True),
        ANGLES[0]: near(np.deg2rad(30), 0.05),
        ANGLES[1]: near(np.deg2rad(150), 0.05),
        "markers.offset": vsr.Unknown(OFFSETS - 0.008, OFFSETS + 0.008, prior=(OFFSETS, 0.002)),
    }


STATED = {f"{PATH}[0]": 0.0114, f"{PATH}[1]": -0.0295} | dict(
    zip(ANGLES, np.deg2rad([30, 150]).tolist(), strict=True)
)
AS_STATED = {f"markers.offset[{i}][{j}]": x for (i, j), x in np.ndenumerate(OFFSETS)}
ONE = {"shared": [MODULI]}
MODELS: dict[str, tuple[dict[str, float], dict]] = {
    "calibrated": ({}, ONE),
    "link 2 with its own modulus": ({}, {}),
    "own modulus, tendons to the tip": ({"actuators[*].end": TO_THE_TIP}, {}),
    "tendons to the tip": ({"actuators[*].end": TO_THE_TIP}, ONE),
    "without friction": ({"actuators[*].friction": 0.0}, ONE),
    "gains of one": ({"inputs.gain[*]": 1.0}, ONE),
    "base not turned": ({"base.rotation[*][*]": 0.0}, ONE),
    "tendon paths as stated": (STATED, ONE),
    "marker offsets as stated": (AS_STATED, ONE),
}
"""What is fixed and what is shared in each model."""


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


def record_of(fit: vsr.Fit, test: vsr.Fit) -> dict[str, Any]:
    return {
        "rms on A [mm]": millimetres(fit),
        "rms on B, held out [mm]": millimetres(test),
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


def compared(full: vsr.Fit, test: vsr.Measurements) -> dict[str, Any]:
    found = {}
    for name, (fixed, options) in MODELS.items():
        fit = full.refit(fixed, **options)
        found[name] = record_of(fit, fit.on(test))
        print(
            f"{name:33} A {found[name]['rms on A [mm]']} B {found[name]['rms on B, held out [mm]']}"
        )
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
    scene, train, test = tentacle(), holds("A"), holds("B")
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        full = vsr.fit(scene, unknowns(), train, model=MODEL, progress=False)
        seconds.append(time.perf_counter() - start)
    found = compared(full, test)
    calibrated = full.refit(**ONE)
    print(calibrated)
    record = {
        "machine": machine(),
        "seconds with compiling, without": seconds,
        "steps": full.steps,
        "models": found,
    }
    if options.json:
        Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
