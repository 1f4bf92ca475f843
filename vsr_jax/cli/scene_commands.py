"""The commands for a scene file: `solve` solves it, `check` reports the health of the solve."""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..analysis.health import check
from ..arm.scene import Scene
from ..files.output import write_json
from ..files.scene_file import load
from ..models.base import Model
from ..models.basis import Basis, Legendre
from ..models.prescribed import Prescribed
from ..models.strain_dependent import StrainDependent
from ..solution.equilibrium import Equilibrium
from ..solution.plausible_strain import strain_warnings
from ..solution.solver import solve
from ..solution.step_choice import plan
from .common import (
    DONE,
    NOT_CONVERGED,
    add_cache,
    add_precision,
    check_folders,
    command,
    draw_without_display,
    positive_integer,
    print_warnings,
    set_precision,
)

MODELS = ("strain-dependent", "prescribed", "continuum")
"""Names of the models, the most used first."""

LEGENDRE_ORDER = 8
"""Order of the Legendre polynomials of `--model prescribed`, for each free strain."""

STATIONS = 41
"""Stations of pictures and JSON files, evenly spaced from base to tip."""

_SCENE_EXAMPLE = """
a scene file:
  inputs = [10.0, 5.0]                # tensions [N]; --inputs overrides them
  [rod]
  length = 0.75                       # SI units throughout
  section = { type = "Circular", radius = { type = "Taper", base = 0.012, tip = 0.010 } }
  material = { young = 5.93e5, shear = 2.00e5 }
  [[actuators]]
  type = "Tendon"
  routing = { type = "Helix", radius = 0.005, angle = 1.529 }
  [[actuators]]
  type = "Tendon"
  routing = { type = "Parallel", y = 0.0, z = 0.005 }
"""


def add_solve(commands: Any) -> None:
    """Adds the command `solve`."""
    parser = command(
        commands,
        "solve",
        description="Solves the scene of a TOML file and prints status, tip, stability and "
        "threads.",
        example="vsr-jax solve scene.toml --inputs 8 2.5 --plot arm.png --json arm.json",
        more=_SCENE_EXAMPLE,
        run=_solve,
    )
    add_scene(parser)
    parser.add_argument(
        "--plot", metavar="FILE", help="draw the arm into a picture: .png, .pdf, .svg"
    )
    parser.add_argument(
        "--json",
        metavar="FILE",
        help="save inputs, status, tip, positions, strains, threads and stability",
    )


def add_check(commands: Any) -> None:
    """Adds the command `check`."""
    parser = command(
        commands,
        "check",
        description="Solves the scene of a TOML file and 65 variants of it, 129 for a scene with "
        "inputs and loads. Prints the\n"
        "status, the stability margin, how far inputs and loads may grow and how the solve fails "
        "beyond, the change\n"
        "of the tip with finer steps, the conditioning, and advice.",
        example="vsr-jax check scene.toml --inputs 8 2.5",
        run=_check,
    )
    add_scene(parser)
    parser.add_argument("--json", metavar="FILE", help="save the report")


def add_scene(parser: argparse.ArgumentParser, inputs: str = "those of the file") -> None:
    """Adds the arguments for the scene, its inputs and the model; `inputs` describes the default
    inputs."""
    parser.add_argument("scene", metavar="SCENE", help="the TOML file")
    parser.add_argument(
        "--inputs",
        "--input",
        metavar="U",
        nargs="*",
        type=float,
        help=f"one number per actuator (default: {inputs})",
    )
    parser.add_argument(
        "--model",
        choices=MODELS,
        help=f"model (default: that of vsr.solve); prescribed: Legendre polynomials up to order "
        f"{LEGENDRE_ORDER} for each free strain",
    )
    parser.add_argument(
        "--steps",
        metavar="N",
        type=positive_integer,
        help="steps along the arm (default: the model's)",
    )
    parser.add_argument(
        "--tolerance",
        metavar="M",
        type=float,
        help="error bound of the tip in metres, which sets the steps; instead of --steps",
    )
    add_precision(parser)
    add_cache(parser)


class SceneTask(NamedTuple):
    """Scene, inputs, model and title from the file and the command line."""

    scene: Scene
    inputs: Array
    model: Model | None
    title: str


