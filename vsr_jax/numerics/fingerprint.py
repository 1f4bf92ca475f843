"""A hash that identifies a computation, so that stored results are reused only by the same
computation."""

import hashlib
import re
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np


def fingerprint(function: Callable, arguments: Any, *more: Any) -> str:
    """Hash of the program of `function(*arguments)` and of all numbers in it, in the arguments and
    in `more`."""
    arrays, static = eqx.partition((function, arguments), eqx.is_array)

    def run(arrays: Any) -> Any:
        whole, given = eqx.combine(arrays, static)
        return whole(*given)

    program = jax.make_jaxpr(run)(arrays)
    digest = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(program.jaxpr)).encode())
    for leaf in jax.tree.leaves((program.consts, arrays, more)):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()
