"""Whether measured positions can belong to an arm: units, and distances from its base."""

from collections.abc import Sequence

import numpy as np

from ..arm.scene import Scene
from .measurements import Measurements
from .observation import Markers
from .unknowns import POSITION, Column

_STRETCH = 1.5
"""Length of a stretched arm over its length at rest up to which a position is believed."""
_NEAR = 0.01
"""Share of the reach below which all positions together are too close to the base."""


def check_positions(scene: Scene, data: Measurements, columns: Sequence[Column]) -> None:
    """Raises `ValueError` for markers that the arm cannot reach, and for those that look as if they
    were given in millimetres."""
    base = np.zeros(3) if scene.rod.base is None else np.asarray(scene.rod.base)[:3, 3]
    length = float(scene.rod.length)
    for one in data.observations:
        if not isinstance(one, Markers):
            continue
        X = length if one.X is None else np.asarray(one.X)
        room = _STRETCH * X + np.linalg.norm(np.asarray(one.offset), axis=1)
        room = room + _shift(columns, (POSITION, f"{one.name}.offset"))
        if not one.labelled:
            room = np.full_like(room, np.max(room))
        distance = np.linalg.norm(np.asarray(one.value, float) - base, axis=-1)
        if not np.any(distance > room):
            if np.nanmax(distance) < _NEAR * np.max(room):
                raise ValueError(
                    f"{one.name}: got positions within {np.nanmax(distance):.3g} m of the base of "
                    f"an arm of {length:g} m, need both in metres; is the scene in millimetres?"
                )
            continue
        shape, row = np.argwhere(distance > room)[0]
        found = f"{distance[shape, row]:.3g} m from the base of an arm of {length:g} m"
        if not np.any(distance / 1000 > room) and np.nanmedian(distance / room) > 10:
            raise ValueError(
                f"{one.name}: got {one.labels[row]} {found}, need metres; these look like "
                f"millimetres"
            )
        raise ValueError(
            f"{one.name}: got {one.labels[row]} of shape {shape} {found}, need positions that it "
            f"can reach (at most {np.broadcast_to(room, len(one.labels))[row]:.3g} m)"
        )


def _shift(columns: Sequence[Column], names: tuple[str, ...]) -> float:
    """Largest displacement that unknown base positions and offsets allow [m]."""
    sizes = {
        name: [
            max(abs(column.low), abs(column.high))
            for column in columns
            if any(slot[0] == name for slot, _, _ in column.acts)
        ]
        for name in names
    }
    return float(sum(np.linalg.norm(size) for size in sizes.values() if size))
