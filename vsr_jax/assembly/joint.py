"""Joints between a section of an arm and a body or the ground."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.description import Part
from ..arm.held import Support, directions_across
from ..arm.pose_loads import Needs
from ..numerics.se3 import rotation_vector
from ..typing import MatrixLike, Pose, Scalar, ScalarLike, VectorLike, real
from ..validation import choice, concrete, count, numbers, rigid

Kind = Literal["fixed", "ball", "hinge", "slider"]


class Joint(Part):
    r"""A joint between a section of an arm and a body or the ground.

    With the pose $(R_0, r_0)$ of the joint and $(R, r)$ of the section,

    - `"fixed"`: $r = r_0, \; R = R_0$,
    - `"ball"`: $r = r_0$,
    - `"hinge"`: $r = r_0, \; R a = R_0 a$: it turns about a,
    - `"slider"`: $R = R_0, \; r = r_0 + s R_0 a$ with any s: it slides along a.

    **Arguments:**
    - `arm`: index of the arm, from 0.
    - `body`: index of the body, from 0; None is the ground.
    - `kind`: as above.
    - `X` [m]: abscissa of the section, the tip by default. 0 is the base, which the body then
      carries; it can only be fixed.
    - `pose`: of the joint in the axes of the body, of the ground in those of the world, shape
      (4, 4). By default the joint is where the section lies at rest, with the body in its own pose.
    - `axis`: a, in the axes of the section; of hinges and sliders, z by default.

    **Raises:** `ValueError` for another kind, a base that is not fixed, an axis that is zero.
    """

    arm: int = eqx.field(static=True)
    body: int | None = eqx.field(static=True)
    kind: Kind = eqx.field(static=True)
    X: Scalar | None = eqx.field(metadata={"unit": "m"})
    pose: Pose | None = eqx.field(metadata={"unit": "-", "pose": True})
    axis: Float[Array, "3"] | None
    at_base: bool = eqx.field(static=True)

    def __init__(
        self,
        arm: int,
        body: int | None = None,
        kind: Kind = "fixed",
        *,
        X: ScalarLike | None = None,
        pose: MatrixLike | None = None,
        axis: VectorLike | None = None,
    ):
        self.arm = count("Joint.arm", arm, least=0)
        self.body = None if body is None else count("Joint.body", body, least=0)
        self.kind = choice("Joint.kind", kind, ("fixed", "ball", "hinge", "slider"))
        self.X = None if X is None else numbers("Joint.X", X, least=0.0)
        self.pose = None if pose is None else rigid("Joint.pose", pose)
        if axis is not None and kind not in ("hinge", "slider"):
            raise ValueError(f"Joint.axis: got {axis!r} with kind={kind!r}, which has no axis")
        self.axis = None
        if kind in ("hinge", "slider"):
            self.axis = numbers("Joint.axis", (0.0, 0.0, 1.0) if axis is None else axis, (3,))
            known = concrete(self.axis)
            if known is not None and not np.any(known):
                raise ValueError("Joint.axis: got (0, 0, 0), need a direction")
        known = None if self.X is None else concrete(self.X)
        self.at_base = known is not None and bool(np.all(known == 0))
        if self.at_base and kind != "fixed":
            raise ValueError(f"Joint.kind: got {kind!r} at X = 0, need 'fixed' for a base")

    def in_world(self, poses: Float[Array, "bodies 4 4"]) -> Pose:
        """Its pose in the world, with the bodies in some poses; of a joint that has a pose."""
        assert self.pose is not None
        return self.pose if self.body is None else poses[self.body] @ self.pose

    def moved(self, pose: Pose) -> "Joint":
        """The joint with another pose."""
        return eqx.tree_at(lambda j: j.pose, self, pose, is_leaf=lambda x: x is None)

    def support(self, frame: Pose) -> "JointSupport":
        """The joint as its arm has it, in a pose in the world."""
        return JointSupport(self.X, frame, self.axis, self.kind)


class JointSupport(Support):
    """The joint as the arm has it: a section held in the `frame` of the joint in the world."""

    X: Scalar | None
    frame: Pose
    axis: Float[Array, "3"] | None
    kind: Kind = eqx.field(static=True)
    effect = "joint"

    def __init__(self, X: Scalar | None, frame: Pose, axis: Float[Array, "3"] | None, kind: Kind):
        self.X, self.frame, self.axis, self.kind = X, frame, axis, kind

    @property
    def units(self) -> tuple[str, ...]:
        lengths, angles = {"fixed": (3, 3), "ball": (3, 0), "hinge": (3, 2), "slider": (2, 3)}[
            self.kind
        ]
        return (*(("m",) * lengths), *(("rad",) * angles))

    @property
    def needs(self) -> Needs:
        return "pose" if self.kind == "slider" else "rotation"

    @property
    def fixed(self) -> bool:
        return True

    def settled(self, rotation: MatrixLike, position: VectorLike) -> "JointSupport":
        frame = self.frame.at[:3, :3].set(real(rotation)).at[:3, 3].set(real(position))
        return eqx.tree_at(lambda one: one.frame, self, frame)

    def deviation(
        self, base: MatrixLike, rotation: MatrixLike, position: VectorLike
    ) -> Float[Array, " rows"]:
        frame = self.frame[:3, :3]
        apart = frame.T @ (real(position) - self.frame[:3, 3])
        turn = frame.T @ real(rotation)
        if self.kind == "ball":
            return apart
        if self.kind == "fixed":
            return jnp.concatenate([apart, rotation_vector(turn)])
        assert self.axis is not None
        across = directions_across(self.axis, jnp.eye(3, dtype=self.axis.dtype)).T
        if self.kind == "hinge":
            a = self.axis / jnp.sqrt(jnp.sum(self.axis**2))
            return jnp.concatenate([apart, across @ (turn @ a)])
        return jnp.concatenate([across @ apart, rotation_vector(turn)])
