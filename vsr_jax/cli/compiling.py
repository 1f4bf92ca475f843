"""Compiled programs kept on disk between runs of the command, and a sign of life while it compiles.

JAX finds a program in its cache by the program itself, the compiler's version and the machine, so
that a wrong one is never used.
"""

import argparse
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import jax

from ..analysis.progress import message_when_slow

VARIABLE = "VSR_JAX_CACHE"
"""Environment variable with another folder, or "off"."""

MOST_BYTES = 500_000_000
"""Size of the cache above which the programs that were used longest ago are removed; a program
takes 0.1 to 2 MB."""


def cache_folder() -> Path | None:
    """Folder of the cache: that of `VSR_JAX_CACHE`, else one in the user's cache folder; None if
    the variable is "off" or there is no home folder."""
    chosen = os.environ.get(VARIABLE, "")
    if chosen:
        return None if chosen == "off" else Path(chosen)
    if sys.platform == "win32":
        parent = os.environ.get("LOCALAPPDATA", "")
    elif sys.platform == "darwin":
        parent = "~/Library/Caches"
    else:
        parent = os.environ.get("XDG_CACHE_HOME", "") or "~/.cache"
    try:
        return Path(parent).expanduser() / "vsr_jax" if parent else None
    except RuntimeError:
        return None


def add_cache(parser: argparse.ArgumentParser) -> None:
    """Adds `--no-cache`, see `keep_programs`."""
    parser.add_argument(
        "--no-cache",
        action="store_true",
        help=f"compile everything again and keep nothing; {VARIABLE}=off does the same for every "
        f"command, {VARIABLE}=FOLDER moves the cache",
    )


def keep_programs(options: argparse.Namespace) -> bool:
    """Keeps compiled programs in `cache_folder`, of at most about `MOST_BYTES`, unless `--no-cache`
    was given; call it before any computation.

    **Returns:** whether they are kept: not without a folder that can be written.
    """
    folder = None if options.no_cache else cache_folder()
    if folder is None:
        return False
    try:
        folder.mkdir(parents=True, exist_ok=True)
        remove_oldest(folder, MOST_BYTES)
    except OSError:
        return False
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    return True


def remove_oldest(folder: Path, most_bytes: int) -> None:
    """Removes the files of a folder that were used longest ago until the others take at most
    `most_bytes`."""
    files = [(path.stat(), path) for path in folder.iterdir() if path.is_file()]
    files.sort(key=lambda file: max(file[0].st_mtime, file[0].st_atime))
    excess = sum(stat.st_size for stat, _ in files) - most_bytes
    for stat, path in files:
        if excess <= 0:
            return
        path.unlink(missing_ok=True)  # another process may have removed it
        excess -= stat.st_size


@contextmanager
def compiling(options: argparse.Namespace) -> Iterator[None]:
    """Runs a command with the cache; says so on stderr if it has been silent for three seconds.

    A command without `--no-cache`, whose purpose is to measure compile times, runs as it is; one
    with a progress bar says so there.
    """
    if not hasattr(options, "no_cache"):
        yield
        return
    later = "; the same kind of scene is faster from now on" if keep_programs(options) else ""
    silent = not getattr(options, "progress_bar", False)
    with message_when_slow(f"vsr-jax: compiling{later}", shown=silent):
        yield
