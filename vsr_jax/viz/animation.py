"""Animations of an arm as GIF or MP4 files: a sweep of inputs, or the steps of a design."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, FuncAnimation, PillowWriter
from matplotlib.artist import Artist
from matplotlib.lines import Line2D

from ..solution.equilibrium import Equilibrium
from ..solution.summary import Summary
from ..typing import PathLike
from .body import Body, body_of, draw_body, thread_scales
from .obstacles import draw_obstacles
from .space import equal_scale, fit_height, label_axes, new_space, world_frame
from .style import COLORS, ink
from .tendons import color_bars

_AREA = (0.0, 0.0, 0.83, 0.9)
"""Rectangle of the box in the figure."""
_STATIONS = 40


def film(
    equilibria: Sequence[Equilibrium | Summary],
    path: PathLike | None = None,
    *,
    titles: Sequence[str] | None = None,
    seconds: float = 4.0,
    dpi: int = 100,
) -> FuncAnimation:
    """Animation of a sequence of equilibria in one fixed box, with the path of the tip and one
    scale of tensions and one of pressures, among the obstacles of the first scene.

    Where a solve failed, the last shape before it stays, dimmed, with the message of the status.

    **Arguments:**
    - `equilibria`: solved scenes, or their samples by `plot.sample`, in order.
    - `path`: file to write, `.gif`, or `.mp4` where ffmpeg is installed; none by default.
    - `titles`: one line per equilibrium.
    - `seconds`: duration; `dpi`: dots per inch.

    **Returns:** matplotlib's animation.

    **Raises:** `ValueError` without equilibria, if the first did not converge, for a wrong number
    of titles, another kind of file, and an `.mp4` without ffmpeg.
    """
    if not equilibria:
        raise ValueError("equilibria: got none, need at least one")
    if titles is not None and len(titles) != len(equilibria):
        raise ValueError(f"titles: got {len(titles)}, need {len(equilibria)}, one per equilibrium")
    writer = None if path is None else _writer(path, max(1, round(len(equilibria) / seconds)))
    bodies = _bodies(equilibria)
    points = np.concatenate([body.points for body in bodies])
    around = equilibria[0].scene.obstacles if isinstance(equilibria[0], Equilibrium) else ()
    scales = thread_scales(bodies)
    tips = np.array([body.samples.position[-1] for body in bodies])
    ax = new_space()
    figure: Any = ax.figure

    def draw(i: int) -> list[Artist]:
        for artist in (*ax.lines, *ax.collections, *ax.texts):
            artist.remove()
        ax.plot(*tips[: i + 1].T, color=COLORS[3], linewidth=1.0, label="path of the tip")
        draw_body(ax, bodies[i], color=ink(0.5), scales=scales)
        draw_obstacles(ax, around, points)
        world_frame(ax)
        failed = [] if bodies[i].failure is None else ["no equilibrium"]
        figure.suptitle(": ".join([*([] if titles is None else [titles[i]]), *failed]))
        return []

    ax.auto_scale_xyz(*points.T)
    draw_obstacles(ax, around, points)
    label_axes(ax)
    equal_scale(ax, thinnest=0.2)
    fit_height(ax, _AREA)
    color_bars(ax, scales)
    handles = [Line2D([], [], color=COLORS[3], linewidth=1.0, label="path of the tip")]
    figure.legend(handles=handles, loc="upper left")
    interval = 1000 * seconds / len(bodies)
    moving = FuncAnimation(figure, draw, frames=len(bodies), interval=interval)
    if path is not None and writer is not None:
        moving.save(os.fspath(path), writer=writer, dpi=dpi)
    return moving


def _writer(path: PathLike, rate: int) -> AbstractMovieWriter:
    """The writer of a kind of file, by its ending, for `rate` frames per second."""
    kind = os.path.splitext(os.fspath(path))[1].lower()
    if kind == ".gif":
        return PillowWriter(fps=rate)
    if kind != ".mp4":
        raise ValueError(f"path: got {os.fspath(path)!r}, need a name that ends in .gif or .mp4")
    if not FFMpegWriter.isAvailable():
        raise ValueError(f"path: got {os.fspath(path)!r}, need ffmpeg for .mp4, or a .gif")
    # even numbers of pixels, which the codec needs
    return FFMpegWriter(fps=rate, extra_args=["-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2"])


def _bodies(equilibria: Sequence[Equilibrium | Summary]) -> list[Body]:
    """The arm of each equilibrium; where a solve failed, the last one before it."""
    bodies: list[Body] = []
    for eq in equilibria:
        if isinstance(eq, Equilibrium) and np.ndim(eq.status) == 0 and not bool(eq.converged):
            if not bodies:
                raise ValueError(f"equilibria[0]: got a solve that failed ({eq.message})")
            bodies.append(bodies[-1]._replace(failure=eq.message))
        else:
            bodies.append(body_of(eq, _STATIONS))
    return bodies
