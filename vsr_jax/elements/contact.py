r"""Contact between an arm and obstacles.

The unknowns are the contact forces $\lambda$ [N], one or two per obstacle and step of the grid:
where the gap g to the obstacle is least, and at the end of the step (see `touch`). The rows are the
complementarity of force and gap,

$$\min(\lambda, k g + c \lambda) = 0,$$

so that forces only push, gaps are not negative and one of the two is zero; the stiffness k scales
gaps to forces, and the compliance c, in the end 1e-10, makes the forces of two contacts at one
place unique. The minimum is smoothed over a length b, in the end 1e-9 of the arm:

$$\lambda (k g + c \lambda) = (k b)^2, \quad \lambda > 0.$$

Newton's method solves for forces and shape together, with nearly rigid springs in place of the
contacts in the elimination along the arm (`PointForces`). With $s = k g + c \lambda$ its rows are
those of the smooth minimum (Kanzow 1996), but where force and gap are both positive and their
product is too large,

$$\frac{\lambda s - (k b)^2}{\lambda + s}, \quad \text{as a line}\quad
\frac{s \, \delta\lambda + \lambda \, \delta s}{\lambda + s},$$

the step of primal-dual interior-point methods (Nocedal and Wright 2006, chapter 19). A force far
from its wall then fades as b becomes smaller; by the line of the smooth minimum every contact with
$\lambda > s$ closes its gap at once, which throws the arm about.

From the rest shape b begins as 0.1 of the arm and c as 0.02. The force is then given by the gap,
$\lambda = \tfrac{k}{2 c} (\sqrt{g^2 + 4 c b^2} - g)$, so that the balance is the gradient of an
energy, which shows whether a step is an advance; a creeping motion under all loads approaches it.
After that both become smaller together, and friction (see `slip`) grows.
"""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from ..arm.obstacles import Obstacle
from ..arm.rod import Rod
from ..arm.scene import CrossSections, Scene
from ..mechanics.applied_load import Exerted, finite
from ..mechanics.coupling import SOFTENED, ArmProblem, ArmState, Constraint, Coupling, Scales
from ..mechanics.sizes import softest
from ..numerics.component import Forces, Vector
from ..numerics.damped_newton import HARDENING_STAGES, SOFT_STAGES
from ..numerics.loops import scan
from ..numerics.quadrature import Grid, locate
from ..numerics.se3 import base_pose, stacked_rotation
from ..typing import DTypeLike
from .contact_tangent import ContactSprings, sliding_of
from .nearest import lying
from .slip import Rough, Traces, moved_to
from .supports import of_forces
from .touch import Surroundings, Touch

_LAST = 1e-9, 1e-10
"""Length b, as a fraction of the arm's, and compliance c in the end."""

_FIRST = 0.1, 2e-2
"""Length b, as a fraction of the arm's, and compliance c to begin with."""

_ROOMY = 0.3
"""Room between arm and wall, as a fraction of the arm's length, below which both are smaller from
the start."""

_FLATNESS = 1e-3
"""Bound on the excess of the gap at the nearest point of a step over the least one, as a fraction
of the outline."""

_GRIP = 10.0
"""Stiffness c of `slip`, in units of that of the arm up to the contact."""

_AT_HELD = 1e-6
"""Distance of a held section from the end of a step that is at it, as a fraction of the length."""

_RIGID = 2 / 3
"""Power of the machine epsilon that is the least compliance of a contact in the approximate
tangent, in units of 1 / k."""

_SMOOTH = SOFT_STAGES / HARDENING_STAGES
"""Hardness up to which contacts have no friction; then it grows: all of it at once throws the arm
about."""

_NO_FRICTION = 1e-9
"""Friction that counts as none, in units of k and the arm's length."""

_CLEAR = 0.3
"""Deflection by all contact forces, as a fraction of the least gap, below which nothing is
touched."""

_FLATTER = 0.1
"""Bound on the excess of the gap at the nearest point of a step over the least one, as a fraction
of the length b."""


