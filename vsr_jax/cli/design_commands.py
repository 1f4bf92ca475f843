"""The command `vsr-jax design`: numbers of a scene that minimise an objective."""

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


def add_design(commands: Commands) -> None:
    """Adds `vsr-jax design`."""
    parser = command(
        commands,
        "design",
        description="Finds numbers of a scene that minimise objectives under constraints, as "
        "specified by a problem file.",
        example="vsr-jax design problem.toml --out designed.toml --plot design.png",
        more="  Problem files: see docs/files.md; an example is in notebooks/problems/.\n"
        "  Exit code 1: no design satisfies all constraints.",
        run=_design,
    )
    parser.add_argument(
        "problem",
        metavar="PROBLEM.toml",
        help="free numbers, objectives and constraints",
    )
    parser.add_argument(
        "--out",
        metavar="SCENE.toml",
        help="save the design as a scene file, with its first set of inputs",
    )
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="save numbers, margins, all inputs and the objective of each start",
    )
    parser.add_argument(
        "--plot",
        metavar="PNG",
        help="draw the arm before and after, and the history of the objective",
    )
    parser.add_argument(
        "--checkpoint",
        metavar="FILE",
        help="checkpoint file; the same command resumes from it",
    )
    add_precision(parser)
    add_cache(parser)


def _design(options: argparse.Namespace) -> int:
    from ..optimization.design_file import load_design
    from ..optimization.design_search import design

    set_precision(options.precision)
    check_folders(options.out, options.json, options.plot, options.checkpoint)
    problem = load_design(options.problem)
    inputs = np.asarray(problem.inputs, options.precision)
    found = design(
        problem.scene,
        problem.free,
        problem.objective,
        inputs,
        constraints=problem.constraints,
        uncertain=problem.uncertain,
        search=problem.search,
        out=options.checkpoint,
    )
    print(problem.title or options.problem)
    print(textwrap.indent(str(found), "  "))
    if options.out:
        save(found.scene, options.out, found.inputs[0], problem.title)
    if options.json:
        record = {
            "title": problem.title,
            "objective": found.objective,
            "feasible": found.feasible,
            "margins": found.margins,
        }
        starts = [{"objective": one.objective, "violation": one.violation} for one in found.starts]
        write_json(
            options.json,
            {
                **record,
                "numbers": found.numbers,
                "inputs": found.inputs,
                "starts": starts,
            },
        )
    if options.plot:
        _draw(found, options.plot)
    return DONE if found.feasible else NOT_CONVERGED


def _draw(found: Any, path: str) -> None:
    draw_without_display()
    import matplotlib.pyplot as plt

    from ..viz import plot, plot_design

    with plot.theme():
        figure = plt.figure(figsize=(10, 4.5))
        space = figure.add_subplot(projection="3d")
        space.set_position((0.0, 0.02, 0.52, 0.92))
        plot_design.before_after(found, space)
        plot_design.history(found, figure.add_axes((0.66, 0.14, 0.32, 0.8)))
        figure.savefig(path, dpi=150)
