"""Sections of an arm that are held in space: pinned, clamped, guided, or by rows of one's own."""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.se3 import rotation_vector
from ..numerics.stacked import matmul, matvec, transpose
from ..typing import MatrixLike, Scalar, ScalarLike, VectorLike, real
from ..validation import is_traced, numbers, rigid
from .description import Part
from .pose_loads import Needs
from .rod import Rod


class Support(Part):
    r"""A section whose pose satisfies $g(R, r) = 0$.

    A subclass defines `deviation`, the rows g, and their `units`. The wrench that holds the
    section, the support reaction, is part of the solution: $\lambda \cdot \partial g$ with one
    unknown $\lambda$ for each row. The rows must not depend on each other, and be differentiable
    wherever a section may be.
    """

    X: eqx.AbstractVar[Scalar | None]
    effect: eqx.AbstractClassVar[str]

    @property
    @abstractmethod
    def units(self) -> tuple[str, ...]:
        """Unit of each row: "m" for lengths, "rad" for angles."""

    @abstractmethod
    def deviation(
        self, base: MatrixLike, rotation: MatrixLike, position: VectorLike
    ) -> Float[Array, " rows"]:
        """The rows g, for the pose of the base (4, 4), the rotation R (3, 3) and the position r
        (3,) [m] of the section."""

    @property
    def needs(self) -> Needs:
        r"""What of the pose the wrench $\lambda \cdot \partial g$ depends on."""
        return "pose"

    @property
    def fixed(self) -> bool:
        """Whether the section has a given place."""
        return False

    def place(self, rod: Rod) -> Scalar:
        """Abscissa [m]."""
        return rod.length if self.X is None else self.X

    def settled(self, rotation: MatrixLike, position: VectorLike) -> "Support":
        """The support of a section in that pose, where it is needed at rest; the same by
        default."""
        return self


class Held(Support):
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
    orientation: Float[Array, "3 3"] | None = eqx.field(metadata={"pose": True})
    along: Float[Array, "3"] | None
    effect = "held section"

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

    @property
    def units(self) -> tuple[str, ...]:
        lengths = 0 if self.position is None else 3 if self.along is None else 2
        angles = 0 if self.orientation is None else 3
        return (*(("m",) * lengths), *(("rad",) * angles))

    @property
    def needs(self) -> Needs:
        return "rotation"

    @property
    def fixed(self) -> bool:
        return self.position is not None

    def settled(self, rotation: MatrixLike, position: VectorLike) -> "Held":
        pose = (
            None if self.position is None else real(position),
            None if self.orientation is None else real(rotation),
        )
        return eqx.tree_at(
            lambda held: (held.position, held.orientation), self, pose, is_leaf=lambda x: x is None
        )

    def deviation(
        self, base: MatrixLike, rotation: MatrixLike, position: VectorLike
    ) -> Float[Array, " rows"]:
        r"""$e_j \cdot (r - p)$ and $e_j \cdot \log(R R_0^T)$, with the axes $e_j$ of the base where
        they can be: an arm in a plane, wherever it lies, cannot move along one of them, and its
        support does not push there."""
        axes, rows = real(base)[:3, :3], []
        if self.position is not None:
            apart = real(position) - self.position
            rows.append(matvec(transpose(self._directions(axes)), apart))
        if self.orientation is not None:
            off = rotation_vector(matmul(real(rotation), transpose(self.orientation)))
            rows.append(matvec(transpose(axes), off))
        return jnp.concatenate(rows)

    def _directions(self, axes: Array) -> Float[Array, "3 forces"]:
        """Unit vectors of the world in which its position is held, along `axes` where it can be."""
        return axes if self.along is None else directions_across(self.along, axes)


def directions_across(line: Float[Array, "3"], axes: Array) -> Float[Array, "3 2"]:
    """Two unit vectors across a line and each other, the first one across one of the `axes` too."""
    a = line / jnp.sqrt(jnp.sum(line**2))
    first = jnp.cross(a, axes[:, jnp.argmin(jnp.abs(axes.T @ a))])
    first = first / jnp.sqrt(jnp.sum(first**2))
    return jnp.stack([first, jnp.cross(a, first)], axis=1)


def _rotation(value: MatrixLike) -> Float[Array, "3 3"]:
    whole = jnp.asarray(value)
    if whole.shape == (3, 3):
        pose = jnp.eye(4, dtype=whole.dtype).at[:3, :3].set(whole)
        return rigid("Held.orientation", pose)[:3, :3]
    return rigid("Held.orientation", value)[:3, :3]
