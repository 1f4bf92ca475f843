"""The command `vsr-jax design`: numbers of a scene that make an objective least."""

import argparse
from typing import Any

import numpy as np

from ..analysis.plausible import warnings_of
from ..files.scene_file import save as save_scene
from ..optimization.design_file import load_design
from .common import DONE, NOT_CONVERGED, add_precision, check_folders, command, hasten, use, warn
from .scene_commands import save


def add_design(commands: Any) -> None:
    """Adds `vsr-jax design`."""
    parser = command(
        commands,
        "design",
        help="find routings, sizes and inputs by gradient",
        description="Numbers of a scene that make objectives least under constraints, as a "
        "problem file asks for them.",
        example="vsr-jax design problem.toml --out designed.toml --plot design.png",
        more="  Problem files: see `python -c 'import vsr_jax.designfile as d; "
        "print(d.__doc__)'`; one lies in notebooks/problems/.\n"
        "  Exit code 1: no design keeps all constraints.",
        run=_design,
    )
    parser.add_argument(
        "problem",
        metavar="PROBLEM.toml",
        help="what is free, what is to be least, what is to be kept",
    )
    parser.add_argument(
        "--out",
        metavar="SCENE.toml",
        help="a scene file for the design, with its first set of inputs",
    )
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="save numbers, margins, all inputs and the objective of each start",
    )
    parser.add_argument(
        "--plot", metavar="PNG", help="draw the arm before and after, and how the objective fell"
    )
    parser.add_argument(
        "--keep",
        metavar="FILE",
        help="keep what is reached in a file; the same command goes on from there",
    )
    add_precision(parser)


def _design(options: argparse.Namespace) -> int:
    from ..arm.scene_numbers import matching, parameters
    from ..optimization.design_search import design

    hasten(optimise=True)
    use(options.precision)
    check_folders(options.out, options.json, options.plot, options.keep)
    task = load_design(options.problem)
    warn(warnings_of(task.scene))
    inputs = np.asarray(task.inputs, options.precision)
    found = design(task.scene, task.free, task.objective, inputs, out=options.keep, **task.settings)
    known = parameters(found.scene)
    names = [
        name for pattern in task.free if pattern != "inputs" for name in matching(pattern, known)
    ]
    print(task.title or options.problem)
    print(
        f"  objective  {found.objective:.6g} after {len(found.trace.objective)} steps of "
        f"{len(found.starts)} starts"
    )
    for name in names:
        print(
            f"  {name} = "
            f"{np.array2string(np.asarray(known[name].value), precision=6, separator=', ')} "
            f"[{known[name].unit or '?'}]"
        )
    if "inputs" in task.free:
        print(
            "  inputs     "
            + "; ".join(", ".join(f"{x:.6g}" for x in row) for row in np.asarray(found.inputs))
        )
    for name, margin in found.margins.items():
        print(f"  {name}: {'kept' if margin >= 0 else 'VIOLATED'}, margin {margin:.3g}")
    if options.out:
        save_scene(found.scene, options.out, found.inputs[0], task.title)
    if options.json:
        values = {name: np.asarray(known[name].value).tolist() for name in names}
        record = {
            "title": task.title,
            "objective": found.objective,
            "feasible": found.feasible,
            "margins": found.margins,
        }
        starts = [{"objective": one.objective, "violation": one.violation} for one in found.starts]
        save(
            options.json,
            {
                **record,
                "numbers": values,
                "inputs": np.asarray(found.inputs).tolist(),
                "starts": starts,
            },
        )
    if options.plot:
        _draw(task, found, inputs[0], options.plot)
    return DONE if found.feasible else NOT_CONVERGED


def _draw(task: Any, found: Any, before: np.ndarray, path: str) -> None:
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    from ..viz import plot_design

    figure = plt.figure(figsize=(10, 4.5))
    plot_design.before_after(
        task.scene, found, before, figure.add_axes((0.0, 0.05, 0.52, 0.9), projection="3d")
    )
    plot_design.history(found, figure.add_axes((0.66, 0.14, 0.32, 0.8)))
    figure.savefig(path, dpi=150)
