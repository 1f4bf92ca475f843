"""A long descent kept in a file: written after every chunk of steps, taken up again by the call
that began it."""

import json
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..numerics.fingerprint import fingerprint
from .descent import Problem, State, Trace, first_update


class Checkpoint:
    """The file of one problem with its settings: a line of JSON, then the arrays.

    **Arguments:** `path`: the file, None to keep nothing; `problem`, `optimizer`, `settings`: what
    tells this descent from others.

    **Raises:** `ValueError` for a path that cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike | None,
        problem: Problem,
        optimizer: Any,
        settings: tuple[Any, ...],
    ):
        self._path = None if path is None else Path(path)
        if self._path is None:
            return
        if not self._path.parent.is_dir() or self._path.is_dir():
            raise ValueError(
                f"design.out: got {str(path)!r}, need a file in a folder that is there"
            )
        middle = jax.tree.map(lambda low, high: 0.5 * (low + high), problem.low, problem.high)
        rule = fingerprint(first_update, (optimizer, middle))
        self._digest = fingerprint(
            problem.terms, (middle,), problem.low, problem.high, rule, settings
        )

    def begun(self, states: State) -> tuple[State, Trace]:
        """Where the descent stands: as kept in the file, or at its first states.

        **Raises:** `ValueError` for a file that holds something else.
        """
        starts = states.best.objective.shape[0]
        none = np.zeros((0, starts), states.best.objective.dtype)
        if self._path is None or not self._path.exists():
            return states, Trace(none, none)
        with self._path.open("rb") as file:
            head = _head(file.readline())
            if head.get("design") != self._digest:
                raise ValueError(
                    f"design.out: {self._path} holds something else, need another file or the "
                    f"call that made it"
                )
            like = np.zeros((head["steps"], starts), none.dtype)
            return eqx.tree_deserialise_leaves(file, (states, Trace(like, like)))

    def write(self, states: State, trace: Trace) -> None:
        """Keeps where the descent stands; a process that dies in it leaves what was kept before."""
        if self._path is None:
            return
        part = self._path.with_name(self._path.name + ".part")
        with part.open("wb") as file:
            file.write(
                json.dumps({"design": self._digest, "steps": len(trace.objective)}).encode() + b"\n"
            )
            eqx.tree_serialise_leaves(file, (jax.tree.map(jnp.asarray, states), trace))
        part.replace(self._path)


def _head(line: bytes) -> dict[str, Any]:
    try:
        head = json.loads(line)
    except ValueError:
        return {}
    return head if isinstance(head, dict) else {}
