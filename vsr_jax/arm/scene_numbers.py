"""The numbers of a scene by name, with their units: what sensitivities are told by and what a
design is free to change.

Names are the arguments of the constructors, as in a scene file: `rod.section.radius.base`,
`actuators[0].routing.angle`, `loads[1].force`. A plain number that stands for a profile has the
name of the argument (`rod.material.young`).
"""

import dataclasses
import difflib
import re
from collections.abc import Callable, Iterator, Mapping
from functools import reduce
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array

from .loads import DistributedWrench
from .profile import Constant, PolynomialProfile
from .routing import Polynomial, Spline
from .scene import Scene

_UNITS = {
    **dict.fromkeys(
        (
            "length",
            "radius",
            "outer",
            "inner",
            "width",
            "height",
            "semi_axis_y",
            "semi_axis_z",
            "guide_radius",
        ),
        "m",
    ),
    **dict.fromkeys(("y", "z", "X", "pitch", "start", "end", "ends"), "m"),
    **dict.fromkeys(("angle", "phase"), "rad"),
    **dict.fromkeys(("young", "shear"), "Pa"),
    **dict.fromkeys(("density", "fluid_density"), "kg/m^3"),
    **{"area": "m^2", "acceleration": "m/s^2", "force": "N", "moment": "N m", "stiffness": "N"},
    **dict.fromkeys(("poisson", "friction", "slope_y", "slope_z", "base", "shear_correction"), "-"),
}
_PER_LENGTH = {"force": "N/m", "moment": "N"}
_INHERITED = ("base", "tip", "values", "coefficients")
"""Fields of profiles, whose unit is that of what the profile stands for."""

Way = tuple[Callable[[Any], Any], ...]


class Parameter(NamedTuple):
    """A number, or an array of numbers, of a scene. Its `unit` is "" where it is not known; the
    unit of coefficient i of a polynomial is that by m^i."""

    value: Array
    unit: str
    polynomial: bool
    ways: tuple[Way, ...]
    """How to get at it from the scene; a spline keeps its abscissas twice."""

    def entries(self, name: str) -> list[tuple[str, str]]:
        """Name and unit of each of its numbers, in order."""
        places = list(np.ndindex(self.value.shape))
        units = [
            _per_length(self.unit, place[0]) if self.polynomial else self.unit for place in places
        ]
        return [
            (name + "".join(f"[{i}]" for i in place), unit)
            for place, unit in zip(places, units, strict=True)
        ]


def parameters(scene: Scene) -> dict[str, Parameter]:
    """Every number of a scene by its name: `value`, and `unit` where it is known."""
    found: dict[str, Parameter] = {}
    for name, unit, way in _walk(scene, "", "", ()):
        if name in found:
            found[name] = found[name]._replace(ways=(*found[name].ways, way))
        else:
            polynomial = isinstance(_at(scene, way[:-1]), PolynomialProfile)
            found[name] = Parameter(_at(scene, way), unit, polynomial, (way,))
    return found


def matching(pattern: str, known: Mapping[str, Any]) -> list[str]:
    """Names that a pattern stands for: `actuators[*].routing.radius` is the radius of each.

    **Raises:** `ValueError` for a name that nothing has.
    """
    form = re.compile(re.escape(pattern).replace(r"\[\*\]", r"\[\d+\]"))
    names = [name for name in known if form.fullmatch(name)]
    if not names:
        close = difflib.get_close_matches(pattern, known, n=1)
        guess = f"; did you mean {close[0]!r}?" if close else f", known are {', '.join(known)}"
        raise ValueError(f"{pattern}: the scene has no such number{guess}")
    return names


def replaced(scene: Scene, values: Mapping[str, Array]) -> Scene:
    """The scene with other numbers under the given names."""
    known = parameters(scene)
    ways = [(way, value) for name, value in values.items() for way in known[name].ways]
    return (
        eqx.tree_at(lambda s: [_at(s, way) for way, _ in ways], scene, [value for _, value in ways])
        if ways
        else scene
    )


def _at(value: Any, way: Way) -> Any:
    return reduce(lambda here, get: get(here), way, value)


def _walk(value: Any, name: str, unit: str, way: Way) -> Iterator[tuple[str, str, Way]]:
    if eqx.is_inexact_array(value):
        yield name, unit, way
    elif isinstance(value, Constant):
        yield from _walk(value.value, name, unit, (*way, attrgetter("value")))
    elif isinstance(value, Polynomial | Spline):
        yield from _walk_path(value, name, way)
    elif isinstance(value, eqx.Module):
        for field in dataclasses.fields(value):
            below = f"{name}.{field.name}" if name else field.name
            yield from _walk(
                getattr(value, field.name),
                below,
                _unit(value, field.name, unit),
                (*way, attrgetter(field.name)),
            )
    elif isinstance(value, tuple | list | dict):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            inner = ("1/m" if key < 3 else "-") if name == "rod.rest_strain" else unit
            yield from _walk(item, f"{name}[{key!r}]", inner, (*way, itemgetter(key)))


def _walk_path(routing: Polynomial | Spline, name: str, way: Way) -> Iterator[tuple[str, str, Way]]:
    """Their coordinates are kept as profiles, of which a user sees the numbers only."""
    for axis in ("y", "z"):
        profile = (*way, attrgetter(axis))
        yield (
            f"{name}.{axis}",
            "m",
            (*profile, attrgetter("coefficients" if isinstance(routing, Polynomial) else "values")),
        )
        if isinstance(routing, Spline):
            yield f"{name}.X", "m", (*profile, attrgetter("X"))


def _unit(owner: eqx.Module, field: str, unit: str) -> str:
    if unit and field in _INHERITED:
        return unit
    if isinstance(owner, DistributedWrench):
        return _PER_LENGTH.get(field, "")
    return _UNITS.get(field, "")


def _per_length(unit: str, power: int) -> str:
    if power == 0 or not unit:
        return unit
    if unit == "m":
        return {1: "-", 2: "1/m"}.get(power, f"1/m^{power - 1}")
    return f"{unit}/m" if power == 1 else f"{unit}/m^{power}"
