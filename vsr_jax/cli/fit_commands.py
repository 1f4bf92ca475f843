"""The command `vsr-jax fit`: numbers of a scene from measured shapes."""

import argparse
import textwrap
from typing import Any

import numpy as np

from ..files.output import write_json
from ..files.scene_file import save
from .common import (
    DONE,
    NOT_CONVERGED,
    Commands,
    add_cache,
    add_precision,
    check_folders,
    command,
    draw_without_display,
    set_precision,
)


def add_fit(commands: Commands) -> None:
    """Adds `vsr-jax fit`."""
    parser = command(
        commands,
        "fit",
        description="Finds numbers of a scene, and of the rig that measured it, from measured "
        "shapes, with standard errors.",
        example="vsr-jax fit fit.toml --out calibrated.toml --plot fit.png",
        more="  Fit files: see docs/files.md.\n"
        "  Exit code 1: the fit did not converge, or a shape has no equilibrium.",
        run=_fit,
    )
    parser.add_argument("fit", metavar="FIT.toml", help="scene, measurements and unknowns")
    parser.add_argument("--out", metavar="SCENE.toml", help="save the calibrated scene")
    parser.add_argument(
        "--json", metavar="FILE", help="save numbers, covariance, residuals and what is unsure"
    )
    parser.add_argument(
        "--plot", metavar="PNG", help="draw measured and fitted shapes, residuals and unknowns"
    )
    add_precision(parser)
    add_cache(parser)


def _fit(options: argparse.Namespace) -> int:
    from ..calibration.fit_file import load_fit
    from ..calibration.fitting import fit

    set_precision(options.precision)
    check_folders(options.out, options.json, options.plot)
    problem = load_fit(options.fit)
    found = fit(problem.scene, problem.free, problem.data, **problem.options)
    print(problem.title or options.fit)
    print(textwrap.indent(str(found), "  "))
    if options.out:
        save(found.scene, options.out, title=problem.title)
    if options.json:
        write_json(options.json, _record(problem.title, found))
    if options.plot:
        _draw(found, options.plot)
    return DONE if found.converged and not found.failed else NOT_CONVERGED


def _record(title: str, found: Any) -> dict[str, Any]:
    return {
        "title": title,
        "status": found.reason,
        "steps": found.steps,
        "chi_squared": found.chi_squared,
        "freedom": found.freedom,
        "numbers": {name: one._asdict() for name, one in found.numbers.items()},
        "covariance": np.asarray(found.covariance),
        "rms": {series: found.rms(series) for series in found.problem.data.groups},
        "undetermined": found.undetermined,
        "failed": found.failed,
    }


def _draw(found: Any, path: str) -> None:
    draw_without_display()
    from ..viz import plot, plot_fit

    with plot.theme():
        plot_fit.overview(found).savefig(path, dpi=150)
