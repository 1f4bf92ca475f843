"""`sweep`: equilibria of any number of samples, in chunks, on all cores, devices and processes,
stored in memory or on disk."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import PyTree
from tqdm import tqdm

from ..arm.scene import Scene
from ..models.base import Model, Status
from ..numerics.fingerprint import fingerprint
from ..solution.equilibrium import Equilibrium
from ..typing import PathLike, VectorLike
from ..validation import count
from .sweep_labels import labels
from .sweep_program import Program, Task, number, stored_outputs
from .sweep_store import Archive, InMemory

_CHUNK, _CHUNK_ELSEWHERE = 16_384, 65_536
"""Samples per chunk on CPUs, and per device otherwise: a GPU takes as long for thousands as for a
hundred."""

_MEMORY = 1 << 32

Outputs: TypeAlias = str | Sequence[str] | Callable[[Equilibrium], Mapping[str, Any]]


class Sweep(Mapping[str, Any]):
    """Result of a sweep: a mapping from the names of its outputs to arrays whose first axis is that
    of the samples.

    **Fields:** `status`, a `Status` as an integer for each sample; outputs of samples that did not
    converge are NaN. The arrays are NumPy arrays; for a sweep to disk they are Zarr arrays, which
    read only the requested part, as in `result["tip"][:100]`.
    """

    def __init__(self, arrays: Mapping[str, Any]):
        self._arrays = {name: array for name, array in arrays.items() if name != "status"}
        self.status = arrays["status"]

    def __getitem__(self, name: str) -> Any:
        return self._arrays[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)

    @property
    def converged(self) -> np.ndarray:
        """Whether each sample is an equilibrium."""
        return np.asarray(self.status) == Status.CONVERGED

    @property
    def counts(self) -> dict[str, int]:
        """Number of samples for each status, by its name."""
        values, numbers = np.unique(np.asarray(self.status), return_counts=True)
        return {
            Status(int(value)).name.lower(): int(number)
            for value, number in zip(values, numbers, strict=True)
        }

    def __repr__(self) -> str:
        said = ", ".join(f"{number} {status}" for status, number in self.counts.items())
        return (
            f"Sweep({said}; {', '.join(f'{name} {array.shape}' for name, array in self.items())})"
        )


def sweep(
    scene: Scene | Callable[[PyTree], tuple[Scene, VectorLike]],
    inputs: PyTree,
    *,
    outputs: Outputs = "tip",
    model: Model | None = None,
    out: PathLike | None = None,
    chunk: int | None = None,
    memory: int = _MEMORY,
    devices: Sequence[Any] | None = None,
    progress: bool = True,
) -> Sweep:
    """Equilibria of many inputs, or of many scenes.

        # tensions: (samples, actuators)
        tips = vsr.sweep(scene, tensions)["tip"]
        samples = {"radius": radii, "tensions": tensions}
        vsr.sweep(lambda s: (arm(s["radius"]), s["tensions"]), samples, out="designs.zarr")

    One compiled program solves chunk after chunk in batches, on all devices, and on a CPU on all of
    its cores. If several processes share a `jax.distributed` runtime, each of them calls `sweep`
    and solves its share of the chunks.
    Samples are independent; the status of each shows whether it converged.

    **Arguments:**
    - `scene`: a scene, or a function from one sample to a scene and the inputs of its actuators.
    - `inputs`: the samples, shape (samples, actuators); for a function any pytree of arrays whose
      first axis is the samples.
    - `outputs`: names of quantities of an `Equilibrium` that are one array (`tip`, `lengths`,
      `forces`, `slack`, `stability`, `condition`, `energy`, `q`, or one added to the table) and
      `steps`, or a function from an `Equilibrium` to a dict of arrays; nothing else is computed.
    - `model`: as for `solve`.
    - `out`: a Zarr folder (`pip install "vsr-jax[sweep]"`), which `xarray.open_zarr` reads, see
      below. Each chunk is written when it is done. The same call resumes an interrupted sweep and
      reads a finished one; results are bit-identical on the same devices.
    - `chunk`: samples per chunk, by default 16,384 on CPUs and 65,536 per device otherwise; an
      existing folder keeps its own. An interrupted sweep loses about one; smaller ones lose
      less, and sweep cheap scenes more slowly.
    - `memory`: bound [bytes] on the intermediate values of all that is solved at once, 4 GiB by
      default; it limits the batch size.
    - `devices`: devices of this process to use, all by default.
    - `progress`: whether to show a bar with rate and remaining time. It advances by parts of a
      chunk, each half a second of work, or one batch of 256 samples where that takes longer.

    **The store:** `tip` has the dimensions (sample, row, column), `inputs`, `lengths`, `forces` and
    `slack` (sample, actuator), `energy` (sample, part), `q` (sample, dof), or (sample, actuator)
    where it is the thread forces; outputs of a function have (sample, NAME_dim_1, ...), and so do
    the samples that a function turns into scenes. Units are attributes, or coordinates where they
    differ along an axis: `input_units`, `column_units`, `dof_units`. The tip position is
    `data.tip.sel(column="position", row=["x", "y", "z"])`. The attributes hold the model, the
    precision, the version and, as TOML, a scene that has no Python functions.

    Every chunk has a checksum (CRC-32C). Each call reads all chunks once to verify them, which
    takes little time compared to solving them; missing or damaged chunks are computed again, with
    one warning. Only one sweep at a time can write to a folder.

    **Returns:** a `Sweep` with all samples, in every process.

    **Raises:** `ValueError` for samples of a wrong shape or of unequal numbers, an unknown output,
    a bound on memory that a single sample exceeds, an `out` with other content or with damaged
    metadata, or one to which another sweep is writing; `ImportError` without Zarr.

    **Warns:** `UserWarning` where chunks in `out` are missing or damaged, with their names and
    samples.
    """
    task = Task(scene, model, _named(outputs))
    samples = _samples(scene, inputs)
    total = number(samples)
    like = jax.eval_shape(jax.vmap(lambda sample: task(sample)), samples)
    local = Mesh(np.array(jax.local_devices() if devices is None else list(devices)), ("samples",))
    size = min(_chunk(local) if chunk is None else count("sweep.chunk", chunk), total)
    archive = InMemory(like, size) if out is None else _archive(out, task, like, samples, size)
    missing = archive.missing(
        range(jax.process_index(), -(-total // archive.chunk), jax.process_count())
    )
    with archive.writing():
        if missing:
            memory = count("sweep.memory", memory)
            with tqdm(
                desc="compiling",
                unit=" shapes",
                unit_scale=True,
                miniters=1,
                disable=not progress or jax.process_index() > 0,
            ) as bar:
                program = Program(task, samples, archive.chunk, local, memory)
                _run(program, missing, archive, bar)
    return Sweep(archive.arrays())


def _run(program: Program, chunks: list[int], archive: InMemory | Archive, bar: tqdm) -> None:
    """Solves chunks part by part; each is written while the next one is solved."""
    failed, parts = 0, []
    bar.set_description(refresh=False)
    bar.reset(sum(map(program.samples_in, chunks)))
    pool = ThreadPoolExecutor(program.threads, thread_name_prefix="sweep")
    try:
        for index, part in program.solved(chunks, pool):
            parts.append(part)
            failed += np.count_nonzero(part["status"] != Status.CONVERGED)
            bar.set_postfix(failed=failed, refresh=False)
            bar.update(number(part))
            if sum(map(number, parts)) == program.samples_in(index):
                archive.write(index, _joined(parts))
                parts = []
    finally:
        pool.shutdown(cancel_futures=True)


def _joined(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The outputs of several parts as one."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _chunk(devices: Mesh) -> int:
    on_cpu = devices.devices.flat[0].platform == "cpu"
    return _CHUNK if on_cpu else _CHUNK_ELSEWHERE * devices.devices.size


def _named(outputs: Outputs) -> tuple[str, ...] | Callable:
    if callable(outputs):
        return outputs
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    known = stored_outputs()
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(
            f"sweep.outputs: got {', '.join(map(repr, unknown))}, need names from "
            f"{', '.join(known)}, or a function"
        )
    return names


def _samples(scene: Scene | Callable, inputs: PyTree) -> PyTree:
    """The samples as NumPy arrays, in the dtypes that JAX converts them to."""
    samples = jax.tree.map(
        lambda x: np.asarray(x, jax.dtypes.canonicalize_dtype(np.asarray(x).dtype)), inputs
    )
    if isinstance(scene, Scene):
        samples = np.asarray(samples)
        if samples.ndim != 2 or samples.shape[1] != len(scene.inputs):
            raise ValueError(
                f"sweep.inputs: got shape {samples.shape}, need (samples, "
                f"{len(scene.inputs)}), one row per sample"
            )
        if not np.issubdtype(samples.dtype, np.floating):
            samples = samples.astype(jax.dtypes.canonicalize_dtype(float))
    elif not callable(scene):
        raise ValueError(
            f"sweep.scene: got {scene!r}, need a Scene, or a function from a sample to a Scene "
            f"and its inputs"
        )
    numbers = {name: x.shape[:1] for name, x in _flat(samples).items()}
    if len(set(numbers.values())) != 1 or min(numbers.values()) in ((), (0,)):
        said = ", ".join(f"{name} {shape}" for name, shape in numbers.items())
        raise ValueError(
            f"sweep.inputs: got {said or 'no array'}, need arrays with the same number of samples "
            f"along their first axis, at least one"
        )
    return samples


def _flat(samples: PyTree) -> dict[str, np.ndarray]:
    """The samples by name: `inputs`, followed by their path in the pytree, as in
    `inputs_radius`."""
    leaves = jax.tree_util.tree_flatten_with_path(samples)[0]
    return {
        "_".join(["inputs", *re.findall(r"\w+", jax.tree_util.keystr(path))]): x
        for path, x in leaves
    }


def _archive(
    out: PathLike, task: Task, like: Mapping[str, Any], samples: PyTree, chunk: int
) -> Archive:
    flat = _flat(samples)
    digest = fingerprint(task, (jax.tree.map(lambda x: x[0], samples),), samples)
    return Archive(out, like, flat, chunk, labels(task, like, samples, flat), digest)
