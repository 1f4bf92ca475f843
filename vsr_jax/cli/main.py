"""The command `vsr-jax`: solves, checks, sweeps, designs and calibrates scenes, finds inputs for
targets, reproduces the paper, measures costs."""

import argparse
import sys
from collections.abc import Sequence

from .. import __version__
from .common import BAD_USAGE, EXIT_CODES
from .compiling import compiling
from .design_commands import add_design
from .fit_commands import add_fit
from .inverse_commands import add_reach
from .scene_commands import add_check, add_solve
from .study_commands import add_accuracy, add_effects, add_paper
from .sweep_commands import add_sweep

EXAMPLES = (
    "vsr-jax solve scene.toml --plot arm.png",
    "vsr-jax check scene.toml",
    "vsr-jax sweep scene.toml --samples 100000 --plot workspace.png",
    "vsr-jax reach scene.toml --target 0.5 0.1 0.2 --high 12",
    "vsr-jax design problem.toml --out designed.toml",
    "vsr-jax fit fit.toml --out calibrated.toml",
    "vsr-jax paper --out results",
    "vsr-jax effects",
    "vsr-jax accuracy scene.toml",
)
"""One example per command."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command with arguments `argv`, by default those of the process.

    **Returns:** the exit code: 0 done, 1 a solve did not converge, 2 bad usage.

    **Raises:** `SystemExit` from argparse, with 0 after help or version, 2 for invalid
    arguments.
    """
    options = _parser().parse_args(
        [_spaced(argument) for argument in (sys.argv[1:] if argv is None else argv)]
    )
    try:
        with compiling(options):
            return options.run(options)
    except (ValueError, OSError, ImportError) as error:
        print(f"vsr-jax: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_USAGE


def _spaced(argument: str) -> str:
    """The argument, a negative number with a space in front: argparse takes -1e-3 for an option."""
    try:
        return f" {argument}" if float(argument) < 0 else argument
    except ValueError:
        return argument


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vsr-jax",
        description="Statics of soft manipulators: Cosserat rods bent by tendons and fluidic "
        "chambers.",
        epilog="\n  ".join(("examples:", *EXAMPLES)) + f"\n\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"vsr-jax {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add_solve(commands)
    add_check(commands)
    add_sweep(commands)
    add_reach(commands)
    add_design(commands)
    add_fit(commands)
    add_paper(commands)
    add_effects(commands)
    add_accuracy(commands)
    return parser
