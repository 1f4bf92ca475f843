"""Cost of a function: operations, compile time and times of warm calls."""

import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from ..numerics.fingerprint import nested


def primitives(program: Any) -> Counter[str]:
    """How often each primitive occurs in a program and in all that it calls, the body of a loop
    counted once; their total is a size of the program that does not depend on the machine."""
    return Counter(equation.primitive.name for part in nested(program) for equation in part.eqns)


class Timed:
    """A function compiled for its arguments.

    **Arguments:**
    - `function`, `args`: function that is compiled, and its arguments.
    - `calls`: calls per `run`.

    **Attributes:**
    - `compile_s`: time to trace and compile [s].
    - `operations`: floating-point operations of the compiled program, each loop body counted once;
      None if XLA does not report them.
    """

    def __init__(self, function: Callable, *args: PyTree, calls: int = 1):
        start = time.perf_counter()
        self.compiled = jax.jit(function).lower(*args).compile()
        self.compile_s = time.perf_counter() - start
        self.args, self.calls = args, calls
        self.samples: list[float] = []
        self.cpu_samples: list[float] = []

    @cached_property
    def output(self) -> PyTree:
        """Result of the first call. It is made on first access and not in the constructor: programs
        can be compiled in parallel, but programs that run from two threads can deadlock on a
        CPU."""
        return jax.block_until_ready(self.compiled(*self.args))

    @property
    def operations(self) -> int | None:
        """Floating-point operations of the compiled program, each loop body counted once."""
        costs = self.compiled.cost_analysis()
        return int(costs["flops"]) if isinstance(costs, dict) and "flops" in costs else None

    def run(self) -> None:
        """Calls the function and records wall and CPU times [us]; the first call of all is not
        recorded."""
        _ = self.output
        for _ in range(self.calls):
            start, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(self.compiled(*self.args))
            self.samples.append(1e6 * (time.perf_counter() - start))
            self.cpu_samples.append(1e6 * (time.process_time() - cpu))

    def summary(self) -> dict[str, float]:
        """Compile time [s]; median, 10 % and 90 % quantiles of the wall times [us]; median of the
        CPU times [us]."""
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
    """Description of the machine: architecture, cores and device."""
    return f"{platform.machine()}, {os.cpu_count()} cores, {jax.devices()[0].device_kind}"


def take_turns(jobs: Iterable[Timed], rounds: int) -> None:
    """Runs all jobs in turn, round after round, so that other load on the machine affects all of
    them equally."""
    jobs = list(jobs)
    for _ in range(rounds):
        for job in jobs:
            job.run()
