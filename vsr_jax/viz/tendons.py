"""Threads of an arm as lines in the colour of their tension, chambers in that of their pressure."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.actuator import Tendon
from ..solution.equilibrium import Equilibrium
from .style import PRESSURE, RGB, TENSION

_IDLE = 1e-9
"""Tension [N] below which a tendon counts as slack."""

SLACK_DASHES = (0.0, (3.0, 2.0))

_BARS = {
    0: [],
    1: [(0.885, 0.25, 0.018, 0.5)],
    2: [(0.885, 0.54, 0.018, 0.32), (0.885, 0.12, 0.018, 0.32)],
}
"""Rectangles of the colour bars in the figure, by their number."""


def is_slack(
    eq: Equilibrium, tension: Float[np.ndarray, " threads"]
) -> Bool[np.ndarray, " threads"]:
    """Which threads are slack: tendons without tension."""
    tendons = [isinstance(actuator, Tendon) for actuator in eq.scene.actuators]
    return np.array(tendons, bool) & (tension <= _IDLE)


class Scale(NamedTuple):
    """Colours of a quantity of threads: `norm` has zero in the middle of the `map`; `low` and
    `high` are the ends of the colour bar, with its `label` and what both ends do, `ends`."""

    label: str
    map: Colormap
    ends: tuple[str, str]
    norm: Normalize
    low: float
    high: float

    def color(self, value: float) -> RGB:
        """Colour of a value."""
        red, green, blue, _ = self.map(self.norm(value))
        return red, green, blue


class Scales(NamedTuple):
    """The scales of tensions [N], and of pressures [kPa] of chambers."""

    tension: Scale
    pressure: Scale

    def colors(self, tension: np.ndarray, pressure: np.ndarray) -> list[RGB]:
        """The colour of each thread, by its pressure [kPa] if it has one, else by its tension."""
        return [
            self.tension.color(t) if np.isnan(p) else self.pressure.color(p)
            for t, p in zip(tension, pressure, strict=True)
        ]


def tension_scale(tensions: Sequence[np.ndarray]) -> Scale:
    """The scale for some sets of tensions [N], see `_scale`."""
    return _scale("thread tension [N]", TENSION, ("pushes", "pulls"), tensions)


def pressure_scale(pressures: Sequence[np.ndarray]) -> Scale:
    """The scale for some sets of pressures [kPa], see `_scale`."""
    return _scale("chamber pressure [kPa]", PRESSURE, ("pulls", "pushes"), pressures)


def _scale(label: str, map: Colormap, ends: tuple[str, str], values: Sequence[np.ndarray]) -> Scale:
    """A scale for some sets of values, NaN where a thread has none. Its bar shows one sign if all
    of them have it, and nothing if all are zero."""
    every = np.concatenate([np.zeros(1), *values])
    greatest = float(np.nanmax(np.abs(every))) or 1.0
    low, high = (greatest * bool(np.any(sign * every > 0)) for sign in (-1, 1))
    return Scale(label, map, ends, Normalize(-greatest, greatest), -low, high)


def draw_threads(
    ax: Axes3D,
    threads: Float[np.ndarray, "threads stations 3"],
    colors: Sequence[RGB],
    slack: Bool[np.ndarray, " threads"],
) -> None:
    """Lines in their colours, slack ones dashed."""
    for place, color, loose in zip(threads, colors, slack, strict=True):
        style: dict[str, Any] = {"linewidth": 1.6}
        if loose:
            style = {"linestyle": SLACK_DASHES, "linewidth": 1.0}
        ax.plot(*place.T, color=color, **style)


def color_bars(ax: Axes3D, scales: Scales) -> None:
    """The colour bars of the scales at the right of the figure, without those that show nothing."""
    shown = [scale for scale in scales if scale.low != scale.high]
    for scale, box in zip(shown, _BARS[len(shown)], strict=True):
        _color_bar(ax, scale, box)


def _color_bar(ax: Axes3D, scale: Scale, box: tuple[float, float, float, float]) -> None:
    figure: Any = ax.figure
    colors = ScalarMappable(scale.norm, scale.map)
    bar = figure.colorbar(colors, cax=figure.add_axes(box), label=scale.label)
    bar.ax.set_ylim(scale.low, scale.high)
    bar.ax.yaxis.set_major_locator(MaxNLocator(4))
    size = mpl.rcParams["xtick.labelsize"]
    below, above = scale.ends
    if scale.low:
        bar.ax.set_xlabel(below, fontsize=size)
    if scale.low and scale.high:
        bar.ax.set_title(above, fontsize=size)
    bar.outline.set_visible(False)
