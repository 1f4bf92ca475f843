"""The loads of a scene at the nodes of a grid."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import Scene
from ..numerics.quadrature import Grid, before_point, beyond
from ..numerics.stacked import stack
from .chords import Discs, discs_of
from .pose_terms import PoseTerm, finite, pose_terms
from .touch import Surroundings


class FollowerPoint(NamedTuple):
    """A wrench that follows a section: the number of steps before it, 1 at the nodes before it and
    0 beyond, and the wrench (6,) in the body frame."""

    step: Array
    before: Array
    wrench: Array


class Loading(NamedTuple):
    r"""The loads of a scene on a grid, arrays of shape (6, stages, steps); None for those that are
    absent.

    - `dead`: wrench $(\sum M_i + \int c, n)$ of the world-frame loads beyond each node, known in
      advance; `dead_density`: $(c, f)$ in the world frame;
    - `follower_density`: $(c, f)$ in the body frame; `follower_points`: wrenches at points in the
      body frame;
    - `by_pose`: loads that depend on the pose of their section;
    - `discs`: tendons that run straight from disc to disc;
    - `around`: the obstacles and the contact forces;
    - `base`: pose of the base, the identity for None.
    """

    dead: Array | None
    dead_density: Array | None
    follower_density: Array | None
    follower_points: tuple[FollowerPoint, ...]
    by_pose: tuple[PoseTerm, ...]
    discs: Discs | None
    base: Array | None
    around: Surroundings | None = None

    @property
    def only_discs(self) -> bool:
        """Whether there are no loads, only straight tendons."""
        dead = self.dead is None and self.follower_density is None
        return dead and not (self.follower_points or self.by_pose or self.around)

    @property
    def turns_chords(self) -> bool:
        """Whether loads turn the chords of straight tendons."""
        return self.discs is not None and not self.only_discs

    @property
    def motion(self) -> int:
        """Size of the motions of sections by which wrenches in the world frame change: 0 for dead
        loads, 3 (rotation) or 6 (and displacement)."""
        if self.around is not None or any(term.load.needs == "pose" for term in self.by_pose):
            return 6
        turns = self.by_pose or self.follower_points
        return 3 if turns or self.follower_density is not None or self.discs is not None else 0

    @property
    def conservative(self) -> Array | bool:
        """Whether all loads have a potential: no follower loads, no dead moments in space."""
        if self.follower_density is not None or self.follower_points:
            return False
        if not all(term.load.conservative for term in self.by_pose):
            return False
        return True if self.dead is None else jnp.all(self.dead[:3] == 0, axis=(0, 1, 2))

    def scaled(self, share: Array) -> "Loading":
        """A fraction of all loads."""
        return self._mapped(lambda x: share * x)

    def absent(self) -> "Loading":
        """Zero in place of all loads."""
        terms = tuple(
            term._replace(load=finite(term.load), rod=finite(term.rod)) for term in self.by_pose
        )
        return self._replace(by_pose=terms)._mapped(jnp.zeros_like)

    def _mapped(self, function: Callable[[Array], Array]) -> "Loading":
        """A function of every component of the loads."""
        points = tuple(
            point._replace(wrench=jax.tree.map(function, point.wrench))
            for point in self.follower_points
        )
        return self._replace(
            dead=jax.tree.map(function, self.dead),
            dead_density=jax.tree.map(function, self.dead_density),
            follower_density=jax.tree.map(function, self.follower_density),
            follower_points=points,
            by_pose=tuple(term._replace(share=function(term.share)) for term in self.by_pose),
        )


def loading(scene: Scene, grid: Grid) -> Loading | None:
    """The loads and straight tendons of a scene on a grid; None if it has none."""
    if not scene.reacts:
        return None
    dead_density, follower_density = (scene.density(grid.X, frame) for frame in ("world", "body"))
    density = None if dead_density is None else stack(dead_density)
    follower = None if follower_density is None else stack(follower_density)
    parts = [] if density is None else [beyond(density, grid)]
    for X, wrench in scene.point_wrenches("world"):
        parts.append(jnp.where(grid.X < X, stack(wrench)[:, None, None], 0.0))
    dead = sum(parts[1:], parts[0]) if parts else None
    points = tuple(
        FollowerPoint(*before_point(grid, X), stack(wrench))
        for X, wrench in scene.point_wrenches("body")
    )
    by_pose, discs = pose_terms(scene, grid), discs_of(scene, grid)
    return Loading(dead, density, follower, points, by_pose, discs, scene.rod.frame)
