"""Arms in motion: a sweep of inputs, or a design as it goes on, as a GIF."""

import os
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter

from ..solution.equilibrium import Equilibrium
from ..solution.summary import Summary
from . import plot


def film(
    equilibria: Sequence[Equilibrium | Summary],
    path: str | os.PathLike[str] | None = None,
    *,
    titles: Sequence[str] | None = None,
    seconds: float = 4.0,
    dpi: int = 100,
) -> FuncAnimation:
    """The arm through a row of equilibria, all in one box, with the trail of its tip.

    **Arguments:**
    - `equilibria`: solved arms, or what `plot.sample` made of them, in order.
    - `path`: a GIF to write; none by default.
    - `titles`: a line for each.
    - `seconds`: of the whole film; `dpi`: dots per inch.

    **Returns:** matplotlib's animation.

    **Raises:** `ValueError` for no equilibria, for one that did not converge, and for another
    number of titles.
    """
    frames = [eq if isinstance(eq, Summary) else plot.sample(eq, 40) for eq in equilibria]
    if not frames:
        raise ValueError("equilibria: got none, need at least one")
    if titles is not None and len(titles) != len(frames):
        raise ValueError(f"titles: got {len(titles)}, need {len(frames)}, one an equilibrium")
    figure = plt.figure(figsize=(4.8, 4.2))
    ax = figure.add_subplot(projection="3d")
    walls = np.concatenate([frame.wall.reshape(-1, 3) for frame in frames])
    tips = np.array([frame.position[-1] for frame in frames])

    def draw(i: int) -> list[Any]:
        ax.clear()
        ax.plot(*tips[: i + 1].T, color=plot.COLORS[1], linewidth=1.0)
        plot.arm(frames[i], ax)
        ax.auto_scale_xyz(*walls.T)
        plot.equal_scale(ax)
        ax.set_title("" if titles is None else titles[i])
        return []

    moving = FuncAnimation(figure, draw, frames=len(frames), interval=1000 * seconds / len(frames))
    if path is not None:
        moving.save(
            os.fspath(path), writer=PillowWriter(fps=max(1, round(len(frames) / seconds))), dpi=dpi
        )
    return moving
