"""What a function costs: operations, compile time and the times of its warm calls."""

import os
import platform
import time
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import jax
import numpy as np


class Timed:
    """A function compiled for its arguments.

    **Arguments:**
    - `function`, `args`: what is compiled and called.
    - `calls`: how often each `run` calls it.

    **Attributes:**
    - `compile_s`: time to trace and compile it [s].
    - `operations`: floating-point operations of the compiled program, the body of each loop counted
      once; None if XLA does not say.
    """

    def __init__(self, function: Callable, *args: Any, calls: int = 1):
        start = time.perf_counter()
        self.compiled = jax.jit(function).lower(*args).compile()
        self.compile_s = time.perf_counter() - start
        self.args, self.calls = args, calls
        self.samples: list[float] = []
        self.cpu_samples: list[float] = []

    @cached_property
    def output(self) -> Any:
        """What the first call returned. That is made when first asked for, and not in the
        constructor: programs may be compiled side by side, but two that run so from two threads can
        wait for each other for ever on a CPU."""
        return jax.block_until_ready(self.compiled(*self.args))

    @property
    def operations(self) -> int | None:
        """Floating-point operations of the compiled program, the body of each loop counted once."""
        costs = self.compiled.cost_analysis()
        return int(costs["flops"]) if isinstance(costs, dict) and "flops" in costs else None

    def run(self) -> None:
        """Calls it and notes the times [us], by the clock and on the CPUs; the very first call is
        not among them."""
        _ = self.output
        for _ in range(self.calls):
            start, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(self.compiled(*self.args))
            self.samples.append(1e6 * (time.perf_counter() - start))
            self.cpu_samples.append(1e6 * (time.process_time() - cpu))

    def summary(self) -> dict[str, float]:
        """Compile time [s], median and spread (10 to 90 %) of the warm calls [us], and the median
        of their CPU time [us]."""
        low, median, high = (float(x) for x in np.quantile(self.samples, [0.1, 0.5, 0.9]))
        cpu = float(np.median(self.cpu_samples))
        return {
            "compile_s": self.compile_s,
            "median_us": median,
            "low_us": low,
            "high_us": high,
            "cpu_us": cpu,
        }


def machine() -> str:
    """The machine in words: architecture, cores and device."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {jax.devices()[0].device_kind}"


def take_turns(jobs: Iterable[Timed], rounds: int) -> None:
    """Runs all jobs in turn, round after round, so that a busy machine is busy for all of them
    alike."""
    jobs = list(jobs)
    for _ in range(rounds):
        for job in jobs:
            job.run()
