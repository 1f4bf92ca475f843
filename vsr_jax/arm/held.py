"""Held sections: points of an arm that are pinned, clamped or guided in space."""

from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..typing import MatrixLike, Scalar, ScalarLike, VectorLike, real
from ..validation import is_traced, numbers, rigid
from .description import Part
from .rod import Rod


class Held(Part):
    r"""A section held in space: its position r(X), its orientation R(X), or both.

    $$r(X) = p, \quad R(X) = R_0,$$

    or $r(X) = p + s\,a$ with any s for a section that slides along a line. The wrench that holds
    the section, the support reaction, is part of the solution.

    **Arguments:**
    - `X`: abscissa of the section [m], above 0, the tip by default.
    - `position`: p [m] in the world, None if the section may move.
    - `orientation`: $R_0$, a rotation (3, 3) or a pose (4, 4) whose rotation counts, None if the
      section may turn.
    - `along`: direction a of the line along which the section slides, None if it does not.

    **Raises:** `ValueError` if nothing is held, for an orientation that is not a rotation, for a
    direction that is zero or comes without a position.
    """

    X: Scalar | None = eqx.field(metadata={"unit": "m"})
    position: Float[Array, "3"] | None = eqx.field(metadata={"unit": "m"})
    orientation: Float[Array, "3 3"] | None
    along: Float[Array, "3"] | None
    effect: ClassVar[str] = "held section"

    def __init__(
        self,
        X: ScalarLike | None = None,
        *,
        position: VectorLike | None = None,
        orientation: MatrixLike | None = None,
        along: VectorLike | None = None,
    ):
        if position is None and orientation is None:
            raise ValueError(
                "Held: got neither a position nor an orientation, need one of them or both"
            )
        if along is not None and position is None:
            raise ValueError("Held.along: got a direction without a position, need both")
        self.X = None if X is None else numbers("Held.X", X, positive=True)
        self.position = None if position is None else numbers("Held.position", position, (3,))
        self.orientation = None if orientation is None else _rotation(orientation)
        self.along = None if along is None else numbers("Held.along", along, (3,))
        if self.along is not None and not is_traced(self.along) and not jnp.any(self.along != 0):
            raise ValueError("Held.along: got (0, 0, 0), need a direction")

    def place(self, rod: Rod) -> Scalar:
        """Abscissa [m]."""
        return rod.length if self.X is None else self.X

    def directions(self, axes: MatrixLike) -> Float[Array, "3 forces"] | None:
        """Unit vectors of the world in which its position is held, along `axes` where it can be;
        None if it may move."""
        if self.position is None:
            return None
        axes = real(axes)
        if self.along is None:
            return axes
        a = self.along / jnp.sqrt(jnp.sum(self.along**2))
        first = jnp.cross(a, axes[:, jnp.argmin(jnp.abs(axes.T @ a))])
        first = first / jnp.sqrt(jnp.sum(first**2))
        return jnp.stack([first, jnp.cross(a, first)], axis=1)


def _rotation(value: MatrixLike) -> Float[Array, "3 3"]:
    whole = jnp.asarray(value)
    if whole.shape == (3, 3):
        pose = jnp.eye(4, dtype=whole.dtype).at[:3, :3].set(whole)
        return rigid("Held.orientation", pose)[:3, :3]
    return rigid("Held.orientation", value)[:3, :3]
