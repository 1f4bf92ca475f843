"""One compiled program for many samples: side by side on each device, devices independent of each
other."""

from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from ..arm.scene import Scene
from ..models.base import Model
from ..solution.solver import solve

BATCH_SIZE = 512
"""Samples that lie side by side on a CPU: more do not fit its caches, fewer leave its kernels too
little to do."""


def number(samples: Any) -> int:
    """How many samples a pytree of arrays holds."""
    return len(jax.tree.leaves(samples)[0])


class Task(eqx.Module):
    """What is done with one sample."""

    scene: Scene | Callable
    model: Model | None
    outputs: tuple[str, ...] | Callable = eqx.field(static=True)

    def given(self, sample: Any) -> tuple[Scene, Any]:
        """Scene and inputs of a sample."""
        return (self.scene, sample) if isinstance(self.scene, Scene) else self.scene(sample)

    def __call__(self, sample: Any) -> dict[str, Any]:
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
            wanted = {
                name: eq.steps if name == "steps" else eq.value(name) for name in self.outputs
            }
        taken = [name for name in wanted if name == "status" or name.startswith("inputs")]
        if taken:
            raise ValueError(
                f"sweep.outputs: got {taken[0]!r}, need other names than status and inputs..., "
                f"which a sweep has already"
            )
        return {**{name: jnp.asarray(value) for name, value in wanted.items()}, "status": eq.status}


class Program:
    """A task compiled for chunks of one size: those are cut into parts for the devices, these into
    rows that lie side by side.

    As many samples lie side by side as is fast on a CPU, or fills another device, fewer where the
    bound on memory says so. On a CPU the number does not depend on samples, chunk or devices, since
    rounding may depend on it.

    **Arguments:** the task; all samples, NumPy arrays; samples in a chunk; the devices; bound on
    memory [bytes].
    """

    def __init__(self, task: Task, samples: Any, chunk: int, mesh: Mesh, memory: int):
        self.chunk, self._task, self._samples, self._mesh = chunk, task, samples, mesh
        parts = mesh.devices.size
        batch_size = BATCH_SIZE if mesh.devices.flat[0].platform == "cpu" else -(-chunk // parts)
        while True:
            self._rows = parts * batch_size * -(-chunk // (parts * batch_size))
            lowered = _solved.lower(task, self._placed(0), batch_size, mesh)  # pyright: ignore[reportFunctionMemberAccess]
            self._compiled = lowered.compile()
            needed = parts * self._compiled.compiled.memory_analysis().temp_size_in_bytes
            if needed <= memory:
                self._batch_size = batch_size
                return
            if batch_size == 1:
                raise ValueError(
                    f"sweep.memory: got {memory} bytes, need at least {needed} for a sample on "
                    f"each device"
                )
            admitted = max(1, batch_size * memory // needed)
            batch_size = min(batch_size // 2, 1 << (admitted.bit_length() - 1))

    def __call__(self, index: int) -> dict[str, Any]:
        """Outputs of a chunk, not waited for; rows that fill up the last one are copies of its last
        sample."""
        return self._compiled(self._task, self._placed(index), self._batch_size, self._mesh)

    def samples_in(self, index: int) -> int:
        """How many samples a chunk holds."""
        return min(self.chunk, number(self._samples) - index * self.chunk)

    def _placed(self, index: int) -> Any:
        place = index * self.chunk + np.minimum(np.arange(self._rows), self.samples_in(index) - 1)
        return jax.device_put(
            jax.tree.map(lambda x: x[place], self._samples),
            NamedSharding(self._mesh, PartitionSpec("samples")),
        )


@eqx.filter_jit
def _solved(task: Task, samples: Any, batch_size: int, mesh: Mesh) -> dict[str, Any]:
    """Outputs of all samples, each device by itself, `batch_size` side by side: no loop waits for
    another device's samples."""
    arrays, static = eqx.partition(task, eqx.is_array)

    def part(arrays: Any, samples: Any) -> dict[str, Any]:
        rows = jax.tree.map(
            lambda x: x.reshape(len(x) // batch_size, batch_size, *x.shape[1:]), samples
        )
        task = eqx.combine(arrays, static)
        outputs = lax.map(
            jax.vmap(lambda sample: task(sample)), rows
        )  # JAX writes out the name of what it maps, a scene at length
        return jax.tree.map(lambda x: x.reshape(len(x) * batch_size, *x.shape[2:]), outputs)

    split = PartitionSpec("samples")
    return jax.shard_map(
        part, mesh=mesh, in_specs=(PartitionSpec(), split), out_specs=split, check_vma=False
    )(arrays, samples)
