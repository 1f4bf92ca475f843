r"""Contact without friction between an arm and obstacles.

The unknowns are the contact forces $\lambda$ [N], one per obstacle and step of the grid, where the
gap g to the obstacle is least (see `touch`). The rows are the complementarity of force and gap,

$$\min(\lambda, k g) = 0,$$

so that forces only push, gaps are not negative and one of the two is zero; the stiffness k only
scales gaps to forces. The minimum is smoothed,

$$\tfrac12 (\lambda + k g - \sqrt{(\lambda - k g)^2 + 4 (k b)^2}) = 0, \quad \lambda g = k b^2,$$

in the end over a length b of 1e-9 of the arm. Newton's method solves for forces and shape together.

On the way to a solution that this does not find at once, penalties stand for the forces, $\lambda =
\tfrac12 k_p (\sqrt{g^2 + w^2} - g)$: the balance is then the gradient of an energy, which shows
whether a step is an advance. The width w becomes smaller; then b does, from 1e-2 of the arm.
"""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.obstacles import Obstacle
from ..arm.rod import Rod
from ..arm.scene import CrossSections, Scene
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, locate
from ..numerics.se3 import base_pose
from ..numerics.stacked import cross
from .coupling import SOFTENED, ArmProblem, ArmState, Coupling, PointForces
from .held import of_forces
from .pose_terms import finite
from .reaction import Loading
from .sizes import softest
from .touch import Surroundings, Touch

_PENALTY, _WIDTH, _SHARPER = 100.0, 0.02, 1e-3
"""Stiffness $k_p$ of penalties, in multiples of k; their width w, as a fraction of the arm's
length, and by what it becomes smaller as they harden."""

_BLUR = 1e-9
"""Length b, as a fraction of the arm's."""

_RIGID = 2 / 3
"""Power of the machine epsilon that is the compliance of a contact in the approximate tangent, in
units of 1 / k: two contacts side by side then share their force."""

_FLATNESS, _FLATTER = 0.5, 0.5
"""Bound on the excess of the gap at the nearest point of a step over the least one, as a fraction
of the outline over the square of the number of steps, and of the width of penalties."""


