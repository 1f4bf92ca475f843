"""A value that XLA computes once on a CPU, however many operations use it.

XLA fuses an operation with those that use its result, and repeats it in each of them. In passes
along an arm, whose matrices are products of products, the repeated work takes many times the
arithmetic (measured: the elimination of a batch in contact takes sixteen times as long without
`once`). Neither `lax.optimization_barrier`, which is removed before the fusion, nor a copy prevents
it, but two operations are never repeated: a division and a gather.
"""

import math

import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array


def once(x: Array, *, summed: bool = False) -> Array:
    """The same values, computed once on a CPU; of finite floats, in double precision infinite ones
    too, and of truth values. Derivatives of both modes are computed once too. Other devices take
    the values as they are: there a batch in contact takes a third longer with an operation more
    for each.

    **Arguments:** `summed`: for terms of a sum. XLA hands sums to a library, divisions that lead to
    them too: two such sums per Newton step were 5 to 7 % of a batch in single precision.
    """
    if x.dtype == bool:
        return _once.bind(x.astype(jnp.float32), summed=False) > 0
    return _once.bind(x, summed=summed)


def _divided(x: Array) -> Array:
    """The values divided by one, which XLA cannot know; an infinity becomes NaN."""
    return x / (1.0 + 0.0 * x)


def _clamped(x: Array) -> Array:
    """As `_divided`, for infinities too; in single precision this costs a batch a fifth."""
    one = jnp.ones((), x.dtype)
    return x / (1.0 + 0.0 * lax.clamp(-one, x, one))


def _gathered(x: Array) -> Array:
    """The values, gathered row by row along all axes but the last."""
    if not x.size:
        return x
    rows = x.reshape(-1, *x.shape[-1:])
    return rows.at[jnp.arange(rows.shape[0])].get(mode="promise_in_bounds").reshape(x.shape)


def _kept(x: Array, *, summed: bool) -> Array:
    """The cheapest: a division in double precision takes longer than a gather. Of one row, XLA sees
    that a gather changes nothing."""
    several = math.prod(x.shape[:-1]) not in (0, 1)  # where it is a symbol too
    if x.dtype != jnp.float64 and not (summed and several):
        return _divided(x)
    return _gathered(x) if several else _clamped(x)


_once = Primitive("once")
_once.def_impl(lambda x, **_: x)
_once.def_abstract_eval(lambda x, **_: x)
ad.deflinear2(_once, lambda cotangent, _, **how: [_once.bind(cotangent, **how)])
batching.defvectorized(_once)
mlir.register_lowering(_once, mlir.lower_fun(lambda x, **_: x, multiple_results=False))
mlir.register_lowering(_once, mlir.lower_fun(_kept, multiple_results=False), platform="cpu")
