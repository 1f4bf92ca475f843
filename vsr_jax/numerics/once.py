"""A value that XLA computes once on a CPU, however many operations use it.

XLA fuses an operation with those that use its result, and repeats it in each of them. In passes
along an arm, whose matrices are products of products, the repeated work takes many times the
arithmetic (measured: the elimination of a batch in contact takes sixteen times as long without
`once`). Neither `lax.optimization_barrier`, which is removed before the fusion, nor a copy prevents
it, but two operations are never repeated: a division and a gather.
"""

import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


def once(x: Array) -> Array:
    """The same values, computed once; of floats and of truth values. Derivatives of both modes are
    computed once too."""
    return _once.bind(x.astype(jnp.float32)) > 0 if x.dtype == bool else _once.bind(x)


def _divided(x: Array) -> Array:
    """The values divided by one, which XLA cannot know."""
    return x / (1.0 + 0.0 * x)


def _gathered(x: Array) -> Array:
    """The values, gathered row by row along all axes but the last."""
    rows = x.reshape(-1, *x.shape[-1:])
    return rows.at[jnp.arange(len(rows))].get(mode="promise_in_bounds").reshape(x.shape)


def _kept(x: Array) -> Array:
    """The cheaper of both: a division in double precision takes longer than a gather."""
    return _gathered(x) if x.ndim and x.dtype == jnp.float64 else _divided(x)


_once = Primitive("once")
_once.def_impl(lambda x: x)
_once.def_abstract_eval(lambda x: x)
ad.deflinear2(_once, lambda cotangent, _: [once(cotangent)])
batching.defvectorized(_once)
mlir.register_lowering(_once, mlir.lower_fun(_divided, multiple_results=False))
mlir.register_lowering(_once, mlir.lower_fun(_kept, multiple_results=False), platform="cpu")
