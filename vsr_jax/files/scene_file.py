"""Scenes as TOML files: every object is a table with `type = "Helix"` and the arguments of its
constructor by name.

The top level of a file contains the arguments of `Scene` and, optionally, a `title` and `inputs`.
Units are those of the constructors. The type is optional where only one class is possible (`rod`,
`discs`, `rigid`) and for a `Material`. A profile can be a plain number.

A new class needs an entry in its group below and a field for each argument of its constructor, of
the same name. An argument without a field is read but not written, as `diameter` of `Circular`.
"""

import difflib
import inspect
import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from jaxtyping import Array, Float

from ..arm.actuator import Chamber, Tendon, Thread
from ..arm.composite import Composite, Inclusion
from ..arm.discs import Discs
from ..arm.driven import Input
from ..arm.fields import arguments
from ..arm.held import Held
from ..arm.loads import DistributedWrench, Gravity, PointWrench, TipWrench
from ..arm.material import Material
from ..arm.obstacles import Box, Cylinder, Plane, Sphere
from ..arm.pose_loads import MagneticDensity, MagneticMoment, Payload, Spinning, Spring
from ..arm.profile import Constant, Piecewise, PolynomialProfile, SplineProfile, Taper
from ..arm.rigid_piece import RigidPiece
from ..arm.rod import Rod
from ..arm.routing import Helix, Linear, Parallel, Polynomial, Spline
from ..arm.rubber import NeoHookean, Ogden
from ..arm.scene import Scene
from ..arm.section import Annular, Circular, Elliptic, Joined, Rectangular
from ..arm.stiffness import Stiffness
from ..arm.tube import Tube
from ..typing import PathLike, VectorLike
from ..validation import concrete
from .output import replacing

Group = dict[str, type]

Table = dict[str, Any]
"""A table of a TOML file."""


def _group(*kinds: type) -> Group:
    return {kind.__name__: kind for kind in kinds}


_PROFILES = _group(Constant, Taper, PolynomialProfile, SplineProfile, Piecewise)
_SECTIONS = _group(Circular, Annular, Rectangular, Elliptic, Joined)
_GROUPS = {
    "rod": _group(Rod),
    "discs": _group(Discs),
    "rigid": _group(RigidPiece),
    "material": _group(Material, NeoHookean, Ogden, Composite, Stiffness),
    "inclusions": _group(Inclusion),
    "section": _SECTIONS,
    "sections": _SECTIONS,
    "routing": _group(Parallel, Linear, Helix, Polynomial, Spline),
    "actuators": _group(Thread, Tendon, Chamber),
    "loads": _group(
        Gravity,
        TipWrench,
        PointWrench,
        DistributedWrench,
        Spring,
        Payload,
        MagneticMoment,
        MagneticDensity,
        Spinning,
    ),
    "held": _group(Held),
    "obstacles": _group(Plane, Sphere, Cylinder, Box, Tube),
    "driven": _group(Input),
}
"""Classes that are possible under a key; profiles under every other key."""

_USUAL = (Material,)
"""Classes of a table without a type where others are possible too."""

_FILE_KEYS = ("title", "inputs")
_SHORT_LIST = re.compile(r"\[\n[^][{}]*\]")


class SceneFile(NamedTuple):
    """Contents of a scene file.

    **Fields:** the `scene`; `inputs`, one number per actuator, None if the file has none; the
    `title`, free text.
    """

    scene: Scene
    inputs: Float[Array, " inputs"] | None = None
    title: str = ""


