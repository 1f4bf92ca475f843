"""Rigid bodies: plates, tools, grasped objects."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.description import Part
from ..typing import MatrixLike, Pose, Scalar, ScalarLike, VectorLike
from ..validation import numbers, rigid


class Body(Part):
    r"""A rigid body that arms carry. Joints say where they are fastened.

    **Arguments:**
    - `pose`: where the search for its equilibrium begins, a rigid transform of shape (4, 4), as
      from `vsr_jax.pose`; also where it lies in joints without a pose of their own.
    - `mass` [kg]: none by default; its weight acts at the `centre` [m], in its own axes.
    - `force` [N], `moment` [N m]: of the world, constant, at its origin; zero by default.

    **Raises:** `ValueError` for a pose that is not a rigid transform and a negative mass.
    """

    pose: Pose = eqx.field(metadata={"unit": "-", "pose": True})
    mass: Scalar | None = eqx.field(metadata={"unit": "kg"})
    centre: Float[Array, "3"] = eqx.field(metadata={"unit": "m"})
    force: Float[Array, "3"] = eqx.field(metadata={"unit": "N"})
    moment: Float[Array, "3"] = eqx.field(metadata={"unit": "N m"})

    def __init__(
        self,
        pose: MatrixLike,
        *,
        mass: ScalarLike | None = None,
        centre: VectorLike = (0.0, 0.0, 0.0),
        force: VectorLike = (0.0, 0.0, 0.0),
        moment: VectorLike = (0.0, 0.0, 0.0),
    ):
        self.pose = rigid("Body.pose", pose)
        self.mass = None if mass is None else numbers("Body.mass", mass, least=0.0)
        self.centre = numbers("Body.centre", centre, (3,))
        self.force = numbers("Body.force", force, (3,))
        self.moment = numbers("Body.moment", moment, (3,))

    def wrench(self, pose: Pose, gravity: Array) -> Float[Array, "6"]:
        """Moment [N m] about its origin in its own axes, and force [N] in the world's, on it in a
        pose."""
        force, moment = self.force, self.moment
        if self.mass is not None:
            weight = self.mass * gravity
            force, moment = force + weight, moment + jnp.cross(pose[:3, :3] @ self.centre, weight)
        return jnp.concatenate([pose[:3, :3].T @ moment, force])
