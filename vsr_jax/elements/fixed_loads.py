"""Loads that are known in the world frame, dead loads, or in the frame of their section, follower
loads."""

from dataclasses import replace

import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import Scene
from ..mechanics.applied_load import AppliedLoad, Exerted, Pose, Slopes
from ..numerics.quadrature import Grid, before_point, beyond
from ..numerics.stacked import rows, skew, stack, turned


class DeadLoad(AppliedLoad):
    r"""All loads that are fixed in the world frame: `wrench` $(\sum M_i + \int c, n)$ by what acts
    beyond each node, known in advance, and `density` $(c, f)$, both (6, stages, steps); None where
    there is none."""

    wrench: Array
    density: Array | None

    @property
    def conservative(self) -> Array:
        """Whether there are no moments: these have no potential in space."""
        return jnp.all(self.wrench[:3] == 0, axis=(0, 1, 2))

    def scaled(self, share: Array) -> "DeadLoad":
        return DeadLoad(share * self.wrench, None if self.density is None else share * self.density)

    def absent(self) -> "DeadLoad":
        density = None if self.density is None else jnp.zeros_like(self.density)
        return DeadLoad(jnp.zeros_like(self.wrench), density)

    def exerted(self, pose: Pose) -> Exerted:
        return Exerted(self.wrench, self.density)

    def sizes(self, length: Array, base: Array | None, motion: int) -> list[Array]:
        return [self.wrench] if self.density is None else [length * self.density, self.wrench]


class _Follower(AppliedLoad):
    @property
    def conservative(self) -> bool:
        return False

    @property
    def motion(self) -> int:
        return 3


class FollowerDensity(_Follower):
    """All loads per length that follow their sections: `density` $(c, f)$ (6, stages, steps) in the
    frames of these."""

    density: Array

    def scaled(self, share: Array) -> "FollowerDensity":
        return FollowerDensity(share * self.density)

    def absent(self) -> "FollowerDensity":
        return FollowerDensity(jnp.zeros_like(self.density))

    def exerted(self, pose: Pose) -> Exerted:
        density = turned(pose.rotation, self.density)
        return Exerted(beyond(density, pose.grid), density, note=density)

    def slopes(self, pose: Pose, exerted: Exerted, size: int) -> Slopes:
        return Slopes(density=_turning(exerted.note, size))

    def sizes(self, length: Array, base: Array | None, motion: int) -> list[Array]:
        return [length * self.density]


class FollowerPoint(_Follower):
    """A wrench that follows a section: the number of steps before it, 1 at the nodes before it and
    0 beyond, and the `wrench` (6,) in its frame."""

    step: Array
    before: Array
    wrench: Array

    def scaled(self, share: Array) -> "FollowerPoint":
        return replace(self, wrench=share * self.wrench)

    def absent(self) -> "FollowerPoint":
        return replace(self, wrench=jnp.zeros_like(self.wrench))

    def exerted(self, pose: Pose) -> Exerted:
        wrench = turned(pose.rotation_at(self.step), self.wrench)
        return Exerted(self.before * wrench[:, None, None], note=wrench)

    def slopes(self, pose: Pose, exerted: Exerted, size: int) -> Slopes:
        return Slopes(ends=at_end(self.step, _turning(exerted.note, size), pose.grid))

    def sizes(self, length: Array, base: Array | None, motion: int) -> list[Array]:
        return [self.wrench[:, None, None]]


def fixed_loads(scene: Scene, grid: Grid) -> tuple[AppliedLoad, ...]:
    """The loads of a scene that are known in a frame, on a grid."""
    found: list[AppliedLoad] = []
    density, follower = (scene.density(grid.X, frame) for frame in ("world", "body"))
    density = None if density is None else stack(density)
    parts = [] if density is None else [beyond(density, grid)]
    for X, wrench in scene.point_wrenches("world"):
        parts.append(jnp.where(grid.X < X, stack(wrench)[:, None, None], 0.0))
    if parts:
        found.append(DeadLoad(sum(parts[1:], parts[0]), density))
    for X, wrench in scene.point_wrenches("body"):
        found.append(FollowerPoint(*before_point(grid, X), stack(wrench)))
    if follower is not None:
        found.append(FollowerDensity(stack(follower)))
    return tuple(found)


def at_end(step: Array, slope: Array, grid: Grid) -> Array:
    """A derivative (6, size) of what acts at the end of the step before one, on all steps."""
    there = jnp.arange(grid.h.shape[0]).reshape(-1, *(1,) * step.ndim) == step - 1
    return there.astype(grid.h.dtype) * slope[:, :, None]


def _turning(wrench: Array, size: int) -> Array:
    """Derivative (6, size, ...) of a wrench that turns with its section."""
    turn = jnp.concatenate([-skew(rows(wrench, 0, 3)), -skew(rows(wrench, 3, 6))])
    return turn if size == 3 else jnp.concatenate([turn, jnp.zeros_like(turn)], axis=1)
