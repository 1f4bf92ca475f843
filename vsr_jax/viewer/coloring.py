"""What colours mean in the page: strain and stress of the wall, tension and pressure of the
threads."""

from collections.abc import Callable
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Colormap, to_hex

from ..arm.scene import Scene
from ..viz.style import PRESSURE, TENSION
from .description import Shape
from .sliders import prefixed

BANDS = 32
"""Colours of a scale. The page colours triangles, not points."""

_SHRINK = 0.5
"""Share of a scale below which it becomes smaller."""
_ROUND = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
"""Ends of scales, times a power of ten."""


class Coloring(NamedTuple):
    """A quantity that is shown in colour.

    **Fields:** its name and its `unit`; the `values` at the wall, or where it is `of_threads` those
    of each thread, NaN without; the `map` of colours; `signed`, whether zero is in the middle of
    the scale; `ends`, what its lowest and its highest value mean.
    """

    label: str
    unit: str
    values: Callable[[Shape], np.ndarray]
    map: Colormap
    signed: bool = True
    ends: tuple[str, str] = ("", "")
    of_threads: bool = False


def _known(values: np.ndarray | None) -> np.ndarray:
    return np.zeros(0) if values is None else values


COLORINGS = {
    "strain": Coloring(
        "strain along the arm", "", lambda s: s.strain, TENSION, ends=("short", "long")
    ),
    "stress": Coloring(
        "von Mises stress", "Pa", lambda s: s.stress, mpl.colormaps["viridis"], signed=False
    ),
    "tension": Coloring(
        "thread tension",
        "N",
        lambda s: _known(s.body.tension),
        TENSION,
        ends=("pushes", "pulls"),
        of_threads=True,
    ),
    "pressure": Coloring(
        "chamber pressure",
        "Pa",
        lambda s: _known(s.body.pressure),
        PRESSURE,
        ends=("pulls", "pushes"),
        of_threads=True,
    ),
}
"""The choices by name."""


def colorings_of(scene: Scene) -> tuple[str, ...]:
    """Names of the choices for a scene: pressure only with chambers, tension only with other
    threads, stress only where moduli are known."""
    inflated = [actuator.pressure_area is not None for actuator in scene.actuators]
    there = {"tension": not all(inflated), "pressure": any(inflated)}
    there["stress"] = scene.rod.material.moduli(0.0, scene.rod.length) is not None
    return tuple(name for name in COLORINGS if there.get(name, True))


class Scale:
    """A scale of colours with a round end, which follows the values slowly: colours of neighbouring
    shapes can be compared."""

    def __init__(self, coloring: Coloring):
        self.coloring, self.high = coloring, 0.0

    @property
    def low(self) -> float:
        """The lowest value."""
        return -self.high if self.coloring.signed else 0.0

    def cover(self, values: np.ndarray) -> None:
        """Extends the scale to values, or shortens it where it is far too long."""
        greatest = float(np.nanmax(np.abs(values), initial=0.0))
        if greatest > self.high or greatest < _SHRINK * self.high:
            self.high = rounded_up(greatest)

    def levels(self, values: np.ndarray) -> np.ndarray:
        """Index of the colour of each value."""
        span = self.high - self.low
        share = (values - self.low) / span if span else np.full(np.shape(values), 0.5)
        return np.clip(np.floor(share * BANDS), 0, BANDS - 1).astype(int)

    def colors(self) -> np.ndarray:
        """The colours as bytes, shape (BANDS, 3)."""
        middles = (np.arange(BANDS) + 0.5) / BANDS
        return np.rint(255 * np.asarray(self.coloring.map(middles))[:, :3]).astype(np.uint8)

    def html(self) -> str:
        """The colour bar for the page."""
        stops = ", ".join(to_hex(self.coloring.map(x)) for x in np.linspace(0, 1, 9))
        factor, unit = prefixed(self.high, self.coloring.unit)
        ends = [
            " ".join(filter(None, (f"{x / factor:.3g}", unit, meaning)))
            for x, meaning in zip((self.low, self.high), self.coloring.ends, strict=True)
        ]
        return (
            '<div style="padding:0.2em 0.9em;font-size:0.8em">'
            f"<div>{self.coloring.label}</div>"
            f'<div style="height:0.8em;background:linear-gradient(90deg,{stops})"></div>'
            '<div style="display:flex;justify-content:space-between">'
            f"<span>{ends[0]}</span><span>{ends[1]}</span></div></div>"
        )


def rounded_up(value: float) -> float:
    """The next round number, 0 for 0."""
    if value <= 0:
        return 0.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(m * power for m in _ROUND if m * power >= value * (1 - 1e-9)))
