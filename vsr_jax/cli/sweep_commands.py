"""The command `sweep`: solves a scene file for many inputs and reports the workspace of the tip."""

import argparse
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ..analysis.sweep_program import stored_outputs
from ..analysis.sweeping import Sweep, sweep
from .common import (
    DONE,
    NOT_CONVERGED,
    add_bounds,
    bounds,
    check_folders,
    command,
    draw_without_display,
    positive_integer,
)
from .scene_commands import add_scene, model_between, task_of


def add_sweep(commands: Any) -> None:
    """Adds the command `sweep`."""
    parser = command(
        commands,
        "sweep",
        description="Draws inputs uniformly between two bounds, solves the scene of a TOML file "
        "for each, and prints the extent\n"
        "of the tip positions. The same command resumes an interrupted sweep to disk. The exit "
        "status is 1 if no\n"
        "sample converged.",
        example="vsr-jax sweep scene.toml --samples 100000 --high 10 5 --out workspace.zarr "
        "--plot workspace.png",
        run=_sweep,
    )
    add_scene(parser)
    parser.add_argument(
        "--samples",
        metavar="N",
        type=positive_integer,
        default=10_000,
        help="number of samples (default: %(default)s)",
    )
    add_bounds(parser, "--inputs, or those of the file")
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the random inputs (default: %(default)s)"
    )
    parser.add_argument(
        "--outputs",
        nargs="+",
        choices=tuple(stored_outputs()),
        default=["tip"],
        help="quantities to store besides the status (default: tip)",
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        help='a Zarr folder for inputs and outputs, which xarray reads; needs "vsr-jax[sweep]"',
    )
    parser.add_argument(
        "--plot", metavar="FILE", help="draw the tips into a picture: .png, .pdf, .svg"
    )


def _sweep(options: argparse.Namespace) -> int:
    task = task_of(options)
    check_folders(options.out, options.plot)
    dtype = task.inputs.dtype
    low, high = bounds(options.low, options.high, task.scene, np.asarray(task.inputs))
    inputs = (
        np.random.default_rng(options.seed)
        .uniform(low, high, (options.samples, len(low)))
        .astype(dtype)
    )
    model = model_between(task, options.tolerance, low, high)
    outputs = tuple(dict.fromkeys([*options.outputs, "tip"]))
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.filterwarnings("always", message="sweep.out")
        warnings.showwarning = lambda message, *_, **__: print(
            f"vsr-jax: {message}", file=sys.stderr
        )
        result = sweep(task.scene, inputs, outputs=outputs, model=model, out=options.out)
    seconds = time.perf_counter() - start
    tips = np.asarray(result["tip"])[:, :3, 3]
    print("\n".join(_lines(task.title or options.scene, low, high, result, tips)))
    print(f"time        {seconds:.1f} s, including compilation")
    if not np.any(result.converged):
        if options.plot:
            print(f"vsr-jax: {options.plot} is not drawn: no sample converged", file=sys.stderr)
        return NOT_CONVERGED
    if options.plot:
        _draw(options.plot, task.title, tips, inputs, low, high)
    return DONE


def _lines(
    title: str, low: np.ndarray, high: np.ndarray, result: Sweep, tips: np.ndarray
) -> list[str]:
    """The report of a sweep."""
    ranges = ", ".join(f"{a:g} to {b:g}" for a, b in zip(low, high, strict=True))
    counts = ", ".join(f"{number:,} {status}" for status, number in result.counts.items())
    lines = [title, f"inputs      {ranges}", f"samples     {counts}"]
    if np.any(result.converged):
        extents = zip("xyz", np.nanmin(tips, axis=0), np.nanmax(tips, axis=0), strict=True)
        lines += [f"tip {axis}       {least:.6g} to {most:.6g} m" for axis, least, most in extents]
    return lines


def _draw(
    path: str, title: str, tips: np.ndarray, inputs: np.ndarray, low: np.ndarray, high: np.ndarray
) -> None:
    draw_without_display()
    from ..viz import plot

    varied = high != low  # the mean of many inputs carries no information
    share = (
        np.mean((inputs - low)[:, varied] / (high - low)[varied], axis=1)
        if 0 < np.sum(varied) < 4
        else None
    )
    with plot.theme():
        axes = plot.workspace(tips, values=share, label="mean share of the inputs' range")
        axes[0].figure.suptitle(title)
        axes[0].figure.savefig(Path(path), dpi=200)
