r"""Tendons that run straight from hole to hole.

A tendon of force $\tau$ goes through holes $p_i = r(D_i) + R(D_i) d(D_i)$. Its length is the sum of
its chords, $l = \sum_i |p_{i+1} - p_i|$, with the direction $e_i$ each. The derivative of that
length by the strain at a section X between two holes is, in the world frame, the wrench of a unit
force in the chord,

$$w = ((p_i - r) \times e_i, \ e_i),$$

which takes the place of the column $(d \times t, t)$ of $B_\tau$. It depends on the strain up to
the next hole, so $\tau w$ is a part of the reaction at X.

Where the force $f_i = \tau e_i$ of a chord keeps its direction in space, the tangent is that of
dead forces at the holes. Beside that the chord turns,

$$\delta f_i = \frac{\tau}{|p_{i+1} - p_i|} (1 - e_i e_i^T) (\delta p_{i+1} - \delta p_i),$$

two springs across each taut chord: a change of the tangent of rank two.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.discs import steps_before
from ..arm.scene import Scene
from ..mechanics.applied_load import AppliedLoad, Exerted, Loading, Pose, Slopes
from ..mechanics.reaction import react
from ..numerics.component import Vector
from ..numerics.quadrature import Grid, collocation, weighted
from ..numerics.stacked import components, cross, dot, identity, transpose, turned


class Discs(AppliedLoad):
    """All straight tendons of an arm on a grid, their holes one after another.

    - `places`: their places among the threads. `hole_counts`: the number of holes of each.
    - `at`: shape (holes, steps + 1), 1 where a hole lies among the starts of the steps and the tip.
    - `before`: shape (holes, steps), 1 for the steps before each hole.
    - `y`, `z`: where the holes cross their sections [m], shape (holes,).
    """

    places: tuple[int, ...] = eqx.field(static=True)
    hole_counts: tuple[int, ...] = eqx.field(static=True)
    at: Array
    before: Array
    y: Array
    z: Array
    local = True

    @property
    def motion(self) -> int:
        return 3

    @property
    def threads(self) -> tuple[int, ...]:
        return self.places

    def scaled(self, share: Array) -> "Discs":
        """The same: it is the forces of the tendons that come by increments, not their way."""
        return self

    def absent(self) -> "Discs":
        return self

    def exerted(self, pose: Pose) -> Exerted:
        pull = pull_of(self, pose)
        return Exerted(levered=pull.wrench, note=pull)

    def slopes(self, pose: Pose, exerted: Exerted, size: int, *, alone: bool) -> Slopes:
        pull: Pull = exerted.note
        if alone:
            return Slopes(ends=pull.cut_slopes(size), joined=pull.joined)
        return Slopes(ends=pull.slopes(size))

    def spans(self, pose: Pose, exerted: Exerted, *, alone: bool) -> Vector:
        return exerted.note.springs(pose.rotation, cut=alone)

    @property
    def first(self) -> np.ndarray:
        """Index of the first hole of each chord."""
        last = np.cumsum(self.hole_counts) - 1
        return np.setdiff1d(np.arange(last[-1]), last)

    @property
    def owner(self) -> np.ndarray:
        """For each chord the index of its tendon among the straight ones."""
        return np.repeat(np.arange(len(self.hole_counts)), np.array(self.hole_counts) - 1)


class Chords(NamedTuple):
    """The chords of an arm in the world frame, with the arms of a batch in the last axes.

    - `lever`: from each node to the first hole of a chord, shape (3, chords, stages, steps).
    - `direction`: shape (3, chords). `length`: shape (chords,).
    - `arms`: from the axis to the holes, $R d$, shape (3, holes).
    """

    lever: Array
    direction: Array
    length: Array
    arms: Array


class Pull(NamedTuple):
    """The chords of the straight tendons and their forces $f_i$, shape (3, chords)."""

    discs: Discs
    chords: Chords
    force: Array

    @property
    def wrench(self) -> Array:
        """Wrench (m, n) of all chords on the nodes, (6, stages, steps)."""
        return self.carried(self.force)

    def carried(self, force: Array) -> Array:
        """Wrench on the nodes, in the world frame, of forces (3, chords) along the chords."""
        return jnp.sum(self._each(force), axis=1)

    def _each(self, force: Array) -> Array:
        """The same chord by chord, (6, chords, stages, steps)."""
        force = jnp.broadcast_to(force[:, :, None, None], self.chords.lever.shape)
        first, before = self.discs.first, self.discs.before
        over = before[first + 1] - before[first]
        return over[:, None] * jnp.concatenate([cross(self.chords.lever, force), force])

    def across(self, force: Array, *, cut: bool) -> Array:
        """Wrenches chord by chord of forces (3, chords) in any direction, with the moments
        $(p_{i+1} - p_i) \\times f_i$ of both ends of a chord on the sections before it; where the
        arm is `cut`, only on those of the same piece."""
        first = self.discs.first
        before = self.discs.before[first + 1]
        if cut:
            piece = jnp.cumsum(
                jnp.concatenate([jnp.zeros_like(self.joined[:1]), 1.0 - self.joined[:-1]]), axis=0
            )
            own = jnp.sum(self.discs.at[first, :-1] * piece, axis=1)
            before = before * (piece == own[:, None])
        moment = cross(self.chords.length * self.chords.direction, force)
        moment = before[:, None] * moment[:, :, None, None]
        return self._each(force) + jnp.concatenate([moment, jnp.zeros_like(moment)])

    def length(self, place: int) -> Array:
        """Length of the tendon at a place among the threads, the sum of its chords [m]."""
        return jnp.sum(self.chords.length[self._of(place)], axis=0)

    def unit(self, place: int, rotation: Array) -> Vector:
        """Wrench of a unit force in a tendon on the nodes, in their frames."""
        own = jnp.asarray(self._of(place)).reshape(-1, *(1,) * (self.force.ndim - 2))
        force = jnp.where(own, self.chords.direction, 0.0)
        return components(turned(transpose(rotation), self.carried(force)))

    def _of(self, place: int) -> np.ndarray:
        """Whether each chord belongs to the tendon at a place among the threads."""
        return self.discs.owner == self.discs.places.index(place)

    @property
    def joined(self) -> Array:
        """1 for each step over whose end a chord passes, shape (steps,): at all other ends the arm
        can be cut, without loads."""
        first, before = self.discs.first, self.discs.before
        over = before[first + 1] - before[first]
        after = jnp.concatenate([over[:, 1:], jnp.zeros_like(over[:, :1])], axis=1)
        return jnp.max(over * after, axis=0)

    def cut_slopes(self, motion: int) -> Array:
        """`slopes` of an arm that is cut where no chord passes: there only the chords before the
        cut act at their holes."""
        joined, first = self.joined, self.discs.first
        incoming = jnp.zeros_like(self.chords.arms).at[:, first + 1].add(self.force)
        return joined * self.slopes(motion) + (1.0 - joined) * self._at_steps(incoming, motion)

    def springs(self, rotation: Array, *, cut: bool) -> Vector:
        r"""Wrenches $w_j$ on the nodes, in their frames, for which the turning of the chords adds
        $\sum_j w_j w_j^T$ to the tangent: component arrays (2 chords, stages, steps)."""
        e = self.chords.direction
        along_x = jnp.asarray(np.eye(3)[:, 0], e.dtype).reshape(3, *(1,) * (e.ndim - 1))
        along_y = jnp.asarray(np.eye(3)[:, 1], e.dtype).reshape(3, *(1,) * (e.ndim - 1))
        across = cross(e, jnp.where(jnp.abs(e[:1]) < 0.7, along_x, along_y))
        across = across / jnp.sqrt(dot(across, across))
        root = jnp.sqrt(self.stiffness)
        both = []
        for unit in (across, cross(e, across)):
            both.append(turned(transpose(rotation)[:, :, None], self.across(root * unit, cut=cut)))
        return components(jnp.concatenate(both, axis=1))

    @property
    def stiffness(self) -> Array:
        """Stiffness $-\\tau / l$ across each taut chord [N/m], zero across a slack one."""
        return jnp.maximum(-dot(self.force, self.chords.direction), 0.0) / self.chords.length

    def slopes(self, motion: int) -> Array:
        r"""Derivatives (6, motion, steps) of the wrenches at the ends of the steps by the rotations
        there: a force F at a hole q beside the axis has the moment $q \times F$, which changes by
        $(q F^T - q \cdot F) \theta$."""
        first = self.discs.first
        at_holes = jnp.zeros_like(self.chords.arms)
        at_holes = at_holes.at[:, first + 1].add(self.force).at[:, first].add(-self.force)
        return self._at_steps(at_holes, motion)

    def _at_steps(self, F: Array, motion: int) -> Array:
        """`slopes` for forces (3, holes) in the holes."""
        q = self.chords.arms
        at_holes = q[:, None] * F[None]
        at_holes = at_holes - dot(q, F) * identity(at_holes)
        at_steps = jnp.sum(self.discs.at[:, 1:] * at_holes[:, :, :, None], axis=2)
        none = [(0, 0)] * (at_steps.ndim - 2)
        return jnp.pad(at_steps, [(0, 3), (0, motion - 3), *none])


def discs_of(scene: Scene, grid: Grid) -> Discs | None:
    """The straight tendons of a scene on a grid; None if it has none."""
    tendons = [(i, scene.actuators[i]) for i in scene.straight]
    if not tendons:
        return None
    holes = [tendon.holes(scene.rod.length) for _, tendon in tendons]
    paths = [jax.vmap(tendon.routing)(X) for X, (_, tendon) in zip(holes, tendons, strict=True)]
    step = jnp.concatenate([steps_before(grid, X) for X in holes])[:, None]
    places, sizes = tuple(i for i, _ in tendons), tuple(X.size for X in holes)
    dtype, every = grid.h.dtype, jnp.arange(grid.h.size + 1)
    y, z = (jnp.concatenate(x) for x in zip(*paths, strict=True))
    at, before = step == every, every[:-1] < step
    return Discs(places, sizes, at.astype(dtype), before.astype(dtype), y, z)


def pull_of(discs: Discs, pose: Pose) -> Pull:
    """The chords of an arm, and their forces."""
    grid, axis = pose.grid, pose.axis
    R = jnp.concatenate([pose.starts, pose.end[:, :, None]], axis=2)
    run = jnp.sum(grid.weight * axis, axis=1)
    r = jnp.cumsum(jnp.concatenate([jnp.zeros_like(run[:, :1]), run], axis=1), axis=1)
    here = jnp.sum(discs.at * R[:, 1:, None], axis=3)
    arms = here[:, 0] * discs.y + here[:, 1] * discs.z
    p = jnp.sum(discs.at * r[:, None], axis=2) + arms
    first = discs.first
    chord = p[:, first + 1] - p[:, first]
    length = jnp.sqrt(dot(chord, chord))
    direction = chord / length
    since = weighted(collocation(axis.shape[1]), grid.h * axis, axis=1)
    lever = p[:, first][:, :, None, None] - r[:, None, None, :-1] - since[:, None]
    tau = jnp.stack(jnp.broadcast_arrays(*(pose.forces[place] for place in discs.places)))
    return Pull(discs, Chords(lever, direction, length, arms), tau[discs.owner] * direction)


def pull_on(exerted: tuple[Exerted, ...], place: int) -> Pull | None:
    """The chords that a thread runs along, of what all loads exert; None where it runs along its
    path."""
    for one in exerted:
        if isinstance(one.note, Pull) and place in one.note.discs.places:
            return one.note
    return None


def chords_of(scene: Scene, xi: Vector, grid: Grid) -> Pull:
    """The chords of the straight tendons of a scene without their forces."""
    discs = discs_of(scene, grid)
    assert discs is not None  # see `Scene.straight`
    forces = (jnp.zeros_like(scene.rod.length),) * len(scene.actuators)
    return react(xi, grid, Loading((discs,), scene.rod.frame), forces).exerted[0].note
