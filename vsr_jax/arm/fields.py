"""What the fields of a scene's parts declare about their numbers, as metadata.

`eqx.field(metadata={"unit": "m"})` is a field of numbers in metres. The keys are

- `unit`: see `Unit`, or `OF_OWNER`;
- `powers`: True if item i is the coefficient of $X^i$, in `unit` per m^i;
- `named`: False if the number has the name of the argument that holds it, as in `Constant`;
- `pose`: True for a pose (4, 4) or a rotation (3, 3).
"""

import dataclasses
import inspect
from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx

Unit = str | tuple[str, ...]
"""A unit such as "m" or "kg/m^3", "-" for a number without unit, "" where it is not known; a tuple
has the unit of each item."""

OF_OWNER = "of the owner"
"""Unit of the numbers of a profile: that of the field that holds the profile."""


def unit_of(field: dataclasses.Field, owner: Unit) -> Unit:
    """Unit of the numbers in a field, for an object whose own unit is `owner`."""
    unit = field.metadata.get("unit", "")
    return owner if unit == OF_OWNER else unit


def item_unit(unit: Unit, item: int) -> str:
    """Unit of one item of a tuple."""
    return unit[item] if isinstance(unit, tuple) else unit


def coefficient_unit(unit: str, power: int) -> str:
    """Unit of the coefficient of $X^i$ in a polynomial whose value has `unit`."""
    if power == 0 or not unit:
        return unit
    if unit == "m":
        return {1: "-", 2: "1/m"}.get(power, f"1/m^{power - 1}")
    return f"{unit}/m" if power == 1 else f"{unit}/m^{power}"


class Argument(NamedTuple):
    """An argument of a constructor as the object stores it; `unit`, `powers` and `named` come
    from the metadata of its field."""

    name: str
    value: Any
    default: Any
    unit: Unit
    powers: bool
    named: bool


def arguments(part: eqx.Module, owner: Unit = "") -> Iterator[Argument]:
    """The constructor's arguments that an object stores: those with a field of their name, in the
    constructor's order, without those that are None.

    **Arguments:**
    - `part`: the object.
    - `owner`: unit of the field that holds it.
    """
    fields = {field.name: field for field in dataclasses.fields(part)}
    for name, parameter in inspect.signature(type(part)).parameters.items():
        value = getattr(part, name, None)
        if name in fields and value is not None:
            unit, metadata = unit_of(fields[name], owner), fields[name].metadata
            options = metadata.get("powers", False), metadata.get("named", True)
            yield Argument(name, value, parameter.default, unit, *options)
