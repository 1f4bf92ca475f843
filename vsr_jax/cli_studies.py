"""The commands that study: `paper` runs section IV of the paper anew, `effects` shows what each effect of a scene costs."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import jax

from .cli_common import DONE, NOT_CONVERGED, check_folders, command, positive
from .strain_dependent import StrainDependent


def add_paper(commands: Any) -> None:
    """Adds the command `paper`."""
    parser = command(
        commands,
        "paper",
        help="run section IV of the paper anew: table and figures",
        description="Solves the cases of section IV of Renda et al. (2020) with every model, compares them with the reference\n"
        "solutions and writes table.md, table.json, Fig. 2 and, with case A2, Fig. 3 (PNG and PDF). All cases take about\n"
        "two minutes on two cores.",
        example="vsr-jax paper --out results --cases A2 B1",
        run=_paper,
    )
    parser.add_argument("--out", metavar="DIR", default="paper", help="folder for the results, made if need be (default: %(default)s)")
    parser.add_argument("--cases", metavar="CASE", nargs="+", help="cases among A1 A2 A3 B1 B2 C1 C2 (default: all)")


def add_effects(commands: Any) -> None:
    """Adds the command `effects`."""
    parser = command(
        commands,
        "effects",
        help="what each effect of a scene costs on this machine",
        description="Adds the effects to one arm, one after another: poses, gravity, a tip wrench, a follower load, a second section,\n"
        "a tendon driven by its length, friction. Prints operations of the compiled program (the body of each loop counted\n"
        "once), compile time and the times of a solve, alone and in a batch, each against the row above. Takes a few minutes.",
        example="vsr-jax effects --lanes 64 --json effects.json",
        run=_effects,
    )
    parser.add_argument("--lanes", type=positive, default=256, help="shapes in the batch (default: %(default)s)")
    parser.add_argument("--steps", type=positive, default=16, help="steps along the arm (default: %(default)s)")
    parser.add_argument("--json", metavar="FILE", help="save the figures")


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

    check_folders(options.json)
    costs = effects.measure(
        options.lanes, model=StrainDependent(options.steps), say=lambda name: print(f"compiling: {name}", file=sys.stderr)
    )
    print("\n".join(effects.table(costs)))
    if options.json:
        rows = [cost._asdict() for cost in costs]
        Path(options.json).write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return DONE if all(cost.converged == 1 for cost in costs) else NOT_CONVERGED
