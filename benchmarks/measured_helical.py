"""A robot that somebody built and measured (`benchmarks/measured/helical`): a printed wire with
three thick discs, three helical tendons that run straight between them and rub, motors that pull
lengths, two markers on the last disc. Calibrated, and tested by leaving out one step after another.

    pip install . && python benchmarks/measured_helical.py [--json FILE]

For each model: root mean square distances of the markers, fitted and of the step left out.
"""

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr

FILE = Path(__file__).parent / "measured/helical/trial.csv"
FREE, THICKNESS, DISCS = 0.23 / 3, 0.005, 3
LENGTH = DISCS * (FREE + THICKNESS)
PLACES = (FREE + THICKNESS) * np.arange(1, DISCS + 1)
YOUNG, SHEAR, DENSITY, MASS = 2.31e9, 0.849e9, 742.7, 0.0075
OFFSET, HOLE, TURN = 0.021, 0.0015, 2 * np.pi / 3
CABLE, FRICTION = 2474.0, 0.2
COMMAND = 1e-3 * np.array([-7.5, 2.3642, 1.4824])
ROLL = np.deg2rad(176)
"""Turn of the arm about its axis in the frame of the camera, from where the first step goes."""
SD = 5e-4
"""Of each measured coordinate [m]: two trials of the motion agree within 1 mm."""
MODEL = vsr.StrainDependent(6)
"""A step for each free piece and each disc; the tip of the last one is within 5e-7 m of that
by 24 steps."""
DISTANCE = "actuators[*].routing.function.parameters[1]"
NUMBERS: dict[str, float] = {
    "actuators[*].friction": FRICTION,
    "rod.discs.mass": MASS,
    DISTANCE: OFFSET - HOLE,
}
"""Numbers that every model fixes, as stated."""
MODELS: dict[str, dict[str, float]] = {
    "as built": {},
    "without friction": {"actuators[*].friction": 0.0},
    "friction 0.4": {"actuators[*].friction": 0.4},
    "tendons in the middle of the holes": {DISTANCE: OFFSET},
    "weightless discs": {"rod.discs.mass": 0.0},
    "modulus as stated": {"rod.material.young": YOUNG},
    "zeros as commanded": {"inputs.offset": 0.0},
}
"""What is fixed differently in each."""


def measured() -> np.ndarray:
    """Positions (steps, markers, 3) [m]."""
    with FILE.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return 1e-3 * np.array(
        [[[float(row[f"p{i}_{axis}"]) for axis in "xyz"] for i in (1, 2)] for row in rows]
    )


def path(X: jax.Array, outer: jax.Array, inner: jax.Array, angle: jax.Array) -> tuple:
    """A helix through the holes of the base and the last disc at the distance `outer`, and through
    the discs between at `inner`: there a tendon touches the side of its hole towards the axis."""
    ends = jnp.array([0.0, PLACES[0] - THICKNESS, PLACES[-2], PLACES[-1] - THICKNESS])
    radius = jnp.interp(X, ends, jnp.stack([outer, inner, inner, outer]))
    angle = angle + TURN * X / LENGTH
    return radius * jnp.cos(angle), radius * jnp.sin(angle)


def arm(*, straight: bool = True, thick: bool = True) -> vsr.Scene:
    """The robot as its makers state it, in the camera's frame, below which its base is; its tendons
    straight from disc to disc or along the section, its discs thick or without a thickness."""
    up, roll = np.array([0.0, 0.0, -1.0]), (np.cos(ROLL), np.sin(ROLL))
    base = np.eye(4)
    base[:3, 0] = up
    base[:3, 1] = roll[0], -roll[1], 0.0
    base[:3, 2] = np.cross(up, base[:3, 1])
    base[:3, 3] = measured()[0].mean(axis=0) - LENGTH * up
    wire = vsr.Rod(
        LENGTH,
        vsr.Circular(0.002),
        vsr.Material(YOUNG, poisson=YOUNG / (2 * SHEAR) - 1, density=DENSITY),
        base=base,
        discs=vsr.Discs(
            places=PLACES, radius=0.0225, mass=MASS, thickness=THICKNESS if thick else None
        ),
    )
    tendons = [
        vsr.Tendon(
            vsr.Function(path, OFFSET, OFFSET - HOLE, i * TURN),
            control="length",
            stiffness=CABLE,
            friction=FRICTION,
            motion="pull" if COMMAND[i] < 0 else "release",
            straight=straight,
        )
        for i in range(3)
    ]
    return vsr.Scene(wire, tendons, [vsr.Gravity((0.0, 0.0, 9.81))])