class Contacts(Constraint):
    """All contacts of an arm; the unknowns are their forces [N], shape (per_step * steps, ...), and
    with friction a pair, the second (3, per_step * steps, ...) the friction [N] in the world.

    **Fields:** the `obstacles`, the `rod` and the position of its `base`; the stiffness k, `scale`;
    `flatness` and `lift` of `Surroundings`; the length b, `blur`, and the compliance c, `give`, and
    both to begin with, `first`; `loose`: 1 where the flatness is the larger one;
    the number of `steps`; the coefficients of `friction` and the stiffness c of `slip` on each
    step, `grip` (steps, ...), both None without; `soft`: 1 where the gaps give the forces;
    `traces`: what the contacts remember where the arm follows a path of inputs, None without.
    """

    obstacles: tuple[Obstacle, ...]
    rod: Rod
    base: Array
    scale: Array
    flatness: Array
    lift: Array
    blur: Array
    give: Array
    first: Array
    loose: Array
    steps: int = eqx.field(static=True)
    friction: Array | None = None
    grip: Array | None = None
    soft: Array | None = None
    traces: Traces | None = None
    begins_soft = True

    @property
    def per_step(self) -> int:
        """Number of contacts of a step."""
        return len(self.obstacles) + len(lying(self.obstacles))

    def relaxed(self) -> "Contacts":
        obstacles, rod = finite((self.obstacles, self.rod))
        return replace(self, obstacles=obstacles, rod=rod, lift=self.lift + 1e3 * rod.length)

    def loosened(self, loose: Array) -> "Contacts":
        return replace(self, loose=jnp.maximum(self.loose, loose.astype(self.loose.dtype)))

    @property
    def looseness(self) -> Array:
        return self.loose

    def softened(self, hardness: Array) -> "Contacts":
        of, length = self.scale.dtype, self.rod.length
        roughness = jnp.clip((hardness - _SMOOTH) / (1 - _SMOOTH), 0.0, 1.0)
        ends = zip(self.first, _LAST, strict=True)
        blur, give = (first * (last / first) ** hardness for first, last in ends)
        return replace(
            self,
            soft=(hardness < SOFTENED).astype(of),
            blur=(blur * length).astype(of),
            give=give.astype(of),
            flatness=jnp.maximum(self.flatness, _FLATTER * blur * length).astype(of),
            friction=None if self.friction is None else roughness * self.friction,
        )

    def start(self, xi: Vector, problem: ArmProblem) -> Vector:
        """The bending of the middle of what encloses the arm, if anything does."""
        for obstacle in self.obstacles:
            bending = _bending_along(obstacle, self.rod.base, problem.grid.h)
            if bending is not None:
                return (
                    xi[0],
                    *(0.0 * x + k for x, k in zip(xi[1:3], bending, strict=True)),
                    *xi[3:],
                )
        return xi

    def like(self, other: Coupling) -> bool:
        return (
            isinstance(other, Contacts)
            and len(self.obstacles) == len(other.obstacles)
            and self.per_step == other.per_step
            and (self.friction is None) == (other.friction is None)
        )

    def guess(self, forces: Forces, grid: Grid) -> PyTree:
        force = jnp.zeros((self.per_step * self.steps, *grid.h.shape[1:]), grid.h.dtype)
        return force if self.friction is None else (force, jnp.stack([force] * 3))

    def exerts(self, x: PyTree) -> tuple[Surroundings]:
        around = Surroundings(
            self.obstacles,
            self.rod,
            self.base,
            self._flatness(),
            self.lift,
            self.scale / self.give,
            2 * jnp.sqrt(self.give) * self.blur,
            self._forces(x),
            self.soft,
            self._rough(x),
        )
        return (around,)

    def _flatness(self) -> Array:
        """Bulge of a gap that counts as flat: if loosened that of the curvature 1 / L."""
        bulge = self.rod.length / (8.0 * self.steps**2)
        rough = jnp.maximum(self.flatness, bulge.astype(self.flatness.dtype))
        return jnp.where(self.loose > 0, rough, self.flatness)

    def _forces(self, x: PyTree) -> Array:
        """The contact forces."""
        return x if self.friction is None else x[0]

    def _rough(self, x: PyTree) -> Rough | None:
        """Friction."""
        if self.friction is None or self.traces is None:
            return None
        assert self.grip is not None
        least = _NO_FRICTION * self.scale * self.rod.length
        return Rough(self.friction, self.grip, least, x[1], self.traces)

    def dissipates(self) -> Array | None:
        if self.friction is None or self.traces is None:
            return None
        return jnp.any(self.friction > 0, axis=0)

    def after(self, x: PyTree, at: ArmState, problem: ArmProblem) -> "Contacts":
        if self.friction is None:
            return self
        assert at.along is not None  # a scene with obstacles reacts
        pose = at.along.pose
        return replace(self, traces=Traces(self.base, pose.axis, pose.rotation))

    def remembering(self, other: Coupling, X: Array, grid: Grid) -> "Contacts":
        assert isinstance(other, Contacts)
        traces = None if other.traces is None else moved_to(other.traces, X, grid)
        return replace(self.loosened(other.loose > 0), traces=traces)

    def note(self, x: PyTree, at: ArmState, own: tuple[Exerted, ...], problem: ArmProblem) -> Touch:
        """The contacts."""
        (around,) = own
        return around.note

    def residual(
        self, x: PyTree, at: ArmState, note: Touch, problem: ArmProblem, free: tuple[int, ...]
    ) -> PyTree:
        force, own = note.force, self._forces(x).reshape(note.force.shape)
        pushed = self.scale * note.gap + self.give * force
        rows, _ = self._smooth_minimum(force, pushed)
        rows = jnp.where(note.handed != 0, own, rows)
        if self.soft is not None:
            rows = jnp.where(self.soft > 0, own - force, rows)
        rows = rows.reshape(self._forces(x).shape)
        if self.friction is None:
            return rows
        return rows, x[1] if note.slip is None else note.slip.row.reshape(x[1].shape)

    def springs(
        self, x: PyTree, at: ArmState, note: Touch, problem: ArmProblem, free: tuple[int, ...]
    ) -> ContactSprings:
        pushed = self.scale * note.gap + self.give * note.force
        _, by_gap = self._smooth_minimum(note.force, pushed)
        own = 1 - jnp.abs(note.handed)
        own = own if self.soft is None else (1 - self.soft) * own
        pushing = own * by_gap
        least = float(jnp.finfo(own.dtype).eps) ** _RIGID
        assert at.along is not None  # a scene with obstacles reacts
        touch, sliding = sliding_of(note, at.along.pose, problem, free)
        normal = ContactSprings(
            touch,
            sliding,
            own * note.per_force,
            own * note.direction,
            note.cell,
            note.part,
            pushing * self.scale,
            jnp.maximum(1 - (1 - self.give) * pushing, least),
            note.handed,
        )
        if note.slip is None:
            return normal
        assert self.grip is not None
        return _with_slip(normal, note, self.grip, least * self.grip / self.scale)

    def prevents(
        self, x: PyTree, at: ArmState, note: Touch, problem: ArmProblem
    ) -> tuple[Vector, Array]:
        """Of one arm: friction does not hold it."""
        assert at.along is not None
        springs = self.springs(x, at, note, problem, ())
        steps = jnp.arange(self.steps)
        here, before = jnp.eye(self.steps), steps < steps[:, None]
        shares = jnp.where(here > 0, note.shares[..., None], before)  # (stages, obstacles, of, in)
        force = shares[None] * note.normal[:, None, ..., None]
        world = jnp.concatenate([jnp.zeros_like(force), force])
        world = jnp.moveaxis(world, (2, 3), (0, 1)).reshape(-1, *world.shape[:2], self.steps)
        wrenches = of_forces(world, at.along, problem.grid)
        return wrenches, springs.corner[: self.per_step].reshape(-1)

    def clear(self, at: ArmState, note: Touch, problem: ArmProblem) -> Array:
        """Whether all forces together bend the arm by much less than the least gap."""
        bent = jnp.sum(note.force, axis=(0, 1)) / self.scale
        return bent < _CLEAR * jnp.min(note.gap, axis=(0, 1))

    def moved(self, x: PyTree, X: Array, grid: Grid) -> PyTree:
        """The forces on the steps in which the middles of the old ones lie."""
        if X.shape[1] == self.steps:
            return x
        step, _ = locate(grid, jnp.mean(X, axis=0))

        def gathered(force: Array) -> Array:
            force = force.reshape(*force.shape[:-1], self.per_step, -1)
            found = jnp.zeros((*force.shape[:-1], self.steps), force.dtype)
            found = found.at[..., step].add(force)
            return found.reshape(*force.shape[:-2], -1)

        return jax.tree.map(gathered, x)

    def _smooth_minimum(self, force: Array, pushed: Array) -> tuple[Array, Array]:
        """The smoothed minimum of force and scaled gap, and its derivative by the gap where it is
        approximated by a line."""
        apart, square = force - pushed, (self.scale * self.blur) ** 2
        root = jnp.sqrt(apart**2 + 4 * square)
        total, excess = force + pushed, force * pushed - square
        inside = (force > 0) & (pushed > 0) & (excess > 0)
        # the difference of sum and root loses the digits of a force where a gap is large
        whole = jnp.where(inside, total, 0.5 * (jnp.abs(total) + root))
        smooth = jnp.where(total > 0, excess / whole, 0.5 * (total - root))
        return smooth, 0.5 * (1 + apart / jnp.where(inside, total, root))

    def scales(self, problem: ArmProblem) -> Scales:
        if self.friction is None:
            return Scales(self.scale, problem.length)
        return Scales((self.scale,) * 2, (problem.length,) * 2)


