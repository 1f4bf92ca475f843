"""Programs that take longer to compile than to run."""

from collections.abc import Callable
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
    options outside of its transformations only, and batches are traced by `jax.vmap`."""
    plain = eqx.filter_jit(function)

    @cache
    def quick() -> Callable:
        options: dict[str, Any] = {"compiler_options": quick_compilation()}
        return eqx.filter_jit(function, **options)

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        leaves = jax.tree.leaves((args, kwargs))
        if not any(isinstance(leaf, Tracer) for leaf in leaves):
            try:
                return quick()(*args, **kwargs)
            except ValueError as error:  # known arguments in a function that `jax.jit` traces
                if _NESTED not in str(error):
                    raise
        return plain(*args, **kwargs)

    return cast(F, call)


@cache
def quick_compilation() -> dict[str, bool]:
    """Compiler options with which a large program compiles in two thirds of the time on CPU: XLA's
    older code generation for fused operations. One arm is solved as fast, large batches half as
    fast. Empty on other devices, and where XLA does not know the option."""
    options = {"xla_cpu_use_fusion_emitters": False}
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x, compiler_options=options).lower(0.0).compile()
    except (RuntimeError, ValueError):
        return {}
    return options
