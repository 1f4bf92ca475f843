"""Many equilibria at once: any number of samples, in chunks, over all devices and processes, to memory or to disk."""

import hashlib
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from tqdm import tqdm

from ._check import count
from .archive import Archive, InMemory
from .equilibrium import Equilibrium
from .model import Model, Status
from .scene import Scene
from .solve import solve

OUTPUTS = ("tip", "lengths", "forces", "slack", "stability", "condition", "q", "steps")
"""Quantities of an `Equilibrium` that a sweep knows by name."""

_CHUNK = 16_384
_LANES_ON_CPU = 128
_MEMORY = 1 << 30

Outputs: TypeAlias = str | Sequence[str] | Callable[[Equilibrium], Mapping[str, Any]]


class Sweep(Mapping[str, Any]):
    """Outcome of a sweep: a mapping from the names of its outputs to arrays whose first axis is that of the samples.

    **Fields:** `status`, a `Status` as an integer for each sample; the outputs are NaN where it is not converged. The arrays are
    NumPy's, or, of a sweep to disk, Zarr's, which read what is asked for, as in `result["tip"][:100]`.
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
        """How many samples ended with each status, by its name."""
        values, numbers = np.unique(np.asarray(self.status), return_counts=True)
        return {Status(int(value)).name.lower(): int(number) for value, number in zip(values, numbers, strict=True)}

    def __repr__(self) -> str:
        said = ", ".join(f"{number} {status}" for status, number in self.counts.items())
        return f"Sweep({said}; {', '.join(f'{name} {array.shape}' for name, array in self.items())})"


def sweep(
    scene: Scene | Callable[[Any], tuple[Scene, Any]],
    inputs: Any,
    *,
    outputs: Outputs = "tip",
    model: Model | None = None,
    out: str | os.PathLike | None = None,
    chunk: int | None = None,
    memory: int = _MEMORY,
    devices: Sequence[Any] | None = None,
    progress: bool = True,
) -> Sweep:
    """Equilibria of many inputs, or of many scenes.

        tips = vsr.sweep(scene, tensions)["tip"]                                    # tensions: (samples, actuators)
        vsr.sweep(lambda s: (arm(s["radius"]), s["tensions"]), {"radius": radii, "tensions": tensions}, out="designs.zarr")

    One compiled program solves chunk after chunk, a part on each device. Where several processes share a `jax.distributed`
    runtime, each calls this and takes its share of the chunks. No sample changes another; one that fails says so in its status.

    **Arguments:**
    - `scene`: a scene, or a function from one sample to a scene and the inputs of its actuators.
    - `inputs`: the samples, shape (samples, actuators); for a function any pytree of arrays whose first axis is the samples.
    - `outputs`: names among `tip`, `lengths`, `forces`, `slack`, `stability`, `condition`, `q` and `steps`, or a function from an
      `Equilibrium` to arrays by name; only what is asked for is computed.
    - `model`: as for `solve`.
    - `out`: a folder for Zarr (`pip install "vsr-jax[sweep]"`), which xarray reads. Each chunk is written when it is done. The same
      call goes on where a killed one stopped, with the same result, to the bit on the same devices.
    - `chunk`: samples in a chunk, 16,384 by default; a folder keeps its own.
    - `memory`: bound [bytes] on the intermediate values of the compiled program, by which fewer samples are solved side by side.
    - `devices`: those of this process that take part, all by default.
    - `progress`: whether to show a bar with rate and remaining time.

    **Returns:** a `Sweep`, whole in every process.

    **Raises:** `ValueError` for samples of a wrong shape or of different numbers, an unknown output, a bound on memory that not
    even one sample keeps, or an `out` that holds something else; `ImportError` where Zarr is missing.
    """
    task = _Task(scene, model, _named(outputs))
    samples = _samples(scene, inputs)
    total = _number(samples)
    like = jax.eval_shape(jax.vmap(task), samples)
    size = min(_CHUNK if chunk is None else count("sweep.chunk", chunk), total)
    archive = InMemory(like, size) if out is None else Archive(out, like, _flat(samples), size, _digest(task, samples))
    local = Mesh(np.array(jax.local_devices() if devices is None else list(devices)), ("samples",))
    program = _Program(task, samples, archive.chunk, local, count("sweep.memory", memory))
    mine = range(jax.process_index(), -(-total // archive.chunk), jax.process_count())
    with tqdm(total=total, unit=" shapes", unit_scale=True, disable=not progress or jax.process_index() > 0) as bar:
        _run(program, [i for i in mine if not archive.has(i)], archive, bar)
    return Sweep(archive.arrays())


class _Task(eqx.Module):
    """What is done with one sample."""

    scene: Scene | Callable
    model: Model | None
    outputs: tuple[str, ...] | Callable = eqx.field(static=True)

    def __call__(self, sample: Any) -> dict[str, Any]:
        scene, inputs = (self.scene, sample) if isinstance(self.scene, Scene) else self.scene(sample)
        eq = solve(scene, inputs, model=self.model)
        if callable(self.outputs):
            wanted = self.outputs(eq)
            if not isinstance(wanted, Mapping):
                raise ValueError(f"sweep.outputs: got a function that returns {type(wanted).__name__}, need arrays by name, as a dict")
        else:
            wanted = {name: getattr(eq, name) for name in self.outputs}
        return {**{name: jnp.asarray(value) for name, value in wanted.items()}, "status": eq.status}


class _Program:
    """A task compiled for chunks of one size: those are cut into parts for the devices, these into rows that lie side by side.

    As many samples lie side by side as is fast on a CPU, or fills another device, halved until the bound on memory is kept. The
    number does not depend on samples, chunk or devices, since a processor's rounding may depend on it.
    """

    def __init__(self, task: _Task, samples: Any, chunk: int, mesh: Mesh, memory: int):
        self.chunk, self._task, self._samples, self._mesh = chunk, task, samples, mesh
        parts = mesh.devices.size
        lanes = _LANES_ON_CPU if mesh.devices.flat[0].platform == "cpu" else _CHUNK
        while True:
            self._rows = parts * lanes * -(-chunk // (parts * lanes))
            lowered = _solved.lower(task, self._placed(0), lanes, mesh)  # pyright: ignore[reportFunctionMemberAccess]
            self._compiled = lowered.compile()
            needed = parts * self._compiled.compiled.memory_analysis().temp_size_in_bytes
            if needed <= memory:
                self._lanes = lanes
                return
            if lanes == 1:
                raise ValueError(f"sweep.memory: got {memory} bytes, need at least {needed} for a sample on each device")
            admitted = max(1, lanes * memory // needed)
            lanes = min(lanes // 2, 1 << (admitted.bit_length() - 1))

    def __call__(self, index: int) -> dict[str, Any]:
        """Outputs of a chunk, not waited for; rows that fill up the last one are copies of its last sample."""
        return self._compiled(self._task, self._placed(index), self._lanes, self._mesh)

    def samples_in(self, index: int) -> int:
        """How many samples a chunk holds."""
        return min(self.chunk, _number(self._samples) - index * self.chunk)

    def _placed(self, index: int) -> Any:
        place = index * self.chunk + np.minimum(np.arange(self._rows), self.samples_in(index) - 1)
        return jax.device_put(jax.tree.map(lambda x: x[place], self._samples), NamedSharding(self._mesh, PartitionSpec("samples")))


@eqx.filter_jit
def _solved(task: _Task, samples: Any, lanes: int, mesh: Mesh) -> dict[str, Any]:
    """Outputs of all samples, each device by itself, `lanes` side by side: no loop waits for another device's samples."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def part(arrays: Any, samples: Any) -> dict[str, Any]:
        rows = jax.tree.map(lambda x: x.reshape(-1, lanes, *x.shape[1:]), samples)
        outputs = lax.map(jax.vmap(eqx.combine(arrays, static)), rows)
        return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), outputs)

    split = PartitionSpec("samples")
    return jax.shard_map(part, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False)(arrays, samples)


