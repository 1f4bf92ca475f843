"""What exerts wrenches on an arm: the interface of loads that are applied to the nodes of a grid.

All arrays of one arm have the arms of a batch in further axes at their end.
"""

from abc import abstractmethod
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..chain import Spans
from ..numerics.component import Forces
from ..numerics.quadrature import Grid, before, sum_along
from ..numerics.se3 import base_pose


class Pose(NamedTuple):
    """Where the sections of an arm are, in the world frame.

    **Fields:** rotations at the `starts` of the steps (3, 3, steps), at the `end` of the arm (3, 3)
    and at the nodes, `rotation` (3, 3, stages, steps); the `axis` $p'$ at the nodes (3, stages,
    steps); the pose of the `base`, the identity for None; the `grid`; the `forces` [N] of the
    threads at their start.
    """

    starts: Array
    end: Array
    rotation: Array
    axis: Array
    base: Array | None
    grid: Grid
    forces: Forces

    def rotation_at(self, step: Array) -> Array:
        """Rotation at the start of a step, or at the end of the arm for the step after the last."""
        whole = jnp.concatenate([self.starts, self.end[:, :, None]], axis=2)
        here = jnp.arange(whole.shape[2]).reshape(-1, *(1,) * step.ndim) == step
        return jnp.sum(jnp.where(here, whole, 0.0), axis=2)

    def positions(self) -> Array:
        """Positions of the nodes (3, stages, steps)."""
        return self._first[:, None, None] + before(self.axis, self.grid)

    def position_behind(self, nodes: Array) -> Array:
        """Position (3,) of the section behind the nodes where an array is 1."""
        return (self._first[:, None, None] + sum_along(nodes * self.axis, self.grid))[:, 0, 0]

    @property
    def _first(self) -> Array:
        base = jnp.asarray(base_pose(self.base, self.grid.h.dtype))[:3, 3]
        return base_of(base, self.axis.ndim - 3)


class Exerted(NamedTuple):
    """What a load exerts on an arm in one pose, wrenches (6, stages, steps) in the world frame,
    None where there is none.

    **Fields:** `wrench`: on each node by all that acts beyond it, without the levers of its forces;
    `density`: per length; `levered`: as `wrench`, the levers included; `note`: what the load needs
    of it later.
    """

    wrench: Array | None = None
    density: Array | None = None
    levered: Array | None = None
    note: Any = None


class Slopes(NamedTuple):
    """How a load changes with the motions of the sections, for `Coupled`: `density`, `ends` and
    `spans` there; None where nothing changes."""

    density: Array | None = None
    ends: Array | None = None
    spans: Spans | None = None


class AppliedLoad(eqx.Module):
    """A load on the nodes of a grid.

    - `conservative`: whether it has a potential.
    - `motion`: size of the motions of sections by which it changes: 0 for a dead load, 3 (rotation)
      or 6 (and displacement).
    """

    @property
    def conservative(self) -> Array | bool:
        return True

    @property
    def motion(self) -> int:
        return 0

    @property
    def threads(self) -> tuple[int, ...]:
        """Threads whose force it exerts: they do not run along the sections."""
        return ()

    @abstractmethod
    def scaled(self, share: Array) -> "AppliedLoad":
        """A fraction of it."""

    @abstractmethod
    def absent(self) -> "AppliedLoad":
        """Zero in place of it, also where its numbers are not finite."""

    @abstractmethod
    def exerted(self, pose: Pose) -> Exerted:
        """What it exerts."""

    def slopes(self, pose: Pose, exerted: Exerted, size: int) -> Slopes:
        """Its derivatives by motions of a `size`. None by default, of a dead load."""
        return Slopes()

    def within_step(
        self, exerted: Exerted, step: Array, sigma: Array, *, smooth: bool
    ) -> Array | None:
        """Wrench (6, ...) on places in steps, where it jumps within these, less that on the first
        node; `smooth`: with each jump spread over its step. It does not by default."""
        return None

    def sizes(self, length: Array, base: Array | None, motion: int) -> list[Array]:
        """Sizes (6, stages, steps) of its wrenches on a straight arm; none by default."""
        return []


class Loading(NamedTuple):
    """All loads of an arm; `base`: its pose, the identity for None."""

    loads: tuple[AppliedLoad, ...]
    base: Array | None

    def having(self, more: tuple[AppliedLoad, ...]) -> "Loading":
        """These loads and more."""
        return self._replace(loads=(*self.loads, *more))

    def without_threads(self) -> "Loading | None":
        """These loads without those that are forces of threads; None if there are no others."""
        others = tuple(load for load in self.loads if not load.threads)
        return self._replace(loads=others) if others else None

    @property
    def motion(self) -> int:
        """Size of the motions of sections by which the loads change."""
        return max((load.motion for load in self.loads), default=0)

    @property
    def conservative(self) -> Array | bool:
        """Whether all loads have a potential."""
        found = True
        for load in self.loads:
            found = load.conservative & found
        return found

    @property
    def threads(self) -> tuple[int, ...]:
        """Threads that do not run along the sections."""
        return tuple(place for load in self.loads for place in load.threads)

    def along_sections(self, tau: Forces) -> Forces:
        """Forces of the threads that run along the sections, zero for the others."""
        elsewhere = self.threads
        return tuple(
            jnp.zeros_like(force) if i in elsewhere else force for i, force in enumerate(tau)
        )

    def along_chords(self, forces: Forces, shares: tuple[Array | None, ...]) -> Forces:
        """Forces of the threads at their start, but of those that do not run along the sections in
        each step: times their share at its first node."""
        elsewhere = self.threads
        return tuple(
            force if share is None or i not in elsewhere else force * share[0]
            for i, (force, share) in enumerate(zip(forces, shares, strict=True))
        )

    def scaled(self, share: Array) -> "Loading":
        """A fraction of all loads."""
        return self._replace(loads=tuple(load.scaled(share) for load in self.loads))

    def absent(self) -> "Loading":
        """Zero in place of all loads."""
        return self._replace(loads=tuple(load.absent() for load in self.loads))


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
