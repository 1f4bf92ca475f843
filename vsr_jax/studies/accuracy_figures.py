"""Figures of accuracy against time: one panel per scene, one line per family of models."""

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from ..typing import VectorLike
from ..validation import choice
from .accuracy import AccuracyRow

ERRORS = {
    "tip": "tip error [m]",
    "strain": "strain error [-]",
    "gradient": "relative error of the gradient [-]",
}
TIMES = {"batch_us": "time per shape in a batch [us]", "single_us": "time of a single solve [us]"}

_STYLES: dict[str, tuple[str, str]] = {
    "steps of order 6": ("#0072B2", "o"),
    "steps of order 4": ("#56B4E9", "s"),
    "steps of order 2": ("#000000", "."),
    "Legendre": ("#D55E00", "^"),
    "piecewise constant": ("#E69F00", "v"),
    "basis of the paper": ("#E69F00", "*"),
    "continuum, Tsit5": ("#CC79A7", "P"),
    "continuum, Dopri8": ("#009E73", "D"),
    "continuum, Kvaerno5": ("#999999", "X"),
}
_LEAST = 1e-16
"""Smallest error that is drawn: a logarithmic axis has no zero."""


Curve = tuple[VectorLike, VectorLike]
"""Times [us] and errors."""


def work_precision(
    rows: Mapping[str, Sequence[AccuracyRow]],
    *,
    error: str = "tip",
    time: str = "batch_us",
    others: Mapping[str, Mapping[str, Curve]] | None = None,
) -> Figure:
    """Error against time, both logarithmic, one panel per scene; float32 with open markers and
    dashed lines.

    **Arguments:** `rows`: by name of the scene; `error`, `time`: keys of `ERRORS` and `TIMES`;
    `others`: for other tools, by name of the scene and name of the tool, (times [us], errors).

    **Raises:** `ValueError` for an unknown error or time.
    """
    choice("error", error, tuple(ERRORS))
    choice("time", time, tuple(TIMES))
    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    figure, axes = plt.subplots(
        lines,
        columns,
        figsize=(0.6 + 3.4 * columns, 1.0 + 2.9 * lines),
        squeeze=False,
        layout="constrained",
    )
    for ax in axes.flat[len(rows) :]:
        ax.set_axis_off()
    handles: dict[str, Line2D] = {}
    for ax, (name, some) in zip(axes.flat, rows.items(), strict=False):
        handles |= _panel(ax, some, error, time)
        for place, (tool, (times, errors)) in enumerate(((others or {}).get(name) or {}).items()):
            face = "white" if place else "#8B0000"
            (handles[tool],) = ax.loglog(
                times,
                errors,
                color="#8B0000",
                marker="d",
                linestyle=":",
                markersize=5,
                markerfacecolor=face,
            )
        ax.set_title(name, fontsize=11)
        ax.grid(alpha=0.3)
        ax.xaxis.set_major_locator(LogLocator(numticks=6))
    figure.supxlabel(TIMES[time])
    figure.supylabel(ERRORS[error])
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside upper center",
        ncols=min(5, columns + 2),
        fontsize=9,
        frameon=False,
    )
    return figure


def _panel(ax: Axes, rows: Sequence[AccuracyRow], error: str, time: str) -> dict[str, Line2D]:
    handles = {}
    for family, dtype in dict.fromkeys((row.family, row.dtype) for row in rows):
        some = [
            row
            for row in rows
            if (row.family, row.dtype) == (family, dtype) and getattr(row, error) is not None
        ]
        color, marker = _STYLES.get(family, ("#000000", "+"))
        single = dtype == "float32"
        times, errors = (
            [getattr(row, time) for row in some],
            [max(getattr(row, error), _LEAST) for row in some],
        )
        (line,) = ax.loglog(
            times,
            errors,
            color=color,
            marker=marker,
            markersize=5,
            linewidth=1.2,
            linestyle="--" if single else "-",
            markerfacecolor="white" if single else color,
        )
        handles[f"{family}, float32" if single else family] = line
    return handles
