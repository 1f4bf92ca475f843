"""Products of small matrices and of vectors with their components in the first axes, as one
operation of a program each, as `lax.dot_general` is one: its derivatives in reverse mode are
products again, where those of multiplications and sums would be three times as many operations, to
be traced and compiled.

XLA has no such products: `dot_general` with hundreds of arms or nodes behind the components calls a
library for each of them.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array

from ..typing import Shape
from .loops import alike, manual

_FEW = 16
"""Number of terms up to which `total` adds them one by one."""


def parts(x: Array, axis: int) -> list[Array]:
    """The components of an axis, of length one there. Their transpose joins them, where that of
    slices would pad and add each."""
    return list(lax.split(x, (1,) * x.shape[axis], axis))


def total(x: Array, axis: int) -> Array:
    """Sum over an axis; where it is short term by term, since a reduction is slow in a batch."""
    if not 0 < x.shape[axis] <= _FEW:
        return jnp.sum(x, axis)
    first, *others = parts(x, axis)
    return lax.squeeze(sum(others, first), (axis,))


def product(a: Array, b: Array) -> Array:
    """Product of the matrices (n, k, ...) and (k, m, ...)."""
    return _product.bind(*_alike(a, b), lead=0, of=(1, 0))


def cross(a: Array, b: Array) -> Array:
    """Vector product of two vectors (3, ...)."""
    return _cross.bind(*_alike(a, b), lead=0)


def _alike(a: Array, b: Array) -> tuple[Array, Array]:
    """Both factors in the higher one of their precisions, and of one type inside a mesh."""
    dtype = jnp.promote_types(a.dtype, b.dtype)
    a, b = alike(a.astype(dtype), b.astype(dtype))
    return a, b


def _of_shape(shape: Shape, factor: ShapedArray) -> ShapedArray:
    """Type of a product of this shape, which inside a mesh varies as its factors do."""
    if manual():
        return factor.update(shape=shape, weak_type=False)
    return ShapedArray(shape, factor.dtype)


def _contracted(a: Any, b: Any, *, lead: int, of: tuple[int, int]) -> Array:
    """Sum over the axis `of` each of two matrices behind so many leading axes: (1, 0) is A B, (0,
    0) is A^T B and (1, 1) is A B^T."""
    summed, ahead, behind = {(1, 0): (1, 2, 0), (0, 0): (0, 2, 1), (1, 1): (2, 1, 0)}[of]
    terms = jnp.expand_dims(a, lead + ahead) * jnp.expand_dims(b, lead + behind)
    return total(terms, lead + summed)


def _shape(a: ShapedArray, b: ShapedArray, *, lead: int, of: tuple[int, int]) -> ShapedArray:
    one, other = a.shape[lead : lead + 2], b.shape[lead : lead + 2]
    if len(a.shape) != len(b.shape) or one[of[0]] != other[of[1]]:
        raise TypeError(f"no product of matrices of shapes {a.shape} and {b.shape}")
    axes = jnp.broadcast_shapes(
        a.shape[:lead] + a.shape[lead + 2 :], b.shape[:lead] + b.shape[lead + 2 :]
    )
    matrix = one[1 - of[0]], other[1 - of[1]]
    return _of_shape((*axes[:lead], *matrix, *axes[lead:]), a)


def _by_first(back: Any, a: Any, b: Any, *, lead: int, of: tuple[int, int]) -> Array:
    first, second = of
    if first == 1:
        found = _product.bind(back, b, lead=lead, of=(1, 1 - second))
    else:
        found = _product.bind(b, back, lead=lead, of=(1 - second, 1))
    return _summed_to(a.aval.shape, found)


def _by_second(back: Any, a: Any, b: Any, *, lead: int, of: tuple[int, int]) -> Array:
    first, second = of
    if second == 0:
        found = _product.bind(a, back, lead=lead, of=(1 - first, 0))
    else:
        found = _product.bind(back, a, lead=lead, of=(0, 1 - first))
    return _summed_to(b.aval.shape, found)


def _crossed(a: Any, b: Any, *, lead: int) -> Array:
    (x, y, z), (u, v, w) = (parts(jnp.asarray(p), lead) for p in (a, b))
    return jnp.concatenate([y * w - z * v, z * u - x * w, x * v - y * u], axis=lead)


def _cross_shape(a: ShapedArray, b: ShapedArray, *, lead: int) -> ShapedArray:
    if len(a.shape) != len(b.shape) or not a.shape[lead] == b.shape[lead] == 3:
        raise TypeError(f"no product of vectors of shapes {a.shape} and {b.shape}")
    return _of_shape(jnp.broadcast_shapes(a.shape, b.shape), a)


def _cross_by_first(back: Any, a: Any, b: Any, *, lead: int) -> Array:
    return _summed_to(a.aval.shape, _cross.bind(b, back, lead=lead))


def _cross_by_second(back: Any, a: Any, b: Any, *, lead: int) -> Array:
    return _summed_to(b.aval.shape, _cross.bind(back, a, lead=lead))


def _summed_to(shape: Shape, x: Array) -> Array:
    """Sum over the axes along which a factor of a shape was repeated."""
    axes = tuple(i for i, (one, all) in enumerate(zip(shape, x.shape, strict=True)) if one != all)
    return jnp.sum(x, axes, keepdims=True) if axes else x


def _primitive(
    name: str, value: Callable, shape: Callable, by_first: Callable, by_second: Callable
) -> Primitive:
    """A product as an operation, from its value and shape and the parts of its transpose."""
    made = Primitive(name)

    def batched(factors: tuple[Array, Array], axes: tuple, **how: Any) -> tuple[Array, int]:
        a, b = (
            x[None] if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(factors, axes, strict=True)
        )
        return made.bind(a, b, **(how | {"lead": how["lead"] + 1})), 0

    made.def_impl(value)
    made.def_abstract_eval(shape)
    ad.defbilinear(made, by_first, by_second)
    batching.primitive_batchers[made] = batched
    mlir.register_lowering(made, mlir.lower_fun(value, multiple_results=False))
    return made


_product = _primitive("small_product", _contracted, _shape, _by_first, _by_second)
_cross = _primitive("cross_product", _crossed, _cross_shape, _cross_by_first, _cross_by_second)
