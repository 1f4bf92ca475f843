r"""Loads that depend on the pose of their section, on a grid: their wrenches and the derivatives of
these with respect to small motions of the sections.

A motion of a section is $z = \theta$, its rotation in the world frame, or $z = (\theta, \rho)$ with
its displacement, if some load depends on positions.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.pose_loads import PoseLoad
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..mechanics.applied_load import AppliedLoad, Exerted, Pose, Slopes, finite
from ..numerics.batching import arms_in, of_each_arm
from ..numerics.quadrature import Grid, before_point, beyond
from ..numerics.se3 import base_pose
from ..numerics.stacked import matmul, skew
from .fixed_loads import at_end


class PoseTerm(AppliedLoad):
    """A load that depends on the pose of its section, the rod, and the fraction of the load that
    acts; its abscissa and, as for `FollowerPoint`, the number of steps and the nodes before it. For
    a load per length the abscissas are those of the nodes, and the rest is None."""

    load: PoseLoad
    rod: Rod
    share: Array
    X: Array
    step: Array | None
    before: Array | None

    @property
    def conservative(self) -> bool:
        return self.load.conservative

    @property
    def motion(self) -> int:
        return 6 if self.load.needs == "pose" else 3

    def scaled(self, share: Array) -> "PoseTerm":
        return replace(self, share=share * self.share)

    def absent(self) -> "PoseTerm":
        load, rod = finite((self.load, self.rod))
        return replace(self, load=load, rod=rod, share=jnp.zeros_like(self.share))

    def section(self, pose: Pose) -> tuple[Array, Array | None]:
        """Rotation and position where it acts; None for a position that it does not depend on."""
        needed = self.motion == 6
        if self.step is None or self.before is None:
            return pose.rotation, pose.positions() if needed else None
        place = pose.position_behind(self.before) if needed else None
        return pose.rotation_at(self.step), place

    def exerted(self, pose: Pose) -> Exerted:
        rotation, position = section = self.section(pose)
        here = self.wrench(rotation, position)
        if self.before is None:
            return Exerted(beyond(here, pose.grid), here, note=section)
        return Exerted(self.before * here[:, None, None], note=section)

    def slopes(self, pose: Pose, exerted: Exerted, size: int) -> Slopes:
        rotation, position = exerted.note
        here = self.slope(rotation, position, size)
        if self.step is None:
            return Slopes(density=here)
        return Slopes(ends=at_end(self.step, here, pose.grid))

    def wrench(self, rotation: Array, position: Array | None) -> Array:
        """Wrench or density in the world frame, (6, ...), where the sections have a rotation (3, 3,
        ...) and a position (3, ...); None if no load depends on it."""

        def of_section(load: PoseLoad, *section: Any) -> Array:
            return load.wrench(*section)

        return self.share * self.each(of_section, rotation, position)

    def slope(self, rotation: Array, position: Array | None, size: int) -> Array:
        """Derivative (6, `size`, ...) of `wrench` with respect to the motion z."""

        def of_section(load: PoseLoad, rod: Rod, X: Array, R: Array, r: Array) -> Array:
            def moved(z: Array) -> Array:
                shifted = r + z[3:] if size > 3 else r
                return load.wrench(rod, X, R + matmul(skew(z[:3]), R), shifted)

            return jax.jacfwd(moved)(jnp.zeros(size, R.dtype))

        return self.share * self.each(of_section, rotation, position)

    def sizes(self, length: Array, base: Array | None, motion: int) -> list[Array]:
        """Of the wrench and of its change as the section turns by 1 rad and moves by the length of
        the arm."""
        g = jnp.asarray(base_pose(base, self.share.dtype))
        axes = (1,) * (self.X.ndim - self.share.ndim)
        rotation, first = g[:3, :3], g[:3, 3]
        rotation = rotation.reshape(3, 3, *axes, *self._behind(rotation, 2))
        first = first.reshape(3, *axes, *self._behind(first, 1))
        position = first + rotation[:, 0] * self.X
        rotation = jnp.broadcast_to(rotation, (3, 3, *position.shape[1:]))
        slope = jnp.abs(self.slope(rotation, position, motion))
        total = jnp.abs(self.wrench(rotation, position)) + jnp.sum(slope[:, :3], axis=1)
        total = total + self.rod.length * jnp.sum(slope[:, 3:], axis=1)
        return [length * total if self.step is None else total[:, None, None]]

    def each(self, function: Callable, rotation: Array, position: Array | None) -> Array:
        """A function of the load, the rod, the abscissa, the rotation and the position of every
        section of every arm, its axes in front of those of the sections."""
        behind = self.share.ndim
        arms = arms_in((self, rotation, position), behind)
        nodes = rotation.shape[2 : rotation.ndim - behind]
        place = jnp.zeros_like(rotation[0]) if position is None else position
        X = jnp.broadcast_to(self.X, (*nodes, *self.X.shape[self.X.ndim - behind :]))

        def listed(x: Array, components: int) -> Array:
            return x.reshape(*x.shape[:components], -1, *x.shape[x.ndim - behind :])

        of_arm = jax.vmap(function, (None, None, 0, 2, 1), -1)
        arguments = self.load, self.rod, listed(X, 0), listed(rotation, 2), listed(place, 1)
        found = of_each_arm(of_arm, arms, *arguments)
        return found.reshape(*found.shape[: found.ndim - 1 - behind], *nodes, *arms)

    def _behind(self, x: Array, components: int) -> tuple[int, ...]:
        """Axes of the arms of an array that may have none."""
        return x.shape[components:] or (1,) * self.share.ndim


def pose_terms(scene: Scene, grid: Grid) -> tuple[PoseTerm, ...]:
    """The loads of a scene that depend on the pose of their section."""
    terms = []
    for load in scene.pose_loads:
        X, one = load.place(scene.rod), jnp.ones_like(grid.h[0])
        if X is None:
            terms.append(PoseTerm(load, scene.rod, one, grid.X, None, None))
        else:
            terms.append(PoseTerm(load, scene.rod, one, X, *before_point(grid, X)))
    return tuple(terms)
