"""A hash that identifies a computation, so that stored results are reused only by the same
computation."""

import hashlib
import re
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.extend.core import Literal


def fingerprint(function: Callable, arguments: Any, *more: Any) -> str:
    """Hash of the program of `function(*arguments)` and of all numbers in it, in the arguments and
    in `more`."""
    arrays, static = eqx.partition((function, arguments), eqx.is_array)

    def run(arrays: Any) -> Any:
        whole, given = eqx.combine(arrays, static)
        return whole(*given)

    program = jax.make_jaxpr(run)(arrays)
    parts = list(nested(program))
    constants = [getattr(part, "consts", ()) for part in parts]
    # an array among them is printed by its shape only
    literals = [
        atom.val
        for part in parts
        for equation in part.eqns
        for atom in equation.invars
        if isinstance(atom, Literal)
    ]
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(program.jaxpr)).encode())
    for leaf in jax.tree.leaves((constants, literals, arrays, more)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()


def nested(program: Any) -> Iterator[Any]:
    """A program and all programs that it calls, the body of a loop once.

    A program is whatever has `eqns`: JAX had one class for programs with constants of their own,
    `consts`, and one for others, and has a single class since 0.12.
    """
    yield program
    for equation in program.eqns:
        for leaf in jax.tree.leaves(list(equation.params.values()), is_leaf=_is_program):
            if _is_program(leaf):
                yield from nested(leaf)


def _is_program(x: Any) -> bool:
    return hasattr(x, "eqns")
