"""Compiled programs kept on disk between processes, in the user's cache folder.

A program is found by a hash of its code, of the options, the versions and the processor that it was
compiled with, so that another one is never used. JAX's own cache, and with it the programs of the
user, are left as they are set.
"""

import hashlib
import os
import platform
import re
import sys
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
from jax.experimental import serialize_executable
from jax.stages import Compiled, Lowered

VARIABLE = "VSR_JAX_CACHE"
"""Environment variable with another folder, or "off"."""

MOST_BYTES = 500_000_000
"""Size of the folder above which the programs that were used longest ago are removed; a program
takes 0.1 to 5 MB."""

_KIND = ".program"
"""Ending of the files."""


def compiled(lowered: Lowered, options: dict[str, Any]) -> Compiled:
    """A program compiled with options for one device of the host, or the stored one."""
    path = _path(lowered, options)
    found = None if path is None else _read(path, lowered)
    if found is None:
        found = lowered.compile(compiler_options=options)
        if path is not None:
            _write(path, found)
    return found


def stored(lowered: Lowered, options: dict[str, Any]) -> Compiled | None:
    """The stored program, None if there is none."""
    path = _path(lowered, options)
    return None if path is None else _read(path, lowered)


def folder() -> Path | None:
    """The folder that `VSR_JAX_CACHE` names, else one in the user's cache folder; None if the
    variable is "off" or there is no home folder."""
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


def remove_oldest(folder: Path, most_bytes: int) -> None:
    """Removes the programs in a folder that were used longest ago until the others take at most
    `most_bytes`."""
    files = [(path.stat(), path) for path in folder.glob(f"*{_KIND}")]
    files.sort(key=lambda file: max(file[0].st_mtime, file[0].st_atime))
    excess = sum(stat.st_size for stat, _ in files) - most_bytes
    for stat, path in files:
        if excess <= 0:
            return
        path.unlink(missing_ok=True)  # another process may have removed it
        excess -= stat.st_size


def _path(lowered: Lowered, options: dict[str, Any]) -> Path | None:
    where = _usable(folder())
    if where is None:
        return None
    said = (
        _canonical(lowered.as_text()),
        sorted(options.items()),
        os.environ.get("XLA_FLAGS", ""),
        _machine(),
    )
    return where / (hashlib.sha256(repr(said).encode()).hexdigest() + _KIND)


def _canonical(text: str) -> str:
    """The text of a program, with the functions that it calls named by hashes of their texts.

    JAX lets calls share a function if an equal one from earlier is still in memory, so that names
    depend on when Python last looked for garbage.
    """
    head, *parts = re.split(r"^  func\.func \w+ @([\w.]+)", text, flags=re.MULTILINE)
    bodies = {name: body.rstrip("} \n") for name, body in zip(parts[::2], parts[1::2], strict=True)}

    @cache
    def name(function: str) -> str:
        return hashlib.sha256(named(bodies[function]).encode()).hexdigest()

    def named(body: str) -> str:
        return re.sub(r"@([\w.]+)", lambda x: name(x[1]) if x[1] in bodies else x[0], body)

    return head + named(bodies["main"])


@cache
def _usable(where: Path | None) -> Path | None:
    """A folder that can be written, reduced to its size once in a process."""
    try:
        if where is not None:
            where.mkdir(parents=True, exist_ok=True)
            remove_oldest(where, MOST_BYTES)
    except OSError:
        return None
    return where


@cache
def _machine() -> tuple[str, ...]:
    """Versions of the compiler, and the processor with its instructions."""
    instructions = ""
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = information.read_text(errors="replace").splitlines()
        instructions = next((x for x in lines if x.startswith(("flags", "Features"))), "")
    return version("jax"), version("jaxlib"), *platform.uname()[4:], instructions


def _read(path: Path, lowered: Lowered) -> Compiled | None:
    try:
        data = path.read_bytes()
    except OSError:
        return None
    with suppress(OSError):  # a folder that is only read
        os.utime(path)
    device = jax.local_devices(backend="cpu")[0]
    try:
        return serialize_executable.deserialize_and_load(
            data, lowered.in_tree, lowered.out_tree, device.client, [device]
        )
    except Exception:  # a damaged file, of whatever kind: the program is compiled again
        return None


def _write(path: Path, program: Compiled) -> None:
    """Stores a program, in one step for other processes."""
    temporary = path.with_suffix(f".{os.getpid()}")
    try:
        temporary.write_bytes(serialize_executable.serialize(program)[0])
        os.replace(temporary, path)
    except Exception:  # a full disk; a program that JAX cannot store, with a callback or a sort
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
