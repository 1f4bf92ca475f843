"""Where the chunks of a sweep go: into memory, or into a Zarr folder that outlives the process."""

import os
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from .model import Status

Arrays = Mapping[str, Any]
"""Arrays by name, or their shapes and dtypes; the first axis is that of the samples."""

_STATUS = {
    "flag_values": [int(status) for status in Status],
    "flag_meanings": " ".join(status.name.lower() for status in Status),
}
_UNITS = {"lengths": "m", "forces": "N", "slack": "m"}
_MISSING = -1


class InMemory:
    """Chunks in memory, those of all processes put together at the end.

    **Arguments:**
    - `like`: shapes and dtypes of everything that will come.
    - `chunk`: samples in a chunk; chunk i is that of process i modulo their number.
    """

    def __init__(self, like: Arrays, chunk: int):
        self.chunk = chunk
        rounds = -(-len(like["status"]) // (chunk * jax.process_count()))
        self._like = like
        self._rows = {name: np.zeros((rounds, chunk, *x.shape[1:]), x.dtype) for name, x in like.items()}

    def has(self, index: int) -> bool:
        """Whether a chunk is there already."""
        return False

    def write(self, index: int, arrays: Arrays) -> None:
        """Keeps a chunk."""
        for name, rows in self._rows.items():
            rows[index // jax.process_count(), : len(arrays[name])] = arrays[name]

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything, in the order of the samples."""
        return {name: self._joined(rows)[: len(self._like[name])] for name, rows in self._rows.items()}

    def _joined(self, rows: np.ndarray) -> np.ndarray:
        if jax.process_count() > 1:
            rows = np.moveaxis(np.asarray(multihost_utils.process_allgather(rows)), 0, 1)
            rows = rows.reshape(-1, *rows.shape[2:])
        return rows.reshape(-1, *rows.shape[2:])


class Archive:
    """Chunks in a Zarr folder, one file for each and each output; the status, written last, tells which are there.

    **Arguments:**
    - `path`: the folder; made if it is not there, else it has to hold the same sweep.
    - `like`, `chunk`: as for `InMemory`; the chunks of a folder keep their size.
    - `samples`: what is solved, which is kept too.
    - `digest`: a text that no other sweep has.

    **Raises:** `ImportError` without Zarr; `ValueError` for a folder that holds something else.
    """

    def __init__(self, path: str | os.PathLike, like: Arrays, samples: Arrays, chunk: int, digest: str):
        self._zarr = _zarr()
        if jax.process_index() == 0 and not Path(path).exists():
            self._create(Path(path), like, samples, chunk, digest)
        _meet("made")
        self._group = self._opened(path, digest)
        self.chunk = self._group["status"].chunks[0]

    def has(self, index: int) -> bool:
        """Whether a chunk is there already."""
        return int(self._group["status"][index * self.chunk]) != _MISSING

    def write(self, index: int, arrays: Arrays) -> None:
        """Writes a chunk, each file whole or not at all."""
        start = index * self.chunk
        for name in sorted(arrays, key="status".__eq__):
            self._group[name][start : start + len(arrays[name])] = arrays[name]

    def arrays(self) -> dict[str, Any]:
        """Zarr's arrays, once all processes are done."""
        _meet("done")
        return {name: self._group[name] for name in self._group.attrs["outputs"]}

    def _opened(self, path: str | os.PathLike, digest: str) -> Any:
        try:
            group = self._zarr.open_group(path, mode="r+")
            kept = group.attrs["digest"]
        except (OSError, ValueError, KeyError):
            raise ValueError(f"sweep.out: {path} is there and holds no sweep, need a new path") from None
        if kept != digest:
            raise ValueError(f"sweep.out: {path} holds another sweep, need a new path, or the same scene, model, samples and outputs")
        return group

    def _create(self, path: Path, like: Arrays, samples: Arrays, chunk: int, digest: str) -> None:
        """Makes the folder beside its place and moves it there whole."""
        if not path.absolute().parent.is_dir():
            raise ValueError(f"sweep.out: there is no folder {str(path.absolute().parent)!r}")
        draft = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        group = self._zarr.open_group(draft, mode="w")
        for name, x in {**samples, **like}.items():
            fill = np.nan if np.issubdtype(x.dtype, np.floating) else _MISSING
            array = group.create_array(
                name,
                shape=x.shape,
                dtype=x.dtype,
                chunks=(chunk, *x.shape[1:]),
                fill_value=fill,
                dimension_names=("sample", *(f"{name}_{axis}" for axis in range(1, len(x.shape)))),
                attributes=_STATUS if name == "status" else {"units": _UNITS[name]} if name in _UNITS else {},
            )
            if name in samples:
                array[...] = x
        group.attrs.update(digest=digest, outputs=list(like))
        draft.rename(path)


def _zarr() -> Any:
    try:
        import zarr
    except ImportError:
        raise ImportError('sweep.out: Zarr is not installed, need pip install "vsr-jax[sweep]"') from None
    return zarr


def _meet(where: str) -> None:
    if jax.process_count() > 1:
        multihost_utils.sync_global_devices(f"vsr_jax.sweep {where}")
