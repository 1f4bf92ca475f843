r"""Loads that depend on the pose of their section, on a grid: their wrenches and the derivatives of
these with respect to small motions of the sections.

A motion of a section is $z = \theta$, its rotation in the world frame, or $z = (\theta, \rho)$ with
its displacement, if some load depends on positions.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.pose_loads import PoseLoad
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..numerics.batching import arms_in
from ..numerics.quadrature import Grid, before_point
from ..numerics.se3 import base_pose
from ..numerics.stacked import matmul, skew


class PoseTerm(NamedTuple):
    """A load that depends on the pose of its section, the rod, and the fraction of the load that
    acts; its abscissa and, as for `FollowerPoint`, the number of steps and the nodes before it. For
    a load per length the abscissas are those of the nodes, and the rest is None."""

    load: PoseLoad
    rod: Rod
    share: Array
    X: Array
    step: Array | None
    before: Array | None

    def wrench(self, rotation: Array, position: Array | None) -> Array:
        """Wrench or density in the world frame, (6, ...), where the sections have a rotation (3, 3,
        ...) and a position (3, ...); None if no load depends on it."""

        def of_section(load: PoseLoad, *section: Any) -> Array:
            return load.wrench(*section)

        return self.share * self._each(of_section, rotation, position)

    def slope(self, rotation: Array, position: Array | None, size: int) -> Array:
        """Derivative (6, `size`, ...) of `wrench` with respect to the motion z."""

        def of_section(load: PoseLoad, rod: Rod, X: Array, R: Array, r: Array) -> Array:
            def moved(z: Array) -> Array:
                shifted = r + z[3:] if size > 3 else r
                return load.wrench(rod, X, R + matmul(skew(z[:3]), R), shifted)

            return jax.jacfwd(moved)(jnp.zeros(size, R.dtype))

        return self.share * self._each(of_section, rotation, position)

    def size(self, base: Array | None, motion: int) -> Array:
        """Size (6, ...) of the wrench and of its change as the section turns by 1 rad and moves by
        the length of the arm, for a straight arm."""
        g = jnp.asarray(base_pose(base, self.share.dtype))
        axes = (1,) * (self.X.ndim - self.share.ndim)
        rotation, first = g[:3, :3], g[:3, 3]
        rotation = rotation.reshape(3, 3, *axes, *self._behind(rotation, 2))
        first = first.reshape(3, *axes, *self._behind(first, 1))
        position = first + rotation[:, 0] * self.X
        rotation = jnp.broadcast_to(rotation, (3, 3, *position.shape[1:]))
        slope = jnp.abs(self.slope(rotation, position, motion))
        total = jnp.abs(self.wrench(rotation, position)) + jnp.sum(slope[:, :3], axis=1)
        return total + self.rod.length * jnp.sum(slope[:, 3:], axis=1)

    def _behind(self, x: Array, components: int) -> tuple[int, ...]:
        """Axes of the arms of an array that may have none."""
        return x.shape[components:] or (1,) * self.share.ndim

    def _each(self, function: Callable, rotation: Array, position: Array | None) -> Array:
        """A function of every section of every arm, its axes in front of those of the sections."""
        behind = self.share.ndim
        arms = arms_in((self, rotation, position), behind)
        nodes = rotation.shape[2 : rotation.ndim - behind]
        place = jnp.zeros_like(rotation[0]) if position is None else position
        X = jnp.broadcast_to(self.X, (*nodes, *self.X.shape[self.X.ndim - behind :]))

        def listed(x: Array, components: int) -> Array:
            return x.reshape(*x.shape[:components], -1, *x.shape[x.ndim - behind :])

        of_arm = jax.vmap(function, (None, None, 0, 2, 1), -1)
        arguments = self.load, self.rod, listed(X, 0), listed(rotation, 2), listed(place, 1)
        if behind:
            arguments = jax.tree.map(
                lambda x: jnp.broadcast_to(x, (*x.shape[: x.ndim - behind], *arms)), arguments
            )
            of_arm = jax.vmap(of_arm, -1, -1)
        found = of_arm(*arguments)
        return found.reshape(*found.shape[: found.ndim - 1 - behind], *nodes, *arms)


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


def base_of(base: Array, axes: int) -> Array:
    """Position (3, ...) of the base with as many axes of arms, of size 1 where they are missing."""
    return base.reshape(3, *base.shape[1:], *(1,) * (axes + 1 - base.ndim))


def starts_of(base: Array, axis: Array, grid: Grid) -> Array:
    """Positions (3, steps, *arms) of the starts of the steps, for the axis p' (3, stages, steps,
    *arms) at the nodes."""
    parts = jnp.sum(grid.weight * axis, axis=1)
    return base_of(base, parts.ndim - 2)[:, None] + jnp.cumsum(parts, axis=1) - parts


def finite(tree: Any) -> Any:
    """Zero in place of all numbers that are not finite."""
    return jax.tree.map(lambda x: jnp.where(jnp.isfinite(x), x, jnp.zeros_like(x)), tree)
