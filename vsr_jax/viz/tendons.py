"""Threads of an arm as lines in the colour of their tension."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.actuator import Tendon
from ..solution.equilibrium import Equilibrium
from .style import RGB, TENSION

_IDLE = 1e-9
"""Tension [N] below which a tendon counts as slack."""

SLACK_DASHES = (0.0, (3.0, 2.0))


def is_slack(
    eq: Equilibrium, tension: Float[np.ndarray, " threads"]
) -> Bool[np.ndarray, " threads"]:
    """Which threads are slack: tendons without tension."""
    tendons = [isinstance(actuator, Tendon) for actuator in eq.scene.actuators]
    return np.array(tendons, bool) & (tension <= _IDLE)


class TensionScale(NamedTuple):
    """Colours of tensions [N]: `norm` has zero in its middle; `low` and `high` are the ends of the
    colour bar."""

    norm: Normalize
    low: float
    high: float

    def color(self, tension: float) -> RGB:
        """Colour of a tension [N]."""
        red, green, blue, _ = TENSION(self.norm(tension))
        return red, green, blue


def tension_scale(tensions: Sequence[np.ndarray]) -> TensionScale:
    """The scale for some sets of tensions [N]. Its bar shows one sign if all of them have it, and
    nothing if all are zero."""
    every = np.concatenate([np.zeros(1), *tensions])
    greatest = float(np.max(np.abs(every))) or 1.0
    low, high = (greatest * bool(np.any(sign * every > 0)) for sign in (-1, 1))
    return TensionScale(Normalize(-greatest, greatest), -low, high)


def draw_threads(
    ax: Axes3D,
    threads: Float[np.ndarray, "threads stations 3"],
    tension: Float[np.ndarray, " threads"],
    slack: Bool[np.ndarray, " threads"],
    scale: TensionScale,
) -> None:
    """Lines in the colour of their tension, slack ones dashed."""
    for place, force, loose in zip(threads, tension, slack, strict=True):
        style: dict[str, Any] = {"linewidth": 1.6}
        if loose:
            style = {"linestyle": SLACK_DASHES, "linewidth": 1.0}
        ax.plot(*place.T, color=scale.color(force), **style)


def tension_bar(
    ax: Axes3D, scale: TensionScale, box: tuple[float, float, float, float]
) -> Colorbar | None:
    """The colour bar of `scale`; None if all tensions are zero.

    **Arguments:** `box`: left, bottom, width and height in the figure.
    """
    if scale.low == scale.high:
        return None
    figure: Any = ax.figure
    colors = ScalarMappable(scale.norm, TENSION)
    bar = figure.colorbar(colors, cax=figure.add_axes(box), label="thread tension [N]")
    bar.ax.set_ylim(scale.low, scale.high)
    bar.ax.yaxis.set_major_locator(MaxNLocator(4))
    size = mpl.rcParams["xtick.labelsize"]
    if scale.low:
        bar.ax.set_xlabel("pushes", fontsize=size)
    if scale.low and scale.high:
        bar.ax.set_title("pulls", fontsize=size)
    bar.outline.set_visible(False)
    return bar
