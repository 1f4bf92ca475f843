"""Loops that also work inside `jax.shard_map` with its default check.

There the type of an array names the mesh axes over which its values vary, and the carry of a loop
must keep its type. A carry that begins as zeros varies over no axis, and after one step over those
of the data: JAX refuses it, and its own loops cast nothing. The loops of this module cast the carry
to the axes over which its steps vary, and to no others: what is typed as varying is summed over its
axes in derivatives. Elsewhere they are those of `jax.lax`, with the same programs.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

Tree = TypeVar("Tree")


def while_loop(going: Callable[[Tree], Array], step: Callable[[Tree], Tree], begin: Tree) -> Tree:
    """`jax.lax.while_loop`."""
    if not _checked():
        return lax.while_loop(going, step, begin)
    axes = _axes_of(begin) | _axes_of_found(lambda: (step(begin), going(begin)))
    return lax.while_loop(going, lambda x: _varying(step(x), axes), _varying(begin, axes))


def fori_loop(low: int, high: Any, step: Callable[[Any, Tree], Tree], begin: Tree) -> Tree:
    """`jax.lax.fori_loop`."""
    if not _checked():
        return lax.fori_loop(low, high, step, begin)
    axes = _axes_of((begin, high)) | _axes_of_found(lambda: step(jnp.asarray(low), begin))
    return lax.fori_loop(low, high, lambda i, x: _varying(step(i, x), axes), _varying(begin, axes))


def scan(
    step: Callable[[Any, Any], tuple],
    begin: Any,
    every: Any,
    *,
    length: int | None = None,
    reverse: bool = False,
) -> tuple[Any, Any]:
    """`jax.lax.scan`."""
    if not _checked():
        return lax.scan(step, begin, every, length, reverse)
    once = _axes_of_found(lambda: lax.scan(lambda _, x: ((), step(begin, x)[0]), (), every, length))
    axes = _axes_of(begin) | once

    def cast(carry: Any, x: Any) -> tuple[Any, Any]:
        carry, found = step(carry, x)
        return _varying(carry, axes), found

    return lax.scan(cast, _varying(begin, axes), every, length, reverse)


def alike(*trees: Any) -> tuple[Any, ...]:
    """The trees of arrays, all varying over the mesh axes over which any of their leaves does."""
    return _varying(trees, _axes_of(trees)) if manual() else trees


def manual() -> bool:
    """Whether a function is traced for the devices of a mesh, as by `jax.shard_map`."""
    return bool(jax.sharding.get_abstract_mesh().manual_axes)


def _checked() -> bool:
    """Whether JAX checks there over which axes arrays vary; a cast changes nothing otherwise."""
    axes = frozenset(jax.sharding.get_abstract_mesh().manual_axes)
    return bool(axes) and bool(_axes_of_found(lambda: _varying(jnp.zeros(()), axes)))


def _axes_of(tree: Any) -> frozenset:
    """Mesh axes over which any leaf varies."""
    return frozenset().union(*(_axes_of_type(jax.typeof(x)) for x in jax.tree.leaves(tree)))


def _axes_of_type(of: Any) -> frozenset:
    """Mesh axes over which arrays of a type vary: `vma` until JAX 0.9."""
    return of.vma if hasattr(of, "vma") else of.mat.varying


def _axes_of_found(function: Callable[[], Any]) -> frozenset:
    """Mesh axes over which the results of a function vary. It is traced for nothing else: a step
    may vary by any array that it closes over."""
    found = []
    jax.eval_shape(lambda: found.append(_axes_of(function())))
    return found[0]


def _varying(tree: Tree, axes: frozenset) -> Tree:
    """The arrays, cast to vary over the axes and over those over which they do already."""

    def cast(x: Any) -> Any:
        more = tuple(sorted(axes - _axes_of(x), key=str))
        if not more:
            return x
        if hasattr(lax, "pcast"):
            return lax.pcast(x, more, to="varying")
        return lax.pvary(x, more)  # until JAX 0.8  # pyright: ignore[reportAttributeAccessIssue]

    return jax.tree.map(cast, tree)
