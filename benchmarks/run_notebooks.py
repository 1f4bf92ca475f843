"""Runs the notebooks, each in a fresh kernel, and prints the time of each.

    pip install ".[notebooks]" && python benchmarks/run_notebooks.py [01_first_arm ...]

They run in notebooks/ and are not changed: outputs go to a temporary folder. The first failure ends
the run with exit status 1, after its name and the last line of its error.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FOLDER = Path(__file__).parents[1] / "notebooks"
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def chosen(names: list[str]) -> list[Path]:
    """Notebooks by name, with or without the extension; all notebooks if no names are given."""
    known = {path.stem: path for path in sorted(FOLDER.glob("*.ipynb"))}
    unknown = [name for name in names if Path(name).stem not in known]
    if unknown:
        sys.exit(f"run_notebooks: got {', '.join(unknown)}, need some of {', '.join(known)}")
    return [known[Path(name).stem] for name in names] or list(known.values())


def run(path: Path, timeout: int) -> str | None:
    """Last line of the error, None if the notebook succeeds."""
    with tempfile.TemporaryDirectory() as out:
        settings = [
            f"--ExecutePreprocessor.timeout={timeout}",
            "--output-dir",
            out,
            "--log-level",
            "ERROR",
        ]
        command = [
            sys.executable,
            "-m",
            "nbconvert",
            "--to",
            "notebook",
            "--execute",
            *settings,
            path.name,
        ]
        done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=False)
    if done.returncode == 0:
        return None
    lines = [line for line in COLOURS.sub("", done.stderr).splitlines() if line.strip()]
    return lines[-1].strip() if lines else f"exit code {done.returncode}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "notebooks", nargs="*", metavar="NOTEBOOK", help="names of notebooks, all by default"
    )
    parser.add_argument(
        "--timeout", type=int, default=600, metavar="SECONDS", help="limit for one cell (600)"
    )
    options = parser.parse_args()
    for path in chosen(options.notebooks):
        start = time.perf_counter()
        error = run(path, options.timeout)
        print(f"{path.stem:32} {time.perf_counter() - start:6.1f} s", flush=True)
        if error is not None:
            print(f"{path.name} failed: {error}", file=sys.stderr)
            sys.exit(1)


if __name__ == "__main__":
    main()
