"""Names, units and descriptions in the store of a sweep: dimensions, coordinates and attributes in
the form that xarray reads."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import PyTree

from ..arm.scene import Scene
from ..files.scene_file import to_toml
from ..models.base import Model, Status
from ..models.strain_dependent import StrainDependent
from ..solution.energy import Energy
from ..typing import VectorLike
from .sweep_program import Task, number, stored_outputs


class Label(NamedTuple):
    """Dimension names and attributes of an array."""

    dims: tuple[str, ...]
    attributes: dict[str, Any]


class Labels(NamedTuple):
    """Metadata of a store: a label for each array, the values of the coordinates, and the
    attributes of the group."""

    arrays: dict[str, Label]
    coordinates: dict[str, np.ndarray]
    attributes: dict[str, Any]


class _Coordinate(NamedTuple):
    dim: str
    long_name: str
    values: np.ndarray


_FORCES_AS_Q = "Coordinates of the strain in the model's basis: the thread forces"

_STATUS = {
    "long_name": "how the solve ended",
    "flag_values": [int(status) for status in Status],
    "flag_meanings": " ".join(status.name.lower() for status in Status),
}

_AXES = {
    "row": _Coordinate(
        "row",
        "component in the world frame, w: last row of the homogeneous matrix",
        np.array(["x", "y", "z", "w"]),
    ),
    "column": _Coordinate(
        "column",
        "axis of the tip's section, or its position",
        np.array(["axis_x", "axis_y", "axis_z", "position"]),
    ),
    "column_units": _Coordinate(
        "column", "unit of each column of the pose", np.array(["1", "1", "1", "m"])
    ),
    "part": _Coordinate("part", "part of the energy", np.array(Energy._fields)),
}
"""Coordinates of the axes of quantities, by name."""


def labels(
    task: Task, like: Mapping[str, Any], samples: PyTree, flat: Mapping[str, np.ndarray]
) -> Labels:
    """Labels of a sweep's store.

    **Arguments:** `task`; `like`: shapes and dtypes of its outputs; `samples`: all samples as a
    pytree; `flat`: the same as arrays by name.

    **Raises:** `ValueError` for an output with the name of a dimension or coordinate, or with a
    slash in its name.
    """
    scene, inputs = eqx.filter_eval_shape(_given, task, jax.tree.map(lambda x: x[0], samples))
    model = StrainDependent() if task.model is None else task.model
    named = () if callable(task.outputs) else task.outputs
    coordinates = (
        _actuators(scene)
        | _inputs(scene)
        | _axes(named)
        | (_dofs(model, like["q"].shape[1]) if "q" in named else {})
    )
    arrays = {
        name: _sample(name, x, isinstance(task.scene, Scene), coordinates)
        for name, x in flat.items()
    }
    arrays |= {name: _output(name, x, name in named, coordinates) for name, x in like.items()}
    _check_names(like, {*coordinates, *(dim for label in arrays.values() for dim in label.dims)})
    arrays |= {name: Label((c.dim,), {"long_name": c.long_name}) for name, c in coordinates.items()}
    values = {name: c.values for name, c in coordinates.items()}
    return Labels(arrays, values, _attributes(task, model, number(samples), inputs.dtype))


def _axes(named: tuple[str, ...]) -> dict[str, _Coordinate]:
    """Coordinates of the axes of the named quantities."""
    known = stored_outputs()
    dims = {dim for name in named for dim in known[name].dims}
    return {name: axis for name, axis in _AXES.items() if axis.dim in dims}


def _given(task: Task, sample: PyTree) -> tuple[Scene, VectorLike]:
    scene, inputs = task.given(sample)
    return scene, scene.check_inputs(inputs)


def _actuators(scene: Scene) -> dict[str, _Coordinate]:
    kinds = [type(a).__name__ for a in scene.actuators]
    return {
        "actuator": _Coordinate(
            "actuator", "place in scene.actuators", np.arange(len(scene.actuators))
        ),
        "actuator_type": _Coordinate("actuator", "class of the actuator", np.array(kinds, str)),
    }


def _inputs(scene: Scene) -> dict[str, _Coordinate]:
    """Units of the inputs; with driven numbers their names too, on an axis of their own."""
    names, units = ([getattr(x, of) for x in scene.inputs] for of in ("name", "unit"))
    if not scene.driven:
        unit = "unit of the actuator's input"
        return {"input_units": _Coordinate("actuator", unit, np.array(units, str))}
    return {
        "input": _Coordinate("input", "class of an actuator, or number", np.array(names, str)),
        "input_units": _Coordinate("input", "unit of the input", np.array(units, str)),
    }


def _dofs(model: Model, size: int) -> dict[str, _Coordinate]:
    """Names and units of the coordinates q; none where they are the thread forces."""
    pairs = model.dof_labels(size)
    if pairs is None:
        return {}
    names, units = zip(*pairs, strict=True) if pairs else ((), ())
    return {
        "dof": _Coordinate("dof", "strain, and place in its family of functions", np.array(names)),
        "dof_units": _Coordinate("dof", "unit of each coordinate", np.array(units)),
    }


def _sample(
    name: str, x: np.ndarray, inputs: bool, coordinates: Mapping[str, _Coordinate]
) -> Label:
    if not inputs:
        return _labelled(_numbered(name, x.ndim), {"long_name": f"samples, {name}"}, coordinates)
    units = sorted(set(coordinates["input_units"].values.tolist()))
    attributes = {
        "long_name": "inputs of actuators and numbers"
        if "input" in coordinates
        else "inputs of the actuators",
        "units": units[0] if len(units) == 1 else "see input_units",
    }
    return _labelled(("sample", coordinates["input_units"].dim), attributes, coordinates)


def _output(name: str, x: Any, named: bool, coordinates: Mapping[str, _Coordinate]) -> Label:
    if name == "status":
        return Label(("sample",), _STATUS)
    if not named:
        return _labelled(
            _numbered(name, len(x.shape)),
            {"long_name": f"output {name} of the function given to the sweep"},
            coordinates,
        )
    _, dims, unit, long_name = stored_outputs()[name]
    if name == "q" and "dof" not in coordinates:
        dims, unit, long_name = ("actuator",), "N", _FORCES_AS_Q
    for dim in dims:
        if f"{dim}_units" in coordinates:
            unit = f"see {dim}_units"
    return _labelled(("sample", *dims), {"long_name": long_name, "units": unit}, coordinates)


def _numbered(name: str, ndim: int) -> tuple[str, ...]:
    return ("sample", *(f"{name}_dim_{axis}" for axis in range(1, ndim)))


def _labelled(
    dims: tuple[str, ...], attributes: dict[str, Any], coordinates: Mapping[str, _Coordinate]
) -> Label:
    """A label that lists the non-index coordinates, as the CF conventions require."""
    more = [
        name
        for name, coordinate in coordinates.items()
        if coordinate.dim in dims and coordinate.dim != name
    ]
    return Label(dims, attributes | ({"coordinates": " ".join(more)} if more else {}))


def _check_names(outputs: Mapping[str, Any], taken: set[str]) -> None:
    for name in outputs:
        if name in taken or "/" in name:
            raise ValueError(
                f"sweep.outputs: got {name!r}, need a name without / and other than "
                f"{', '.join(sorted(taken))}, for a store"
            )


def _attributes(task: Task, model: Model, samples: int, dtype: Any) -> dict[str, Any]:
    from .. import __version__

    attributes = {
        "title": f"Equilibria of a soft manipulator, {samples} samples",
        "source": f"vsr_jax {__version__}",
        "model": eqx.tree_pformat(model, width=100_000, short_arrays=False),
        "precision": str(dtype),
    }
    if isinstance(task.scene, Scene):
        with suppress(ValueError):  # a scene with Python functions has no file
            attributes["scene"] = to_toml(task.scene)
    return attributes
