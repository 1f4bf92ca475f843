"""A hash that identifies a computation, so that stored results are reused only by the same
computation."""

import hashlib
import re
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal


def fingerprint(function: Callable, arguments: Any, *more: Any) -> str:
    """Hash of the program of `function(*arguments)` and of all numbers in it, in the arguments and
    in `more`."""
    arrays, static = eqx.partition((function, arguments), eqx.is_array)

    def run(arrays: Any) -> Any:
        whole, given = eqx.combine(arrays, static)
        return whole(*given)

    program = jax.make_jaxpr(run)(arrays)
    parts = list(nested(program))
    constants = [part.consts for part in parts]
    # an array among them is printed by its shape only
    literals = [
        atom.val
        for part in parts
        for equation in part.jaxpr.eqns
        for atom in equation.invars
        if isinstance(atom, Literal)
    ]
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(program.jaxpr)).encode())
    for leaf in jax.tree.leaves((constants, literals, arrays, more)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def nested(program: ClosedJaxpr) -> Iterator[ClosedJaxpr]:
    """A program and all programs that it calls, the body of a loop once, each with its own
    constants."""
    yield program
    for equation in program.jaxpr.eqns:
        for leaf in jax.tree.leaves(
            list(equation.params.values()), is_leaf=lambda x: isinstance(x, ClosedJaxpr | Jaxpr)
        ):
            # since JAX 0.12 both are one class, and a program keeps its own constants
            if isinstance(leaf, ClosedJaxpr):
                yield from nested(leaf)
            elif isinstance(leaf, Jaxpr):
                yield from nested(ClosedJaxpr(leaf, ()))
