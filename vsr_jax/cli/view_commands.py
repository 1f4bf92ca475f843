"""The command `vsr-jax view`: the live view of a scene file in the browser."""

import argparse
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from ..solution.solver import solve
from .common import (
    DONE,
    Commands,
    add_bounds,
    bounds,
    command,
)
from .scene_commands import add_scene, task_of


def add_view(commands: Commands) -> None:
    """Adds `vsr-jax view`."""
    parser = command(
        commands,
        "view",
        description="Opens a page in the browser in which the arm of a scene file is turned by "
        "hand: sliders for the inputs and for\n"
        "chosen numbers, a tip to drag, sweeps to play, the scene and pictures to save. Ctrl-C "
        "ends it.\n"
        'Needs "vsr-jax[viewer]".',
        example="vsr-jax view scene.toml --number rod.material.young --number rod.length 0.2 0.4",
        run=_view,
    )
    add_scene(parser, "those of the file, or zeros")
    add_bounds(parser, "twice the greatest input of the same kind")
    parser.add_argument(
        "--number",
        metavar=("NAME", "LOW HIGH"),
        nargs="+",
        action="append",
        default=[],
        help="a number of the scene that gets a slider, and its range (default: from half to twice "
        "the number); can be repeated",
    )
    parser.add_argument(
        "--play", metavar="FILE", help="CSV file with a row of inputs for each frame, to be played"
    )
    parser.add_argument("--theme", choices=("light", "dark"), default="light", help="of the page")
    parser.add_argument(
        "--host",
        default="localhost",
        help="address to serve; 0.0.0.0 for other machines too (default: %(default)s)",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=8080,
        help="port, or the next free one (default: %(default)s)",
    )
    parser.add_argument("--no-browser", action="store_true", help="do not open the page")


def _view(options: argparse.Namespace) -> int:
    from ..viewer.page import view, viewer_library

    viewer_library()
    numbers = numbers_of(options.number)
    task = task_of(options, at_rest=True)
    model = task.model
    if options.tolerance is not None:
        model = solve(task.scene, task.inputs, tolerance=options.tolerance).model
    ends = None
    if options.low is not None or options.high is not None:
        ends = bounds(options.low, options.high, task.scene, np.asarray(task.inputs), 2)
    with _interrupts_end():
        view(
            task.scene,
            task.inputs,
            numbers=numbers,
            bounds=ends,
            model=model,
            play=None if options.play is None else rows_of(options.play),
            title=task.title,
            theme=options.theme,
            host=options.host,
            port=options.port,
            browser=not options.no_browser,
            block=True,
        )
    return DONE


@contextmanager
def _interrupts_end() -> Iterator[None]:
    """Context in which Ctrl-C ends the process at once: XLA aborts if the interpreter ends while a
    thread compiles, which takes too long to wait for."""
    before = signal.signal(signal.SIGINT, lambda *_: os._exit(DONE))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def numbers_of(given: Sequence[Sequence[str]]) -> dict[str, Any]:
    """Names and ranges of the numbers from the values of `--number`.

    **Raises:** `ValueError` for values that are not a name, or a name and two numbers.
    """
    found: dict[str, Any] = {}
    for name, *ends in given:
        try:
            pair = [float(end) for end in ends]
        except ValueError:
            pair = [np.nan]
        if len(pair) not in (0, 2) or np.any(np.isnan(pair)):
            raise ValueError(
                f"--number: got {' '.join((name, *ends))}, need a name, or a name and its least "
                f"and greatest value"
            )
        found[name] = pair or None
    return found


def rows_of(path: str) -> np.ndarray:
    """Rows of inputs in a CSV file.

    **Raises:** `ValueError` for a file that cannot be read or holds anything else.
    """
    try:
        return np.loadtxt(path, delimiter=",", ndmin=2)
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror or error}") from None
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
