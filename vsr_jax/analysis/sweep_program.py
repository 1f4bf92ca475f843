"""One compiled program for many samples, run by several threads: batched on each device, without
communication between devices."""

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Executor
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, PyTree

from ..arm.scene import Scene
from ..models.base import Model
from ..numerics.loops import fori_loop
from ..solution.equilibrium import Equilibrium
from ..solution.quantities import QUANTITIES, Quantity
from ..solution.solver import solve
from ..typing import VectorLike

BATCH_SIZE = 256
"""Samples per batch on a CPU: without loads 128 are a tenth faster, since they fit the caches, and
with constraints 512, which wait less for the arms that take most steps."""

_PART_SECONDS = 0.5
"""Time [s] that a part should take; then the bar advances."""

_SPLIT = PartitionSpec(None, "samples")
"""Batches one after the other, the samples of each split over the devices."""


def number(samples: PyTree) -> int:
    """Number of samples in a pytree of arrays."""
    return len(jax.tree.leaves(samples)[0])


class Output(NamedTuple):
    """A quantity that a sweep can store: its value for an equilibrium, the names of the value's
    axes, its unit and its description."""

    value: Callable[[Equilibrium], Any]
    dims: tuple[str, ...]
    unit: str
    description: str


_STEPS = Output(lambda eq: eq.steps, (), "1", "Newton steps, or integration steps of Continuum")


def stored_outputs() -> dict[str, Output]:
    """The quantities that a sweep can store by name: those of the table that are a single array and
    not a function of X, and the solver's `steps`."""
    table = [entry for entry in QUANTITIES.values() if isinstance(entry, Quantity)]
    found = {
        entry.name: Output(entry, entry.dims, entry.unit, entry.description)
        for entry in table
        if entry.dims is not None
    }
    return found | {"steps": _STEPS}


class Task(eqx.Module):
    """Computation for one sample: scene, model and outputs."""

    scene: Scene | Callable
    model: Model | None
    outputs: tuple[str, ...] | Callable = eqx.field(static=True)

    def given(self, sample: PyTree) -> tuple[Scene, VectorLike]:
        """Scene and inputs of a sample."""
        return (self.scene, sample) if isinstance(self.scene, Scene) else self.scene(sample)

    def __call__(self, sample: PyTree) -> dict[str, Any]:
        scene, inputs = self.given(sample)
        eq = solve(scene, inputs, model=self.model)
        if callable(self.outputs):
            wanted = self.outputs(eq)
            if not isinstance(wanted, Mapping):
                raise ValueError(
                    f"sweep.outputs: got a function that returns {type(wanted).__name__}, need "
                    f"arrays by name, as a dict"
                )
        else:
            known = stored_outputs()
            wanted = {name: known[name].value(eq) for name in self.outputs}
        taken = [name for name in wanted if name == "status" or name.startswith("inputs")]
        if taken:
            raise ValueError(
                f"sweep.outputs: got {taken[0]!r}, need other names than status and inputs..., "
                f"which are reserved"
            )
        return {**{name: jnp.asarray(value) for name, value in wanted.items()}, "status": eq.status}


