"""Animations of an arm as GIF files: a sweep of inputs, or the steps of a design."""

import os
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.artist import Artist

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
    """Animation of a sequence of equilibria in one fixed box, with the path of the tip.

    **Arguments:**
    - `equilibria`: solved scenes, or their samples by `plot.sample`, in order.
    - `path`: GIF file to write; none by default.
    - `titles`: one line per equilibrium.
    - `seconds`: duration; `dpi`: dots per inch.

    **Returns:** matplotlib's animation.

    **Raises:** `ValueError` without equilibria, for one that did not converge, and for a wrong
    number of titles.
    """
    frames = [eq if isinstance(eq, Summary) else plot.sample(eq, 40) for eq in equilibria]
    if not frames:
        raise ValueError("equilibria: got none, need at least one")
    if titles is not None and len(titles) != len(frames):
        raise ValueError(f"titles: got {len(titles)}, need {len(frames)}, one per equilibrium")
    figure = plt.figure(figsize=(4.8, 4.2))
    ax = figure.add_subplot(projection="3d")
    walls = np.concatenate([frame.wall.reshape(-1, 3) for frame in frames])
    tips = np.array([frame.position[-1] for frame in frames])

    def draw(i: int) -> list[Artist]:
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
