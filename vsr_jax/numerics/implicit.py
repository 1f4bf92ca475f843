"""Implicit derivatives of roots, shared by all solvers. Parameters that do not change are not
differentiated."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array

from .loops import alike
from .newton import Root
from .once import once


def implicit_root(
    find: Callable[..., Root],
    residual: Callable[..., Any],
    solve: Callable[..., Any],
    at_rest: Callable[..., tuple],
    *parameters: Any,
    settle: Callable[..., tuple] = lambda found, *parameters: parameters,
) -> Root:
    r"""Root $x(p)$ of $r(x, p) = 0$ whose derivative is $dx = -(\partial r / \partial x)^{-1}
    (\partial r / \partial p) \, dp$.

    Derivatives of any order, in forward and reverse mode; the iteration is never differentiated. A
    problem without a root has no derivative: its entries are replaced by those of `at_rest`, where
    everything is finite, so that they do not affect the other problems of a batch.

    **Arguments:** all but the parameters close over constants only.
    - `find`: maps the parameters to a `Root`.
    - `residual`: maps x and the parameters to r.
    - `solve`: maps x, the parameters and a right side b to the solution y of $(\partial r /
      \partial x) \, y = b$. Linear in b, so that JAX can transpose it.
    - `at_rest`: maps x and the parameters to the same with finite values of all that may have
      failed. A parameter that it returns unchanged costs no operation.
    - `parameters`: pytrees of arrays.
    - `settle`: maps the root found and the parameters to those that it belongs to, if `find` may
      choose between problems.
    """

    @jax.custom_jvp
    def root(*parameters: Any) -> Root:
        return find(*parameters)

    @partial(root.defjvp, symbolic_zeros=True)
    def _(primals: tuple, tangents: tuple) -> tuple[Root, Root]:
        found = root(*primals)
        sound = once(found.converged & found.definite)
        rest_x, *rest = at_rest(found.x, *primals)
        replaced = jax.tree.map(lambda p, p_rest: p is not p_rest, primals, tuple(rest))
        x = jax.tree.map(partial(jnp.where, sound), found.x, rest_x)

        def safe(parameters: tuple) -> tuple:
            finite = jax.tree.map(
                lambda replace, p, p_rest: jnp.where(sound, p, p_rest) if replace else p,
                replaced,
                parameters,
                tuple(rest),
            )
            return settle(found, *finite)

        right = change_of(lambda *p: residual(x, *safe(p)), primals, tangents)
        change = jax.tree.map(jnp.negative, solve(x, *safe(primals), right))
        return found, Root(change, *no_derivative(*found[1:]))

    return root(*alike(*parameters))


def unchanged(tangent: Any) -> bool:
    """Whether the tangent of a primal is a symbolic zero."""
    return isinstance(tangent, SymbolicZero)


def change_of(function: Callable, primals: tuple, tangents: tuple) -> Any:
    """Derivative of a function along tangents. By primals whose tangent is a symbolic zero it is
    not differentiated.

    A scene has dozens of numbers. Usually only a few of them change, and differentiating by the
    others would double the program.
    """
    return jax.jvp(*_moving(function, primals, tangents))[1]


def _moving(
    function: Callable, primals: tuple, tangents: tuple
) -> tuple[Callable, tuple[Array, ...], tuple[Array, ...]]:
    """The function of the primals whose tangent is no symbolic zero, these, and their tangents."""
    leaves, tree = jax.tree.flatten(primals)
    rates = jax.tree.leaves(tangents)
    moving = [i for i, rate in enumerate(rates) if not unchanged(rate)]

    def moved(*values: Array) -> Any:
        changed = dict(zip(moving, values, strict=True))
        return function(
            *jax.tree.unflatten(tree, [changed.get(i, leaf) for i, leaf in enumerate(leaves)])
        )

    return moved, tuple(leaves[i] for i in moving), tuple(rates[i] for i in moving)


def at_nodes(function: Callable) -> Callable:
    """A function of each node alone, of component arrays to a tuple of them, whose derivative is
    the product with its Jacobian at each node: a small program, where one tangent system is solved
    by many products."""

    def rule(primals: tuple, tangents: tuple) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        moved, values, rates = _moving(function, primals, tangents)
        shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in jax.tree.leaves(primals)))

        def stacked(parts: tuple[Array, ...]) -> Array:
            return jnp.stack([jnp.broadcast_to(x, shape) for x in parts])

        found, back = jax.vjp(lambda values: jnp.stack(moved(*values)), stacked(values))
        unit = jnp.eye(len(found), dtype=found.dtype)
        unit = unit.reshape(*unit.shape, *(1,) * len(shape)) * jnp.ones_like(found)
        jacobian = jax.vmap(back)(unit)[0]
        return tuple(found), tuple(jnp.sum(jacobian * stacked(rates), axis=1))

    found = jax.custom_jvp(function)
    found.defjvp(rule, symbolic_zeros=True)
    return found


def no_derivative(*values: Array | None) -> tuple[Any, ...]:
    """Tangents of integer and boolean outputs."""

    def none(value: Array) -> Any:
        return alike(np.zeros(value.shape, jax.dtypes.float0), value)[0]

    return jax.tree.map(none, values)