def load(path: PathLike) -> SceneFile:
    """Reads a scene from a TOML file.

    Numbers have JAX's default precision: for float64 set `jax_enable_x64` first.

    **Arguments:** `path`: the file.

    **Returns:** a `SceneFile`: the scene, its inputs and its title.

    **Raises:** `ValueError`, one line that starts with the file's name, if the file cannot be read,
    is not TOML (with line and column) or has a key or value that is unknown, missing or rejected by
    a constructor (with the key's path).
    """
    try:
        return parse_scene(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def parse_scene(text: str) -> SceneFile:
    """The scene in a TOML text, as `load` reads it from a file.

    **Raises:** `ValueError` as `load`, without the file's name.
    """
    return parse_table(tomllib.loads(text), "")


def parse_table(table: Table, path: str) -> SceneFile:
    """The scene in a table of a TOML file; `path` is the path of the table's key.

    **Raises:** `ValueError` as `load`, without the file's name.
    """
    check_keys(Scene, table, path, _FILE_KEYS)
    title, inputs = table.get("title", ""), table.get("inputs")
    if not isinstance(title, str):
        raise ValueError(at(path, f"title: got {title!r}, need text"))
    scene = build(
        Scene, {key: value for key, value in table.items() if key not in _FILE_KEYS}, path
    )
    return SceneFile(scene, None if inputs is None else scene.check_inputs(inputs), title)


def to_toml(scene: Scene, inputs: VectorLike | None = None, title: str = "") -> str:
    """A scene as TOML text, which `parse_scene` reads back bit-identically in the same
    precision.

    Arguments with their default value are omitted.

    **Arguments:**
    - `scene`: the scene.
    - `inputs`: one number per actuator, stored with the scene.
    - `title`: free text.

    **Raises:** `ValueError` for a scene with Python functions or user-defined classes, with their
    path; for a scene traced by a JAX transformation such as `jax.jit`; and for invalid inputs.
    """
    head: Table = {"title": title} if title else {}
    if inputs is not None:
        head["inputs"] = _numbers(scene.check_inputs(inputs), "inputs")
    text = tomli_w.dumps(head | _arguments(scene, ""))
    return _SHORT_LIST.sub(_on_one_line, text)


def save(scene: Scene, path: PathLike, inputs: VectorLike | None = None, title: str = "") -> None:
    """Writes a scene to a TOML file, which `load` reads. Arguments and errors as for `to_toml`.

    The write is atomic: an interrupted call leaves the previous file.
    """
    text = to_toml(scene, inputs, title)
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")


def _on_one_line(match: re.Match[str]) -> str:
    # The writer puts each item on a line of its own. Quoted text has no line breaks, so every line
    # break is between items.
    return "[" + re.sub(r",?\n\s*", ", ", match[0][1:-1]).strip(", ") + "]"


def _read(value: Any, path: str, group: Group) -> Any:
    if isinstance(value, list):
        return [_read(item, f"{path}[{i}]", group) for i, item in enumerate(value)]
    if isinstance(value, dict):
        kind = kind_of(value, path, group)
        return build(kind, {key: item for key, item in value.items() if key != "type"}, path)
    if group is not _PROFILES:
        raise ValueError(
            f"{path}: got {value!r}, need a table of the type {' or '.join(sorted(group))}"
        )
    return value


def kind_of(table: Table, path: str, group: Group) -> type:
    """The class named by the `type` of a table, one of a group."""
    known = ", ".join(sorted(group))
    if "type" not in table:
        usual = _usual(group)
        if usual is not None:
            return usual
        raise ValueError(f"{path}: missing key 'type', known types are {known}")
    name = table["type"]
    if not isinstance(name, str) or name not in group:
        raise ValueError(f"{path}: unknown type {name!r}, known are {known}{_guess(name, group)}")
    return group[name]


def _usual(group: Group) -> type | None:
    """The class of a table without a type; None if it needs one."""
    return next((kind for kind in group.values() if len(group) == 1 or kind in _USUAL), None)


def build(kind: type, table: Table, path: str) -> Any:
    """The object of a class with the arguments in a table, and with the parts of a scene in the
    tables below it.

    **Raises:** `ValueError` as `construct`.
    """

    def read(key: str, value: Any) -> Any:
        return _read(value, _below(path, key), _GROUPS.get(key, _PROFILES))

    return construct(kind, table, path, read)


def construct(
    kind: type, table: Table, path: str, read: Callable[[str, Any], Any] = lambda key, value: value
) -> Any:
    """The object of a class with the arguments in a table.

    **Arguments:** `path`: of the table's key; `read`: function of a key and its value that returns
    the argument.

    **Raises:** `ValueError` with the path for unknown and missing keys, and for arguments that the
    class rejects.
    """
    check_keys(kind, table, path)
    given = {key: read(key, value) for key, value in table.items()}
    try:
        return kind(**given)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(at(path, " ".join(str(error).split()))) from None


def check_keys(kind: type, table: Table, path: str, more: tuple[str, ...] = ()) -> None:
    """Raises `ValueError` for keys that are not arguments of a class and for missing ones."""
    parameters = inspect.signature(kind).parameters
    known = sorted((*parameters, *more))
    for key in table:
        if key not in known:
            raise ValueError(
                at(path, f"unknown key {key!r}, known are {', '.join(known)}{_guess(key, known)}")
            )
    for name, parameter in parameters.items():
        if parameter.default is parameter.empty and name not in table:
            raise ValueError(at(path, f"missing key {name!r}, known are {', '.join(known)}"))


def _guess(name: object, known: Iterable[str]) -> str:
    names = {candidate.lower(): candidate for candidate in known}
    close = difflib.get_close_matches(str(name).lower(), names, n=1)
    return f"; did you mean {names[close[0]]!r}?" if close else ""


def _below(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def at(path: str, message: str) -> str:
    """A message with the path of its key in front."""
    return f"{path}: {message}" if path else message


def _arguments(value: Any, path: str) -> Table:
    table = {}
    for argument in arguments(value):
        name = argument.name
        plain = _write(argument.value, _below(path, name), _GROUPS.get(name, _PROFILES))
        if not _same(plain, argument.default):
            table[name] = plain
    return table


def _write(value: Any, path: str, group: Group) -> Any:
    if isinstance(value, Constant):
        return _numbers(value.value, path)
    if isinstance(value, str | int):
        return value
    if isinstance(value, tuple | list):
        return [_write(item, f"{path}[{i}]", group) for i, item in enumerate(value)]
    if isinstance(value, float | np.ndarray | Array):
        return _numbers(value, path)
    name = type(value).__name__
    if group.get(name) is not type(value):
        raise ValueError(
            f"{path}: a {name} cannot be stored in a scene file; need one of "
            f"{', '.join(sorted(group))}"
        )
    table = _arguments(value, path)
    return table if type(value) is _usual(group) else {"type": name} | table


def _numbers(value: Any, path: str) -> Any:
    """Numbers as floats with the shortest decimals that are exact in the numbers' precision."""
    known = concrete(value)
    if known is None:
        raise ValueError(f"{path}: a traced value cannot be stored in a scene file")
    return np.array([float(str(x)) for x in known.ravel()]).reshape(known.shape).tolist()


def _same(plain: Any, default: Any) -> bool:
    if isinstance(plain, list):
        defaults = default if isinstance(default, tuple | list) else [default] * len(plain)
        return len(defaults) == len(plain) and all(map(_same, plain, defaults))
    if isinstance(plain, float) and isinstance(default, int | float):
        return repr(plain) == repr(float(default))
    return plain == default
