"""The scenes of `bench_peers` as plain numbers, with the settings of each tool."""

from typing import Any, NamedTuple

import numpy as np

import vsr_jax as vsr

NEWTON = "forces, Newton by jacfwd from rest (unloaded)"
_B1: dict[str, Any] = {
    "length": 0.75,
    "radius": 0.01,
    "young": 5.93e5,
    "shear": 2.0e5,
    "density": 120.0,
    "helix": {"radius": 0.005, "angle": 1.529, "phase": 0.0},
    "gravity": None,
    "tip_force": None,
}


class Case(NamedTuple):
    """A scene: description and numbers; steps and orders for vsr_jax; settings for SoRoMoX, from
    coarse to fine; a tension, and the tip there from an independent program."""

    about: str
    numbers: dict[str, Any]
    ours: list[tuple[int, int]]
    theirs: list[tuple]
    tension: float
    tip: tuple[float, float, float] | None


CASES = {
    "A1": Case(
        "the paper's arm A1, a parallel thread (its strain is constant)",
        _B1 | {"helix": {"radius": 0.005, "angle": np.pi / 2, "phase": 0.0}},
        [(1, 2), (1, 6), (2, 2)],
        [(0, 5, 1e-6), (0, 5, 1e-6, "legendre", NEWTON)],
        -5.0,
        None,
    ),
    "B1": Case(
        "the paper's arm B1, a helical thread",
        _B1,
        [(8, 6), (12, 6), (16, 6), (20, 6), (28, 6)],
        [
            (1, 12, 1e-5, "fourier"),
            (8, 30, 1e-5),
            (8, 30, 1e-5, "legendre", NEWTON),
            (16, 80, 1e-8),
            (20, 120, 1e-8),
        ],
        -5.0,
        None,
    ),
    "loaded": Case(
        "B1 under gravity and a dead tip force",
        _B1 | {"gravity": (0.0, 0.0, -9.81), "tip_force": (0.0, 0.02, 0.02)},
        [(6, 6), (8, 6), (12, 6), (16, 6), (20, 6), (26, 6)],
        [
            (6, 12, 1e-3),
            (8, 16, 1e-4),
            (12, 24, 1e-4),
            (16, 48, 1e-5),
            (20, 64, 1e-6),
            (24, 96, 1e-6),
        ],
        -5.0,
        # by SciPy: cross-section balance by Newton, pose and moment by DOP853, base wrench by
        # shooting with load steps
        (0.23267292337207685, 0.20950543772381253, -0.5284293230120489),
    ),
}


def our_scene(numbers: dict[str, Any]) -> vsr.Scene:
    """A scene in vsr_jax."""
    material = vsr.Material(numbers["young"], shear=numbers["shear"], density=numbers["density"])
    arm = vsr.Rod(numbers["length"], vsr.Circular(numbers["radius"]), material)
    loads: list[Any] = []
    if numbers["gravity"] is not None:
        loads = [
            vsr.Gravity(numbers["gravity"]),
            vsr.TipWrench(force=numbers["tip_force"], frame="world"),
        ]
    return vsr.Scene(arm, [vsr.Thread(vsr.Helix(**numbers["helix"]))], loads).astype("float64")
