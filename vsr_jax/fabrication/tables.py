"""Tables for the workshop: thread paths, a drilling plan for discs, a bill of lengths; in
millimetres and degrees."""

import csv
import io
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..arm.actuator import Actuator
from ..arm.scene import Scene
from ..files.output import replacing
from ..typing import PathLike
from .stations import MILLIMETRES, Stations, sections_at, thread_ends
from .walls import channels

_DECIMALS = 4
"""Decimals of millimetres and degrees in tables that are printed or drilled from."""

_PATH_DECIMALS = 6


class Table(NamedTuple):
    """Rows under the names of their columns, which hold the units."""

    columns: tuple[str, ...]
    rows: list[tuple[Any, ...]]

    def __str__(self) -> str:
        cells = [self.columns, *([_text(value) for value in row] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        lines = [
            "  ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True))
            for row in cells
        ]
        return "\n".join(f"  {line}" for line in lines)

    def column(self, name: str) -> list[Any]:
        """The values of a column.

        **Raises:** `ValueError` for an unknown name.
        """
        return [row[self.columns.index(name)] for row in self.rows]


def write_csv(path: PathLike, table: Table) -> None:
    """Writes a table as CSV with one line of names."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(table.rows)
    with replacing(path) as part:
        part.write_text(text.getvalue(), encoding="utf-8")


def path_table(stations: Stations) -> Table:
    """The path of each thread: positions in space, and in the section."""
    columns = ("thread", "X [mm]", "x [mm]", "y [mm]", "z [mm]")
    columns += ("section y [mm]", "section z [mm]", "angle [deg]", "radius [mm]")
    rows: list[tuple[Any, ...]] = []
    positions = stations.threads
    for i, laid in enumerate(stations.laid.T):
        single = laid & np.append(np.diff(stations.X) > 0, True)
        single |= laid & ~np.append(laid[1:], False)
        for row in np.flatnonzero(single):
            place = [stations.X[row], *positions[row, i], *stations.path[row, i]]
            angle, radius = _polar(stations.path[row, i])
            values = [*(MILLIMETRES * x for x in place), angle, MILLIMETRES * radius]
            rows.append((i, *(_rounded(value, _PATH_DECIMALS) for value in values)))
    return Table(columns, rows)


def hole_table(
    scene: Scene, X: Float[np.ndarray, " discs"], bores: Float[np.ndarray, " threads"]
) -> Table:
    """Holes of discs at abscissas X [m]: angle from the y axis towards z, radius from the axis,
    diameter, and the tilt of the thread at rest from the disc's normal."""
    columns = ("disc", "X [mm]", "thread", "angle [deg]", "radius [mm]")
    columns += ("y [mm]", "z [mm]", "tilt [deg]", "bore [mm]")
    path, slope, laid = sections_at(scene, X)
    rows = []
    for disc, thread in zip(*np.nonzero(laid), strict=True):
        angle, radius = _polar(path[disc, thread])
        tilt = float(np.degrees(np.arctan(np.linalg.norm(slope[disc, thread]))))
        y, z = MILLIMETRES * path[disc, thread]
        values = (angle, MILLIMETRES * radius, y, z, tilt, float(MILLIMETRES * bores[thread]))
        place = (int(disc), _rounded(float(MILLIMETRES * X[disc])), int(thread))
        rows.append((*place, *map(_rounded, values)))
    return Table(columns, rows)


def length_table(
    scene: Scene,
    stations: Stations,
    bores: Float[np.ndarray, " threads"],
    lengths: tuple[np.ndarray, np.ndarray],
) -> Table:
    """The bill of lengths: each cable or tube with its anchors, its length at rest and in the
    exported shape, its bore and where it runs."""
    columns = ("thread", "part", "from X [mm]", "to X [mm]")
    columns += ("at rest [mm]", "as exported [mm]", "bore [mm]", "runs")
    inside, rows = channels(stations), []
    for i, (start, end) in enumerate(thread_ends(scene)):
        values = (start, end, lengths[0][i], lengths[1][i], bores[i])
        buried = inside[stations.laid[:, i], i]
        runs = "in a channel" if np.all(buried) else "partly in a channel"
        runs = runs if np.any(buried) else "in the open"
        sizes = (_rounded(MILLIMETRES * value) for value in values)
        rows.append((i, part_name(scene.actuators[i]), *sizes, runs))
    return Table(columns, rows)


def part_name(actuator: Actuator) -> str:
    """What a workshop calls a thread: a tube where a pressure drives it, else a cable."""
    return "cable" if actuator.pressure_area is None else "tube"


def _polar(yz: np.ndarray) -> tuple[float, float]:
    """Angle [deg] from 0 to 360 and radius."""
    angle = np.round(np.degrees(np.arctan2(yz[1], yz[0])), _PATH_DECIMALS) % 360
    return float(angle), float(np.hypot(*yz))


def _rounded(value: float, decimals: int = _DECIMALS) -> float:
    return round(float(value), decimals) + 0.0  # + 0.0 turns -0 into 0


def _text(value: Any) -> str:
    return (
        f"{value:g}"
        if isinstance(value, float) and value == int(value)
        else (f"{value:.3f}" if isinstance(value, float) else str(value))
    )
