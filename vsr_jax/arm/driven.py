"""Inputs that are numbers of a scene: where a section is held, how the base is turned, a field."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..numerics.se3 import stacked_rotation
from ..typing import Scalar
from .description import Part
from .scene_numbers import Module, Parameter, matching, parameters, replaced

_MOTIONS = ("turn_x", "turn_y", "turn_z", "move_x", "move_y", "move_z")
"""What a pose is moved by, in the order of a twist; a rotation by the first three."""


class Input(Part):
    r"""A number of a scene that is an input, as the tension of a tendon is.

    A pose or a rotation is no number that can be given freely. Its inputs move it from where the
    scene has it, about and along its own axes: by the rotation vector $\varphi$ [rad] and the
    displacement p [m],

    $$g = g_0 \begin{pmatrix} \exp \tilde\varphi & p \\ 0 & 1 \end{pmatrix}.$$

    **Arguments:**
    - `number`: a name of `vsr_jax.parameters`, as `"rod.length"`; one entry of an array, as
      `"held[0].position[2]"`; or the array, each entry of which is an input. Of a pose the entries
      are `turn_x`, `turn_y`, `turn_z`, `move_x`, `move_y` and `move_z`, as in `"rod.base.turn_x"`;
      of a rotation the first three. Several names, and a name with `[*]`, have the same inputs.
    - `low`, `high`: least and greatest value, one for all of an array or one for each entry;
      without bounds by default.

    **Raises:** `ValueError` for bounds that contradict each other.
    """

    number: str | tuple[str, ...] = eqx.field(static=True)
    low: float | tuple[float, ...] | None = eqx.field(static=True)
    high: float | tuple[float, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        number: str | Sequence[str],
        *,
        low: float | Sequence[float] | None = None,
        high: float | Sequence[float] | None = None,
    ):
        names = (number,) if isinstance(number, str) else tuple(number)
        if not names or not all(isinstance(name, str) for name in names):
            raise ValueError(f"Input.number: got {number!r}, need the name of a number, or several")
        self.number = names[0] if len(names) == 1 else names
        self.low, self.high = _bound("low", low), _bound("high", high)
        least = -np.inf if self.low is None else self.low
        most = np.inf if self.high is None else self.high
        if np.any(np.greater(least, most)):
            raise ValueError(f"Input.low: got {low!r} with high={high!r}, need low <= high")

    @property
    def names(self) -> tuple[str, ...]:
        """The names it was given."""
        return (self.number,) if isinstance(self.number, str) else self.number


def _bound(name: str, value: object) -> float | tuple[float, ...] | None:
    if value is None:
        return None
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        array = np.asarray(np.nan)
    if array.ndim > 1 or np.any(np.isnan(array)):
        raise ValueError(f"Input.{name}: got {value!r}, need a number, or one for each entry")
    return tuple(array.tolist()) if array.ndim else float(array)


class InputRange(NamedTuple):
    """One input of a scene.

    **Fields:** its `name`, the class of an actuator or the name of a number; its `unit`; its least
    and greatest value, `low` and `high`.
    """

    name: str
    unit: str
    low: float = -np.inf
    high: float = np.inf


Place = tuple[str, int]
"""An entry of an array of a scene: the array's name and the flat index, of a pose that of a
motion."""


class Driven(NamedTuple):
    """One number that is an input: its range, and the places where its value goes."""

    range: InputRange
    places: tuple[Place, ...]


def driven_by(scene: Part, inputs: Sequence[Input]) -> tuple[Driven, ...]:
    """The numbers of a scene that inputs drive, in order.

    **Raises:** `ValueError` for a name that the scene does not have, arrays of different sizes that
    share inputs, as many bounds as entries but another number, and a number that two inputs drive.
    """
    known = parameters(scene)
    places = dict(_places(known))
    found, taken = [], {}
    for i, one in enumerate(inputs):
        arrays = [place for name in one.names for place in _matched(name, places, i)]
        if len({len(rows) for _, rows in arrays}) > 1:
            sizes = ", ".join(f"{name} {len(rows)}" for name, rows in arrays)
            raise ValueError(
                f"Scene.driven[{i}].number: got numbers of different sizes, {sizes}; need one size"
            )
        rows = arrays[0][1]
        ends = [_ends(f"Scene.driven[{i}]", one, name, len(rows)) for name in ("low", "high")]
        for j, (entry, low, high) in enumerate(zip(rows, *ends, strict=True)):
            each = tuple(others[j] for _, others in arrays)
            for place in each:
                if place in taken:
                    raise ValueError(
                        f"Scene.driven[{i}].number: got {_name(known, place)}, which "
                        f"driven[{taken[place]}] drives too"
                    )
                taken[place] = i
            unit = _unit(known, entry)
            found.append(Driven(InputRange(_name(known, entry), unit, low, high), each))
    return tuple(found)


def _places(known: Mapping[str, Parameter]) -> Iterator[tuple[str, list[Place]]]:
    """The places of each array and of each of its entries, by their names."""
    for name, parameter in known.items():
        size = len(_motions(parameter)) or parameter.value.size
        rows = [(name, i) for i in range(size)]
        yield name, rows
        for row in rows if len(rows) > 1 else ():
            yield _name(known, row), [row]


def _matched(
    pattern: str, places: Mapping[str, list[Place]], i: int
) -> list[tuple[str, list[Place]]]:
    try:
        return [(name, places[name]) for name in matching(pattern, places)]
    except ValueError as error:
        raise ValueError(f"Scene.driven[{i}].number: got {error}") from None


def _motions(parameter: Parameter) -> tuple[str, ...]:
    """Names of the motions of a pose or a rotation; none of other numbers."""
    if not parameter.pose:
        return ()
    return _MOTIONS if parameter.value.shape[-1] == 4 else _MOTIONS[:3]


def _name(known: Mapping[str, Parameter], place: Place) -> str:
    name, i = place
    motions = _motions(known[name])
    return f"{name}.{motions[i]}" if motions else known[name].entries(name)[i][0]


def _unit(known: Mapping[str, Parameter], place: Place) -> str:
    name, i = place
    if known[name].pose:
        return "rad" if i < 3 else "m"
    return known[name].entries(name)[i][1]


def _ends(path: str, one: Input, name: str, size: int) -> list[float]:
    """A bound of each of `size` inputs."""
    value = getattr(one, name)
    if isinstance(value, tuple):
        if len(value) != size:
            raise ValueError(f"{path}.{name}: got {len(value)} numbers, need one or {size}")
        return list(value)
    return [(-np.inf if name == "low" else np.inf) if value is None else value] * size


def check_free(scene: Part, inputs: Sequence[Input], places: Iterable[Place]) -> None:
    """Raises `ValueError` for a place whose number is an input, so that the scene's own one has no
    effect: it cannot be found by a fit or a design, nor moved by a slider."""
    if not inputs:
        return
    known = parameters(scene)
    driven = {place for one in driven_by(scene, inputs) for place in one.places}
    for place in places:
        if place in driven and not known[place[0]].pose:
            raise ValueError(
                f"got {_name(known, place)}, which is an input of the scene; need numbers that the "
                f"inputs do not give"
            )


def rest_of(scene: Part, driven: Sequence[Driven]) -> list[Scalar]:
    """The values at which the driven numbers are those of the scene itself."""
    known, found = parameters(scene), []
    for one in driven:
        name, i = one.places[0]
        value = known[name].value
        found.append(jnp.zeros((), value.dtype) if known[name].pose else value.reshape(-1)[i])
    return found


def with_driven(scene: Module, driven: Sequence[Driven], values: Sequence[Array]) -> Module:
    """The scene with values of its driven numbers."""
    given: dict[str, dict[int, Array]] = {}
    for one, value in zip(driven, values, strict=True):
        for name, i in one.places:
            given.setdefault(name, {})[i] = value
    known = parameters(scene)
    return replaced(scene, {name: _changed(known[name], rows) for name, rows in given.items()})


def _changed(parameter: Parameter, rows: Mapping[int, Array]) -> Array:
    """An array with new values of some entries, or a pose after some motions."""
    old = parameter.value
    if not parameter.pose:
        new = jnp.stack([value.astype(old.dtype) for value in rows.values()])
        return old.reshape(-1).at[np.array(list(rows))].set(new).reshape(old.shape)
    none = jnp.zeros((), old.dtype)
    by = [rows[i].astype(old.dtype) if i in rows else none for i in range(6)]
    turn = stacked_rotation(jnp.stack(by[:3]))
    if old.shape[-1] == 3:
        return old @ turn
    motion = jnp.eye(4, dtype=old.dtype).at[:3, :3].set(turn).at[:3, 3].set(jnp.stack(by[3:]))
    return old @ motion
