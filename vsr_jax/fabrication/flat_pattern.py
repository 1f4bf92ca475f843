"""Flat patterns: threads unrolled onto a sheath that is cut flat and wound around the arm, as
DXF."""

from collections.abc import Iterator

import numpy as np

from ..files.output import replacing
from ..typing import PathLike
from .libraries import library
from .stations import MILLIMETRES, Stations

_EDGES = "edges"


def write_dxf(path: PathLike, stations: Stations, arc: np.ndarray) -> None:
    """Writes the threads unrolled at rest, in millimetres: the arc length of the axis along x,
    angle times radius of the thread across it. Angles count from the y axis of the section to z.

    Each thread is in a layer of its own, broken at the seam; the layer `edges` has the edges of the
    sheath of each thread, one turn wide. The seam is in the middle of the widest gap between the
    threads at their starts. For a thread of constant radius the pattern has true lengths.

    **Arguments:** `arc`: arc length of the axis at rest at the stations [m].

    **Raises:** `ImportError` without ezdxf.
    """
    ezdxf = library("ezdxf")
    drawing = ezdxf.new(units=ezdxf.units.MM)
    space, seam = drawing.modelspace(), _seam(stations)
    drawing.layers.add(_EDGES, color=8)
    edges: list[np.ndarray] = []
    for i, laid in enumerate(stations.laid.T):
        layer = f"thread {i}"
        drawing.layers.add(layer, color=1 + i % 6)
        along, (y, z) = arc[laid], stations.path[laid, i].T
        radius = np.hypot(y, z)
        turns = (np.unwrap(np.arctan2(z, y)) - seam) / (2 * np.pi)
        for part in _turns(along, turns, radius, seam):
            space.add_lwpolyline(MILLIMETRES * part, dxfattribs={"layer": layer})
        edge = MILLIMETRES * _sheath(along, radius, seam)
        known = any(e.shape == edge.shape and np.allclose(e, edge, atol=1e-6) for e in edges)
        if not known:
            edges.append(edge)
            space.add_lwpolyline(edge, close=True, dxfattribs={"layer": _EDGES})
    with replacing(path) as part:
        drawing.saveas(part, encoding="utf-8")


def _seam(stations: Stations) -> float:
    """Angle [rad] in the middle of the widest gap between the threads at their starts."""
    paths = zip(np.moveaxis(stations.path, 1, 0), stations.laid.T, strict=True)
    starts = np.array([path[laid][0] for path, laid in paths]).reshape(-1, 2)
    angles = np.sort(np.arctan2(starts[:, 1], starts[:, 0])) if starts.size else np.zeros(1)
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    widest = int(np.argmax(gaps))
    return float(angles[widest] + gaps[widest] / 2 - 2 * np.pi)


def _turns(
    along: np.ndarray, turns: np.ndarray, radius: np.ndarray, seam: float
) -> Iterator[np.ndarray]:
    """The unrolled path, a part for each turn, with points on the seam where it is crossed."""
    whole = np.arange(np.ceil(np.min(turns)), np.floor(np.max(turns)) + 1)
    at = sorted(
        row + (turn - turns[row]) / (turns[row + 1] - turns[row])
        for turn in whole
        for row in np.flatnonzero((turns[:-1] < turn) != (turns[1:] < turn))
    )
    rows = np.arange(turns.size)
    for low, high in zip([0.0, *at], [*at, turns.size - 1.0], strict=True):
        if high <= low:
            continue
        places = np.concatenate(([low], rows[(rows > low) & (rows < high)], [high]))
        x, turn, r = (np.interp(places, rows, values) for values in (along, turns, radius))
        turn = turn - np.floor((turn[0] + turn[-1]) / 2 if turn.size == 2 else turn[1])
        yield np.stack((x, (seam + 2 * np.pi * turn) * r), axis=-1)


def _sheath(along: np.ndarray, radius: np.ndarray, seam: float) -> np.ndarray:
    """Edges of the sheath of a thread, one turn wide."""
    low = np.stack((along, seam * radius), axis=-1)
    high = np.stack((along, (seam + 2 * np.pi) * radius), axis=-1)
    if np.ptp(radius) <= 1e-9 * np.max(radius, initial=1e-3):
        low, high = low[[0, -1]], high[[0, -1]]
    return np.concatenate((low, high[::-1]))
