"""Programs that the package compiles where it is called outside of JAX's transformations.

XLA takes seconds to optimize a solve that then runs in less than a millisecond. Without
optimizations it takes a third of that, and the program runs for some milliseconds. So a program is
compiled quickly at first; one that has run for as long as that took is compiled again in the
background, and replaced when that is ready. Both are kept on disk, see `program_store`.
"""

import gc
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from functools import partial, update_wrapper
from typing import Any
from weakref import WeakSet

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from . import program_store

VARIABLE = "VSR_JAX_TIERS"
"""Environment variable; "off" compiles every program once, with XLA's defaults."""

LONG = 4e-6
"""Seconds that a quick program runs, for each character of its text, before it is compiled again:
about as long as XLA took to compile it."""

SILENT = 3.0
"""Seconds of compiling after which a message appears."""

_LEVEL = "xla_backend_optimization_level"

_SETTINGS = (
    "jax_enable_x64",
    "jax_default_device",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_disable_jit",
    "jax_debug_nans",
    "jax_debug_infs",
)
"""Settings of JAX that a traced program depends on."""

_OF_NUMPY = np.ndarray, np.generic

_shown: ContextVar[bool] = ContextVar("shown", default=True)
_programs: WeakSet["Program"] = WeakSet()


def program(name: str) -> Callable[[Callable], "Program"]:
    """Decorator that makes a function of pytrees a `Program`; `name` is what messages call it."""
    return lambda function: Program(function, name)


class Program:
    """A compiled function of pytrees, in which everything that is not an array is static.

    Under a transformation of JAX, on other devices than a CPU, and where JAX is set to debug, it is
    `equinox.filter_jit(function)`.
    """

    def __init__(self, function: Callable, name: str):
        update_wrapper(self, function)
        self._function, self._name = function, name
        self._traced = eqx.filter_jit(function)
        self._kinds: dict[Hashable, _Kind | None] = {}
        _programs.add(self)

    def __get__(self, instance: Any, owner: Any = None) -> Callable:
        return self if instance is None else partial(self, instance)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        kind, arrays = self._kind(args, kwargs)
        if kind is not None:
            return kind(arrays)
        with garbage_kept():
            return self._traced(*args, **kwargs)

    def compile(self, *args: Any, **kwargs: Any) -> None:
        """Compiles the program for such arguments, without running it."""
        self._kind(args, kwargs)

    def _kind(self, args: tuple, kwargs: dict) -> tuple["_Kind | None", list[Array]]:
        """The program for arguments of this kind, and their arrays; None where JAX compiles it."""
        leaves, structure = jax.tree.flatten((args, kwargs))
        leaves = [jnp.asarray(x) if isinstance(x, _OF_NUMPY) else x for x in leaves]
        arrays = [x for x in leaves if isinstance(x, jax.Array)]
        if any(isinstance(x, Tracer) for x in arrays):
            return None, arrays
        static = tuple([None if isinstance(x, jax.Array) else (type(x), x) for x in leaves])
        kinds = tuple([(x.aval, x.sharding) for x in arrays])
        settings = tuple([getattr(jax.config, setting) for setting in _SETTINGS])
        key = structure, static, kinds, settings
        if key not in self._kinds:
            self._kinds[key] = self._compiled(structure, static, arrays)
        return self._kinds[key], arrays

    def _compiled(self, structure: Any, static: tuple, arrays: list[Array]) -> "_Kind | None":
        text = f"vsr_jax: compiling {self._name}"
        with message_when_slow(text), garbage_kept():
            kind = _Kind(self._function, structure, static) if _on_host(arrays) else None
            return kind if kind is not None and kind.prepare(arrays) else None


