"""One compiled program for many samples, run by several threads: batched on each device, without
communication between devices."""

import os
from collections.abc import Callable, Mapping
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PyTree

from ..arm.scene import Scene
from ..models.base import Model
from ..solution.equilibrium import Equilibrium
from ..solution.quantities import QUANTITIES, Quantity
from ..solution.solver import solve
from ..typing import VectorLike

BATCH_SIZE = 256
"""Samples per batch on a CPU: without loads 128 are a tenth faster, since they fit the caches, and
with constraints 512, which wait less for the arms that take most steps."""


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
    """A task compiled for a part of a chunk, which is split over the devices and then into batches;
    `threads` of the host run parts at once.

    Operations on a batch are too small for all cores of a CPU, and threads within one wait for each
    other; so there are as many threads as cores. On other devices a second one starts the next part
    while the outputs of the first are copied.

    The batch size is `BATCH_SIZE` on a CPU and all that a device has of a chunk on others; it is
    reduced to meet the bound on memory. On a CPU it does not depend on samples, chunk or devices,
    because rounding may depend on it.

    **Arguments:** `task`; `samples`: all samples, NumPy arrays; `chunk`: samples per chunk; `mesh`:
    the devices; `memory`: bound on memory [bytes].
    """

    def __init__(self, task: Task, samples: PyTree, chunk: int, mesh: Mesh, memory: int):
        self.chunk, self._samples, self._mesh = chunk, samples, mesh
        self._task = jax.tree.map(lambda x: jnp.asarray(x) if eqx.is_array(x) else x, task)
        devices = mesh.devices.size
        on_cpu = mesh.devices.flat[0].platform == "cpu"
        self.threads = max(1, cores() // devices) if on_cpu else 2
        at_once = devices * self.threads if on_cpu else devices
        batch_size = BATCH_SIZE if on_cpu else -(-chunk // devices)
        while True:
            self._batch_size = batch_size
            self._rows = devices * batch_size * -(-chunk // (at_once * batch_size))
            lowered = _solved.lower(self._task, self._placed(range(0, 1)), batch_size, mesh)  # pyright: ignore[reportFunctionMemberAccess]
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

    def begin(self, index: int, pool: Executor) -> list[Future]:
        """Begins a chunk: the outputs of its parts."""
        first = index * self.chunk
        last = first + self.samples_in(index)
        parts = (
            range(place, min(place + self._rows, last)) for place in range(first, last, self._rows)
        )
        # placed here: the precision of JAX may be that of a thread
        return [pool.submit(self._solve, self._placed(part), len(part)) for part in parts]

    def samples_in(self, index: int) -> int:
        """Number of samples in a chunk."""
        return min(self.chunk, number(self._samples) - index * self.chunk)

    def _solve(self, samples: PyTree, count: int) -> dict[str, np.ndarray]:
        """Outputs of a part, of its first `count` samples."""
        outputs = self._compiled(self._task, samples, self._batch_size, self._mesh)
        return {name: np.asarray(x)[:count] for name, x in outputs.items()}

    def _placed(self, part: range) -> PyTree:
        """The samples of a part on the devices, padded with copies of the last one."""
        place = np.minimum(part.start + np.arange(self._rows), part.stop - 1)
        return jax.device_put(
            jax.tree.map(lambda x: x[place], self._samples),
            NamedSharding(self._mesh, PartitionSpec("samples")),
        )


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@eqx.filter_jit
def _solved(task: Task, samples: PyTree, batch_size: int, mesh: Mesh) -> dict[str, Any]:
    """Outputs of all samples in batches of `batch_size`; no loop waits for the samples of another
    device."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def part(arrays: PyTree, samples: PyTree) -> dict[str, Any]:
        rows = jax.tree.map(
            lambda x: x.reshape(len(x) // batch_size, batch_size, *x.shape[1:]), samples
        )
        task = eqx.combine(arrays, static)
        outputs = lax.map(
            jax.vmap(lambda sample: task(sample)), rows
        )  # a lambda: JAX prints the name of the mapped function, for a task its whole scene
        return jax.tree.map(lambda x: x.reshape(len(x) * batch_size, *x.shape[2:]), outputs)

    split = PartitionSpec("samples")
    return jax.shard_map(
        part, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
    )(arrays, samples)
