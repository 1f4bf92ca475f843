r"""Held sections: constraints on the position and the orientation of cross-sections.

The unknowns are the components of the support reaction, a force F and a moment M at the section.
The rows are

$$k \, e_j \cdot (r(X) - p), \quad k_\theta \, e_j \cdot \log(R(X) R_0^T),$$

with the held directions $e_j$ and stiffnesses $k = 3 EI / L^3$ and $k_\theta = 3 EI / L$ that only
scale them. The work of a unit force or moment over a change of strain is the change of the position
or rotation, so that rows and columns of the tangent are the same wrenches at the nodes. The
directions are the axes of the base where they can be: an arm in a plane, wherever it lies, cannot
move along one of them, and its support does not push there.

On the way to a solution that Newton's method does not find at once, springs with a thousand times
those stiffnesses stand for the constraints: their energy shows whether a step is an advance.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.held import Held
from ..arm.pose_loads import Needs, PoseLoad
from ..arm.rod import Rod
from ..arm.scene import CrossSections, Scene
from ..chain.border import Border
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, before_point, beyond, sum_along
from ..numerics.se3 import base_pose, rotation_vector
from ..numerics.stacked import (
    components,
    cross,
    dot,
    matmul,
    matvec,
    rows as rows_of,
    stack,
    transpose,
    turned,
)
from ..typing import MatrixLike, Scalar, ScalarLike, VectorLike, real
from .coupling import SOFTENED, ArmProblem, ArmState, Coupling
from .loading import Loading
from .pose_terms import PoseTerm, base_of, finite
from .reaction import Reaction, rotation_at, rotations
from .sizes import shape_of, softest

_SPRING = 1e3
"""Stiffness of the springs that stand for constraints, in multiples of their scale."""


class Hold(NamedTuple):
    """A held section: its abscissa, the number of steps before it and 1 at the nodes before it; the
    `axes` of moments (3, 3); the held directions (3, n) and the position (3,) in which it is held,
    None if it may move; the orientation (3, 3) in which it is held, None if it may turn; both at
    rest."""

    X: Array
    step: Array
    before: Array
    axes: Array
    directions: Array | None
    position: Array | None
    orientation: Array | None
    rest: Array
    rotation: Array

    @property
    def rows(self) -> tuple[int, int]:
        """Number of forces and of moments."""
        forces = 0 if self.directions is None else self.directions.shape[1]
        return forces, 0 if self.orientation is None else 3

    def at_rest(self) -> "Hold":
        """The section held in its pose at rest."""
        return self._replace(
            position=None if self.position is None else self.rest,
            orientation=None if self.orientation is None else self.rotation,
        )

    def force(self, x: Array) -> Array:
        """Wrench (6, ...) of the force for the unknowns of this section."""
        zero = jnp.zeros((3, *x.shape[1:]), x.dtype)
        if self.directions is None:
            return jnp.concatenate([zero, zero])
        force = matvec(self.directions, x[: self.rows[0]])
        return jnp.concatenate([jnp.zeros_like(force), force])

    def wrench(self, x: Array) -> Array:
        """Moment and force (6, ...) for the unknowns of this section."""
        forces, moments = self.rows
        force = self.force(x)
        moment = matvec(self.axes, x[forces:]) if moments else jnp.zeros_like(force[3:])
        return jnp.concatenate([moment, force[3:]])


class Holds(Coupling):
    """All held sections of an arm; the unknowns are the components of the support reactions [N]
    and [N m], shape (components, ...).

    **Fields:** `holds`; the `rod` and the position of its `base`; `scale`, the stiffnesses that
    scale deviations to forces and moments, and `lengths`, those that scale them to numbers, one per
    component; `soft`: 1 where springs stand for the constraints.
    """

    holds: tuple[Hold, ...]
    rod: Rod
    base: Array
    scale: Array
    lengths: Array
    soft: Array | None = None
    softens = True

    def relaxed(self) -> "Holds":
        return replace(finite(self), holds=tuple(hold.at_rest() for hold in self.holds))

    def softened(self, hardness: Array) -> "Holds":
        return replace(self, soft=(hardness < SOFTENED).astype(self.scale.dtype))

    def like(self, other: Coupling) -> bool:
        if not isinstance(other, Holds):
            return False
        return [one.rows for one in self.holds] == [one.rows for one in other.holds]

    def guess(self, forces: Forces, grid: Grid) -> Float[Array, "components ..."]:
        return jnp.zeros((len(self.scale), *grid.h.shape[1:]), grid.h.dtype)

    def loads(self, x: Array, loads: Loading | None) -> Loading | None:
        assert loads is not None
        dead, terms, soft = loads.dead, [], self.soft
        pairs = zip(self.holds, self._parts(x), self._parts(self.scale), strict=True)
        for hold, part, scale in pairs:
            part = part if soft is None else (1 - soft) * part
            forces, _ = hold.rows
            if forces:
                force = hold.before * hold.force(part)[:, None, None]
                dead = force if dead is None else dead + force
            if hold.orientation is not None:
                moment = HoldingMoment(matvec(hold.axes, part[forces:]), hold.orientation)
                terms.append(PoseTerm(moment, self.rod, jnp.ones_like(scale[0]), *hold[:3]))
            if soft is not None:
                terms.append(PoseTerm(self._spring(hold, scale), self.rod, soft, *hold[:3]))
        return loads._replace(dead=dead, by_pose=(*loads.by_pose, *terms))

    def wrenches(self, x: Array) -> Float[Array, "supports 6"]:
        """Moment and force of each support in the world frame, for the unknowns of one arm."""
        parts = zip(self.holds, self._parts(x), strict=True)
        return jnp.stack([hold.wrench(part) for hold, part in parts])

    def note(self, x: Array, at: ArmState, problem: ArmProblem) -> Array:
        """Deviations from what is held, positions [m] and rotations [rad]."""
        along = at.along
        assert along is not None
        off = [part for hold in self.holds for part in self._deviation(hold, along, problem.grid)]
        return jnp.concatenate(off)

    def residual(
        self, x: Array, at: ArmState, note: Array, problem: ArmProblem, free: tuple[int, ...]
    ) -> Array:
        if self.soft is None:
            return self.scale * note
        return self._stiff * note + self.soft * x

    def border(self, x: Array, at: ArmState, note: Array, problem: ArmProblem) -> Border:
        assert at.along is not None
        units = [
            hold.before * hold.wrench(unit.reshape(-1, *(1,) * (x.ndim - 1)))[:, None, None]
            for hold in self.holds
            for unit in jnp.eye(sum(hold.rows), dtype=x.dtype)
        ]
        wrenches = of_forces(stack(tuple(units)), at.along, problem.grid)
        soft = jnp.zeros_like(x) if self.soft is None else jnp.broadcast_to(self.soft, x.shape)
        act = -(1 - soft)[:, None, None]
        return Border(tuple(act * part for part in wrenches), wrenches, self._stiff, soft)

    def sizes(self, x: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        length, sizes = problem.length, []
        for hold, part in zip(self.holds, self._parts(x), strict=True):
            wrench = jnp.abs(hold.wrench(part))[:, None, None]
            moment = rows_of(wrench, 0, 3) + length * jnp.sum(rows_of(wrench, 3, 6), axis=0)
            whole = (*components(moment), *components(rows_of(wrench, 3, 6)))
            sizes.append(shape_of(whole, problem.sections, length))
        return sizes

    def row_sizes(self, rows: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Deviations per length of the arm, and angles."""
        return [rows / (self.scale * self.lengths)]

    def units(self, problem: ArmProblem) -> tuple[Array, Array]:
        root = jnp.sqrt(self.scale)
        return 1 / root, root

    def radians(self, problem: ArmProblem) -> Array:
        return 1 / (self.scale * self.lengths)

    @property
    def _stiff(self) -> Array:
        """Factors from deviations to rows."""
        return self.scale if self.soft is None else self.scale * (1 + self.soft * (_SPRING - 1))

    def _parts(self, x: Array) -> list[Array]:
        """The entries of each section."""
        return jnp.split(x, np.cumsum([sum(hold.rows) for hold in self.holds])[:-1])

    def _deviation(self, hold: Hold, along: Reaction, grid: Grid) -> list[Array]:
        axes, found = along.axis.ndim - 3, []
        if hold.directions is not None and hold.position is not None:
            position = base_of(self.base, axes) + sum_along(hold.before * along.axis, grid)[:, 0, 0]
            found.append(matvec(transpose(hold.directions), position - hold.position))
        if hold.orientation is not None:
            R = rotation_at(along.starts, along.end, hold.step)
            vector = rotation_vector
            for _ in range(axes):
                vector = jax.vmap(vector, -1, -1)
            off = vector(matmul(R, transpose(hold.orientation)))
            found.append(matvec(transpose(hold.axes), off))
        return found

    def _spring(self, hold: Hold, scale: Array) -> "HoldingSpring":
        return HoldingSpring(
            hold.directions,
            hold.position,
            hold.orientation,
            _SPRING * scale[0],
            _SPRING * scale[-1],
        )


