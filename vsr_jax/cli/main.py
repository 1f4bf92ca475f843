"""The command `vsr-jax`: solves, checks, sweeps, designs and calibrates scenes, finds inputs for
targets, reproduces the paper, measures costs."""

import argparse
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NamedTuple

from .. import __version__
from .common import BAD_USAGE, EXIT_CODES, print_warnings


class Command(NamedTuple):
    """A command: the module with its function `add_<name>`, what the list of commands says of it,
    and an example."""

    module: str
    help: str
    example: str


COMMANDS = {
    "solve": Command(
        "scene_commands",
        "solve a scene file and print, draw or save the result",
        "vsr-jax solve scene.toml --plot arm.png",
    ),
    "check": Command(
        "scene_commands",
        "report the health of the solve of a scene file",
        "vsr-jax check scene.toml",
    ),
    "sweep": Command(
        "sweep_commands",
        "solve a scene file for many inputs: its workspace",
        "vsr-jax sweep scene.toml --samples 100000 --plot workspace.png",
    ),
    "reach": Command(
        "inverse_commands",
        "find the inputs of a scene file that bring its tip to a position",
        "vsr-jax reach scene.toml --target 0.5 0.1 0.2 --high 12",
    ),
    "design": Command(
        "design_commands",
        "find routings, sizes and inputs by gradient descent",
        "vsr-jax design problem.toml --out designed.toml",
    ),
    "fit": Command(
        "fit_commands",
        "calibrate a scene with measured shapes",
        "vsr-jax fit fit.toml --out calibrated.toml",
    ),
    "view": Command(
        "view_commands",
        "turn the arm of a scene file by hand in the browser",
        "vsr-jax view scene.toml --number rod.material.young",
    ),
    "export": Command(
        "fabrication_commands",
        "write files for the workshop: body, threads, holes, lengths",
        "vsr-jax export scene.toml --stl arm.stl --step arm.step --csv threads.csv",
    ),
    "paper": Command(
        "study_commands",
        "reproduce section IV of the paper: table and figures",
        "vsr-jax paper --out results",
    ),
    "effects": Command(
        "study_commands",
        "measure what each effect of a scene costs on this machine",
        "vsr-jax effects",
    ),
    "accuracy": Command(
        "study_commands",
        "measure accuracy against time for every model",
        "vsr-jax accuracy scene.toml",
    ),
}
"""The commands by name, in the order of the help."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command with arguments `argv`, by default those of the process.

    **Returns:** the exit code: 0 done, 1 a solve did not converge, 2 bad usage.

    **Raises:** `SystemExit` from argparse, with 0 after help or version, 2 for invalid
    arguments.
    """
    arguments = [_spaced(argument) for argument in (sys.argv[1:] if argv is None else argv)]
    options = _parser(arguments[:1]).parse_args(arguments)
    if getattr(options, "no_cache", False):
        os.environ["VSR_JAX_CACHE"] = "off"
    with warnings.catch_warnings():
        warnings.showwarning = _shown(warnings.showwarning)
        try:
            return options.run(options)
        except (ValueError, OSError, ImportError) as error:
            print(f"vsr-jax: {' '.join(str(error).split())}", file=sys.stderr)
            return BAD_USAGE


def _shown(otherwise: Callable[..., None]) -> Callable[..., None]:
    """Prints a warning of units as the commands do, each once, and another one `otherwise`."""
    said = set()

    def show(message: Warning, category: type[Warning], *where: Any) -> None:
        if category.__name__ != "UnitWarning":  # whose module imports JAX
            otherwise(message, category, *where)
        elif str(message) not in said:
            said.add(str(message))
            print_warnings([str(message)])

    return show


def _spaced(argument: str) -> str:
    """The argument, a negative number with a space in front: argparse takes -1e-3 for an option."""
    try:
        return f" {argument}" if float(argument) < 0 else argument
    except ValueError:
        return argument


def _parser(chosen: Sequence[str]) -> argparse.ArgumentParser:
    """The parser, with the arguments of the chosen command only: their modules import JAX."""
    examples = (command.example for command in COMMANDS.values())
    parser = argparse.ArgumentParser(
        prog="vsr-jax",
        description="Statics of soft manipulators: Cosserat rods bent by tendons and fluidic "
        "chambers.",
        epilog="\n  ".join(("examples:", *examples)) + f"\n\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"vsr-jax {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name, command in COMMANDS.items():
        if name in chosen:
            module = import_module(f".{command.module}", __package__)
            getattr(module, f"add_{name}")(commands)
        else:
            commands.add_parser(name, help=command.help)
    return parser
