"""Checkpoint of a descent: a file written after every chunk of steps, from which the same call
resumes."""

import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

from ..files.output import replacing
from ..numerics.fingerprint import fingerprint
from ..typing import PathLike
from .descent import DescentState, DesignProblem, History, first_update


class Checkpoint:
    """File with the state of one descent: a line of JSON, then the arrays.

    **Arguments:** `path`: the file; None writes nothing. `problem`, `optimizer`, `settings`: what
    the fingerprint in the file identifies.

    **Raises:** `ValueError` for a path that cannot be written.
    """

    def __init__(
        self,
        path: PathLike | None,
        problem: DesignProblem,
        optimizer: optax.GradientTransformationExtraArgs,
        settings: tuple[int, ...],
    ):
        self._path = None if path is None else Path(path)
        if self._path is None:
            return
        if not self._path.parent.is_dir() or self._path.is_dir():
            raise ValueError(f"design.out: got {str(path)!r}, need a file in an existing folder")
        middle = jax.tree.map(lambda low, high: 0.5 * (low + high), problem.low, problem.high)
        rule = fingerprint(first_update, (optimizer, middle))
        self._digest = fingerprint(
            problem.terms, (middle,), problem.low, problem.high, rule, settings, History._fields
        )

    def read(self, states: DescentState) -> tuple[DescentState, History]:
        """States and history in the file; without a file the given states and an empty history.

        **Raises:** `ValueError` for a file of another computation.
        """
        if self._path is None or not self._path.exists():
            return states, _empty(states, 0)
        with self._path.open("rb") as file:
            header = _header(file.readline())
            if header.get("design") != self._digest:
                raise ValueError(
                    f"design.out: {self._path} belongs to another computation, need another file "
                    f"or the same call"
                )
            return eqx.tree_deserialise_leaves(file, (states, _empty(states, header["steps"])))

    def write(self, states: DescentState, history: History) -> None:
        """Replaces the file atomically."""
        if self._path is None:
            return
        header = {"design": self._digest, "steps": len(history.objective)}
        with replacing(self._path) as part, part.open("wb") as file:
            file.write(json.dumps(header).encode() + b"\n")
            eqx.tree_serialise_leaves(file, (jax.tree.map(jnp.asarray, states), history))


def _empty(states: DescentState, steps: int) -> History:
    """A history of zeros for a number of steps."""
    values = np.zeros((steps, *states.best.objective.shape), states.best.objective.dtype)
    return History(
        values, values, {name: np.zeros((steps, *z.shape), z.dtype) for name, z in states.z.items()}
    )


def _header(line: bytes) -> dict[str, Any]:
    try:
        header = json.loads(line)
    except ValueError:
        return {}
    return header if isinstance(header, dict) else {}
