r"""Tendons that run straight from hole to hole.

A tendon of force $\tau$ goes through holes $p_i = r(D_i) + R(D_i) d(D_i)$ in the base and the discs
of the arm. Its length is the sum of its chords, $l = \sum_i |p_{i+1} - p_i|$, with the direction
$e_i$ each. The derivative of that length by the strain at a section X between two holes is, in the
world frame, the wrench of a unit force in the chord,

$$w = ((p_i - r) \times e_i, \ e_i),$$

which takes the place of the column $(d \times t, t)$ of $B_\tau$. It depends on the strain up to
the next hole, so $\tau w$ is a part of the reaction at X.

Where the force $f_i = \tau e_i$ of a chord keeps its direction in space, the tangent is that of
dead forces at the holes. Beside that the chord turns,

$$\delta f_i = \frac{\tau}{|p_{i+1} - p_i|} (1 - e_i e_i^T) (\delta p_{i+1} - \delta p_i),$$

two springs across each taut chord: stiffness across the span between two discs (`chain.spans`),
whatever the number of tendons.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.rod import Rod
from ..arm.scene import Scene
from ..arm.thread_lines import hole_places, runs_between, steps_before
from ..chain import Spans
from ..mechanics.applied_load import AppliedLoad, Exerted, Loading, Pose, Slopes, starts_of
from ..mechanics.reaction import react
from ..numerics.component import Vector
from ..numerics.quadrature import Grid, collocation, weighted
from ..numerics.stacked import components, cross, dot, identity, transpose, turned


class StraightTendons(AppliedLoad):
    """All straight tendons of an arm on a grid. Each step of the grid lies in one span between
    neighbouring holes, or beyond the last.

    - `places`: their places among the threads.
    - `first`, `last`: shape (steps, steps + 1), 1 where the span of a step has its start and its
      end among the starts of the steps and the tip.
    - `opens`: 1 for the first step of each span, and for the steps in none, shape (steps,).
    - `runs`: 1 where a tendon runs through the span of a step, shape (tendons, steps).
    - `hole`, `next_hole`: where it crosses the sections at the start and the end of that span, y
      and z [m], shape (2, tendons, steps).
    """

    places: tuple[int, ...] = eqx.field(static=True)
    first: Array
    last: Array
    opens: Array
    runs: Array
    hole: Array
    next_hole: Array

    @property
    def motion(self) -> int:
        return 6

    @property
    def threads(self) -> tuple[int, ...]:
        return self.places

    def scaled(self, share: Array) -> "StraightTendons":
        """The same: it is the forces of the tendons that come by increments, not their way."""
        return self

    def absent(self) -> "StraightTendons":
        return self

    def exerted(self, pose: Pose) -> Exerted:
        pull = pull_of(self, pose)
        return Exerted(levered=pull.wrench, note=pull)

    def slopes(self, pose: Pose, exerted: Exerted, size: int) -> Slopes:
        pull: Pull = exerted.note
        return Slopes(ends=pull.slopes(), spans=pull.springs())


class Pull(NamedTuple):
    """The chords of the straight tendons in the world frame, for each step those of its span, with
    the arms of a batch in the last axes.

    - `hole`, `next_hole`: from the axis to the holes at the start and at the end of a chord, $R d$,
      `direction`, and `force` $f_i$, shape (3, tendons, steps); `length`, shape (tendons, steps).
    - `back`: from each node to the axis at the start of its span, shape (3, stages, steps).
    """

    tendons: StraightTendons
    hole: Array
    next_hole: Array
    direction: Array
    length: Array
    force: Array
    back: Array

    @property
    def wrench(self) -> Array:
        """Wrench (m, n) of all chords on the nodes, (6, stages, steps)."""
        return self._carried(jnp.sum(cross(self.hole, self.force), 1), jnp.sum(self.force, 1))

    def unit(self, place: int, rotation: Array, gain: Array | None = None) -> Vector:
        """Wrench of a unit force in the tendon at a place among the threads, on the nodes, in their
        frames; `gain`: of that force at the nodes, the same in each step."""
        i = self.tendons.places.index(place)
        force = self.tendons.runs[i] * self.direction[:, i]
        force = force if gain is None else gain[0] * force
        wrench = self._carried(cross(self.hole[:, i], force), force)
        return components(turned(transpose(rotation), wrench))

    def path_length(self, place: int, share: Array | None = None) -> Array:
        """Length of the tendon at a place among the threads, the sum of its chords [m]; each times
        a `share` at the nodes, if one is given."""
        i, own = self.tendons.places.index(place), self.tendons
        weight = own.opens if share is None else share[0] * own.opens
        return jnp.sum(weight * own.runs[i] * self.length[i], axis=0)

    def slopes(self) -> Array:
        r"""Derivatives (6, 6, steps) of the wrenches at the ends of the steps by the motions there:
        a force F at a hole q beside the axis has the moment $q \times F$, which changes by $(q F^T
        - q \cdot F) \theta$."""
        opens = self.tendons.opens
        closes = jnp.concatenate([opens[1:], jnp.ones_like(opens[:1])])
        ending = closes * _turning(self.next_hole, self.force)
        starting = opens * _turning(self.hole, -self.force)
        later = jnp.concatenate([starting[:, :, 1:], jnp.zeros_like(starting[:, :, :1])], axis=2)
        both = ending + later
        return jnp.pad(both, [(0, 3), (0, 3), *[(0, 0)] * (both.ndim - 2)])

    def springs(self) -> Spans:
        """The stiffness $-\\tau / l$ across each taut chord, in two directions."""
        e = self.direction
        along_x, along_y = (
            jnp.asarray(np.eye(3)[:, i], e.dtype).reshape(3, *(1,) * (e.ndim - 1)) for i in (0, 1)
        )
        across = cross(e, jnp.where(jnp.abs(e[:1]) < 0.7, along_x, along_y))
        across = across / jnp.sqrt(dot(across, across))
        root = jnp.sqrt(jnp.maximum(-dot(self.force, e), 0.0) / self.length)
        pulls = jnp.concatenate([root * across, root * cross(e, across)], axis=1)
        holes = (jnp.concatenate([q, q], axis=1) for q in (self.hole, self.next_hole))
        start, end = (jnp.concatenate([cross(q, pulls), pulls]) for q in holes)
        return Spans(-start, end, self.tendons.opens)

    def _carried(self, moment: Array, force: Array) -> Array:
        """Wrench (6, stages, steps) on the nodes of a moment and a force at the starts of the spans
        of all steps, (3, steps)."""
        force = jnp.broadcast_to(force[:, None], self.back.shape)
        return jnp.concatenate([moment[:, None] + cross(self.back, force), force])


def _turning(q: Array, F: Array) -> Array:
    """Sums (3, 3, steps) over the tendons of $q F^T - q \\cdot F$, both (3, tendons, steps)."""
    both = jnp.sum(q[:, None] * F[None], axis=2)
    return both - jnp.sum(dot(q, F), axis=0) * identity(both)


def straight_tendons_of(scene: Scene, grid: Grid) -> StraightTendons | None:
    """The straight tendons of a scene on a grid; None if it has none."""
    tendons = [scene.actuators[i] for i in scene.straight]
    if not tendons:
        return None
    X, (span, first, last) = hole_places(scene.rod), spans_of(scene.rod, grid)
    inside, ahead = span < X.size - 1, jnp.minimum(span + 1, X.size - 1)
    number, dtype = jnp.arange(grid.h.size + 1), grid.h.dtype
    at = [(x[:, None] == number).astype(dtype) for x in (first, last)]
    runs = jnp.stack([runs_between(scene.rod, tendon) for tendon in tendons])
    runs = jnp.where(inside, runs[:, jnp.minimum(span, X.size - 2)], 0.0)
    holes = jnp.stack([jnp.stack(jax.vmap(one.routing)(X)) for one in tendons], axis=1)
    opens = (first == number[:-1]).astype(dtype)
    return StraightTendons(
        scene.straight, at[0], at[1], opens, runs, holes[..., span], holes[..., ahead]
    )


def spans_of(rod: Rod, grid: Grid) -> tuple[Array, Array, Array]:
    """For each step of a grid the span between neighbouring holes in which it lies, the first step
    of that and the one after its last; beyond the last disc each step by itself."""
    every = jnp.arange(grid.h.size)
    begins = steps_before(grid, hole_places(rod))  # the step from each hole, their number at a tip
    span = jnp.sum(begins <= every[:, None], axis=1) - 1
    inside, ahead = span < begins.size - 1, jnp.minimum(span + 1, begins.size - 1)
    first = jnp.where(inside, begins[span], every)
    return span, first, jnp.where(inside, begins[ahead], every + 1)


def pull_of(tendons: StraightTendons, pose: Pose) -> Pull:
    """The chords of an arm, and their forces."""
    grid, axis = pose.grid, pose.axis
    base = jnp.zeros((3, *(1,) * (axis.ndim - 3)), axis.dtype)
    r = starts_of(base, axis, grid)
    r = jnp.concatenate([r, r[:, -1:] + jnp.sum(grid.weight * axis, axis=1)[:, -1:]], axis=1)
    R = jnp.concatenate([pose.starts, pose.end[:, :, None]], axis=2)
    frames = jnp.concatenate([r[:, None], R[:, 1:]], axis=1)  # point and directions of y and z
    start, end = (jnp.sum(at * frames[:, :, None], axis=3) for at in (tendons.first, tendons.last))
    hole, next_hole = (
        at[:, 1, None] * yz[0] + at[:, 2, None] * yz[1]
        for at, yz in ((start, tendons.hole), (end, tendons.next_hole))
    )
    some = jnp.asarray(np.eye(3)[:, :1], axis.dtype).reshape(3, *(1,) * (hole.ndim - 1))
    chord = jnp.where(tendons.runs > 0, (end[:, 0] - start[:, 0])[:, None] + next_hole - hole, some)
    length = jnp.sqrt(dot(chord, chord))
    direction = chord / length
    since = weighted(collocation(axis.shape[1]), grid.h * axis, axis=1)
    back = (start[:, 0] - r[:, :-1])[:, None] - since
    forces = (pose.forces[place] for place in tendons.places)
    tau = [x if x.ndim == axis.ndim - 2 else x[None] for x in forces]
    force = (jnp.stack(jnp.broadcast_arrays(*tau)) * tendons.runs) * direction
    return Pull(tendons, hole, next_hole, direction, length, force, back)


def pull_on(exerted: tuple[Exerted, ...], place: int) -> Pull | None:
    """The chords that a thread runs along, of what all loads exert; None where it runs along its
    path."""
    for one in exerted:
        if isinstance(one.note, Pull) and place in one.note.tendons.places:
            return one.note
    return None


def chords_of(scene: Scene, xi: Vector, grid: Grid) -> Pull:
    """The chords of the straight tendons of a scene without their forces."""
    tendons = straight_tendons_of(scene, grid)
    assert tendons is not None  # see `Scene.straight`
    forces = (jnp.zeros_like(scene.rod.length),) * len(scene.actuators)
    return react(xi, grid, Loading((tendons,), scene.rod.frame), forces).exerted[0].note
