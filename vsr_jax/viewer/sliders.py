"""Sliders: the inputs and the chosen numbers of a scene, each with a name, a unit and a range.

Names are those of `vsr_jax.parameters` and `vsr_jax.design`: `inputs[0]`, `rod.material.young`,
`loads[0].force[2]`.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import jax.numpy as jnp
import numpy as np

from ..arm.actuator import Actuator, Chamber
from ..arm.driven import check_free
from ..arm.plausible import quietly
from ..arm.scene import Scene
from ..arm.scene_numbers import Parameter, matching, parameters
from ..optimization.problem import INPUTS
from ..validation import interval, numbers as checked_numbers

_PREFIXED = ("m", "Pa", "N", "N m")
"""Units that are shown with a prefix."""
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "u"))
_BEND = 2.0
"""Angle [rad] by which a default range of inputs bends an arm that has none."""
_STRETCH = 0.05
"""Share of its length by which a default range of inputs stretches an arm at most."""
_HALVINGS = 8
"""Bisections by which a default range is shortened to numbers that the scene may have."""

Range: TypeAlias = Sequence[float] | None
Chosen: TypeAlias = str | Sequence[str] | Mapping[str, Range]


class Slider(NamedTuple):
    """A number that can be moved.

    **Fields:** its `name`; the array `of` which it is an entry, `"inputs"` or a name of
    `vsr_jax.parameters`, and the `place` there; its `unit`; its range from `low` to `high`.
    """

    name: str
    of: str
    place: tuple[int, ...]
    unit: str
    low: float
    high: float

    @property
    def shown_unit(self) -> tuple[float, str]:
        """Factor and name of the unit in which the slider is shown: with a prefix for which its
        values are between 1 and 1000."""
        return prefixed(max(abs(self.low), abs(self.high)), self.unit)

    def in_si(self, shown: float) -> float:
        """A number in the shown unit in SI units, without digits from rounding."""
        factor = self.shown_unit[0]
        return shown * factor if factor >= 1 else shown / round(1 / factor)


def prefixed(greatest: float, unit: str) -> tuple[float, str]:
    """Factor and name of a unit with the prefix for which a number is between 1 and 1000; units
    that are not used with prefixes remain."""
    if unit not in _PREFIXED or greatest == 0:
        return 1.0, unit
    fitting = [pair for pair in _PREFIXES if greatest >= pair[0]]
    factor, prefix = fitting[0] if fitting else _PREFIXES[-1]
    return factor, prefix + unit


def input_sliders(scene: Scene, inputs: np.ndarray, bounds: Any = None) -> list[Slider]:
    """A slider for each input.

    **Arguments:** `bounds`: least and greatest inputs, as for `reach`. By default the range from 0
    to twice the greatest input of the same kind; where all are 0, inputs that bend the arm alone by
    about 2 rad. That of a driven number is its own, or else reaches visibly to both sides.

    **Raises:** `ValueError` for bounds that contradict each other, an actuator or the inputs.
    """
    if bounds is None:
        low, high = _default_bounds(scene, inputs)
    else:
        low, high = (np.asarray(end, float) for end in interval("bounds", bounds, len(inputs)))
        scene.check_inputs(low)
        scene.check_inputs(high)
    threads = len(scene.actuators)
    return [
        _checked(
            Slider(f"{INPUTS}[{i}]" if i < threads else one.name, INPUTS, (i,), one.unit, *ends),
            inputs[i],
        )
        for i, (one, ends) in enumerate(
            zip(scene.inputs, np.stack([low, high], axis=-1).tolist(), strict=True)
        )
    ]


def number_sliders(scene: Scene, chosen: Chosen) -> list[Slider]:
    """A slider for each chosen number of a scene; an array has one for each entry.

    **Arguments:** `chosen`: names, where `[*]` stands for every index, or a mapping from names to
    ranges. A range is a pair, or None for the default: from half to twice the number, twice the
    greatest entry of an array to both sides, and for zeros what bends the arm visibly; shortened to
    numbers that the scene may have.

    **Raises:** `ValueError` for an unknown name, a range that does not contain the number, and a
    number without a default range.
    """
    ranges = _ranges(chosen)
    known = parameters(scene)
    entries = {
        name: (of, place)
        for of, parameter in known.items()
        for (name, _), place in zip(
            parameter.entries(of), np.ndindex(parameter.value.shape), strict=True
        )
    }
    found: dict[str, Slider] = {}
    for pattern, ends in ranges.items():
        for name in matching(pattern, known | entries):
            each = (
                [name] if name in entries else [e for e, (of, _) in entries.items() if of == name]
            )
            check_free(
                scene, scene.driven, [(entries[x][0], _flat(known, *entries[x])) for x in each]
            )
            for entry in each:
                found[entry] = _number_slider(scene, known, entry, *entries[entry], ends)
    return list(found.values())


def _flat(known: Mapping[str, Parameter], of: str, place: tuple[int, ...]) -> int:
    """Index of an entry in its flat array."""
    return int(np.ravel_multi_index(place, known[of].value.shape)) if place else 0


def _ranges(chosen: Chosen) -> dict[str, Range]:
    if isinstance(chosen, Mapping):
        return dict(chosen)
    names = [chosen] if isinstance(chosen, str) else list(chosen)
    for name in names:
        if not isinstance(name, str):
            raise ValueError(
                f"numbers: got {name!r}, need names such as 'rod.material.young', or a mapping "
                f"from names to ranges"
            )
    return dict.fromkeys(names)


def _number_slider(
    scene: Scene,
    known: Mapping[str, Parameter],
    name: str,
    of: str,
    place: tuple[int, ...],
    ends: Range,
) -> Slider:
    parameter = known[of]
    unit = dict(parameter.entries(of))[name]
    value = float(parameter.value[place])
    if parameter.value.ndim == 2:
        raise ValueError(
            f"numbers: got {name}, an entry of a matrix, need a number or an entry of a row"
        )
    if ends is None:
        low, high = _default_range(scene, name, unit, np.asarray(parameter.value), place)
    else:
        pair = np.asarray(checked_numbers(f"numbers[{name!r}]", ends, (2,)), float)
        low, high = pair.tolist()
    return _checked(Slider(name, of, place, unit, low, high), value)


def _checked(slider: Slider, value: float) -> Slider:
    if not (slider.low <= value <= slider.high and slider.low < slider.high):
        raise ValueError(
            f"{slider.name}: got the range {slider.low:g} to {slider.high:g}, need one that "
            f"contains the number, {value:g} {slider.unit}".rstrip()
        )
    return slider


def _default_bounds(scene: Scene, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    low, high = np.zeros(len(inputs)), np.zeros(len(inputs))
    kinds = [(type(actuator), actuator.unit) for actuator in scene.actuators]
    for i, actuator in enumerate(scene.actuators):
        alike = inputs[: len(kinds)][[kind == kinds[i] for kind in kinds]]
        if np.any(alike):
            low[i], high[i] = 2 * min(alike.min(), 0.0), 2 * max(alike.max(), 0.0)
        else:
            size = _visible_input(scene, actuator)
            low[i], high[i] = -size * (actuator.lowest < 0), size
    for i, one in enumerate(scene.inputs[len(kinds) :], start=len(kinds)):
        size = _visible_number(scene, one.unit) or abs(inputs[i]) or 1.0
        low[i] = one.low if np.isfinite(one.low) else inputs[i] - size
        high[i] = one.high if np.isfinite(one.high) else inputs[i] + size
    return low, high


def _visible_input(scene: Scene, actuator: Actuator) -> float:
    """An input that bends the arm alone by `_BEND`, or stretches it by `_STRETCH`."""
    rod = scene.rod
    middle = rod.length / 2
    start = 0.0 if actuator.start is None else actuator.start
    y, z = (float(x) for x in actuator.routing(jnp.asarray(start, rod.length.dtype)))
    lever = float(np.hypot(y, z))
    length = float(rod.length)
    stiffness = [float(x) for x in rod.stiffness(middle)]
    bending, stretching = max(stiffness[1:3]), stiffness[3]
    force = _STRETCH * stretching
    if lever > 0:
        force = min(_BEND * bending / (length * lever), force)
    area = actuator.pressure_area
    per_input = float(actuator.free_length(0.0, 1.0) - actuator.free_length(0.0, 0.0))
    if per_input:  # by bending and by stretching
        bent = force * length * lever / bending
        found = (bent * lever + force * length / stretching) / abs(per_input)
    elif isinstance(actuator, Chamber) and actuator.control == "gas":
        found = 2 * float(actuator.amount(length))
    else:
        found = force if area is None else force / float(area)
    return float(f"{found:.2g}")


def _default_range(
    scene: Scene, name: str, unit: str, array: np.ndarray, place: tuple[int, ...]
) -> tuple[float, float]:
    value = float(array[place])
    if name.endswith(".phase"):
        low, high = min(-np.pi, value), max(np.pi, value)
    elif np.any(array):
        greatest = 2 * float(np.max(np.abs(array)))
        low, high = (-greatest, greatest) if array.ndim else sorted((value / 2, 2 * value))
    else:
        size = _visible_number(scene, unit)
        if size is None:
            raise ValueError(
                f"numbers[{name!r}]: got no range for a number that is 0, need a pair, the least "
                f"and the greatest value"
            )
        low, high = -size, size
    return _allowed(scene, name, place, array, low), _allowed(scene, name, place, array, high)


def _visible_number(scene: Scene, unit: str) -> float | None:
    """A size of a number that is 0 at which it changes the arm visibly."""
    length = float(scene.rod.length)
    bending = max(float(x) for x in scene.rod.stiffness(scene.rod.length / 2)[1:3])
    sizes = {
        "rad": np.pi,
        "m": 0.1 * length,
        "1/m": np.pi / length,
        "N": bending / length**2,
        "N m": bending / length,
        "N/m": bending / length**3,
    }
    return float(f"{sizes[unit]:.2g}") if unit in sizes else None


def _allowed(
    scene: Scene, name: str, place: tuple[int, ...], array: np.ndarray, end: float
) -> float:
    """The end of a range, or the number nearest to it that the scene may have."""
    of = name if not place else name[: name.rindex("[")]
    value = float(array[place])

    def admits(number: float) -> bool:
        changed = array.copy()
        changed[place] = number
        try:
            with quietly():
                scene.replace(of, changed)
        except ValueError:
            return False
        return True

    if admits(end):
        return end
    share, step = 0.0, 0.5
    for _ in range(_HALVINGS):
        if admits(value + (share + step) * (end - value)):
            share += step
        step /= 2
    return value + share * (end - value)