class Contacts(Coupling):
    """All contacts of an arm; the unknowns are their forces [N], shape (obstacles * steps, ...).

    **Fields:** the `obstacles`, the `rod` and the position of its `base`; the stiffness k, `scale`;
    `flatness` and `lift` of `Surroundings`; the lengths b, `blur`, and w, `width`; `soft`: 1 where
    penalties stand for the forces; the number of `steps`.
    """

    obstacles: tuple[Obstacle, ...]
    rod: Rod
    base: Array
    scale: Array
    flatness: Array
    lift: Array
    blur: Array
    steps: int = eqx.field(static=True)
    soft: Array | None = None
    width: Array | None = None
    softens = True

    def relaxed(self) -> "Contacts":
        obstacles, rod = finite((self.obstacles, self.rod))
        return replace(self, obstacles=obstacles, rod=rod, lift=self.lift + 1e3 * rod.length)

    def softened(self, hardness: Array) -> "Contacts":
        soft = (hardness < SOFTENED).astype(self.scale.dtype)
        width = (_WIDTH * _SHARPER**hardness * self.rod.length).astype(self.scale.dtype)
        flatness = jnp.where(soft > 0, jnp.maximum(self.flatness, _FLATTER * width), self.flatness)
        blur = (_BLUR ** jnp.clip(hardness, 0.25, 1.0) * self.rod.length).astype(self.scale.dtype)
        return replace(self, soft=soft, width=width, flatness=flatness, blur=blur)

    def like(self, other: Coupling) -> bool:
        return isinstance(other, Contacts) and len(self.obstacles) == len(other.obstacles)

    def guess(self, forces: Forces, grid: Grid) -> Float[Array, "contacts ..."]:
        size = len(self.obstacles) * self.steps
        return jnp.zeros((size, *grid.h.shape[1:]), grid.h.dtype)

    def loads(self, x: Array, loads: Loading | None) -> Loading | None:
        assert loads is not None
        around = Surroundings(
            self.obstacles,
            self.rod,
            self.base,
            self.flatness,
            self.lift,
            _PENALTY * self.scale,
            x,
            self.soft,
            self.width,
        )
        return loads._replace(around=around)

    def note(self, x: Array, at: ArmState, problem: ArmProblem) -> Touch:
        """The contacts."""
        assert at.along is not None
        assert at.along.touch is not None
        return at.along.touch

    def residual(
        self, x: Array, at: ArmState, note: Touch, problem: ArmProblem, free: tuple[int, ...]
    ) -> Array:
        pushed = self.scale * note.gap
        exact = 0.5 * (note.force + pushed - self._root(note.force - pushed))
        if self.soft is not None:
            exact = jnp.where(self.soft > 0, x.reshape(exact.shape) - note.force, exact)
        return exact.reshape(x.shape)

    def points(self, x: Array, at: ArmState, note: Touch, problem: ArmProblem) -> PointForces:
        apart = note.force - self.scale * note.gap
        pushing = 0.5 * (1 + apart / self._root(apart))
        hard = jnp.ones_like(apart) if self.soft is None else 1 - self.soft + 0 * apart
        least = jnp.finfo(x.dtype).eps ** _RIGID
        unit = hard * jnp.concatenate([cross(note.lever, note.normal), note.normal])
        corner = jnp.maximum(1 - hard * pushing, least)
        return PointForces(unit, note.cell, hard * pushing * self.scale, corner)

    def rows(self, at: ArmState, note: Touch, grid: Grid) -> Vector:
        """For each contact of one arm the wrenches at the nodes whose work over a change of strain
        is the change of its gap: six components, (contacts, stages, steps)."""
        assert at.along is not None
        steps = jnp.arange(self.steps)
        here, before = jnp.eye(self.steps), steps < steps[:, None]
        shares = jnp.where(here > 0, note.shares[..., None], before)  # (stages, obstacles, of, in)
        force = shares[None] * note.normal[:, None, ..., None]
        world = jnp.concatenate([jnp.zeros_like(force), force])
        world = jnp.moveaxis(world, (2, 3), (0, 1)).reshape(-1, *world.shape[:2], self.steps)
        return of_forces(world, at.along, grid)

    def moved(self, x: Array, X: Array, grid: Grid) -> Array:
        """The forces on the steps in which the middles of the old ones lie."""
        if X.shape[1] == self.steps:
            return x
        step, _ = locate(grid, jnp.mean(X, axis=0))
        force = x.reshape(len(self.obstacles), -1)
        return jnp.zeros((len(force), self.steps), x.dtype).at[:, step].add(force).reshape(-1)

    def _root(self, apart: Array) -> Array:
        """A smooth absolute value of the difference of force and scaled gap."""
        return jnp.sqrt(apart**2 + (2 * self.scale * self.blur) ** 2)

    def sizes(self, x: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        return [x / (self.scale * problem.length)]

    def row_sizes(self, rows: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Gaps and deflections by forces, per length of the arm."""
        return self.sizes(rows, at, problem)

    def units(self, problem: ArmProblem) -> tuple[Array, Array]:
        root = jnp.sqrt(self.scale)
        return 1 / root, root

    def radians(self, problem: ArmProblem) -> Array:
        size = len(self.obstacles) * self.steps
        return jnp.broadcast_to(1 / (self.scale * problem.length), (size,))


def contacts_of(scene: Scene, sections: CrossSections, grid: Grid) -> Contacts | None:
    """The contacts of a scene; None if it has no obstacles."""
    if not scene.obstacles:
        return None
    base = jnp.asarray(base_pose(scene.rod.base, grid.h.dtype))[:3, 3]
    length = jnp.sum(grid.h)
    bending = jnp.sum(grid.weight * softest(sections.stiffness)) / length
    flatness = _FLATNESS * scene.rod.outline(0.5 * scene.rod.length) / grid.h.shape[0] ** 2
    return Contacts(
        scene.obstacles,
        scene.rod,
        base,
        3 * bending / length**3,
        flatness,
        jnp.zeros_like(length),
        _BLUR * length,
        grid.h.shape[0],
    )
