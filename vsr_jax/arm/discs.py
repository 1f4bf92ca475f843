"""The discs of an arm: plates across it, with a hole for each thread."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..typing import ArrayLike, Scalar, ScalarLike, VectorLike, real
from ..validation import concrete, count, numbers
from .description import Part

SAME = 1e-6
"""Distance of two abscissas, as a share of the length, below which they are the same disc."""


class Discs(Part):
    """Discs across a rod. The threads of the arm go through holes in them, which follow their
    routings; a `Tendon` with `straight=True` runs in straight lines between them.

    **Arguments:**
    - `number`: how many there are, evenly spaced with the last one at the tip.
    - `places`: in place of their number, their abscissas [m], positive and ascending. What clamps
      the arm at X = 0 has holes too and is not counted.
    - `radius`: of their rims [m], by default not known. It is part of the outline of the arm:
      threads must be inside, and obstacles are touched there.
    - `mass`: of each disc [kg], one number or one for each; `Gravity` acts on it.
    - `thickness`: [m], of discs that hold the arm between their faces as a `RigidPiece` does; by
      default they do not stiffen it. The abscissa of a disc is that of its face towards the tip.
    """

    number: int | None = eqx.field(static=True)
    places: Float[Array, " discs"] | None = eqx.field(metadata={"unit": "m"})
    radius: Scalar | None = eqx.field(metadata={"unit": "m"})
    mass: Scalar | Float[Array, " discs"] | None = eqx.field(metadata={"unit": "kg"})
    thickness: Scalar | None = eqx.field(metadata={"unit": "m"})

    def __init__(
        self,
        number: int | None = None,
        *,
        places: VectorLike | None = None,
        radius: ScalarLike | None = None,
        mass: VectorLike | None = None,
        thickness: ScalarLike | None = None,
    ):
        if (number is None) == (places is None):
            raise ValueError(
                f"Discs: got number={number!r} and places={places!r}, need one of the two"
            )
        self.number = None if number is None else count("Discs.number", number)
        self.places = None if places is None else _checked(places)
        self.radius = None if radius is None else numbers("Discs.radius", radius, positive=True)
        self.mass = None if mass is None else numbers("Discs.mass", mass, None, least=0.0)
        if self.mass is not None and self.mass.shape not in ((), (self.size,)):
            raise ValueError(
                f"Discs.mass: got shape {self.mass.shape}, need one mass or {self.size}, one for "
                f"each disc"
            )
        self.thickness = (
            None if thickness is None else numbers("Discs.thickness", thickness, positive=True)
        )

    @property
    def size(self) -> int:
        """How many there are."""
        if self.number is not None:
            return self.number
        assert self.places is not None  # one of the two is given
        return self.places.size

    def along(self, length: ScalarLike) -> Float[Array, " discs"]:
        """Abscissas [m] of the discs on an arm of `length` [m], ascending."""
        if self.places is not None:
            return self.places
        length, size = real(length), self.size
        return length * jnp.arange(1, size + 1, dtype=length.dtype) / size

    def faces(self, length: ScalarLike) -> Float[Array, " faces"]:
        """Abscissas [m] of the ends of their holes, ascending: two for each disc with a thickness,
        else one."""
        X = self.along(length)
        if self.thickness is None:
            return X
        return jnp.stack([X - self.thickness, X], axis=1).reshape(-1)

    def stiffen(self, X: ArrayLike, length: ScalarLike) -> Array:
        """Whether X [m], of any shape, lies between the faces of a disc with a thickness."""
        X = real(X)
        if self.thickness is None:
            return jnp.zeros_like(X, bool)
        behind = self.along(length) - X[..., None]
        return jnp.any((behind >= 0) & (behind <= self.thickness), axis=-1)


def _checked(places: VectorLike) -> Float[Array, " discs"]:
    found = numbers("Discs.places", places, None, positive=True)
    if found.ndim != 1 or not found.size:
        raise ValueError(
            f"Discs.places: got shape {found.shape}, need abscissas in a row, one or more"
        )
    known = concrete(found)
    if known is not None and np.any(np.diff(known) <= 0):
        raise ValueError(f"Discs.places: got {places!r}, need ascending abscissas")
    return found