class _Kind:
    """A program for one kind of arguments: their structure, and their static leaves, with None in
    place of arrays."""

    def __init__(self, function: Callable, structure: Any, static: tuple):
        self._function, self._given = function, (structure, static)
        self._returned: tuple[Any, list[tuple | None]] = None, []
        self._ran, self._improving = 0.0, False

    def prepare(self, arrays: list[Array]) -> bool:
        """Compiles the program; False where it has other inputs than the arrays, traced numbers
        that a function among the static leaves closes over."""
        # without unused arguments, programs with other arguments have the same text in the store
        traced = jax.jit(self._flat, keep_unused=True).trace(arrays)
        if len(traced.jaxpr.in_avals) != len(arrays):
            return False
        lowered, quick = traced.lower(), _quick_options()
        best = program_store.stored(lowered, {}) if quick else None
        self._run = best or program_store.compiled(lowered, quick)
        self._lowered = lowered if quick and best is None else None
        self._long = LONG * len(lowered.as_text())
        return True

    def _flat(self, arrays: list[Array]) -> list[Array]:
        """The arrays that the function returns, from those that it takes."""
        structure, static = self._given
        args, kwargs = jax.tree.unflatten(structure, _filled(static, arrays))
        leaves, structure = jax.tree.flatten(self._function(*args, **kwargs))
        self._returned = structure, [None if eqx.is_array(x) else (x,) for x in leaves]
        return [x for x in leaves if eqx.is_array(x)]

    def __call__(self, arrays: list[Array]) -> Any:
        if self._lowered is None:
            found = self._run(arrays)
        else:
            begin = time.perf_counter()
            found = jax.block_until_ready(self._run(arrays))
            self._ran += time.perf_counter() - begin
            if self._ran > self._long and not self._improving:
                self._improving = True
                _improver.add(self)
        structure, static = self._returned
        return jax.tree.unflatten(structure, _filled(static, found))

    def improve(self) -> None:
        """Compiles the program with all optimizations, and runs that from now on."""
        if self._lowered is not None:
            self._run = program_store.compiled(self._lowered, {})
            self._lowered = None


def _filled(static: Sequence[tuple | None], arrays: list[Array]) -> list:
    """Leaves, with the arrays in place of None."""
    rest = iter(arrays)
    return [next(rest) if x is None else x[-1] for x in static]


class _Improver:
    """A thread that improves programs one after another, and ends when there are none. At the end
    of the process it is waited for, since XLA cannot be interrupted, for one program only."""

    def __init__(self):
        self._waiting: deque[_Kind] = deque()
        self._lock = threading.Lock()
        self._running = False

    def add(self, kind: _Kind) -> None:
        """Improves a program when those before it are done."""
        with self._lock:
            self._waiting.append(kind)
            if not self._running:
                self._running = True
                threading.Thread(target=self._work, name="vsr_jax compiler").start()

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._waiting or not threading.main_thread().is_alive():
                    self._running = False
                    return
                kind = self._waiting.popleft()
            with suppress(Exception):  # the program of the first tier goes on
                kind.improve()


_improver = _Improver()


def drop_programs() -> None:
    """Drops all compiled programs of the package, as `jax.clear_caches` those of JAX."""
    for one in _programs:
        one._kinds.clear()


@contextmanager
def garbage_kept() -> Iterator[None]:
    """Context in which Python does not look for garbage: a program is traced as some hundred
    thousand small objects that stay, and looking through them takes a fifth of the time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@contextmanager
def message_when_slow(text: str) -> Iterator[None]:
    """Context that prints `text` to stderr if it is still open after `SILENT` seconds."""
    timer = threading.Timer(SILENT, print, [text], {"file": sys.stderr, "flush": True})
    timer.daemon = True
    if _shown.get():
        timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextmanager
def messages(shown: bool) -> Iterator[None]:
    """Context with or without messages of programs that compile."""
    token = _shown.set(shown and _shown.get())
    try:
        yield
    finally:
        _shown.reset(token)


def on_cpu() -> bool:
    """Whether programs that are traced now run on a CPU."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    name = device if isinstance(device, str) else getattr(device, "platform", None)
    return (name or jax.default_backend()) == "cpu"


def quick_compilation() -> dict[str, bool | int]:
    """Compiler options with which large programs compile in a third of the time on CPU:
    `jax.jit(function, compiler_options=vsr.quick_compilation())`.

    Without XLA's optimizations one arm takes 5 to 10 times as long to solve: some milliseconds. So
    they are for programs that run hundreds of times, not for batches and not for many thousand
    calls. `solve` and all else that the package compiles itself begins with them.

    **Returns:** the options; none on other devices than CPUs, and none where `XLA_FLAGS` names an
    optimization level.
    """
    if not on_cpu() or _LEVEL in os.environ.get("XLA_FLAGS", ""):
        return {}
    return {_LEVEL: 0, "xla_llvm_disable_expensive_passes": True}


def _quick_options() -> dict[str, bool | int]:
    """`quick_compilation`, unless `VSR_JAX_TIERS` is "off"."""
    return {} if os.environ.get(VARIABLE) == "off" else quick_compilation()


def _on_host(arrays: list[Array]) -> bool:
    """Whether a program for the arrays runs on the first CPU of this process, and JAX does not
    debug."""
    config: Any = jax.config
    if not on_cpu() or config.jax_disable_jit or config.jax_debug_nans or config.jax_debug_infs:
        return False
    host = jax.local_devices(backend="cpu")[0]
    chosen = config.jax_default_device
    return (chosen is None or isinstance(chosen, str) or chosen == host) and all(
        x.sharding.device_set == {host} for x in arrays
    )