def _with_slip(normal: ContactSprings, touch: Touch, grip: Array, least: Array) -> ContactSprings:
    """Contact forces with friction in two directions of each contact."""
    slip = touch.slip
    assert slip is not None
    kept, tangents = jnp.concatenate(slip.kept), touch.tangents
    return normal._replace(
        wrench=jnp.concatenate([normal.wrench, tangents], axis=1),
        direction=jnp.concatenate([normal.direction, touch.slips], axis=1),
        cell=jnp.concatenate([normal.cell] * 3, axis=1),
        part=jnp.concatenate([normal.part] * 3),
        factors=jnp.concatenate([normal.factors, kept * grip]),
        corner=jnp.concatenate([normal.corner, jnp.maximum(1 - kept, least)]),
        handed=jnp.concatenate([normal.handed, jnp.zeros_like(kept)]),
        slip=slip,
    )


def _bending_along(obstacle: Obstacle, base: Array | None, h: Array) -> Array | None:
    """Bending (2, steps) of an arm along the middle of what encloses it, from the turns of its
    directions, without twist."""
    pose = jnp.asarray(base_pose(base, h.dtype))
    ahead = obstacle.directions(pose[:3, 3], pose[:3, 0], h)
    if ahead is None:
        return None

    def turn(R: Array, step: tuple) -> tuple[Array, Array]:
        t, h = step
        axis, cosine = jnp.cross(R[:, 0], t), R[:, 0] @ t
        sine = jnp.linalg.norm(axis)
        vector = axis * jnp.arctan2(sine, cosine) / jnp.where(sine > 0, sine, 1.0)
        k = R.T @ vector / jnp.where(h > 0, h, jnp.inf)
        return stacked_rotation(vector) @ R, k[1:]

    return scan(turn, pose[:3, :3], (ahead, h))[1].T


