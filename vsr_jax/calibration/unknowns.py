r"""The unknowns of a fit: their names, bounds and priors, and how the numbers of each shape depend
on them.

Every number that the model of shape s takes is affine in the unknowns, $p_s = b_s + A_s \theta$: a
number of the scene is an unknown or several that share one; the base pose belongs to the series of
the shape; an input is $g_i u_{si} + o_i$ for the recorded $u_{si}$.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ..arm.driven import check_free
from ..arm.scene import Scene
from ..arm.scene_numbers import matching, parameters
from ..typing import ArrayLike
from ..validation import numbers
from .measurements import Measurements

Slot = tuple[str, int]
"""A number that the model takes: name of an array and index of an entry in it."""

POSITION, ROTATION, INPUTS = "base.position", "base.rotation", "inputs"
GAIN, OFFSET = "inputs.gain", "inputs.offset"
_RESERVED = ("base", "inputs", "rod", "actuators", "loads")


class Unknown(NamedTuple):
    """Bounds and prior of an unknown of a fit.

    **Fields:**
    - `low`, `high`: least and greatest value, numbers or arrays of the number's shape; an entry
      with equal bounds is fixed there.
    - `prior`: mean and standard deviation of a normal prior, each a number or an array.
    - `shared`: whether all numbers that match the name have one value.
    """

    low: ArrayLike
    high: ArrayLike
    prior: tuple[ArrayLike, ArrayLike] | None = None
    shared: bool = False


Free = Mapping[str, Unknown | Sequence]
"""Unknowns by name: an `Unknown`, or a pair of bounds."""


class _Target(NamedTuple):
    """A number, or an array of numbers, that can be unknown: value at the start, unit of each
    entry, the array of slots that it acts on, and how: "all" shapes, one "series", "gain" or
    "offset" of the inputs."""

    value: np.ndarray
    units: list[str]
    slots: str
    acts: str
    series: str = ""


class Column(NamedTuple):
    """One unknown: its label and unit, its value at the start, bounds and prior (infinite standard
    deviation for none), what it acts on, and whether it is `shared` by all names that match."""

    label: str
    unit: str
    start: float
    low: float
    high: float
    mean: float
    sd: float
    acts: tuple[tuple[Slot, str, str], ...]
    shared: bool = False

    def fixed(self, value: float) -> "Column":
        """The unknown fixed at a value."""
        return self._replace(low=value, high=value, start=value)


def columns_of(scene: Scene, data: Measurements, free: Free) -> tuple[Column, ...]:
    """The unknowns that `free` names, fixed entries included.

    **Raises:** `ValueError` for unknown names, contradictory bounds, priors without a positive
    standard deviation, and a number that two patterns name.
    """
    if not isinstance(free, Mapping) or not free:
        raise ValueError(f"free: got {free!r}, need bounds of at least one number by its name")
    targets = dict(_targets(scene, data))
    columns, taken = [], {}
    for pattern, given in free.items():
        names = matching(pattern, targets)
        unknown = _unknown(pattern, given)
        if unknown.shared and "*" not in pattern and targets[names[0]].acts != "series":
            raise ValueError(
                f"free[{pattern!r}].shared: got True for one array, whose entries stay apart; need "
                f"a name with [*] that matches several"
            )
        for name in names:
            if name in taken:
                raise ValueError(f"free: got {name} by {taken[name]!r} and by {pattern!r}")
            taken[name] = pattern
        groups = [(pattern, names)] if unknown.shared else [(name, [name]) for name in names]
        for label, members in groups:
            columns += _entries(label, unknown, [targets[name] for name in members])
    acted = (slot for column in columns for slot, kind, _ in column.acts if kind == "all")
    check_free(scene, scene.driven, acted)
    if not any(column.high > column.low for column in columns):
        raise ValueError("free: got equal bounds everywhere, need at least one number to find")
    return tuple(columns)


def slots_of(columns: Sequence[Column]) -> tuple[Slot, ...]:
    """The numbers of the model that the unknowns act on, each once."""
    return tuple(dict.fromkeys(slot for column in columns for slot, _, _ in column.acts))


def affine(
    columns: Sequence[Column], places: Sequence[Slot], inputs: np.ndarray, series: Sequence[str]
) -> tuple[np.ndarray, np.ndarray]:
    """$b$ and $A$ for shapes with given inputs (shapes, actuators) and series, with the numbers of
    the model in the order of `places`; shapes (shapes, slots) and (shapes, slots, unknowns)."""
    slots = {slot: i for i, slot in enumerate(places)}
    b = np.zeros((len(inputs), len(slots)))
    A = np.zeros((len(inputs), len(slots), len(columns)))
    scaled = {slot for column in columns for slot, kind, _ in column.acts if kind == "gain"}
    for slot, i in slots.items():
        if slot[0] == INPUTS and slot not in scaled:
            b[:, i] = inputs[:, slot[1]]
    for k, column in enumerate(columns):
        for slot, kind, group in column.acts:
            here = np.array([one == group for one in series]) if kind == "series" else 1.0
            A[:, slots[slot], k] += inputs[:, slot[1]] if kind == "gain" else here
    return b, A


def _targets(scene: Scene, data: Measurements) -> Iterator[tuple[str, _Target]]:
    for name, parameter in parameters(scene).items():
        if name != "rod.base":
            units = [unit for _, unit in parameter.entries(name)]
            yield name, _Target(np.asarray(parameter.value), units, name, "all")
    for group in data.groups:
        for name, unit in ((POSITION, "m"), (ROTATION, "rad")):
            label = f"{name}[{group}]" if group else name
            yield label, _Target(np.zeros(3), [unit] * 3, name, "series", group)
    units = [one.unit for one in scene.inputs]
    if units:
        yield GAIN, _Target(np.ones(len(units)), ["-"] * len(units), INPUTS, "gain")
        yield OFFSET, _Target(np.zeros(len(units)), units, INPUTS, "offset")
    for one in data.observations:
        if one.name in _RESERVED:
            raise ValueError(f"observations: got the name {one.name!r}, which a fit uses itself")
        for name, parameter in parameters(one).items():
            if name not in ("value", "sd"):
                label = f"{one.name}.{name}"
                units = [unit for _, unit in parameter.entries(name)]
                yield label, _Target(np.asarray(parameter.value), units, label, "all")


def _unknown(pattern: str, given: Any) -> Unknown:
    if isinstance(given, Unknown):
        return given
    if not isinstance(given, tuple | list) or len(given) != 2:
        raise ValueError(
            f"free[{pattern!r}]: got {given!r}, need a pair, the least and the greatest value, or "
            f"an Unknown"
        )
    return Unknown(given[0], given[1])


def _entries(label: str, unknown: Unknown, members: list[_Target]) -> Iterator[Column]:
    """A column for each entry of an array, shared by all `members`."""
    first = members[0]
    if any(one.value.shape != first.value.shape for one in members):
        raise ValueError(f"free[{label!r}]: got arrays of different shapes that share one value")
    low, high, mean, sd = _limits(label, unknown, first.value.shape)
    start = np.mean([one.value for one in members], axis=0)
    for i, place in enumerate(np.ndindex(first.value.shape)):
        yield Column(
            label + "".join(f"[{k}]" for k in place),
            first.units[i],
            float(np.clip(start[place], low[place], high[place])),
            float(low[place]),
            float(high[place]),
            float(mean[place]),
            float(sd[place]),
            tuple(((one.slots, i), one.acts, one.series) for one in members),
            unknown.shared,
        )


def for_series(
    columns: Sequence[Column], x: np.ndarray, groups: Sequence[str]
) -> tuple[Column, ...]:
    """Unknowns for measurements of other series: base poses of their own, all else fixed at x. A
    base pose that all series share is fixed too."""
    found: dict[str, Column] = {}
    for column, value in zip(columns, x.tolist(), strict=True):
        if not any(kind == "series" for _, kind, _ in column.acts):
            found[column.label] = column.fixed(value)
            continue
        slot = column.acts[0][0]
        if column.shared:
            acts = tuple((slot, "series", group) for group in groups)
            found[column.label] = column.fixed(value)._replace(acts=acts)
            continue
        for group in groups:
            name = f"{slot[0]}[{group}]" if group else slot[0]
            own = column._replace(label=f"{name}[{slot[1]}]", acts=((slot, "series", group),))
            found[own.label] = own._replace(start=float(np.clip(0.0, own.low, own.high)))
    return tuple(found.values())


def _limits(label: str, unknown: Unknown, shape: tuple[int, ...]) -> list[np.ndarray]:
    """Bounds, mean and standard deviation of the prior, each of a shape."""
    path = f"free[{label!r}]"
    mean, sd = (0.0, np.inf) if unknown.prior is None else _pair(path, unknown.prior)
    given = {"low": unknown.low, "high": unknown.high, "prior mean": mean, "prior sd": sd}
    found = []
    for name, value in given.items():
        free = name == "prior sd" and unknown.prior is None
        array = np.asarray(numbers(f"{path} {name}", value, None, finite=not free), float)
        if array.shape not in ((), shape):
            raise ValueError(f"{path} {name}: got shape {array.shape}, need one number or {shape}")
        found.append(np.broadcast_to(array, shape))
    if np.any(found[0] > found[1]):
        raise ValueError(f"{path}: got {unknown.low!r} to {unknown.high!r}, need the least first")
    if not np.all(found[3] > 0):
        raise ValueError(f"{path} prior: got a standard deviation {sd!r}, need a number > 0")
    return found


def _pair(path: str, prior: Any) -> tuple[Any, Any]:
    if not isinstance(prior, tuple | list) or len(prior) != 2:
        raise ValueError(f"{path} prior: got {prior!r}, need mean and standard deviation")
    return prior[0], prior[1]
