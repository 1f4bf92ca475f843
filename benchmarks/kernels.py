"""Where a batch of arms spends its time: the kernels of its compiled program that take longest.

    python benchmarks/kernels.py "pillar, touched" [--batch N] [--most N]

The scene is a row of the [cost of effects](../docs/benchmarks.md#cost-of-effects). XLA fuses the
operations of a program into kernels and repeats cheap ones in several of them, which
`numerics.once` prevents: a kernel of many operations with a small result is worth a look. The
profiler adds about a microsecond to each run of a kernel, most of the time of those that run
thousands of times, in passes over the nodes; the kernels are sorted by their time without it.
"""

import argparse
import re
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import vsr_jax as vsr
from vsr_jax.studies import effects

STEPS = 16
OVERHEAD = 1e-3
"""What the profiler adds to each run of a kernel [ms]."""


class Kernel(NamedTuple):
    """A kernel of a program: its name, the type of its result, and the operations fused in it."""

    name: str
    result: str
    operations: int


def kernels_of(program: str) -> Iterator[Kernel]:
    """The kernels of a compiled program, from its text."""
    parts = re.split(r"\n(?=(?:%|ENTRY)[^\n]*\{)", program)
    sizes = {part.split(" ", 1)[0]: part.count(" = ") for part in parts}
    fusion = re.compile(r"%([\w.\-]+) = (\w+\[[^\]]*\])\S* fusion\(.*? calls=(%[\w.\-]+)")
    for name, result, called in fusion.findall(program):
        yield Kernel(name, result, sizes[called])


def measured(run: jax.stages.Compiled, inputs: jax.Array) -> tuple[Counter, Counter]:
    """Time [ms] and runs of everything that the profiler sees in one call, by name."""
    jax.block_until_ready(run(inputs))
    times, runs = Counter(), Counter()
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            jax.block_until_ready(run(inputs))
        (trace,) = Path(folder).rglob("*.xplane.pb")
        for plane in jax.profiler.ProfileData.from_file(str(trace)).planes:
            for line in plane.lines:
                for event in line.events:
                    times[event.name] += event.duration_ns * 1e-6
                    runs[event.name] += 1
    return times, runs


def main() -> None:
    """Profile one batch and print its kernels."""
    scenes = {one.name: one for one in effects.scenes() if one.pose and not one.followed}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", choices=scenes)
    parser.add_argument("--batch", type=int, default=256, metavar="N", help="arms (256)")
    parser.add_argument("--most", type=int, default=30, metavar="N", help="kernels (30)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    scene, model = scenes[options.scene], vsr.StrainDependent(STEPS)
    share = np.random.default_rng(0).uniform(0.5, 1.5, (options.batch, 1))
    inputs = jnp.asarray(np.asarray(scene.inputs) * share)

    def tip(inputs: jax.Array) -> jax.Array:
        return vsr.solve(scene.scene, inputs, model=model).tip

    run = jax.jit(jax.vmap(tip)).lower(inputs).compile()
    times, runs = measured(run, inputs)
    found = [kernel for kernel in kernels_of(run.as_text() or "") if runs[kernel.name]]
    total = sum(times[kernel.name] for kernel in found)
    print(f"{options.scene}, {options.batch} arms: {len(found)} kernels, {total:.0f} ms")
    print("| time [ms] | runs | each [us] | kernel | result | operations |")
    print("| ---: | ---: | ---: | --- | --- | ---: |")
    found.sort(key=lambda kernel: times[kernel.name] - OVERHEAD * runs[kernel.name], reverse=True)
    for kernel in found[: options.most]:
        time, count = times[kernel.name], runs[kernel.name]
        print(
            f"| {time:.1f} | {count} | {time / count * 1e3:.1f} | {kernel.name} | {kernel.result} "
            f"| {kernel.operations} |"
        )


if __name__ == "__main__":
    main()