def contacts_of(scene: Scene, sections: CrossSections, grid: Grid) -> Contacts | None:
    """The contacts of a scene; None if it has no obstacles."""
    if not scene.obstacles:
        return None
    base = jnp.asarray(base_pose(scene.rod.base, grid.h.dtype))[:3, 3]
    length = jnp.sum(grid.h)
    bending = jnp.sum(grid.weight * softest(sections.stiffness)) / length
    flatness = _FLATNESS * scene.rod.outline(0.5 * scene.rod.length)
    stiffness, friction = 3 * bending / length**3, _friction(scene.obstacles, grid.h.dtype)
    ends = jnp.maximum(jnp.cumsum(grid.h, axis=0), grid.h[:1])
    return Contacts(
        scene.obstacles,
        scene.rod,
        base,
        stiffness,
        flatness,
        _lift(scene, grid),
        _LAST[0] * length,
        jnp.full_like(length, _LAST[1]),
        _first(scene, length),
        jnp.zeros_like(length),
        grid.h.shape[0],
        friction,
        None if friction is None else _GRIP * stiffness * (length / ends) ** 3,
    )


def _lift(scene: Scene, grid: Grid) -> Array:
    """What is added to the gaps: the end of a step that is held in its place need not touch what it
    may be held on."""
    length, ends = jnp.sum(grid.h), lying(scene.obstacles)
    held = [held.place(scene.rod) for held in scene.held if held.fixed]
    if not ends or not held:
        return jnp.zeros_like(length)
    apart = jnp.abs(grid.start + grid.h - jnp.stack(held).reshape(-1, 1))
    there = jnp.any(apart < _AT_HELD * length, axis=0).astype(length.dtype)
    nearest = jnp.zeros((len(scene.obstacles), len(there)), length.dtype)
    return 1e3 * length * jnp.concatenate([nearest, jnp.stack([there] * len(ends))])


def _friction(obstacles: tuple[Obstacle, ...], dtype: DTypeLike) -> Array | None:
    """Coefficients of friction of the contacts of a step; None if no obstacle has any."""
    if all(obstacle.friction is None for obstacle in obstacles):
        return None
    each = [0.0 if obstacle.friction is None else obstacle.friction for obstacle in obstacles]
    each += [0.0] * len(lying(obstacles))
    return jnp.stack([jnp.asarray(x, dtype) for x in each])


def _first(scene: Scene, length: Array) -> Array:
    """Length b, as a fraction of the arm's, and compliance c to begin with: smaller where a lumen
    leaves the arm little room."""
    blur, give = (jnp.full_like(length, x) for x in _FIRST)
    for obstacle in scene.obstacles:
        room = obstacle.room
        if room is not None:
            room = (room - scene.rod.outline(0.5 * scene.rod.length)) / length
            narrow = jnp.clip(room / _ROOMY, 1e-3, 1.0).astype(length.dtype)
            blur, give = (
                jnp.minimum(blur, narrow * _FIRST[0]),
                jnp.minimum(give, narrow * _FIRST[1]),
            )
    return jnp.stack([blur, give])
