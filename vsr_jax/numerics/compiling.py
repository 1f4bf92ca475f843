"""The device that programs are compiled for, and programs that take longer to trace and compile
than to run."""

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache, wraps
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
from jax.core import Tracer

_NESTED = "`compiler_options` can only be passed to top-level"
"""What JAX says of compiler options under a transformation."""

F = TypeVar("F", bound=Callable)


def quick_jit(function: F) -> F:
    """`equinox.filter_jit`, with `quick_compilation` where nothing is traced: JAX takes compiler
    options outside of its transformations only, and batches are traced by `jax.vmap`. `lower` has
    the options too. Nothing looks for garbage meanwhile."""
    plain = eqx.filter_jit(function)

    @cache
    def quick() -> Callable:
        options: dict[str, Any] = {"compiler_options": quick_compilation()}
        return eqx.filter_jit(function, **options)

    @wraps(function)
    @garbage_kept()
    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        if not any(isinstance(leaf, Tracer) for leaf in leaves):
            try:
                return quick()(*args, **kwargs)
            except ValueError as error:  # known arguments in a function that `jax.jit` traces
                if _NESTED not in str(error):
                    raise
        return plain(*args, **kwargs)

    def lower(*args: Any, **kwargs: Any) -> Any:
        return quick().lower(*args, **kwargs)  # pyright: ignore[reportFunctionMemberAccess]

    call.lower = lower  # pyright: ignore[reportAttributeAccessIssue]
    return cast(F, call)


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


def on_cpu() -> bool:
    """Whether programs that are traced now run on a CPU."""
    device = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    name = device if isinstance(device, str) else getattr(device, "platform", None)
    return (name or jax.default_backend()) == "cpu"


def quick_compilation() -> dict[str, bool | int]:
    """Compiler options with which large programs compile in half to two thirds of the time on CPU:
    `jax.jit(function, compiler_options=vsr.quick_compilation())`.

    XLA's older code generation for fused operations, and its second level of optimization in place
    of the third, unless `XLA_FLAGS` names one. `solve` and all else that is not a large batch use
    them already where they are called outside of JAX's transformations; JAX takes them at the
    outermost `jax.jit` only, so that they are yours to give where `jax.grad` or `jax.jit` is.

    One arm is solved as fast with them, and differentiated too; with contact it takes a tenth
    longer, and a large batch of arms without loads a fifth.

    **Returns:** the options; none on other devices than CPUs, or where XLA does not know them.
    """
    if not on_cpu():
        return {}
    options: dict[str, bool | int] = {"xla_cpu_use_fusion_emitters": False}
    level = "xla_backend_optimization_level"
    if level not in os.environ.get("XLA_FLAGS", ""):
        options[level] = 2
    return options if _known(tuple(options.items())) else {}


@cache
def _known(options: tuple[tuple[str, bool | int], ...]) -> bool:
    """Whether XLA knows compiler options."""
    try:
        jax.jit(lambda x: x, compiler_options=dict(options)).lower(0.0).compile()
    except (RuntimeError, ValueError):
        return False
    return True
