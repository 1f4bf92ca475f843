"""Storage of a sweep's chunks: in memory, or in a Zarr folder on disk."""

import hashlib
import json
import os
import shutil
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

from ..files.output import beside, replacing
from ..typing import PathLike
from .sweep_labels import Label, Labels

try:
    import fcntl
except ImportError:  # not on Windows, where sweeps do not lock
    fcntl = None

Arrays = Mapping[str, Any]
"""Arrays by name, or their shapes and dtypes; the first axis is that of the samples."""

_MISSING = -1
_METADATA = "zarr.json"
_NAMED = 8
"""Damaged chunks that a warning names."""


class InMemory:
    """Chunks in memory; the chunks of all processes are gathered at the end.

    **Arguments:**
    - `like`: shapes and dtypes of all outputs.
    - `chunk`: samples per chunk; chunk i belongs to process i modulo the number of processes.
    """

    def __init__(self, like: Arrays, chunk: int):
        self.chunk = chunk
        rounds = -(-len(like["status"]) // (chunk * jax.process_count()))
        self._like = like
        self._rows = {
            name: np.zeros((rounds, chunk, *x.shape[1:]), x.dtype) for name, x in like.items()
        }

    def missing(self, indices: Iterable[int]) -> list[int]:
        """Chunks to compute: all."""
        return list(indices)

    def writing(self) -> AbstractContextManager[None]:
        """Context in which chunks are written."""
        return nullcontext()

    def write(self, index: int, arrays: Arrays) -> None:
        """Stores a chunk."""
        for name, rows in self._rows.items():
            rows[index // jax.process_count(), : len(arrays[name])] = arrays[name]

    def arrays(self) -> dict[str, np.ndarray]:
        """All outputs, in the order of the samples."""
        return {
            name: self._joined(rows)[: len(self._like[name])] for name, rows in self._rows.items()
        }

    def _joined(self, rows: np.ndarray) -> np.ndarray:
        if jax.process_count() > 1:
            rows = np.moveaxis(np.asarray(multihost_utils.process_allgather(rows)), 0, 1)
            rows = rows.reshape(rows.shape[0] * rows.shape[1], *rows.shape[2:])
        return rows.reshape(rows.shape[0] * self.chunk, *rows.shape[2:])


class Archive:
    """Chunks in a Zarr folder: one file per chunk and array, each with a checksum (CRC-32C); the
    status of a chunk is written last.

    A chunk is computed if it has no status yet, or if one of its files is missing or does not match
    its checksum. The attributes of the group hold a checksum of all metadata. A sweep that writes
    holds a lock, which is released at the latest when its process ends.

    **Arguments:**
    - `path`: the folder; created if it does not exist, else it must hold the same sweep.
    - `like`, `chunk`: as for `InMemory`; an existing folder keeps its chunk size.
    - `samples`: the samples, which are stored too.
    - `labels`: names of dimensions, coordinates and attributes.
    - `digest`: a hash that identifies the sweep.

    **Raises:** `ImportError` without Zarr; `ValueError` for a folder with other content or with
    damaged metadata.
    """

    def __init__(
        self,
        path: PathLike,
        like: Arrays,
        samples: Arrays,
        chunk: int,
        labels: Labels,
        digest: str,
    ):
        zarr = _zarr()
        self._path, self._outputs = Path(path), list(like)
        self._given = {**samples, **labels.coordinates}
        self._damaged: list[tuple[str, int]] = []
        self._todo = 0
        error = None
        if jax.process_index() == 0 and not self._path.exists():
            try:
                self._create(zarr, like, chunk, labels, digest)
            except (ValueError, OSError) as found:
                error = found
        _synchronise(error)
        self._finished = bool(_attributes(self._path, digest)["finished"])
        with zarr.config.set(
            {"array.write_empty_chunks": True}
        ):  # so that a missing file means damage
            group = zarr.open_group(self._path, mode="r+")
            self._arrays = {name: group[name] for name in (*self._given, *like)}
        self.chunk = self._arrays["status"].chunks[0]

    def missing(self, indices: Iterable[int]) -> list[int]:
        """Chunks to compute. Reads every file of the chunks once."""
        todo = []
        for index in indices:
            begun = self._finished or self._file("status", index).exists()
            damaged = [
                name
                for name in (self._arrays if begun else self._given)
                if not self._sound(name, index)
            ]
            self._damaged += [(name, index) for name in damaged]
            if not begun or any(name in self._outputs for name in damaged):
                todo.append(index)
        self._todo = len(todo)
        return todo

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Context in which chunks are written, after `missing`: holds the lock if any process has
        something to write.

        Warns about damaged chunks. Ends when all processes are done.

        **Raises:** `ValueError` if another sweep is writing to the folder.
        """
        needed = _any(bool(self._todo or self._damaged) or not self._finished)
        leads, lock, error = needed and jax.process_index() == 0, None, None
        try:
            if leads:
                try:
                    lock = _locked(self._path)
                except ValueError as found:
                    error = found
            _synchronise(error)
            self._repair()
            yield
            _synchronise()
            if leads and not self._finished:
                _seal(self._path, finished=1)
        finally:
            if lock is not None:
                os.close(lock)

    def write(self, index: int, arrays: Arrays) -> None:
        """Writes a chunk, each file atomically."""
        start = index * self.chunk
        for name in sorted(arrays, key="status".__eq__):
            self._arrays[name][start : start + len(arrays[name])] = arrays[name]

    def arrays(self) -> dict[str, Any]:
        """The Zarr arrays of the outputs."""
        return {name: self._arrays[name] for name in self._outputs}

    def _span(self, name: str, index: int) -> slice:
        chunk = self._arrays[name].chunks[0]
        return slice(index * chunk, min((index + 1) * chunk, self._arrays[name].shape[0]))

    def _file(self, name: str, index: int) -> Path:
        return self._path / name / "/".join(["c", str(index), *"0" * (self._arrays[name].ndim - 1)])

    def _sound(self, name: str, index: int) -> bool:
        """Whether the file of a chunk exists and matches its checksum; true for a chunk beyond the
        end, which has no file."""
        span = self._span(name, index)
        if span.start >= span.stop or self._arrays[name].size == 0:
            return True
        try:
            self._arrays[name][span]
        except (ValueError, TypeError, RuntimeError):  # from checksums and codecs
            return False
        return self._file(name, index).exists()

    def _repair(self) -> None:
        """Removes damaged files, and rewrites samples and coordinates."""
        if not self._damaged:
            return
        warnings.warn(self._damage_warning(), stacklevel=5)  # the caller of sweep
        for name, index in sorted(
            self._damaged, key=lambda place: place[0] != "status"
        ):  # status first: a chunk without it counts as missing
            self._file(name, index).unlink(missing_ok=True)
            if name in self._given:
                span = self._span(name, index)
                self._arrays[name][span] = self._given[name][span]

    def _damage_warning(self) -> str:
        """The warning about damaged chunks."""
        spans = [(name, self._span(name, index)) for name, index in self._damaged]
        names = ", ".join(f"{name}[{span.start}:{span.stop}]" for name, span in spans[:_NAMED])
        more = f" and {len(spans) - _NAMED} more" if len(spans) > _NAMED else ""
        return (
            f"sweep.out: {self._path} has missing or damaged chunks, which are restored "
            f"(outputs computed again): {names}{more}"
        )

    def _create(self, zarr: Any, like: Arrays, chunk: int, labels: Labels, digest: str) -> None:
        """Creates the folder under a temporary name, then renames it atomically."""
        if not self._path.absolute().parent.is_dir():
            raise ValueError(f"sweep.out: there is no folder {str(self._path.absolute().parent)!r}")
        draft = beside(self._path)
        try:
            group = zarr.open_group(draft, mode="w")
            group.attrs.update(labels.attributes)
            for name, x in {**self._given, **like}.items():
                rows = max(len(x), 1) if name in labels.coordinates else chunk
                array = _array(zarr, group, name, x, rows, labels.arrays[name])
                if name in self._given:
                    array[...] = x
            with (
                warnings.catch_warnings()
            ):  # xarray needs consolidated metadata, Zarr warns about them
                warnings.simplefilter("ignore")
                zarr.consolidate_metadata(draft)
            _seal(draft, digest=digest, finished=0)
            draft.rename(self._path)
        except OSError:
            if not self._path.exists():  # else another process created it first
                raise
        finally:
            shutil.rmtree(draft, ignore_errors=True)


def _array(zarr: Any, group: Any, name: str, x: Any, rows: int, label: Label) -> Any:
    """An empty array with `rows` rows per chunk and a checksum for each chunk."""
    text = x.dtype.kind == "U"
    return group.create_array(
        name,
        shape=x.shape,
        dtype=str if text else x.dtype,
        chunks=(rows, *(max(size, 1) for size in x.shape[1:])),
        compressors=(zarr.codecs.ZstdCodec(), zarr.codecs.Crc32cCodec()),
        fill_value=""
        if text
        else np.nan
        if np.issubdtype(x.dtype, np.inexact)
        else _MISSING
        if name == "status"
        else 0,
        dimension_names=label.dims,
        attributes=label.attributes,
        config={"write_empty_chunks": True},
    )


def _attributes(path: Path, digest: str) -> dict[str, Any]:
    """Attributes of a sweep's folder; raises if it does not hold the sweep with that digest."""
    if not (path / _METADATA).is_file():
        raise ValueError(
            f"sweep.out: {path} exists and holds no sweep (no {_METADATA}), need a new path"
        )
    try:
        root = json.loads((path / _METADATA).read_bytes())
        attributes = root["attributes"]
        ours, sound = (
            "digest" in attributes or "checksum" in attributes,
            attributes.get("checksum") == _checksum(path, root),
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        ours, sound, attributes = True, False, {}
    if not ours:
        raise ValueError(f"sweep.out: {path} exists and holds no sweep, need a new path")
    if not sound:
        raise ValueError(
            f"sweep.out: the metadata in {path} are damaged, changed or from another version of "
            f"vsr_jax; need a new path"
        )
    if attributes["digest"] != digest:
        raise ValueError(
            f"sweep.out: {path} holds another sweep, need a new path, or the same scene, model, "
            f"samples and outputs"
        )
    return attributes


def _seal(path: Path, **attributes: Any) -> None:
    """Adds attributes, and the checksum of all metadata, to the group in a folder, atomically."""
    root = json.loads((path / _METADATA).read_bytes())
    root["attributes"] |= attributes
    root["attributes"]["checksum"] = _checksum(path, root)
    text = json.dumps(root, indent=2)
    with replacing(path / _METADATA) as part:
        part.write_text(text, encoding="utf-8")


def _checksum(path: Path, root: dict[str, Any]) -> str:
    """Hash of the metadata of the group, without the checksum itself, and of its arrays."""
    attributes = {name: value for name, value in root["attributes"].items() if name != "checksum"}
    digest = hashlib.sha256(json.dumps(root | {"attributes": attributes}, sort_keys=True).encode())
    for name in sorted(root["consolidated_metadata"]["metadata"]):
        digest.update((path / name / _METADATA).read_bytes())
    return digest.hexdigest()


def _locked(path: Path) -> int | None:
    """A file descriptor that holds the lock of a folder until it is closed or the process ends.

    None where the file system does not support locks.
    """
    file = path / "status" / _METADATA  # a file that is never replaced
    lock = os.open(file, os.O_RDWR if os.access(file, os.W_OK) else os.O_RDONLY)
    try:
        if fcntl is not None:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(lock)
        raise ValueError(
            f"sweep.out: another sweep is writing to {path}; wait until it ends or give a new path"
        ) from None
    except OSError:
        os.close(lock)
        return None
    return lock


def _zarr() -> Any:
    try:
        import zarr
        import zarr.codecs
    except ImportError:
        raise ImportError(
            'sweep.out: Zarr is not installed, need pip install "vsr-jax[sweep]"'
        ) from None
    return zarr


def _any(here: bool) -> bool:
    """Whether the argument is true in any process."""
    return (
        bool(np.any(multihost_utils.process_allgather(np.array(here))))
        if jax.process_count() > 1
        else here
    )


def _synchronise(error: Exception | None = None) -> None:
    """Waits for all processes; if one has an error, all raise."""
    failed = _any(error is not None)
    if error is not None:
        raise error
    if failed:
        raise ValueError(
            "sweep.out: another process of this sweep could not use the folder; see its error"
        )
