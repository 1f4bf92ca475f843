"""The command `vsr-jax`: `solve` solves a scene file, `paper` runs section IV of the paper anew, `effects` shows what each effect costs."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from . import __version__
from .basis import Basis, Legendre
from .discrete import Prescribed
from .equilibrium import Equilibrium
from .model import Model
from .scene import Scene
from .scenefile import load_scene
from .solve import solve
from .strain_dependent import StrainDependent

DONE, NOT_CONVERGED, BAD_USAGE = 0, 1, 2
"""Exit codes."""

MODELS = ("strain-dependent", "prescribed", "continuum")
"""Names of the models in the order of how often they are wanted."""

LEGENDRE_ORDER = 8
"""Order of the Legendre polynomials that `--model prescribed` takes for each free strain."""

STATIONS = 41
"""How many stations, evenly spaced from base to tip, go into a picture and a JSON file."""

_EXIT_CODES = "exit codes: 0 done, 1 a solve did not converge, 2 bad usage"
_SCENE_EXAMPLE = """
a scene file:
  inputs = [10.0, 5.0]                # tensions [N]; --inputs goes first
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


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command with the arguments `argv`, those of the process by default.

    **Returns:** the exit code: 0 done, 1 a solve did not converge, 2 bad usage.

    **Raises:** `SystemExit` from argparse, with 0 after help or version, 2 for arguments it cannot read.
    """
    options = _parser().parse_args([_spaced(argument) for argument in (sys.argv[1:] if argv is None else argv)])
    try:
        return options.run(options)
    except (ValueError, OSError) as error:
        print(f"vsr-jax: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_USAGE


def _spaced(argument: str) -> str:
    """Puts a space before a negative number: argparse would take -1e-3 for an option."""
    try:
        return f" {argument}" if float(argument) < 0 else argument
    except ValueError:
        return argument


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="vsr-jax",
        description="Statics of soft manipulators: Cosserat rods bent by tendons and fluidic chambers.",
        epilog=f"examples:\n  vsr-jax solve scene.toml --plot arm.png\n  vsr-jax paper --out results\n  vsr-jax effects\n\n{_EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"vsr-jax {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_solve(commands)
    _add_paper(commands)
    _add_effects(commands)
    return parser


def _command(commands: Any, name: str, *, example: str, run: Callable, more: str = "", **texts: str) -> argparse.ArgumentParser:
    """A command with an example, `more` under it, and the exit codes at the end of its help."""
    epilog = f"example:\n  {example}\n{more}\n{_EXIT_CODES}"
    command = commands.add_parser(name, epilog=epilog, formatter_class=argparse.RawDescriptionHelpFormatter, **texts)
    command.set_defaults(run=run)
    return command


def _add_solve(commands: Any) -> None:
    command = _command(
        commands,
        "solve",
        help="solve a scene file and print, draw or save the result",
        description="Solves the scene of a TOML file and prints status, tip, stability and threads.",
        example="vsr-jax solve scene.toml --inputs 8 2.5 --plot arm.png --json arm.json",
        more=_SCENE_EXAMPLE,
        run=_solve,
    )
    command.add_argument("scene", metavar="SCENE", help="the TOML file")
    command.add_argument("--inputs", metavar="U", nargs="*", type=float, help="one number an actuator (default: those of the file)")
    command.add_argument(
        "--model",
        choices=MODELS,
        help=f"how to solve (default: vsr.solve chooses); prescribed: Legendre polynomials to order {LEGENDRE_ORDER} for each free strain",
    )
    command.add_argument("--precision", choices=("float64", "float32"), default="float64", help="of all numbers (default: %(default)s)")
    command.add_argument("--plot", metavar="FILE", help="draw the arm into a picture: .png, .pdf, .svg")
    command.add_argument("--json", metavar="FILE", help="save inputs, status, tip, positions, strains, threads and stability")


def _add_paper(commands: Any) -> None:
    command = _command(
        commands,
        "paper",
        help="run section IV of the paper anew: table and figures",
        description="Solves the cases of section IV of Renda et al. (2020) with every model, compares them with the reference\n"
        "solutions and writes table.md, table.json, Fig. 2 and, with case A2, Fig. 3 (PNG and PDF). All cases take about\n"
        "two minutes on two cores.",
        example="vsr-jax paper --out results --cases A2 B1",
        run=_paper,
    )
    command.add_argument("--out", metavar="DIR", default="paper", help="folder for the results, made if need be (default: %(default)s)")
    command.add_argument("--cases", metavar="CASE", nargs="+", help="cases among A1 A2 A3 B1 B2 C1 C2 (default: all)")


def _add_effects(commands: Any) -> None:
    command = _command(
        commands,
        "effects",
        help="what each effect of a scene costs on this machine",
        description="Adds the effects to one arm, one after another: poses, gravity, a tip wrench, a follower load, a second section,\n"
        "a tendon driven by its length, friction. Prints operations of the compiled program (the body of each loop counted\n"
        "once), compile time and the times of a solve, alone and in a batch, each against the row above. Takes a few minutes.",
        example="vsr-jax effects --lanes 64 --json effects.json",
        run=_effects,
    )
    command.add_argument("--lanes", type=_positive, default=256, help="shapes in the batch (default: %(default)s)")
    command.add_argument("--steps", type=_positive, default=16, help="steps along the arm (default: %(default)s)")
    command.add_argument("--json", metavar="FILE", help="save the figures")


def _positive(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"got {text}, need a whole number >= 1")
    return number


def _solve(options: argparse.Namespace) -> int:
    if options.precision == "float64":
        jax.config.update("jax_enable_x64", True)
    scene, inputs, title = load_scene(options.scene)
    inputs = inputs if options.inputs is None else options.inputs
    if inputs is None and scene.actuators:
        kinds = ", ".join(type(actuator).__name__ for actuator in scene.actuators)
        raise ValueError(f"{options.scene}: holds no inputs, need --inputs, one number each for {kinds}")
    _check_folders(options.plot, options.json)
    eq = solve(scene, jnp.asarray([] if inputs is None else inputs, options.precision), model=_model(options.model, scene))
    _tell(eq, title, options)
    return DONE if bool(eq.converged) else NOT_CONVERGED


def _tell(eq: Equilibrium, title: str, options: argparse.Namespace) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from . import plot, report

    print("\n".join(report.lines(eq, title or options.scene)))
    samples = None
    if bool(eq.converged) and (options.plot or options.json):
        samples = plot.sample(eq, np.linspace(0.0, float(eq.scene.rod.length), STATIONS))
    if options.json:
        content = {"scene": options.scene, "title": title, **report.record(eq, samples)}
        Path(options.json).write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    if options.plot and samples is not None:
        ax = plot.arm(samples)
        ax.set_title(title)
        ax.figure.savefig(options.plot, dpi=200, bbox_inches="tight")
    elif options.plot:
        print(f"vsr-jax: {options.plot} is not drawn, there is no shape", file=sys.stderr)


def _model(name: str | None, scene: Scene) -> Model | None:
    if name is None:
        return None
    if name == "prescribed":
        return Prescribed(Basis.uniform(Legendre(LEGENDRE_ORDER), scene.free_strains))
    if name == "continuum":
        from .continuum import Continuum

        return Continuum()
    return StrainDependent()


def _check_folders(*paths: str | None) -> None:
    """Refuses what could not be written, before the work is done."""
    for path in paths:
        if path is not None and not Path(path).parent.is_dir():
            raise ValueError(f"{path}: there is no folder {str(Path(path).parent)!r}")


def _paper(options: argparse.Namespace) -> int:
    import matplotlib

    jax.config.update("jax_enable_x64", True)
    matplotlib.use("Agg")
    from . import reproduce
    from .paper import CASES

    rows = reproduce.run(options.out, tuple(CASES) if options.cases is None else options.cases)
    print(f"{len(rows)} solves of {', '.join(dict.fromkeys(row.case for row in rows))}; errors against the reference solutions:")
    print("\n".join(reproduce.summary(rows)))
    figures = "fig2" if all(row.case != "A2" for row in rows) else "fig2 and fig3"
    print(f"The whole table is in {options.out}/table.md (and .json), the figures in {options.out}: {figures} (.png, .pdf)")
    return DONE if all(row.converged for row in rows) else NOT_CONVERGED


def _effects(options: argparse.Namespace) -> int:
    jax.config.update("jax_enable_x64", True)
    from . import effects

    _check_folders(options.json)
    costs = effects.measure(
        options.lanes, model=StrainDependent(options.steps), say=lambda name: print(f"compiling: {name}", file=sys.stderr)
    )
    print("\n".join(effects.table(costs)))
    if options.json:
        rows = [cost._asdict() for cost in costs]
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return DONE if all(cost.converged == 1 for cost in costs) else NOT_CONVERGED
