r"""Supports: constraints on the poses of cross-sections.

The unknowns are forces $\lambda$ and the rows $k \, g(R, r)$, with the rows g of a support (see
`arm.held`) and stiffnesses $k = 3 EI / L^3$ of lengths and $3 EI / L$ of angles, which only scale
them. A support exerts the wrench of the potential $-\lambda \cdot g$. The work of that wrench for a
unit force over a change of strain is the change of the row, so that rows and columns of the tangent
are the same wrenches at the nodes.

On the way to a solution that Newton's method does not find at once, springs with a thousand times
those stiffnesses stand for the constraints: their energy shows whether a step is an advance.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.held import Support
from ..arm.pose_loads import Needs, PoseLoad
from ..arm.rod import Rod
from ..arm.scene import CrossSections, Scene
from ..chain import Border
from ..mechanics.applied_load import Exerted, Pose, finite
from ..mechanics.coupling import SOFTENED, ArmProblem, ArmState, Constraint, Coupling, Scales
from ..mechanics.reaction import Reaction, rotations
from ..mechanics.sizes import softest
from ..numerics.batching import arms_in, of_each_arm
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, before_point, beyond
from ..numerics.se3 import base_pose
from ..numerics.stacked import (
    components,
    cross,
    dot,
    matmul,
    matvec,
    rows as rows_of,
    skew,
    stack,
    transpose,
    turned,
)
from ..typing import MatrixLike, Scalar, ScalarLike, VectorLike
from .pose_term import PoseTerm

_SPRING = 1e3
"""Stiffness of the springs that stand for constraints, in multiples of their scale."""


class SupportForce(PoseLoad):
    r"""What a support exerts, $V = -(1 - s) \lambda \cdot g + \tfrac{s}{2} \sum_j k_j g_j^2$ with
    its `force` $\lambda$, or springs of the `stiffness` k in its place where s, `soft`, is 1; it is
    0 for None. `base`: pose of the arm's base."""

    support: Support
    base: Array
    force: Array
    stiffness: Array
    soft: Array | None
    effect = "support"

    def __init__(
        self, support: Support, base: Array, force: Array, stiffness: Array, soft: Array | None
    ):
        self.support, self.base, self.frame = support, base, "world"
        self.force, self.stiffness, self.soft = force, stiffness, soft

    @property
    def needs(self) -> Needs:
        return self.support.needs if self.soft is None else "pose"

    def potential(
        self, rod: Rod, X: ScalarLike, rotation: MatrixLike, position: VectorLike
    ) -> Scalar:
        off = self.support.deviation(self.base, rotation, position)
        if self.soft is None:
            return -dot(self.force, off)
        spring = 0.5 * dot(self.stiffness, off**2)
        return self.soft * spring - (1 - self.soft) * dot(self.force, off)


class HeldSection(NamedTuple):
    """A support on a grid: its abscissa, the number of steps before it and 1 at the nodes before
    it, the pose of the `base`, and the `rotation` and `position` of its section at rest."""

    support: Support
    base: Array
    X: Array
    step: Array
    before: Array
    rotation: Array
    position: Array

    def settled(self) -> "HeldSection":
        """The section held where it is at rest."""
        return self._replace(support=self.support.settled(self.rotation, self.position))

    def exerts(
        self, rod: Rod, force: Array, stiffness: Array, soft: Array | None = None
    ) -> PoseTerm:
        """What the support exerts."""
        load = SupportForce(self.support, self.base, force, stiffness, soft)
        return PoseTerm(load, rod, jnp.ones_like(force[0]), self.X, self.step, self.before)

    def deviation(self, pose: Pose) -> Array:
        """For each row the deviation g and the wrench (6,) in the world frame by which it changes
        with a rotation and a displacement of the section, shape (rows, 7, ...)."""

        def of_arm(support: Support, base: Array, R: Array, r: Array) -> Array:
            def off(z: Array) -> Array:
                return support.deviation(base, R + matmul(skew(z[:3]), R), r + z[3:])

            zero = jnp.zeros(6, R.dtype)
            return jnp.concatenate([off(zero)[:, None], jax.jacfwd(off)(zero)], axis=1)

        section = pose.rotation_at(self.step), pose.position_behind(self.before)
        given = self.support, self.base, *section
        return of_each_arm(of_arm, arms_in(given, pose.grid.h.ndim - 1), *given)


