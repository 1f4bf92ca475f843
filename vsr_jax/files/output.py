"""Output files: written as a whole or not at all, and JSON without non-finite numbers."""

import json
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..typing import PathLike


def beside(path: Path) -> Path:
    """A new hidden name in the folder of `path`."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}")


@contextmanager
def replacing(path: PathLike) -> Iterator[Path]:
    """Context that gives a new hidden path to write to; at its end that file replaces `path`
    atomically. An error leaves the previous file unchanged and no other one.

    A path that exists and is not a file, such as `/dev/stdout`, is written directly.
    """
    file = Path(path)
    if file.exists() and not file.is_file():
        yield file
        return
    part = beside(file)
    try:
        yield part
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def plain(value: Any) -> Any:
    """`value` as JSON can represent it: lists for tuples and arrays, None for NaN and infinity."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_json(path: PathLike, content: Any) -> None:
    """Writes a JSON file, atomically; non-finite numbers become null."""
    text = json.dumps(plain(content), indent=1, allow_nan=False)
    with replacing(path) as part:
        part.write_text(text + "\n", encoding="utf-8")
