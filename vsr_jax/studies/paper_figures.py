"""Figures 2 and 3 of the paper from samples of solved scenes."""

from collections.abc import Mapping
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from ..arm.rod import STRAINS
from ..solution.summary import Summary
from ..viz.plot import COLORS, LABELS, arm, equal_scale, shade, strains
from . import paper

Curves = Mapping[tuple[str, tuple[float, ...], str], Summary]
"""Samples by case, forces tau [N] and name of the model."""

_FONT: dict[Any, Any] = {
    "font.size": 14,
    "axes.titlesize": 16,
    "axes.labelsize": 16,
    "legend.fontsize": 13,
    "ytick.labelsize": 12,
}
_PLANAR = ("A1", "A2")
_VIEW = (22, -58)
_COLUMN, _LEFT = 3.7, 1.1
_FIG3_TAU = (-15.0,)


def _style(model: str, color: str) -> dict[str, Any]:
    """Line style: a wide pale band for the continuum, a thin line over it, and dark dashes over
    both, so that all three are visible."""
    return {
        "Continuum": {
            "color": color,
            "linestyle": "-",
            "linewidth": 6.0,
            "alpha": 0.35,
            "solid_capstyle": "butt",
        },
        "StrainDependent": {"color": color, "linestyle": "-", "linewidth": 1.5},
        "Prescribed": {"color": shade(color), "linestyle": (0.0, (4.0, 3.0)), "linewidth": 1.5},
    }[model]


_MODELS = {
    "Continuum": "continuum, eq. (12)",
    "StrainDependent": "strain-dependent basis, eq. (21)",
    "Prescribed": "prescribed basis, eq. (18)",
}


def figure_2(curves: Curves) -> Figure | None:
    """Deformed arms and the six strains of every case, one column per case, the three models by
    line style; None without curves."""
    cases = [case for case in paper.CASES if any(key[0] == case for key in curves)]
    if not cases:
        return None
    width, wide = _LEFT + _COLUMN * len(cases), len(cases) > 3
    with plt.rc_context(_FONT):
        figure = plt.figure(figsize=(width, 21.5))
        grid = figure.add_gridspec(
            8,
            len(cases),
            height_ratios=[0.6, 2.9, *[1.0] * 6],
            left=_LEFT / width,
            right=1 - 0.75 / width,
            bottom=0.035,
            top=0.95,
        )
        grid.update(wspace=0.34, hspace=0.14)
        for column, case in enumerate(cases):
            of_case = {key: value for key, value in curves.items() if key[0] == case}
            _head(case, of_case, figure.add_subplot(grid[0, column]))
            space = figure.add_subplot(grid[1, column], projection="3d")
            panels = [figure.add_subplot(grid[row, column]) for row in range(2, 8)]
            _draw_case(case, of_case, space, panels)
            for panel, name in zip(panels, STRAINS, strict=True):
                panel.set_ylabel(LABELS[name] if column == 0 else "")
        figure.align_ylabels()
        handles = [
            Line2D([], [], label=label, **_style(name, "#555555"))
            for name, label in _MODELS.items()
        ]
        figure.legend(
            handles=handles,
            loc="upper center",
            ncols=3 if wide else 1,
            fontsize=18 if wide else 14,
            frameon=False,
            handlelength=4,
        )
    return figure


def _tensions(curves: Curves) -> dict[tuple[float, ...], str]:
    """Colour of each set of tensions of a case."""
    return dict(zip(dict.fromkeys(key[1] for key in curves), COLORS, strict=False))


def _head(case: str, curves: Curves, ax: Axes) -> None:
    """Name of the case, and a legend of the tensions."""
    ax.axis("off")
    ax.text(
        0.5,
        1.0,
        f"{case}: {paper.CASES[case]}",
        ha="center",
        va="top",
        fontsize=16,
        transform=ax.transAxes,
    )
    handles = [
        Line2D([], [], color=color, linewidth=4, label=_newtons(tau))
        for tau, color in _tensions(curves).items()
    ]
    ax.legend(
        handles=handles,
        title=r"$\tau$ [N]",
        loc="upper center",
        bbox_to_anchor=(0.5, 0.84),
        ncols=2,
        frameon=False,
        handlelength=1.0,
        columnspacing=1.2,
    )


