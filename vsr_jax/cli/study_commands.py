"""The commands `vsr-jax paper`, `effects` and `accuracy`: reproduction of section IV of the paper,
cost of each effect of a scene, cost of accuracy."""

import argparse
import sys

import jax
import jax.numpy as jnp
import numpy as np

from ..files.output import write_json
from ..models.strain_dependent import StrainDependent
from .common import (
    DONE,
    NOT_CONVERGED,
    Commands,
    check_folders,
    command,
    draw_without_display,
    positive_integer,
)
from .scene_commands import SceneTask, read_task

_GROUPS = ("steps", "bases", "continuum")
"""Copy of `studies.accuracy.GROUPS`; importing it takes a second."""


def add_paper(commands: Commands) -> None:
    """Adds `vsr-jax paper`."""
    parser = command(
        commands,
        "paper",
        description="Solves the cases of section IV of Renda et al. (2020) with every model, "
        "compares them with the reference\n"
        "solutions and writes table.md, table.json, Fig. 2 and, with case A2, Fig. 3 (PNG and "
        "PDF). All cases take about\n"
        "two minutes on two cores.",
        example="vsr-jax paper --out results --cases A2 B1",
        run=_paper,
    )
    parser.add_argument(
        "--out",
        metavar="DIR",
        default="paper",
        help="folder for the results, created if missing (default: %(default)s)",
    )
    parser.add_argument(
        "--cases", metavar="CASE", nargs="+", help="some of A1 A2 A3 B1 B2 C1 C2 (default: all)"
    )


def add_effects(commands: Commands) -> None:
    """Adds `vsr-jax effects`."""
    parser = command(
        commands,
        "effects",
        description="Adds effects to one arm, one at a time: poses, gravity, a tip wrench, a "
        "follower load, a second section,\n"
        "a tendon driven by its length, friction, a payload, a spring; then each alone to the arm "
        "under gravity: straight\n"
        "tendons, a rigid piece, a held tip, an obstacle, friction of contact. Prints the "
        "operations of the compiled program\n"
        "(each loop body counted once), the compile time and the time per solve, single and in a "
        "batch, with ratios to the row\n"
        "above or in brackets. Takes ten minutes.",
        example="vsr-jax effects --batch-size 64 --json effects.json",
        run=_effects,
    )
    parser.add_argument(
        "--batch-size",
        type=positive_integer,
        default=256,
        help="shapes in the batch (default: %(default)s)",
    )
    parser.add_argument(
        "--steps",
        type=positive_integer,
        default=16,
        help="steps along the arm (default: %(default)s)",
    )
    parser.add_argument("--json", metavar="FILE", help="save the results")


def add_accuracy(commands: Commands) -> None:
    """Adds `vsr-jax accuracy`."""
    parser = command(
        commands,
        "accuracy",
        description="Solves a scene, by default the paper's B2, with every model at several "
        "resolutions, for random inputs between\n"
        "10 % and 100 % of the given inputs. Prints errors of tip, strain and gradient with their "
        "times, and recommends\n"
        "a model for errors of 1 mm, 1 um and 1 nm. Compiles about thirty programs three times: "
        "five minutes, more with loads.",
        example="vsr-jax accuracy scene.toml --groups steps --plot accuracy.png --json "
        "accuracy.json",
        run=_accuracy,
    )
    parser.add_argument(
        "scene", metavar="SCENE", nargs="?", help="the TOML file (default: the paper's B2)"
    )
    parser.add_argument(
        "--inputs",
        metavar="U",
        nargs="+",
        type=float,
        help="one number per actuator (default: those of the file)",
    )
    parser.add_argument(
        "--groups", nargs="+", choices=_GROUPS, default=list(_GROUPS), help="models (default: all)"
    )
    parser.add_argument(
        "--batch-size",
        type=positive_integer,
        default=128,
        help="shapes in the batch (default: %(default)s)",
    )
    parser.add_argument(
        "--plot", metavar="FILE", help="plot tip errors against times: .png, .pdf, .svg"
    )
    parser.add_argument("--json", metavar="FILE", help="save the results")


def _paper(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)
    draw_without_display()
    from ..studies import reproduction
    from ..studies.paper import CASES

    rows = reproduction.run(options.out, tuple(CASES) if options.cases is None else options.cases)
    print(
        f"{len(rows)} solves of {', '.join(dict.fromkeys(row.case for row in rows))}; errors "
        f"relative to the reference solutions:"
    )
    print("\n".join(reproduction.summary(rows)))
    figures = "fig2" if all(row.case != "A2" for row in rows) else "fig2 and fig3"
    print(
        f"The whole table is in {options.out}/table.md (and .json), the figures in {options.out}: "
        f"{figures} (.png, .pdf)"
    )
    return DONE if all(row.converged for row in rows) else NOT_CONVERGED


def _effects(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)
    from ..studies import effects

    check_folders(options.json)
    costs = effects.measure(
        options.batch_size,
        model=StrainDependent(options.steps),
        report=lambda message: print(message, file=sys.stderr),
    )
    print("\n".join(effects.table(costs)))
    if options.json:
        write_json(options.json, [cost._asdict() for cost in costs])
    return DONE if all(cost.converged == 1 for cost in costs) else NOT_CONVERGED


def _two_helices(inputs: list[float] | None) -> SceneTask:
    from ..studies import paper

    values = np.asarray([-15.0, -15.0] if inputs is None else inputs)
    scene = paper.scene("B2")
    return SceneTask(scene, scene.check_inputs(values), None, "B2, two helices")


def _accuracy(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)
    from ..studies import accuracy

    check_folders(options.plot, options.json)
    task = (
        read_task(options.scene, options.inputs) if options.scene else _two_helices(options.inputs)
    )
    shares = np.random.default_rng(0).uniform(0.1, 1.0, (options.batch_size, task.inputs.size))
    rest = task.scene.rest_inputs
    settings = accuracy.settings(task.scene, groups=options.groups)
    rows = accuracy.measure(
        task.scene,
        rest + jnp.asarray(shares) * (task.inputs - rest),
        settings,
        report=lambda message: print(message, file=sys.stderr),
    )
    print("\n".join([*accuracy.table(rows), "", *accuracy.advice(rows)]))
    title = task.title or options.scene
    if options.json:
        write_json(options.json, {title: [row._asdict() for row in rows]})
    if options.plot:
        draw_without_display()
        from ..studies import accuracy_figures

        accuracy_figures.work_precision({title: rows}).savefig(options.plot, dpi=150)
    return DONE if any(row.tip is not None for row in rows) else NOT_CONVERGED
