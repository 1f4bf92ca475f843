"""Threads of an arm as lines in the colour of their tension."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Normalize
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.actuator import Tendon
from ..solution.equilibrium import Equilibrium
from .style import TENSION

_IDLE = 1e-9
"""Tension [N] below which a tendon counts as slack."""

SLACK_DASHES = (0, (3, 2))


def is_slack(
    eq: Equilibrium, tension: Float[np.ndarray, " threads"]
) -> Bool[np.ndarray, " threads"]:
    """Which threads are slack: tendons without tension."""
    tendons = [isinstance(actuator, Tendon) for actuator in eq.scene.actuators]
    return np.array(tendons, bool) & (tension <= _IDLE)


def tension_scale(tensions: Sequence[np.ndarray]) -> Normalize:
    """The scale of colours for some sets of tensions [N]: zero is in its middle."""
    greatest = max((float(np.max(np.abs(some), initial=0.0)) for some in tensions), default=0.0)
    return Normalize(-greatest or -1.0, greatest or 1.0)


def draw_threads(
    ax: Axes3D,
    threads: Float[np.ndarray, "threads stations 3"],
    tension: Float[np.ndarray, " threads"],
    slack: Bool[np.ndarray, " threads"],
    scale: Normalize,
) -> None:
    """Lines in the colour of their tension, slack ones dashed."""
    for place, force, loose in zip(threads, tension, slack, strict=True):
        style = {"linestyle": SLACK_DASHES, "linewidth": 1.0} if loose else {"linewidth": 1.6}
        ax.plot(*place.T, color=TENSION(scale(force)), **style)


def tension_bar(
    ax: Axes3D, scale: Normalize, tensions: np.ndarray, box: tuple[float, float, float, float]
) -> Colorbar:
    """The colour bar of `scale` at a rectangle of the figure; of one sign where all tensions are.

    **Arguments:** `box`: left, bottom, width and height in the figure.
    """
    figure = ax.figure
    place = figure.add_axes(box)  # pyright: ignore[reportAttributeAccessIssue]
    bar = figure.colorbar(ScalarMappable(scale, TENSION), cax=place, label="thread tension [N]")
    low = 0.0 if np.all(tensions >= 0) else scale.vmin
    high = 0.0 if np.all(tensions <= 0) and low != 0 else scale.vmax
    bar.ax.set_ylim(low, high)
    if low != 0:
        bar.ax.set_title("pulls", fontsize=mpl.rcParams["xtick.labelsize"])
        bar.ax.set_xlabel("pushes", fontsize=mpl.rcParams["xtick.labelsize"])
    bar.outline.set_visible(False)  # pyright: ignore[reportCallIssue]
    return bar