def offsets(scene: vsr.Scene) -> np.ndarray:
    """Places (markers, 3) [m] on the last disc, if the arm stands upright at step 0."""
    base = np.asarray(scene.rod.base)
    return (measured()[0] - base[:3, 3]) @ base[:3, :3] - [LENGTH, 0.0, 0.0]


def measurements(scene: vsr.Scene) -> vsr.Measurements:
    """The trial, with markers at `offsets`."""
    seen, X = measured(), [LENGTH] * 2
    markers = vsr.Markers(seen, X=X, offset=offsets(scene), sd=SD, labels=["p1", "p2"])
    return vsr.Measurements(np.linspace(0, 1, len(seen))[:, None] * COMMAND, markers)


def unknowns(offset: np.ndarray) -> dict[str, vsr.Unknown]:
    """Modulus, zeros of the motors, base, markers near an `offset`; `NUMBERS` are fixed."""
    free = {
        "rod.material.young": vsr.Unknown(5e8, 1e10, prior=(YOUNG, 5e8)),
        "inputs.offset": vsr.Unknown(-3e-3, 3e-3, prior=(0.0, 1e-3)),
        "base.position": vsr.Unknown(-0.1, 0.1, prior=(0.0, 0.02)),
        "base.rotation": vsr.Unknown(-0.6, 0.6, prior=(0.0, [0.1, 0.1, 0.2])),
        "markers.offset": vsr.Unknown(
            offset - 0.04, offset + 0.04, prior=(offset, [[0.005, 0.01, 0.01]] * 2)
        ),
    }
    return free | {name: vsr.Unknown(value, value) for name, value in NUMBERS.items()}


def fitted(scene: vsr.Scene, changes: dict[str, float] | None = None) -> vsr.Fit:
    """The fit of a scene, with numbers fixed at other values."""
    free = unknowns(offsets(scene)) | {k: vsr.Unknown(v, v) for k, v in (changes or {}).items()}
    return vsr.fit(scene, free, measurements(scene), model=MODEL, progress=False)


def record_of(fit: vsr.Fit) -> dict[str, Any]:
    """Root mean square distances [mm], fitted and of each step left out, and cost of the fit."""
    left_out = vsr.cross_validate(fit, len(measured()))
    rounded = [{k: round(1e3 * v, 2) for k, v in one.rms().items()} for one in (fit, left_out)]
    return {
        "fitted [mm]": rounded[0],
        "step left out [mm]": rounded[1],
        "chi^2": round(fit.chi_squared, 1),
        "status": fit.reason,
        "unsolved": list(left_out.unsolved),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", metavar="FILE")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    record: dict[str, Any] = {}

    def write(name: str, value: Any) -> None:
        record[name] = value
        print(name, json.dumps(value), flush=True)
        if options.json:
            Path(options.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    for name, changes in MODELS.items():
        fit = fitted(arm(), changes)
        write(name, record_of(fit))
        if not changes:
            print(fit)
            numbers = fit.numbers.items()
            write("numbers", {k: [x.value, x.error] for k, x in numbers if not np.isnan(x.error)})
    write("tendons along the section", record_of(fitted(arm(straight=False))))
    write("discs without a thickness", record_of(fitted(arm(thick=False))))


if __name__ == "__main__":
    main()
