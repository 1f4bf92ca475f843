r"""Warnings about implausible numbers, most often a wrong unit: millimetres for metres, MPa for Pa.

Checked are length, half thickness b, slenderness L / b, moduli, density, chamber areas and gravity.
No number is rejected here.
"""

import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..typing import Scalar
from .actuator import Actuator
from .loads import Gravity, Load
from .rod import Rod


class UnitWarning(UserWarning):
    """A number far outside of what arms have, most often in a wrong unit. Turn it off with
    `warnings.filterwarnings("ignore", category=vsr.UnitWarning)`."""


_BETWEEN = ("vsr_jax", "equinox", "jaxtyping", "beartype")
"""Packages whose frames are between a warning and the user's line."""


_QUIET = ContextVar("quiet", default=False)


@contextmanager
def quietly() -> Iterator[None]:
    """Without warnings, where the package makes scenes of numbers that the user has not chosen or
    has been warned of."""
    before = _QUIET.set(True)
    try:
        yield
    finally:
        _QUIET.reset(before)


def warn(sentences: Sequence[str]) -> None:
    """Warns of each, at the line of the user's that led here."""
    if not sentences or _QUIET.get():
        return
    frame, level = sys._getframe(), 1
    while frame.f_back is not None:
        if frame.f_globals.get("__name__", "").split(".")[0] not in _BETWEEN:
            break
        frame, level = frame.f_back, level + 1
    for sentence in sentences:
        warnings.warn(sentence, UnitWarning, stacklevel=level)


_AnyArray = Array | np.ndarray

_PREFIXED = ("m", "Pa")
"""Units that are written with a prefix."""
_PREFIXES = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"))


def _readable(value: float, unit: str) -> str:
    """A number with its unit and the prefix that leaves the fewest digits."""
    if unit not in _PREFIXED:
        return f"{value:g} {unit}"
    factor, prefix = next(pair for pair in _PREFIXES if value >= pair[0])
    return f"{value / factor:g} {prefix}{unit}"


class _Range(NamedTuple):
    """Plausible range of a number, a sentence about it with {} for the range, and factors to SI
    units from units that are often confused."""

    least: float
    most: float
    unit: str
    sentence: str
    slips: tuple[tuple[float, str], ...] = ()

    def contains(self, value: float) -> bool:
        return self.least <= value <= self.most

    @property
    def usual(self) -> str:
        """The sentence with the range."""
        ends = [_readable(end, self.unit) for end in (self.least, self.most)]
        if self.unit not in _PREFIXED:
            ends[0] = f"{self.least:g}"
        return self.sentence.format(" to ".join(ends))

    def doubts(self, name: str, values: _AnyArray | float) -> Iterator[str]:
        """A warning about the first of the values outside the range, with the units it may have."""
        for value in np.atleast_1d(values).tolist():
            if not self.contains(value):
                fitting = [unit for factor, unit in self.slips if self.contains(value * factor)]
                slip = f"; is it in {' or '.join(fitting)}?" if fitting else ""
                yield f"{name}: {value:.6g} {self.unit}; {self.usual}{slip}"
                return


_METRIC = ((1e-3, "millimetres"),)
_LENGTH = _Range(1e-3, 20.0, "m", "arms are {} long", _METRIC)
_THICKNESS = _Range(5e-6, 0.5, "m", "arms have {}", _METRIC)
_SLENDERNESS = _Range(3.0, 1e4, "times", "rods are {}")
_MODULUS = _Range(1e3, 2e12, "Pa", "materials have {}", ((1e6, "MPa"), (1e9, "GPa")))
_GRAVITY = _Range(0.0, 100.0, "m/s^2", "the Earth's is 9.81 m/s^2", ((1e-3, "mm/s^2"),))
_DENSITY = _Range(50.0, 25000.0, "kg/m^3", "materials have {}", ((1e3, "g/cm^3"),))

_RANGES = {
    "rod.length": _LENGTH,
    "rod.section: half thickness": _THICKNESS,
    "rod.discs.radius": _THICKNESS,
}
"""Ranges of a rod's numbers, by name."""

_OF_MATERIALS = {
    "young": _MODULUS,
    "shear": _MODULUS,
    "density": _DENSITY,
}
"""Ranges of a material's numbers, by the last part of their names."""