class HoldingMoment(PoseLoad):
    r"""The moment that holds an orientation, $V = -\mu \cdot \log (R R_0^T)$: at $R = R_0$ it is
    $\mu$, and unlike a dead moment it has a potential."""

    moment: Array
    orientation: Array
    effect = "moment of a held section"

    def __init__(self, moment: Array, orientation: Array):
        self.moment, self.orientation, self.frame = moment, orientation, "world"

    @property
    def needs(self) -> Needs:
        return "rotation"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        off = rotation_vector(matmul(real(rotation), transpose(self.orientation)))
        return -dot(self.moment, off)


class HoldingSpring(PoseLoad):
    r"""Springs that stand for a held section, $V = \tfrac12 k |E^T (r - p)|^2 + \tfrac12 k_\theta
    |\log (R R_0^T)|^2$."""

    directions: Array | None
    position: Array | None
    orientation: Array | None
    push: Array
    turn: Array
    effect = "spring of a held section"

    def __init__(
        self,
        directions: Array | None,
        position: Array | None,
        orientation: Array | None,
        push: Array,
        turn: Array,
    ):
        self.directions, self.position, self.orientation = directions, position, orientation
        self.push, self.turn, self.frame = push, turn, "world"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        energy = jnp.zeros_like(self.push)
        if self.directions is not None and self.position is not None:
            apart = matvec(transpose(self.directions), real(position) - self.position)
            energy += 0.5 * self.push * dot(apart, apart)
        if self.orientation is not None:
            off = rotation_vector(matmul(real(rotation), transpose(self.orientation)))
            energy += 0.5 * self.turn * dot(off, off)
        return energy


