"""One style for all figures: colours that colour-blind readers can distinguish, in a light and a
dark theme."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.typing import ColorType

from ..validation import choice

COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""The palette of Okabe and Ito, which colour-blind readers can distinguish."""

TENSION = LinearSegmentedColormap.from_list("tension", ["#0072B2", "#9a9a9a", "#D55E00"])
"""Diverging map of signed tensions: blue where a thread pushes, grey at zero, vermilion where it
pulls. Its grey is visible on both themes."""

PRESSURE = TENSION.reversed()
"""The same for pressures: blue where a chamber pushes, vermilion where a vacuum pulls."""

Theme = Literal["light", "dark"]
RGB = tuple[float, float, float]

_SHARED: dict[str, Any] = {
    "font.size": 9.0,
    "axes.labelsize": 9.0,
    "axes.titlesize": 10.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.6,
    "image.cmap": "viridis",
}

_THEMES: dict[Theme, tuple[str, str, str]] = {
    "light": ("#ffffff", "#1f1f1f", "#d5d5d5"),
    "dark": ("#15181c", "#e4e4e4", "#3d4249"),
}
"""Background, ink and grid lines."""


def settings(name: Theme = "light") -> dict[Any, Any]:
    """Settings of matplotlib (`rcParams`) of a theme."""
    paper, ink, grid = _THEMES[choice("theme", name, tuple(_THEMES))]
    pane = mixed(paper, ink, 0.03)
    settings = dict(_SHARED)
    settings |= dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), paper)
    inked = ("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color")
    settings |= dict.fromkeys(inked, ink)
    settings |= {f"axes3d.{axis}axis.panecolor": (*pane, 1.0) for axis in "xyz"}
    return settings | {"grid.color": grid}


@contextmanager
def theme(name: Theme = "light") -> Iterator[None]:
    """Context in which figures have the style of the package, on a light or a dark background.

    **Raises:** `ValueError` for another name.
    """
    with mpl.rc_context(settings(name)):
        yield


def ink(strength: float = 1.0) -> RGB:
    """Colour of text in the current style, or its mixture with the background, which is 0."""
    paper = mpl.rcParams["axes.facecolor"]
    return mixed(paper, mpl.rcParams["text.color"], strength)


def mixed(first: ColorType, second: ColorType, share: float) -> RGB:
    """Mixture of two colours; `share` is that of the second."""
    red, green, blue = (1 - share) * np.array(to_rgb(first)) + share * np.array(to_rgb(second))
    return float(red), float(green), float(blue)


def shade(color: ColorType) -> RGB:
    """A shade of a colour for lines drawn over it: nearer to the colour of text."""
    return mixed(color, mpl.rcParams["text.color"], 0.45)