def read_task(
    path: str,
    inputs: Sequence[float] | None,
    precision: str = "float64",
    *,
    at_rest: bool = False,
) -> SceneTask:
    """The task of a scene file, with the default model.

    **Arguments:** `path`: the file; `inputs`: from the command line, None for those of the file;
    `precision`: of all numbers; `at_rest`: whether they are those at rest where there are none.

    **Raises:** `ValueError` for an invalid file or invalid numbers.
    """
    set_precision(precision)
    scene, stored, title = load(path)
    values = stored if inputs is None else inputs
    if values is None:
        if scene.inputs and not at_rest:
            kinds = ", ".join(one.name for one in scene.inputs)
            raise ValueError(f"{path}: has no inputs, need --inputs, one number each for {kinds}")
        values = scene.rest_inputs
    return SceneTask(scene, jnp.asarray(values, precision), None, title)


def task_of(options: argparse.Namespace, *, at_rest: bool = False) -> SceneTask:
    """The task of the arguments that `add_scene` adds; `at_rest` as of `read_task`.

    **Raises:** `ValueError` as `read_task`, and for a tolerance together with a model.
    """
    task = read_task(options.scene, options.inputs, options.precision, at_rest=at_rest)
    if options.tolerance is not None and (options.model, options.steps) != (None, None):
        raise ValueError(
            "--tolerance: got --model or --steps too, need one or the other: a tolerance sets both"
        )
    return task._replace(model=_model(options.model, options.steps, task.scene))


def model_between(
    task: SceneTask, tolerance: float | None, low: np.ndarray, high: np.ndarray
) -> Model | None:
    """The model of the task, or the one that meets a tolerance for inputs between two bounds."""
    if tolerance is None:
        return task.model
    dtype = task.inputs.dtype
    return plan(task.scene, tolerance, (low.astype(dtype), high.astype(dtype))).model


def _solve(options: argparse.Namespace) -> int:
    scene, inputs, model, title = task_of(options)
    check_folders(options.plot, options.json)
    eq = solve(scene, inputs, model=model, tolerance=options.tolerance)
    _tell(eq, title, options)
    if not bool(eq.converged):
        return NOT_CONVERGED
    print_warnings(strain_warnings(eq))
    return DONE


def _check(options: argparse.Namespace) -> int:
    scene, inputs, model, title = task_of(options)
    check_folders(options.json)
    model = (
        model
        if options.tolerance is None
        else solve(scene, inputs, tolerance=options.tolerance).model
    )
    health = check(scene, inputs, model=model)
    print(title or options.scene, health, sep="\n")
    if options.json:
        write_json(options.json, {"scene": options.scene, "title": title, **health.record()})
    return DONE if bool(health.equilibrium.converged) else NOT_CONVERGED


def _tell(eq: Equilibrium, title: str, options: argparse.Namespace) -> None:
    from . import report

    found = report.summary(eq, STATIONS) if options.json else None
    values = report.values(eq) if found is None else found.values
    error = options.tolerance is not None
    print("\n".join(report.lines(eq, values, title or options.scene, error=error)))
    if options.json:
        write_json(
            options.json, {"scene": options.scene, "title": title, **report.record(eq, found)}
        )
    if options.plot:
        _draw(eq, title, options.plot)
        if not bool(eq.converged):
            said = "the solve failed, so it shows the arm at rest"
            print(f"vsr-jax: {options.plot}: {said}", file=sys.stderr)


def _draw(eq: Equilibrium, title: str, path: str) -> None:
    draw_without_display()
    from ..viz import plot

    with plot.theme():
        figure: Any = plot.arm(eq, stations=STATIONS).figure
        figure.text(0.015, 0.02, title)
        figure.savefig(path, dpi=200)


def _model(name: str | None, steps: int | None, scene: Scene) -> Model | None:
    if name is None and steps is None:
        return None
    if name == "continuum":
        from ..models.continuum import Continuum

        if steps is not None:
            raise ValueError("--steps: not available for the continuum model, whose steps adapt")
        return Continuum()
    chosen = (
        Prescribed(Basis.uniform(Legendre(LEGENDRE_ORDER), scene.free_strains))
        if name == "prescribed"
        else StrainDependent()
    )
    return chosen if steps is None else replace(chosen, steps=steps)
