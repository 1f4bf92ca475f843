"""What the commands of `vsr-jax` share: exit codes, the look of their help, and arguments that
several take."""

import argparse
import os
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

DONE, NOT_CONVERGED, BAD_USAGE = 0, 1, 2
"""Exit codes."""

EXIT_CODES = "exit codes: 0 done, 1 a solve did not converge, 2 bad usage"


def command(
    commands: Any, name: str, *, example: str, run: Callable, more: str = "", **texts: str
) -> argparse.ArgumentParser:
    """A command with an example, `more` under it, and the exit codes at the end of its help."""
    epilog = f"example:\n  {example}\n{more}\n{EXIT_CODES}"
    parser = commands.add_parser(
        name, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter, **texts
    )
    parser.set_defaults(run=run)
    return parser


def positive(text: str) -> int:
    """A whole number of at least 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"got {text}, need a whole number >= 1")
    return number


def check_folders(*paths: str | None) -> None:
    """Refuses what could not be written, before the work is done."""
    for path in paths:
        if path is not None and not Path(path).parent.is_dir():
            raise ValueError(f"{path}: there is no folder {str(Path(path).parent)!r}")


def warn(sentences: Iterable[str]) -> None:
    """Prints warnings to stderr, each in a line."""
    for sentence in sentences:
        print(f"vsr-jax: warning: {sentence}", file=sys.stderr)


def add_bounds(parser: argparse.ArgumentParser, usual: str) -> None:
    """The arguments of `bounds`; `usual`: what the greatest inputs are where they are not given."""
    parser.add_argument(
        "--low",
        metavar="U",
        nargs="+",
        type=float,
        help="least inputs, one for all or one an actuator (default: 0)",
    )
    parser.add_argument(
        "--high", metavar="U", nargs="+", type=float, help=f"greatest inputs (default: {usual})"
    )


def add_precision(parser: argparse.ArgumentParser) -> None:
    """The argument of `use`."""
    parser.add_argument(
        "--precision",
        choices=("float64", "float32"),
        default="float64",
        help="of all numbers (default: %(default)s)",
    )


def use(precision: str) -> None:
    """Has JAX know double precision, if that is asked for; comes before any number is made."""
    if precision == "float64":
        jax.config.update("jax_enable_x64", True)


def bounds(
    low: Sequence[float] | None, high: Sequence[float] | None, usual: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest inputs, one number an actuator, from `--low` and `--high`: 0 and `usual`
    where they are not given.

    **Raises:** `ValueError` for another number of them, and where they are crossed.
    """
    pair = []
    for name, values in (
        ("--low", [0.0] if low is None else low),
        ("--high", usual if high is None else high),
    ):
        if len(values) not in (1, len(usual)):
            raise ValueError(
                f"{name}: got {len(values)} numbers, need one for all actuators or {len(usual)}, "
                f"one for each"
            )
        pair.append(np.broadcast_to(np.asarray(values, float), usual.shape))
    if np.any(pair[0] > pair[1]):
        low_row, high_row = (" ".join(f"{value:g}" for value in row) for row in pair)
        raise ValueError(f"--low: got {low_row}, need at most --high, {high_row}")
    return pair[0], pair[1]


def hasten(*, optimise: bool) -> None:
    """Has XLA compile a program that runs once in half the time, unless XLA_FLAGS says what to do;
    comes before anything is computed.

    Kernels are emitted without MLIR, whose passes cost a hundredth of a second for each of them,
    and if not `optimise` they are left as they are. A flag that a release does not know ends the
    process: so only for releases that know these.
    """
    if jax.__version_info__ < (0, 11):
        flags = (
            "--xla_cpu_use_fusion_emitters=false",
            *["--xla_backend_optimization_level=0"] * (not optimise),
        )
        os.environ.setdefault("XLA_FLAGS", " ".join(flags))


def one_device_a_core() -> None:
    """Has JAX see each core of the machine's CPU as a device, unless XLA_FLAGS says what to do;
    comes before anything is computed.

    Devices work on samples of their own, where threads within one operation wait for each other.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    os.environ.setdefault("XLA_FLAGS", f"--xla_force_host_platform_device_count={cores}")
