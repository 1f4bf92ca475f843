"""Pieces of an arm that do not bend: couplings, thick discs, a tool at the tip."""

from collections.abc import Sequence
from itertools import pairwise

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..typing import ArrayLike, Scalar, ScalarLike, real
from ..validation import ROUNDING, is_traced, numbers
from .description import Part


class RigidPiece(Part):
    """A piece of an arm that does not bend: its strain is exactly the rest strain, for any wrench.

    Everything else is as elsewhere on the arm: the section and the density give its weight, loads
    act on it, and threads follow their paths through it. The moduli of the rod do not matter there.

    **Arguments:**
    - `start`, `end`: abscissas of its ends [m], by default the arm's base and tip.

    **Raises:** `ValueError` for an end that is not beyond the start, if both are known. `Scene`
    raises it for a piece beyond the arm, for pieces that overlap, and for an arm that is rigid all
    over.
    """

    start: Scalar | None = eqx.field(metadata={"unit": "m"})
    end: Scalar | None = eqx.field(metadata={"unit": "m"})

    def __init__(self, start: ScalarLike | None = None, end: ScalarLike | None = None):
        self.start = None if start is None else numbers("RigidPiece.start", start, least=0.0)
        self.end = None if end is None else numbers("RigidPiece.end", end, positive=True)
        if not any(x is None or is_traced(x) for x in (self.start, self.end)):
            _check_order("RigidPiece", *self.ends(0.0))

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] of its ends on the arm."""
        return tuple(x for x in (self.start, self.end) if x is not None)

    def ends(self, length: ScalarLike) -> tuple[float, float]:
        """Known abscissas of its ends [m] on an arm of a known length."""
        return (
            0.0 if self.start is None else float(self.start),
            float(length if self.end is None else self.end),
        )

    def covers(self, X: ArrayLike) -> Array:
        """Whether X [m], of any shape, lies on it, the ends included."""
        X = real(X)
        here = jnp.ones_like(X, bool) if self.start is None else self.start <= X
        return here if self.end is None else here & (self.end >= X)


def check_pieces(name: str, pieces: Sequence[RigidPiece], length: float) -> None:
    """Raises `ValueError` for pieces of known numbers that are empty, beyond an arm of a known
    length or overlap, and if they leave nothing of it that bends."""
    slack, ends = ROUNDING * length, [piece.ends(length) for piece in pieces]
    for i, (start, end) in enumerate(ends):
        for what, x in (("start", start), ("end", end)):
            if x > length + slack:
                raise ValueError(
                    f"{name}[{i}].{what}: got {x:g} m, need a place on the arm of {length:g} m"
                )
        _check_order(f"{name}[{i}]", start, end)
    order = sorted(range(len(ends)), key=ends.__getitem__)
    for i, j in pairwise(order):
        if ends[j][0] < ends[i][1] - slack:
            raise ValueError(
                f"{name}[{j}].start: got {ends[j][0]:g} m within {name}[{i}], which is from "
                f"{ends[i][0]:g} to {ends[i][1]:g} m; need pieces that do not overlap"
            )
    if sum(end - start for start, end in ends) > length - slack:
        raise ValueError(
            f"{name}: got pieces that cover all of the arm of {length:g} m, need a part of it that "
            f"bends"
        )


def _check_order(name: str, start: float, end: float) -> None:
    if not start < end:
        raise ValueError(
            f"{name}.end: got end = {end:g} m and start = {start:g} m, need an end beyond the start"
        )