def _run(program: _Program, chunks: list[int], archive: InMemory | Archive, bar: tqdm) -> None:
    """Solves chunks, each while the one before is written."""
    bar.update(bar.total - sum(program.samples_in(i) for i in chunks) if jax.process_count() == 1 else 0)
    failed, before = 0, None
    for index in [*chunks, None]:
        now = None if index is None else (index, program(index))
        if before is not None:
            done, outputs = before
            size = program.samples_in(done)
            arrays = {name: np.asarray(x)[:size] for name, x in outputs.items()}
            archive.write(done, arrays)
            failed += np.count_nonzero(arrays["status"] != Status.CONVERGED)
            bar.set_postfix(failed=failed, refresh=False)
            bar.update(size * jax.process_count())
        before = now


def _named(outputs: Outputs) -> tuple[str, ...] | Callable:
    if callable(outputs):
        return outputs
    names = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    unknown = [name for name in names if name not in OUTPUTS]
    if unknown:
        raise ValueError(f"sweep.outputs: got {', '.join(map(repr, unknown))}, need some of {', '.join(OUTPUTS)}, or a function")
    return names


def _samples(scene: Scene | Callable, inputs: Any) -> Any:
    """The samples as NumPy arrays in the dtype JAX gives them."""
    samples = jax.tree.map(lambda x: np.asarray(x, jax.dtypes.canonicalize_dtype(np.asarray(x).dtype)), inputs)
    if isinstance(scene, Scene):
        samples = np.asarray(samples)
        if samples.ndim != 2 or samples.shape[1] != len(scene.actuators):
            raise ValueError(f"sweep.inputs: got shape {samples.shape}, need (samples, {len(scene.actuators)}), a row for each sample")
        if not np.issubdtype(samples.dtype, np.floating):
            samples = samples.astype(jax.dtypes.canonicalize_dtype(float))
    elif not callable(scene):
        raise ValueError(f"sweep.scene: got {scene!r}, need a Scene, or a function from a sample to a Scene and its inputs")
    numbers = {name: x.shape[:1] for name, x in _flat(samples).items()}
    if len(set(numbers.values())) != 1 or min(numbers.values()) in ((), (0,)):
        said = ", ".join(f"{name} {shape}" for name, shape in numbers.items())
        raise ValueError(f"sweep.inputs: got {said or 'no array'}, need arrays with one first axis, that of the samples, at least one")
    return samples


def _flat(samples: Any) -> dict[str, np.ndarray]:
    """The samples by name: `inputs`, or with the places in their tree, as in `inputs_radius`."""
    leaves = jax.tree_util.tree_flatten_with_path(samples)[0]
    return {"_".join(["inputs", *re.findall(r"\w+", jax.tree_util.keystr(path))]): x for path, x in leaves}


def _number(samples: Any) -> int:
    return len(jax.tree.leaves(samples)[0])


def _digest(task: _Task, samples: Any) -> str:
    """A hash of what is computed, as JAX sees it, and of all numbers that go in."""
    arrays, static = eqx.partition(task, eqx.is_array)
    one = jax.tree.map(lambda x: x[0], samples)
    program = jax.make_jaxpr(lambda arrays, sample: eqx.combine(arrays, static)(sample))(arrays, one)
    text = re.sub(r" at 0x[0-9a-f]+", "", str(program.jaxpr))
    digest = hashlib.sha256(text.encode())
    for leaf in jax.tree.leaves((program.consts, arrays, samples)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()