def _draw_case(case: str, curves: Curves, space: Axes3D, panels: list[Axes]) -> None:
    for name in _MODELS:
        for tau, color in _tensions(curves).items():
            if (case, tau, name) in curves:
                samples, style = curves[case, tau, name], _style(name, color)
                detail = name == "StrainDependent"
                arm(samples, space, surface=detail, threads=detail, **style)
                strains(samples, panels, **style)
    _view(case, space)
    for panel in panels:
        panel.yaxis.set_major_locator(MaxNLocator(4))
        panel.set_xticks([0, 0.25, 0.5, 0.75], ["0", "0.25", "0.5", "0.75"])
        panel.grid(alpha=0.3)
        panel.tick_params(labelbottom=panel is panels[-1])
        panel.set_xlabel("X [m]" if panel is panels[-1] else "")


def _view(case: str, space: Axes3D) -> None:
    """Sets the view, along z for planar arms and oblique for the others, and widens the panel to
    the whole column."""
    left, bottom, width, height = space.get_position().bounds
    space.set_position((left - 0.3 * width, bottom - 0.05 * height, 1.5 * width, 1.25 * height))
    space.patch.set_visible(False)
    space.tick_params(labelsize=12, pad=1)
    if case in _PLANAR:
        equal_scale(space, zoom=1.3)
        space.view_init(90, -90)
        space.set_proj_type("ortho")
        space.set(zticks=[], zlabel="")
        space.tick_params(axis="y", pad=9)
        space.yaxis.labelpad = 20
    else:
        equal_scale(space, zoom=1.12)
        space.view_init(*_VIEW)


def _newtons(tau: tuple[float, ...]) -> str:
    return ", ".join(f"{t:g}" for t in tau).replace("-", "\N{MINUS SIGN}")


def figure_3(curves: Curves) -> Figure | None:
    """Shapes and bending of A2 at -15 N for the continuum, the two variable-strain models and PCS;
    None without A2."""
    styles = {
        "Continuum": ("continuum", _style("Continuum", "#777777")),
        "StrainDependent": ("strain-dependent, 1 DOF", _style("StrainDependent", COLORS[0])),
        "Prescribed": (
            "prescribed, 3 DOF",
            {"color": COLORS[1], "linestyle": (0.0, (4.0, 3.0)), "linewidth": 2.0},
        ),
        "PCS": (
            "PCS, three sections, 6 DOF",
            {"color": COLORS[2], "linestyle": "-.", "linewidth": 2.0},
        ),
    }
    drawn = {
        name: curves["A2", _FIG3_TAU, name] for name in styles if ("A2", _FIG3_TAU, name) in curves
    }
    if not drawn:
        return None
    with plt.rc_context(_FONT):
        figure, (plane, bending) = plt.subplots(1, 2, figsize=(13, 5.6), layout="constrained")
        for name, samples in drawn.items():
            label, style = styles[name]
            x, y, _ = samples.position.T
            plane.plot(x, y, label=label, **style)
            plane.plot(x[-1], y[-1], "o", color=style["color"], markersize=5)
            # a piecewise-constant strain is constant up to the next station, where a section begins
            strains(
                samples,
                bending,
                names=("bending_z",),
                drawstyle="steps-post" if name == "PCS" else "default",
                **style,
            )
        plane.set(xlabel="x [m]", ylabel="y [m]", title=r"A2, $\tau = -15$ N: deformed shape")
        plane.set(aspect="equal", xticks=np.linspace(-0.3, 0.1, 5))
        bending.set(title="Bending about z", xticks=np.linspace(0, paper.LENGTH, 4))
        for axes in (plane, bending):
            axes.grid(alpha=0.3)
        figure.legend(
            *plane.get_legend_handles_labels(),
            loc="outside lower center",
            ncols=4,
            frameon=False,
            handlelength=3,
        )
    return figure
