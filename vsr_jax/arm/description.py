"""Scenes and their parts as text: numbers with their units. Traced and batched numbers are shown as
such."""

import re
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..validation import is_traced
from .fields import Unit, arguments, coefficient_unit, item_unit

WIDTH = 100
MOST_NUMBERS = 8
"""Longer arrays are described by their size and range."""


_BREAK = re.compile(r", (?=[A-Za-z<(])")
"""Where a line may break: between arguments, not within a short vector."""


class Part(eqx.Module):
    """A part of a scene.

    Its `repr` is one line with the arguments of its constructor and their units. Left out are
    arguments at a neutral default: zeros, ones or the name of an option.
    """

    def __repr__(self) -> str:
        return describe(self)


def describe(value: Any, unit: Unit = "", *, powers: bool = False) -> str:
    """`value` in one line, its numbers in `unit`; `powers` as in `fields`."""
    if isinstance(value, Part):
        plain = _plain(value)
        if plain is not None:
            return describe(plain, unit)
        inner = ", ".join(f"{name}={text}" for name, text in described_arguments(value, unit))
        return f"{type(value).__name__}({inner})"
    if isinstance(value, tuple | list):
        return _items(value, unit)
    if isinstance(value, jax.Array | np.ndarray | np.number | jax.ShapeDtypeStruct):
        return _numbers(value, item_unit(unit, 0), powers)
    return repr(value)


def described_arguments(part: Part, unit: Unit = "") -> list[tuple[str, str]]:
    """Name and text of each argument of `part` that its `repr` shows."""
    return [
        (a.name, describe(a.value, a.unit, powers=a.powers))
        for a in arguments(part, unit)
        if not _is_neutral(a.value, a.default)
    ]


def table(title: str, rows: Iterable[tuple[str, str]]) -> str:
    """Lines of labels and texts under a title; long texts continue on the next line."""
    rows = list(rows)
    column = max((len(label) for label, _ in rows), default=0) + 4
    lines = [title]
    for label, text in rows:
        line = f"  {label}".ljust(column)
        for i, piece in enumerate(_BREAK.split(text)):
            if i and len(line) + len(piece) + 3 > WIDTH:
                lines.append(f"{line},")
                line = " " * (column + 2) + piece
            else:
                line += f", {piece}" if i else piece
        lines.append(line)
    return "\n".join(lines)


def _plain(value: Any) -> Any:
    """The array of a profile that is a plain number; None for every other part."""
    return next((a.value for a in arguments(value) if not a.named), None)


def _items(values: tuple | list, unit: Unit) -> str:
    numbers = [_plain(value) if isinstance(value, Part) else value for value in values]
    if isinstance(unit, str) and all(isinstance(x, jax.Array | np.ndarray) for x in numbers):
        return _with_unit(f"({', '.join(describe(x) for x in numbers)})", unit)
    return f"({', '.join(describe(x, item_unit(unit, i)) for i, x in enumerate(values))})"


def _numbers(value: Any, unit: str, powers: bool) -> str:
    shape = tuple(value.shape)
    array = _known(value)
    if array is None:
        kind = "traced" if is_traced(value) else "unknown"
        return f"{kind} {shape}" if shape else kind
    if array.dtype.kind not in "fiu":
        return repr(value)
    if powers and array.ndim == 1 and array.size <= MOST_NUMBERS:
        texts = [_with_unit(_number(x), coefficient_unit(unit, i)) for i, x in enumerate(array)]
        return f"({', '.join(texts)})"
    if powers:
        unit = f"{unit} per m^i" if unit else ""
    if array.size <= MOST_NUMBERS or shape == (4, 4):
        return _with_unit(_nested(array), unit)
    size = f"{array.size} numbers" if array.ndim == 1 else f"numbers of shape {shape}"
    low, high = _number(array.min()), _number(array.max())
    values = f"each {low}" if low == high else f"from {low} to {high}"
    return _with_unit(f"{size}, {values}", unit)


def _nested(array: Any) -> str:
    return f"({', '.join(map(_nested, array))})" if np.ndim(array) else _number(array)


def _number(x: Any) -> str:
    """Six digits, without the zeros and the plus of an exponent."""
    mantissa, _, exponent = f"{float(x):.6g}".partition("e")
    return f"{mantissa}e{int(exponent)}" if exponent else mantissa


def _with_unit(text: str, unit: str) -> str:
    return text if unit in ("", "-") else f"{text} {unit}"


def _is_neutral(value: Any, default: Any) -> bool:
    """Whether an argument has its default and that is zeros, ones or an option."""
    if isinstance(value, str | bool):
        return value == default
    if isinstance(value, tuple | list):
        same_size = isinstance(default, tuple | list) and len(default) == len(value)
        return same_size and all(map(_is_neutral, value, default))
    known = _known(_plain(value) if isinstance(value, Part) else value)
    if known is None or not isinstance(default, int | float | tuple):
        return False
    neutral = np.asarray(default)
    fits = known.shape[known.ndim - neutral.ndim :] == neutral.shape
    return bool(fits and np.isin(neutral, (0, 1)).all() and np.all(known == neutral))


def _known(value: Any) -> np.ndarray | None:
    """The numbers of an array; None if they are not known."""
    if not isinstance(value, jax.Array | np.ndarray | np.number) or is_traced(value):
        return None
    return None if isinstance(value, jax.Array) and value.is_deleted() else np.asarray(value)
