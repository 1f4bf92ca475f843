"""The numbers of a scene by name, with their units: names for sensitivities, designs and fits.

Names consist of constructor arguments, as in a scene file: `rod.section.radius.base`,
`actuators[0].routing.angle`, `loads[1].force`. A profile that is a plain number has the name of the
argument (`rod.material.young`).
"""

import dataclasses
import difflib
import re
from collections.abc import Callable, Iterator, Mapping
from functools import reduce
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..typing import ArrayLike
from ..validation import numbers
from .description import Part
from .fields import Unit, coefficient_unit, item_unit, unit_of

Way = tuple[Callable[[Any], Any], ...]
Module = TypeVar("Module", bound=eqx.Module)


class Parameter(NamedTuple):
    """A number, or an array of numbers, of a scene.

    **Fields:** the `value`; its `unit`, "" where it is not known; `powers`, whether item i is the
    coefficient of $X^i$ and has that unit per m^i; `way`, the steps from the scene to the value;
    `pose`, whether it is a pose or a rotation.
    """

    value: Any
    unit: str
    powers: bool
    way: Way
    pose: bool = False

    def entries(self, name: str) -> list[tuple[str, str]]:
        """Name and unit of each of its numbers, in order."""
        return [
            (
                name + "".join(f"[{i}]" for i in place),
                coefficient_unit(self.unit, place[0]) if self.powers else self.unit,
            )
            for place in np.ndindex(self.value.shape)
        ]


def parameters(scene: eqx.Module) -> dict[str, Parameter]:
    """Every number of a scene, or of another module, by its name: its `value`, and its `unit` if
    known."""
    return dict(_walk(scene, "", "", False, ()))


def matching(pattern: str, known: Mapping[str, object]) -> list[str]:
    """Names that match a pattern: `actuators[*].routing.radius` matches the radius of each.

    **Raises:** `ValueError` if no name matches.
    """
    form = re.compile(re.escape(pattern).replace(r"\[\*\]", r"\[[^]]+\]"))
    names = [name for name in known if form.fullmatch(name)]
    if not names:
        close = difflib.get_close_matches(pattern, known, n=1)
        guess = f"; did you mean {close[0]!r}?" if close else f", known are {', '.join(known)}"
        raise ValueError(f"{pattern}: the scene has no such number{guess}")
    return names


def checked_values(scene: Part, values: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """New values of named numbers of a scene by their full names, in the precision and the shape of
    the numbers that they replace; one number stands for all of an array.

    **Raises:** `ValueError` for a name that the scene does not have, a wrong shape, and known
    values that are not finite.
    """
    known, found = parameters(scene), {}
    for pattern, value in values.items():
        for name in matching(pattern, known):
            old, new = known[name].value, numbers(name, value, None)
            if new.shape not in ((), old.shape):
                shapes = f"one number or shape {old.shape}" if old.shape else "one number"
                raise ValueError(f"{name}: got shape {new.shape}, need {shapes}")
            found[name] = jnp.broadcast_to(new, old.shape).astype(old.dtype)
    return found


def replaced(part: Module, values: Mapping[str, Array]) -> Module:
    """A scene, or another module, with new values of the named numbers."""
    known = parameters(part)
    ways = [known[name].way for name in values]
    return (
        eqx.tree_at(lambda s: [_at(s, way) for way in ways], part, list(values.values()))
        if ways
        else part
    )


def _at(value: Any, way: Way) -> Any:
    return reduce(lambda here, get: get(here), way, value)


def _walk(
    value: Any, name: str, unit: Unit, powers: bool, way: Way, pose: bool = False
) -> Iterator[tuple[str, Parameter]]:
    if eqx.is_inexact_array(value) or isinstance(value, jax.ShapeDtypeStruct):
        yield name, Parameter(value, item_unit(unit, 0), powers, way, pose)
    elif isinstance(value, eqx.Module):
        for field in dataclasses.fields(value):
            below = f"{name}.{field.name}" if name else field.name
            yield from _walk(
                getattr(value, field.name),
                below if field.metadata.get("named", True) else name,
                unit_of(field, unit),
                field.metadata.get("powers", False),
                (*way, attrgetter(field.name)),
                field.metadata.get("pose", False),
            )
    elif isinstance(value, tuple | list | dict):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for i, (key, item) in enumerate(items):
            below = f"{name}[{key!r}]"
            yield from _walk(item, below, item_unit(unit, i), powers, (*way, itemgetter(key)))
