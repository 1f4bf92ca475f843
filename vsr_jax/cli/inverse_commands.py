"""The command `vsr-jax reach`: inputs that bring the tip of a scene to a position."""

import argparse
import textwrap

import jax.numpy as jnp
import numpy as np

from ..files.output import write_json
from ..solution.plausible_strain import strain_warnings
from . import report
from .common import (
    DONE,
    NOT_CONVERGED,
    Commands,
    add_bounds,
    bounds,
    check_folders,
    command,
    print_warnings,
)
from .scene_commands import add_scene, model_between, task_of


def add_reach(commands: Commands) -> None:
    """Adds `vsr-jax reach`."""
    parser = command(
        commands,
        "reach",
        description="Finds inputs between two bounds that bring the tip to a position with the "
        "least effort, and solves the scene there.\n"
        "Exit code 1: the position is out of reach; the nearest point found is printed.",
        example="vsr-jax reach scene.toml --target 0.5 0.1 0.2 --high 12",
        run=_reach,
    )
    add_scene(parser)
    parser.add_argument(
        "--target",
        metavar=("X", "Y", "Z"),
        nargs=3,
        type=float,
        required=True,
        help="position of the tip [m]",
    )
    add_bounds(parser, "twice --inputs, or twice the inputs of the file")
    parser.add_argument(
        "--allowed-miss",
        metavar="M",
        type=float,
        help="distance [m] from the target that counts as reached (default: 1e-4 of the length)",
    )
    parser.add_argument(
        "--json", metavar="FILE", help="save target, inputs, miss and the pose of the tip"
    )


def _reach(options: argparse.Namespace) -> int:
    from ..analysis.inverse import reach

    task = task_of(options)
    check_folders(options.json)
    low, high = bounds(options.low, options.high, task.scene, np.asarray(task.inputs), 2)
    model = model_between(task, options.tolerance, low, high)
    found = reach(
        task.scene,
        jnp.asarray(options.target, task.inputs.dtype),
        (low, high),
        model=model,
        allowed_miss=options.allowed_miss,
        progress=False,
    )
    eq = found.equilibrium
    print("\n".join(report.lines(eq, report.values(eq), task.title or options.scene)))
    print(textwrap.indent(str(found), "  "))
    print_warnings(strain_warnings(eq))
    if options.json:
        outcome = {
            "target": options.target,
            "inputs": found.inputs,
            "miss": found.miss,
            "allowed_miss": found.allowed_miss,
            "reached": found.reached,
            "tip": found.equilibrium.tip,
        }
        write_json(options.json, {"scene": options.scene, "title": task.title, **outcome})
    return DONE if bool(found.reached) else NOT_CONVERGED