class Program:
    """A task compiled for parts of chunks, batch after batch on each device; `threads` of the host
    run parts at once, each for about half a second.

    Operations on a batch are too small for all cores of a CPU, and threads within one wait for each
    other; so there are as many threads as cores. On other devices a second one starts the next part
    while the outputs of the first are copied.

    The batch size is `BATCH_SIZE` on a CPU and all that a device has of a chunk on others; it is
    reduced to meet the bound on memory. On a CPU it does not depend on samples, chunk or devices,
    because rounding may depend on it. The number of batches is an argument of the program: the
    first parts are one batch, later ones as many as the time of those before them suggests.

    **Arguments:** `task`; `samples`: all samples, NumPy arrays; `chunk`: samples per chunk; `mesh`:
    the devices; `memory`: bound on memory [bytes].
    """

    def __init__(self, task: Task, samples: PyTree, chunk: int, mesh: Mesh, memory: int):
        self.chunk, self._samples, self._mesh = chunk, samples, mesh
        self._task = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array(x) else x, task)
        self._batches = 1
        devices = mesh.devices.size
        on_cpu = mesh.devices.flat[0].platform == "cpu"
        self.threads = max(1, cores() // devices) if on_cpu else 2
        at_once = devices * self.threads if on_cpu else devices
        batch_size = BATCH_SIZE if on_cpu else -(-chunk // devices)
        while True:
            self._rows = devices * batch_size
            self._most = -(-chunk // (at_once * batch_size))
            lowered = _solved.lower(self._task, self._placed(range(0, 1)), jnp.int32(1), mesh)  # pyright: ignore[reportFunctionMemberAccess]
            self._compiled = lowered.compile()
            needed = at_once * self._compiled.compiled.memory_analysis().temp_size_in_bytes
            if needed <= memory:
                return
            if batch_size == 1:
                raise ValueError(
                    f"sweep.memory: got {memory} bytes, need at least {needed} for one sample on "
                    f"each core or device"
                )
            admitted = max(1, batch_size * memory // needed)
            batch_size = min(batch_size // 2, 1 << (admitted.bit_length() - 1))

    def solved(
        self, chunks: Iterable[int], pool: Executor
    ) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """The outputs of the parts of chunks in order, with their chunk; later parts are solved
        meanwhile."""
        ahead = deque()
        for index in chunks:
            start, last = index * self.chunk, index * self.chunk + self.samples_in(index)
            while start < last:
                part = range(start, min(start + self._rows * self._batches, last))
                # placed here: the precision of JAX may be that of a thread
                ahead.append((index, pool.submit(self._solve, self._placed(part), len(part))))
                start = part.stop
                if len(ahead) > 2 * self.threads:
                    done, future = ahead.popleft()
                    yield done, future.result()
        for done, future in ahead:
            yield done, future.result()

    def samples_in(self, index: int) -> int:
        """Number of samples in a chunk."""
        return min(self.chunk, number(self._samples) - index * self.chunk)

    def _solve(self, samples: PyTree, count: int) -> dict[str, np.ndarray]:
        """Outputs of a part, of its first `count` samples."""
        start, batches = time.perf_counter(), -(-count // self._rows)
        outputs = self._compiled(self._task, samples, jnp.int32(batches), self._mesh)
        # copies: the arrays have room for the largest part
        found = {name: np.array(np.asarray(x)[:count]) for name, x in outputs.items()}
        wanted = batches * _PART_SECONDS / (time.perf_counter() - start)
        self._batches = int(np.clip(wanted, 1, self._most))
        return found

    def _placed(self, part: range) -> PyTree:
        """The samples of a part on the devices, batch by batch, padded with copies of the last
        one."""
        place = np.minimum(part.start + np.arange(self._most * self._rows), part.stop - 1)
        return jax.device_put(
            jax.tree.map(lambda x: x[place.reshape(self._most, self._rows)], self._samples),
            NamedSharding(self._mesh, _SPLIT),
        )


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@eqx.filter_jit
def _solved(task: Task, samples: PyTree, batches: Array, mesh: Mesh) -> dict[str, Any]:
    """Outputs of some `batches`, the first of those in `samples`; no loop waits for the samples of
    another device."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def part(arrays: PyTree, samples: PyTree, batches: Array) -> dict[str, Any]:
        task = eqx.combine(arrays, static)
        # a lambda: JAX prints the name of the mapped function, for a task its whole scene
        batch = jax.vmap(lambda sample: task(sample))
        solve = jax.jit(batch, inline=True)  # traced once for its shapes and in the loop

        def with_batch(i: Array, outputs: PyTree) -> PyTree:
            new = solve(jax.tree.map(lambda x: x[i], samples))
            put = partial(lax.dynamic_update_index_in_dim, index=i, axis=0)
            return jax.tree.map(put, outputs, new)

        shapes = jax.eval_shape(solve, jax.tree.map(lambda x: x[0], samples))
        none = jax.tree.map(lambda x: jnp.zeros((number(samples), *x.shape), x.dtype), shapes)
        return fori_loop(0, batches, with_batch, none)

    specs = PartitionSpec(), _SPLIT, PartitionSpec()
    outputs = jax.shard_map(part, mesh=mesh, in_specs=specs, out_specs=_SPLIT, check_vma=False)(
        arrays, samples, batches
    )
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), outputs)