class Measures(NamedTuple):
    """Half thickness [m], area of the outline [m^2] and the material's numbers along an arm."""

    thickness: _AnyArray
    area: _AnyArray
    material: Mapping[str, _AnyArray]


def measures_at(rod: Rod, X: Scalar) -> Measures:
    """What `doubts` needs of a section at X [m]."""
    zero = jnp.zeros_like(rod.length)
    thickness = rod.section.clearance(zero, zero, X, rod.length)
    wide = thickness if rod.rim is None else jnp.maximum(thickness, rod.rim)
    area = jnp.maximum(rod.section.geometry(X, rod.length).area, jnp.pi * wide**2)
    limits = rod.material.limits(rod.section, X, rod.length)
    return Measures(thickness, area, {name: value for (name, _), (value, _) in limits.items()})


def doubts(
    rod: Rod, actuators: Sequence[Actuator], loads: Sequence[Load], measures: Measures
) -> Iterator[str]:
    """Sentences about implausible numbers of a scene, from the measures along its rod."""
    length, thickness = float(rod.length), float(np.mean(measures.thickness))
    values = {"rod.length": length, "rod.section: half thickness": thickness}
    if rod.rim is not None:
        values["rod.discs.radius"] = float(rod.rim)
    for name, range_ in _RANGES.items():
        if name in values:
            yield from range_.doubts(name, values[name])
    for name, value in measures.material.items():
        range_ = _OF_MATERIALS.get(name.rpartition(".")[2].split()[0])
        if range_ is not None:
            yield from range_.doubts(f"rod.material.{name}", value)
    slenderness = length / thickness
    sized = _LENGTH.contains(length) and _THICKNESS.contains(thickness)
    if sized and not _SLENDERNESS.contains(slenderness):
        yield (
            f"rod: {slenderness:.3g} times as long as half its thickness; {_SLENDERNESS.usual}; "
            "are length and sizes in one unit?"
        )
    yield from _moduli(measures.material)
    yield from _measured_stiffness(measures)
    yield from _gravities(loads)
    for i, actuator in enumerate(actuators):
        area, most = actuator.pressure_area, np.max(measures.area)
        if area is not None and float(area) > most:
            slip = "; is it in mm^2?" if 1e-6 * float(area) <= most else ""
            yield (
                f"actuators[{i}].area: {float(area):.6g} m^2; the section has {most:.3g} m^2{slip}"
            )


def _gravities(loads: Sequence[Load]) -> Iterator[str]:
    """Warns of gravity that is too large, or points straight up."""
    for i, load in enumerate(loads):
        if isinstance(load, Gravity):
            name, g = f"loads[{i}].acceleration", np.asarray(load.acceleration, float)
            size = float(np.linalg.norm(g))
            yield from _GRAVITY.doubts(name, size)
            if size > 0 and g[2] > 0.999 * size:
                yield f"{name}: points up, along +z; is its sign right?"


def _measured_stiffness(measures: Measures) -> Iterator[str]:
    """Warns of a bending stiffness that material within the outline cannot have beside the axial
    one: $EI / EA$ is the mean square of its distance from the neutral axis."""
    material, most = measures.material, np.max(measures.thickness)
    for name in ("EI_y", "EI_z"):
        if name in material and "EA" in material:
            bending, axial = (float(np.mean(material[x])) for x in (name, "EA"))
            away = np.sqrt(bending / axial)
            if away > most:
                yield (
                    f"rod.material: {name} {bending:.6g} N m^2 and EA {axial:.6g} N; what is stiff "
                    f"would lie {away:.3g} m from the axis, the outline {most:.3g} m; are both in "
                    "SI units?"
                )


def _moduli(material: Mapping[str, _AnyArray]) -> Iterator[str]:
    """Warns if the ratio of two moduli, each plausible by itself, is implausible."""
    for owner in [name[: -len("shear")] for name in material if name.endswith("shear")]:
        young, shear = (float(np.mean(material[owner + name])) for name in ("young", "shear"))
        plausible = _MODULUS.contains(young) and _MODULUS.contains(shear)
        if plausible and not 0.01 <= young / shear <= 1000:
            yield (
                f"rod.material{('.' + owner)[:-1]}: young {young:.6g} Pa and shear {shear:.6g} Pa; "
                "their ratio is 2 to 3 in most materials; are both in Pa?"
            )