class Supports(Constraint):
    """All supports of an arm; the unknowns are their forces [N] and moments [N m], shape (rows,
    ...).

    **Fields:** the `sections` and the `rod`; `stiffness`, which scales deviations to forces and
    moments, and `lengths`, which scale them to numbers, one per row; `soft`: 1 where springs stand
    for the constraints.
    """

    sections: tuple[HeldSection, ...]
    rod: Rod
    stiffness: Array
    lengths: Array
    soft: Array | None = None

    def relaxed(self) -> "Supports":
        """Sections that are held where they are at rest."""
        return finite(replace(self, sections=tuple(one.settled() for one in self.sections)))

    def softened(self, hardness: Array) -> "Supports":
        return replace(self, soft=(hardness < SOFTENED).astype(self.stiffness.dtype))

    def like(self, other: Coupling) -> bool:
        return isinstance(other, Supports) and self._units == other._units

    def guess(self, forces: Forces, grid: Grid) -> Float[Array, "rows ..."]:
        return jnp.zeros((len(self.stiffness), *grid.h.shape[1:]), grid.h.dtype)

    def exerts(self, x: Array) -> tuple[PoseTerm, ...]:
        every = zip(self.sections, self._parts(x), self._springs, strict=True)
        return tuple(one.exerts(self.rod, force, k, self.soft) for one, force, k in every)

    def note(self, x: Array, at: ArmState, own: tuple[Exerted, ...], problem: ArmProblem) -> Array:
        """`HeldSection.deviation` of all."""
        assert at.along is not None  # a scene with supports reacts
        pose = at.along.pose
        return jnp.concatenate([one.deviation(pose) for one in self.sections])

    def residual(
        self, x: Array, at: ArmState, note: Array, problem: ArmProblem, free: tuple[int, ...]
    ) -> Array:
        off = self._stiff * note[:, 0]
        return off if self.soft is None else off + self.soft * x

    def border(self, x: Array, at: ArmState, note: Array, problem: ArmProblem) -> Border:
        wrenches, soft = self.prevents(x, at, note, problem)
        act = -(1 - soft)[:, None, None]
        columns = tuple(act * part for part in wrenches)
        return Border(columns, wrenches, self._stiff, soft, jnp.ones_like(soft, jnp.int32))

    def prevents(
        self, x: Array, at: ArmState, note: Array, problem: ArmProblem
    ) -> tuple[Vector, Array]:
        assert at.along is not None
        parts = zip(self.sections, self._parts(note[:, 1:]), strict=True)
        world = [one.before * wrench[:, :, None, None] for one, wrench in parts]
        soft = jnp.zeros_like(x) if self.soft is None else jnp.broadcast_to(self.soft, x.shape)
        return of_forces(jnp.concatenate(world), at.along, problem.grid), soft

    def wrenches(self, x: Array, note: Array) -> Float[Array, "supports 6"]:
        """Moment and force of each support in the world frame, for the unknowns of one arm."""
        parts = zip(self._parts(x), self._parts(note[:, 1:]), strict=True)
        return jnp.stack([force @ unit for force, unit in parts])

    def scales(self, problem: ArmProblem) -> Scales:
        return Scales(self.stiffness, self.lengths)

    @property
    def _units(self) -> list[tuple[str, ...]]:
        return [one.support.units for one in self.sections]

    @property
    def _springs(self) -> list[Array]:
        return [_SPRING * k for k in self._parts(self.stiffness)]

    @property
    def _stiff(self) -> Array:
        """Factors from deviations to rows."""
        if self.soft is None:
            return self.stiffness
        return self.stiffness * (1 + self.soft * (_SPRING - 1))

    def _parts(self, x: Array) -> list[Array]:
        """The rows of each section."""
        return jnp.split(x, np.cumsum([len(units) for units in self._units])[:-1])


def of_forces(world: Array, along: Reaction, grid: Grid) -> Vector:
    """Wrench in the body frame at the nodes, with levers, by wrenches (m, 6, stages, steps, ...) in
    the world frame beyond them: six components of shape (m, stages, steps, ...)."""
    axis, back = along.pose.axis, transpose(along.pose.rotation)

    def one(wrench: Array) -> Array:
        lever = beyond(cross(axis, rows_of(wrench, 3, 6)), grid)
        moment = rows_of(wrench, 0, 3) + lever
        force = jnp.broadcast_to(rows_of(wrench, 3, 6), moment.shape)
        return turned(back, jnp.concatenate([moment, force]))

    return components(jnp.moveaxis(jax.vmap(one)(world), 1, 0))


def supports_of(scene: Scene, sections: CrossSections, grid: Grid) -> Supports | None:
    """The supports of a scene; None if it has none."""
    if not scene.held:
        return None
    rest = stack(tuple(jnp.broadcast_to(x, grid.X.shape) for x in sections.rest))
    frame = jnp.asarray(base_pose(scene.rod.frame, grid.h.dtype))
    starts, R, end = rotations(rows_of(rest, 0, 3), grid.h, frame)
    pose = Pose(starts, end, R, matvec(R, rows_of(rest, 3, 6)), frame, grid, ())

    def held(support: Support) -> HeldSection:
        X = support.place(scene.rod)
        step, before = before_point(grid, X)
        there = pose.rotation_at(step), pose.position_behind(before)
        return HeldSection(support, frame, X, step, before, *there)

    held_sections, length = tuple(map(held, scene.held)), jnp.sum(grid.h)
    units = [unit for one in scene.held for unit in one.units]
    lengths = jnp.stack([length if unit == "m" else jnp.ones_like(length) for unit in units])
    bending = jnp.sum(grid.weight * softest(sections.stiffness))
    return Supports(held_sections, scene.rod, 3 * bending / (length * lengths) ** 2, lengths)