def of_forces(world: Array, along: Reaction, grid: Grid) -> Vector:
    """Wrench in the body frame at the nodes, with levers, by wrenches (m, 6, stages, steps, ...) in
    the world frame beyond them: six components of shape (m, stages, steps, ...)."""

    def one(wrench: Array) -> Array:
        lever = beyond(cross(along.axis, rows_of(wrench, 3, 6)), grid)
        moment = rows_of(wrench, 0, 3) + lever
        force = jnp.broadcast_to(rows_of(wrench, 3, 6), moment.shape)
        return turned(transpose(along.rotation), jnp.concatenate([moment, force]))

    return components(jnp.moveaxis(jax.vmap(one)(world), 1, 0))


def holds_of(scene: Scene, sections: CrossSections, grid: Grid) -> Holds | None:
    """The held sections of a scene; None if it has none."""
    if not scene.held:
        return None
    base = jnp.asarray(base_pose(scene.rod.frame, grid.h.dtype))
    axes = base[:3, :3]
    rest = stack(tuple(jnp.broadcast_to(x, grid.X.shape) for x in sections.rest))
    starts, R, end = rotations(rows_of(rest, 0, 3), grid.h, base)
    axis = matvec(R, rows_of(rest, 3, 6))

    def hold(held: Held) -> Hold:
        X = held.place(scene.rod)
        step, before = before_point(grid, X)
        rotation = rotation_at(starts, end, step)
        place = base[:3, 3] + sum_along(before * axis, grid)[:, 0, 0]
        ways = held.directions(axes)
        return Hold(X, step, before, axes, ways, held.position, held.orientation, place, rotation)

    holds, length = tuple(map(hold, scene.held)), jnp.sum(grid.h)
    units = [
        unit
        for one in holds
        for unit in (*[length] * one.rows[0], *[jnp.ones_like(length)] * one.rows[1])
    ]
    lengths = jnp.stack(units)
    bending = jnp.sum(grid.weight * softest(sections.stiffness))
    scale = 3 * bending / (length * lengths) ** 2
    return Holds(holds, scene.rod, base[:3, 3], scale, lengths)
