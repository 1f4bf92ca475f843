"""The paper's scenes A1 to C2 (Tables I and III), its prescribed bases (Tables II and IV,
corrected) and reference solutions.

Federico Renda, Costanza Armanini, Vincent Lebastard, Fabien Candelier and Frederic Boyer, A
Geometric Variable-Strain Approach for Static Modeling of Soft Manipulators With Tendon and Fluidic
Actuation, IEEE RA-L 5 (2020).
"""

import json
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from ..arm.actuator import Thread
from ..arm.material import Material
from ..arm.profile import Taper
from ..arm.rod import Rod
from ..arm.routing import Helix, Linear, Routing
from ..arm.scene import Scene
from ..arm.section import Circular
from ..models.basis import Basis, Family, Monomial, PiecewiseConstant, Trigonometric
from ..validation import choice

LENGTH = 0.75
TIP_RADIUS = 0.01
CASES = {
    "A1": "parallel thread",
    "A2": "oblique thread",
    "A3": "three oblique threads",
    "B1": "one helix",
    "B2": "two helices",
    "C1": "cone, three oblique threads",
    "C2": "cone, two helices",
}
"""Name and description of each case."""

_HALF = TIP_RADIUS / 2
_ANGLES = (1.529, 1.487)
_OBLIQUE = (
    Linear(0.0, _HALF, _HALF / LENGTH, -_HALF / LENGTH),
    Linear(0.0, -_HALF, _HALF / LENGTH, _HALF / LENGTH),
    Linear(-_HALF, 0.0),
)


class ReferenceSolution(NamedTuple):
    """A reference solution: forces [N], tip pose, strain (k, u) and position [m] at stations X [m],
    stability margin."""

    tau: np.ndarray
    tip: np.ndarray
    X: np.ndarray
    strain: np.ndarray
    position: np.ndarray
    stability: np.ndarray


def _routings(case: str) -> tuple[Routing, ...]:
    if case == "A1":
        return (Linear(_HALF, 0.0),)
    if case == "A2":
        return (Linear(_HALF, 0.0, -TIP_RADIUS / LENGTH),)
    if case in ("A3", "C1"):
        return _OBLIQUE
    return tuple(Helix(_HALF, angle) for angle in (_ANGLES[:1] if case == "B1" else _ANGLES))


def scene(case: str) -> Scene:
    """Scene of a case of Tables I and III: "A1", "A2", "A3", "B1", "B2", "C1" or "C2". Its inputs
    are the forces tau [N].

    **Raises:** `ValueError` for another name.
    """
    choice("case", case, tuple(CASES))
    base_radius = 0.012 if case.startswith("C") else 0.01
    arm = Rod(LENGTH, Circular(Taper(base_radius, TIP_RADIUS)), Material(5.93e5, shear=2.00e5))
    return Scene(arm, [Thread(routing) for routing in _routings(case)])


def basis(case: str) -> Basis:
    """Prescribed basis of a case, corrected Tables II and IV; C1 and C2 use the bases of the
    cylinder, as in the paper."""
    choice("case", case, tuple(CASES))
    constant, linear = Monomial(0), Monomial(1)
    if case == "A1":
        return Basis({"bending_z": constant, "elongation": constant})
    if case == "A2":
        return Basis({"bending_z": linear, "elongation": constant})
    if case in ("A3", "C1"):
        return Basis(
            {"torsion": constant, "bending_y": linear, "bending_z": linear, "elongation": constant}
        )
    frequencies = np.array([1 / (_HALF * np.tan(angle)) for angle in _ANGLES])[
        : 1 if case == "B1" else 2
    ]

    def waves(**groups: bool) -> Family:
        return Trigonometric(
            frequencies, **{"constant": False, "sine": False, "cosine": False, **groups}
        )

    sine, cosine = waves(sine=True), waves(cosine=True)
    torsion = constant if case == "B1" else waves(constant=True, cosine=True)
    return Basis(
        {
            "torsion": torsion,
            "bending_y": sine,
            "bending_z": cosine,
            "elongation": constant,
            "shear_y": sine,
            "shear_z": cosine,
        }
    )


def piecewise_basis() -> Basis:
    """The piecewise-constant basis of Fig. 3: bending and elongation on three sections, six degrees
    of freedom."""
    return Basis({"bending_z": PiecewiseConstant(3), "elongation": PiecewiseConstant(3)})


def reference(case: str) -> list[ReferenceSolution]:
    """Reference solutions of a case, computed by an independent program; positions are accurate to
    1e-10 m, strains to rounding."""
    choice("case", case, tuple(CASES))
    text = files("vsr_jax").joinpath("data", "paper_cases.json").read_text()
    return [
        ReferenceSolution(**{k: np.asarray(v) for k, v in entry.items()})
        for entry in json.loads(text)["cases"][case]
    ]
