"""The command `vsr-jax export`: files for the workshop."""

import argparse

from ..files.scene_file import load
from ..solution.plausible_strain import strain_warnings
from ..solution.solver import solve
from .common import (
    DONE,
    NOT_CONVERGED,
    Commands,
    check_folders,
    command,
    print_warnings,
    set_precision,
)
from .scene_commands import add_scene, task_of

_FILES = {
    "stl": "the body with its channels as holes, a closed surface of triangles",
    "step": "the axis and the threads as curves in space",
    "csv": "the paths of the threads",
    "dxf": "the threads at rest, unrolled onto a flat sheath",
    "holes": "the drilling plan of the discs, as CSV",
    "lengths": "the bill of cables and tubes, as CSV",
}
"""Options that name files, and what they hold."""


def add_export(commands: Commands) -> None:
    """Adds `vsr-jax export`."""
    parser = command(
        commands,
        "export",
        description="Writes the arm of a scene file for the workshop, in millimetres and degrees: "
        "at rest, or bent by --inputs.\n"
        "Prints the drilling plan, the lengths of cables and tubes and the thinnest wall; warns of "
        "thin walls.\n"
        '--stl and --dxf need "vsr-jax[fabrication]".',
        example="vsr-jax export scene.toml --stl arm.stl --step arm.step --csv threads.csv",
        run=_export,
    )
    add_scene(parser, "none, the arm at rest without loads")
    for name, content in _FILES.items():
        parser.add_argument(f"--{name}", metavar="FILE", help=content)
    parser.add_argument(
        "--bore",
        metavar="M",
        nargs="+",
        type=float,
        help="diameters of the channels in metres, one for all or one per actuator (default: that "
        "of a chamber's area; 0.001 for cables, or less where walls would be thin)",
    )
    parser.add_argument(
        "--wall",
        metavar="M",
        type=float,
        default=4e-4,
        help="thickness of walls in metres below which to warn (default: %(default)g)",
    )
    parser.add_argument(
        "--discs",
        metavar="X",
        nargs="+",
        type=float,
        help="abscissas in metres of the discs to drill (default: those of the arm, or 11)",
    )
    parser.add_argument(
        "--chord",
        metavar="M",
        type=float,
        default=2e-5,
        help="distance in metres of chords from the shape (default: %(default)g)",
    )


def _export(options: argparse.Namespace) -> int:
    from ..fabrication.exporting import fabrication_of

    files = {name: getattr(options, name) for name in _FILES}
    check_folders(*files.values())
    if options.inputs is None:
        if (options.model, options.steps, options.tolerance) != (None, None, None):
            raise ValueError(
                "--inputs: got --model, --steps or --tolerance without it, need inputs to solve for"
            )
        set_precision(options.precision)
        arm, _, title = load(options.scene)
    else:
        task = task_of(options)
        arm, title = (
            solve(task.scene, task.inputs, model=task.model, tolerance=options.tolerance),
            task.title,
        )
        if not bool(arm.converged):
            print("\n".join((title or options.scene, *arm.heading)))
            return NOT_CONVERGED
        print_warnings(strain_warnings(arm))
    made = fabrication_of(
        arm,
        bore=options.bore[0] if options.bore and len(options.bore) == 1 else options.bore,
        wall=options.wall,
        discs=options.discs,
        tolerance=options.chord,
    )
    made.write(**files)
    print(title or options.scene, made, sep="\n")
    print_warnings(made.warnings)
    return DONE
