"""The command `vsr-jax`: `vsr-jax paper` runs section IV of the paper anew."""

import argparse
import sys
from collections.abc import Sequence

from . import __version__

DONE, NOT_CONVERGED, BAD_USAGE = 0, 1, 2
"""Exit codes."""

_EXIT_CODES = "exit codes: 0 done, 1 a solve did not converge, 2 bad usage"


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command with the arguments `argv`, those of the process by default.

    **Returns:** the exit code: 0 done, 1 a solve did not converge, 2 bad usage.

    **Raises:** `SystemExit` from argparse, with 0 after help or version, 2 for arguments it cannot read.
    """
    options = _parser().parse_args(argv)
    try:
        return options.run(options)
    except (ValueError, OSError) as error:
        print(f"vsr-jax: {error}", file=sys.stderr)
        return BAD_USAGE


def _parser() -> argparse.ArgumentParser:
    plain = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(
        prog="vsr-jax",
        description="Statics of soft manipulators: Cosserat rods bent by tendons and fluidic chambers.",
        epilog=f"example:\n  vsr-jax paper --out results\n\n{_EXIT_CODES}",
        formatter_class=plain,
    )
    parser.add_argument("--version", action="version", version=f"vsr-jax {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    paper = commands.add_parser(
        "paper",
        help="run section IV of the paper anew: table and figures",
        description="Solves the cases of section IV of Renda et al. (2020) with every model, compares them with the reference\n"
        "solutions and writes table.md, table.json, Fig. 2 and, with case A2, Fig. 3 (PNG and PDF). All cases take about\n"
        "two minutes on two cores.",
        epilog=f"example:\n  vsr-jax paper --out results --cases A2 B1\n\n{_EXIT_CODES}",
        formatter_class=plain,
    )
    paper.add_argument("--out", metavar="DIR", default="paper", help="folder for the results, made if need be (default: %(default)s)")
    paper.add_argument("--cases", metavar="CASE", nargs="+", help="cases among A1 A2 A3 B1 B2 C1 C2 (default: all)")
    paper.set_defaults(run=_paper)
    return parser


def _paper(options: argparse.Namespace) -> int:
    import jax
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
