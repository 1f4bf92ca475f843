"""Shared by the commands of `vsr-jax`: exit codes, help format, common arguments, precision.
Does not import JAX, which the help does not need."""

import argparse
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..arm.scene import Scene

DONE, NOT_CONVERGED, BAD_USAGE = 0, 1, 2
"""Exit codes."""

EXIT_CODES = "exit codes: 0 done, 1 a solve did not converge, 2 bad usage"


Commands = argparse._SubParsersAction
"""What `add_subparsers` returns."""


def command(
    commands: Commands,
    name: str,
    *,
    example: str,
    run: Callable,
    description: str,
    more: str = "",
) -> argparse.ArgumentParser:
    """Adds a command whose help ends with an example, the text `more` and the exit codes."""
    epilog = f"example:\n  {example}\n{more}\n{EXIT_CODES}"
    parser = commands.add_parser(
        name,
        description=description,
        epilog=epilog,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    return parser


def positive_integer(text: str) -> int:
    """Integer >= 1 from an argument."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"got {text}, need an integer >= 1")
    return number


def check_folders(*paths: str | None) -> None:
    """Checks before any computation that files can be written.

    **Raises:** `ValueError` for a path in a folder that does not exist.
    """
    for path in paths:
        if path is not None and not Path(path).parent.is_dir():
            raise ValueError(f"{path}: there is no folder {str(Path(path).parent)!r}")


def print_warnings(sentences: Iterable[str]) -> None:
    """Prints warnings to stderr, one per line."""
    for sentence in sentences:
        print(f"vsr-jax: warning: {sentence}", file=sys.stderr)


def add_bounds(parser: argparse.ArgumentParser, default: str) -> None:
    """Adds `--low` and `--high`, see `bounds`; `default` describes the default inputs."""
    parser.add_argument(
        "--low",
        metavar="U",
        nargs="+",
        type=float,
        help=f"least inputs, one number for all or one per actuator (default: {default}, where "
        f"negative, else 0)",
    )
    parser.add_argument(
        "--high",
        metavar="U",
        nargs="+",
        type=float,
        help=f"greatest inputs (default: {default}, where positive, else 0)",
    )


def add_precision(parser: argparse.ArgumentParser) -> None:
    """Adds `--precision`, see `set_precision`."""
    parser.add_argument(
        "--precision",
        choices=("float64", "float32"),
        default="float64",
        help="precision of all numbers (default: %(default)s)",
    )


def add_cache(parser: argparse.ArgumentParser) -> None:
    """Adds `--no-cache`: nothing is read from the folder of compiled programs, nor stored there."""
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help="compile everything again and keep nothing; VSR_JAX_CACHE=off does the same for every "
        "command, VSR_JAX_CACHE=FOLDER moves the cache",
    )


def set_precision(precision: str) -> None:
    """Enables double precision in JAX if needed; call it before any array is created."""
    import jax

    if precision == "float64":
        jax.config.update("jax_enable_x64", True)


def bounds(
    low: Sequence[float] | None,
    high: Sequence[float] | None,
    scene: "Scene",
    inputs: np.ndarray,
    factor: float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest inputs, one number per input, from `--low` and `--high`; by default those
    of a driven number with both bounds, and for others the range from rest to `factor` times as far
    as `inputs`.

    **Raises:** `ValueError` for a wrong number of values, and if a lower bound exceeds its upper
    bound.
    """
    rest = np.asarray(scene.rest_inputs)
    default = rest + factor * (inputs - rest)
    own = np.array([(one.low, one.high) for one in scene.inputs]).reshape(-1, 2)
    bounded = np.isfinite(own).all(axis=1)
    pair = []
    for name, values in (
        ("--low", np.where(bounded, own[:, 0], np.minimum(default, rest)) if low is None else low),
        (
            "--high",
            np.where(bounded, own[:, 1], np.maximum(default, rest)) if high is None else high,
        ),
    ):
        if len(values) not in (1, len(default)):
            raise ValueError(
                f"{name}: got {len(values)} numbers, need one for all inputs or {len(default)}, "
                f"one for each"
            )
        pair.append(np.broadcast_to(np.asarray(values, float), default.shape))
    if np.any(pair[0] > pair[1]):
        low_row, high_row = (" ".join(f"{value:g}" for value in row) for row in pair)
        raise ValueError(f"--low: got {low_row}, need at most --high, {high_row}")
    return pair[0], pair[1]


def draw_without_display() -> None:
    """Selects the backend of matplotlib that only writes files; call it before drawing."""
    import matplotlib

    matplotlib.use("Agg")
