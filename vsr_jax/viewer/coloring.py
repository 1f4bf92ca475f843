"""What colours mean in the page: strain and stress of the wall, tension of the threads."""

from collections.abc import Callable
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.colors import Colormap, to_hex

from ..viz.style import TENSION
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

    **Fields:** its name and its `unit`; the `values` at the wall, or of the threads; `signed`,
    whether zero is in the middle of the scale; `ends`, what its lowest and its highest value mean.
    """

    label: str
    unit: str
    values: Callable[[Shape], np.ndarray]
    signed: bool
    ends: tuple[str, str] = ("", "")

    @property
    def map(self) -> Colormap:
        """Its colours."""
        return TENSION if self.signed else mpl.colormaps[mpl.rcParamsDefault["image.cmap"]]


def _tension(shape: Shape) -> np.ndarray:
    tension = shape.body.tension
    return np.zeros(0) if tension is None else tension


COLORINGS = {
    "strain": Coloring("strain along the arm", "", lambda s: s.strain, True, ("short", "long")),
    "stress": Coloring("von Mises stress", "Pa", lambda s: s.stress, False),
    "tension": Coloring("thread tension", "N", _tension, True, ("pushes", "pulls")),
}
"""The choices by name."""


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
        greatest = float(np.max(np.abs(values), initial=0.0))
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
