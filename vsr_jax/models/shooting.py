r"""The continuous model of a loaded arm: a boundary value problem, solved by multiple shooting with
diffrax.

With $\Lambda = F_i - F_a$ eq. 8 reads $\Lambda' = -\mathrm{ad}^*_\xi \Lambda - (c, f)$ and eq. 12
becomes

$$\xi' = (\Sigma - A)^{-1} (\Lambda' - \partial r / \partial X + B_\tau \tau'), \quad
g' = g \hat\xi,$$

starting from $\Lambda = r(\xi)$. All three are integrated: the reaction that follows from the
strain of a slender arm would be the small difference of large numbers. The rotation is known at the
base and the reaction at the tip. Single shooting over a long soft arm is ill-conditioned, so the
arm is divided into segments, also at its breakpoints. The unknowns are the rotation and the
reaction at the start of each segment, continuous except for point loads, and the position if a load
depends on it. The initial guess is a solution on steps.
"""

from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import CrossSections, Scene, shared
from ..mechanics.arm_balance import ArmSolution
from ..mechanics.balance import solve_balance
from ..mechanics.turning import balanced_strain_rate, reaction_rate
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.loops import scan, while_loop
from ..numerics.quadrature import Grid
from ..numerics.se3 import base_pose, hat, stacked_rotation, unskew
from ..numerics.stacked import turned

_SHOTS = 12
"""Bound on the Newton steps of the shooting; from a solution on steps they converge
quadratically."""


def _inside(dtype: Any) -> float:
    """Distance from the ends of a segment, as a fraction of it, at which it is evaluated there: at
    a jump the values are those inside the segment. Rounding of an abscissa is smaller, on segments
    down to a hundredth of the arm."""
    return max(1e-10, 800 * float(jnp.finfo(dtype).eps))


class Guess(NamedTuple):
    """A solution on steps: its grid, the state there, and the thread forces at their start."""

    grid: Grid
    state: ArmSolution
    forces: Forces


class ShootingUnknown(NamedTuple):
    """Rotation (3, 3), reaction (6,) and position (3,) at the start of each segment; None for the
    positions if no load depends on them."""

    rotation: Array
    reaction: Array
    position: Array | None


class SegmentState(NamedTuple):
    """State integrated over a segment: the strain, the pose relative to the start, and the
    reaction in units of `wrench_scale`."""

    xi: Array
    g: Array
    wrench: Array


class Control(NamedTuple):
    """Settings of diffrax: solver, tolerances and the bound on its steps."""

    solver: Any
    rtol: float
    atol: float
    max_steps: int


class Shot(NamedTuple):
    """Solution: the segments (a grid with one step each), the unknowns, the pose at the start of
    each and at the end of the arm, whether the segments match, and the largest number of
    integration steps."""

    segments: Grid
    unknown: ShootingUnknown
    poses: Array
    fits: Array
    steps: Array


def integrate(
    scene: Scene,
    guess: Guess,
    control: Control,
    start: Array,
    h: Array,
    begin: ShootingUnknown,
    part: Array,
    unit: Array,
) -> tuple[SegmentState, Array, Array]:
    """State at a fraction `part` of a segment, whether diffrax succeeded, and its steps; reactions
    are measured in `unit`, their scale."""
    free, inside, (rotation, reaction, position) = scene.free, _inside(h.dtype), begin

    def at(t: Array) -> tuple[Array, CrossSections, Vector]:
        x = start + h * (inside + (1 - 2 * inside) * t)
        shares = guess.state.shares_at(scene, guess.grid, x, guess.forces)
        return x, scene.sections(x), shared(guess.forces, shares)

    def field(t: Any, line: SegmentState, _: None) -> SegmentState:
        (x, sections, tau), rate = jax.jvp(at, (jnp.asarray(t, h.dtype),), (jnp.ones((), h.dtype),))
        per_length = jnp.where(h > 0, h, 1.0)
        rate = jax.tree.map(lambda v: v / per_length, rate)
        xi = c.split(line.xi)
        place = None if position is None else position + rotation @ line.g[:3, 3]
        density = _body_density(scene, x, rotation @ line.g[:3, :3], place)
        change = reaction_rate(xi, c.split(unit * line.wrench), density)
        xi_rate = balanced_strain_rate(xi, tau, rate[2], change, sections, rate[1], free)
        return SegmentState(
            h * c.join(xi_rate), h * (line.g @ hat(line.xi)), h * c.join(change) / unit
        )

    _, sections, tau = at(jnp.zeros_like(h))
    xi = c.join(solve_balance(sections, tau, c.split(reaction), free).xi)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        control.solver,
        t0=jnp.zeros_like(h),
        t1=jnp.maximum(part, inside),
        dt0=None,
        y0=SegmentState(xi, jnp.eye(4, dtype=h.dtype), reaction / unit),
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.PIDController(rtol=control.rtol, atol=control.atol),
        max_steps=control.max_steps,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    assert solution.ys is not None
    line = jax.tree.map(lambda y: y[0], solution.ys)
    completed = solution.result == diffrax.RESULTS.successful
    return line, completed, solution.stats["num_steps"].astype(jnp.int32)


def _body_density(scene: Scene, X: Array, rotation: Array, position: Array | None) -> Vector:
    """Density (c, f) of all loads in the body frame."""
    dead, follower = scene.density(X, "world"), scene.density(X, "body")
    world = jnp.zeros((6,), X.dtype) if dead is None else jnp.stack(dead)
    place = jnp.zeros((3,), X.dtype) if position is None else position
    for load in scene.pose_loads:
        if load.place(scene.rod) is None:
            world = world + load.wrench(scene.rod, X, rotation, place)
    total = c.split(turned(rotation.T, world))
    return total if follower is None else c.add(total, follower)


class _Matching(NamedTuple):
    """The equations of the shooting: z holds for each segment the rotation vector by which its
    start is turned from the first guess, and the changes of its reaction and position."""

    scene: Scene
    guess: Guess
    first: ShootingUnknown
    segments: Grid
    control: Control
    unit: Array

    @property
    def size(self) -> int:
        """Unknowns of a segment."""
        return 9 if self.first.position is None else 12

    def unknown(self, z: Array) -> ShootingUnknown:
        return jax.vmap(_changed)(self.first, z)

    def misfit(self, z: Array, ends: Array) -> Array:
        """In rad, in units of the reaction, and in lengths of the arm."""
        off = _misfit(self.scene, self.unknown(z), ends, self.segments)
        one = jnp.ones_like(self.unit[:3])
        units = jnp.concatenate([one, self.unit, self.scene.rod.length * one])
        return off / units[: self.size]

    def ends(self, z: Array) -> tuple[Array, Array, tuple]:
        """Reaction and rotation at the end of each segment, their derivatives by the segment's row
        of z, and of each segment the relative pose, whether diffrax succeeded, and its steps."""

        def one(row: Array, first: ShootingUnknown, start: Array, h: Array) -> tuple[Array, tuple]:
            end, found = self._end(row, first, start, h)
            return end, (end, found)

        rows = z, self.first, self.segments.start, self.segments.h
        slopes, (ends, found) = jax.vmap(jax.jacfwd(one, has_aux=True))(*rows)
        return ends, slopes, found

    def _end(
        self, row: Array, first: ShootingUnknown, start: Array, h: Array
    ) -> tuple[Array, tuple]:
        begin = _changed(first, row)
        scene, guess, control, all_of_it = self.scene, self.guess, self.control, jnp.ones_like(h)
        line, done, steps = integrate(scene, guess, control, start, h, begin, all_of_it, self.unit)
        end = [self.unit * line.wrench, (begin.rotation @ line.g[:3, :3]).reshape(-1)]
        if begin.position is not None:
            end.append(begin.position + begin.rotation @ line.g[:3, 3])
        return jnp.concatenate(end), (line.g, done, steps)


def _changed(first: ShootingUnknown, row: Array) -> ShootingUnknown:
    """The start of a segment, changed by its row of z."""
    return ShootingUnknown(
        first.rotation @ stacked_rotation(row[:3]),
        first.reaction + row[3:9],
        None if first.position is None else first.position + row[9:],
    )


def shoot(
    scene: Scene,
    guess: Guess,
    first: ShootingUnknown,
    segments: Grid,
    control: Control,
    tolerance: float,
) -> Shot:
    """Rotations and reactions at the start of the segments for which neighbours match."""
    number, unit = segments.h.size, wrench_scale(scene, first.reaction)
    match = _Matching(scene, guess, first, segments, control, unit)

    def step(at: _Iterate) -> _Iterate:
        z = at.following
        ends, slopes, (g, done, steps) = match.ends(z)
        linear = jax.jacfwd(
            lambda moved: match.misfit(moved, ends + jnp.einsum("sij,sj->si", slopes, moved - z))
        )(z)
        off = match.misfit(z, ends)
        dz = jnp.linalg.solve(linear.reshape(z.size, z.size), off.reshape(-1)).reshape(z.shape)
        size = jnp.max(jnp.abs(off))
        return _Iterate(z, z - dz, size, at.misfit, at.taken + 1, jnp.all(done), jnp.max(steps), g)

    def proceed(at: _Iterate) -> Array:
        # the step after the first that fits is taken too: it squares the misfit
        return (at.taken < _SHOTS) & (at.before > tolerance)

    zero = jnp.zeros((number, match.size), segments.h.dtype)
    none, far = jnp.zeros((), jnp.int32), jnp.asarray(jnp.inf, zero.dtype)
    poses = jnp.zeros((number, 4, 4), zero.dtype)
    begin = _Iterate(zero, zero, far, far, none, jnp.array(False), none, poses)
    found = while_loop(proceed, step, begin)
    unknown = match.unknown(found.z)
    base = jnp.eye(4, dtype=zero.dtype).at[:3, :3].set(unknown.rotation[0])
    last, starts = scan(lambda pose, increment: (pose @ increment, pose), base, found.poses)
    fits = found.done & (found.misfit <= tolerance)
    return Shot(segments, unknown, jnp.concatenate([starts, last[None]]), fits, found.steps)


class _Iterate(NamedTuple):
    """State of the shooting's Newton loop: a point and the one after it, the misfit at the point
    and at the one before, the number of steps, and for the point whether all segments could be
    integrated, the most steps that one took, and their relative poses."""

    z: Array
    following: Array
    misfit: Array
    before: Array
    taken: Array
    done: Array
    steps: Array
    poses: Array


def wrench_scale(scene: Scene, reaction: Array) -> Array:
    """Scale (6,) of reactions: the largest of `reaction` (segments, 6) or, if larger, the wrench
    that bends the arm by 1 rad."""
    length, stiffness = scene.rod.length, jnp.stack(scene.rod.stiffness(0.5 * scene.rod.length))
    moment = jnp.max(stiffness[:3]) / length
    bending = jnp.repeat(jnp.stack([moment, moment / length]), 3)
    return jnp.maximum(jnp.max(jnp.abs(reaction), axis=0), bending)


def _misfit(scene: Scene, unknown: ShootingUnknown, ends: Array, segments: Grid) -> Array:
    """Mismatch of the segments: rotation (3) at the start against the end of the segment before,
    reaction (6) at the end against the start of the next, and position (3) as the rotation."""
    base = base_pose(scene.rod.frame, ends.dtype)
    wrench, rotation, position = ends[:, :6], ends[:, 6:15].reshape(-1, 3, 3), ends[:, 15:]
    before = jnp.concatenate([base[None, :3, :3], rotation[:-1]])
    m = jnp.einsum("sji,sjk->sik", before, unknown.rotation)
    turn = unskew(m)
    carried = jnp.concatenate([unknown.reaction[1:], jnp.zeros_like(wrench[:1])])

    def added(carried: Array, X: Array, load: Array) -> Array:
        # to the segment that ends where the load acts
        here = jnp.arange(segments.h.size) == jnp.sum(segments.start < X) - 1
        return carried + jnp.where(here[:, None], load, 0.0)

    back = jax.vmap(lambda R, load: turned(R.T, load))
    for X, point in scene.point_wrenches("body"):
        carried = added(carried, X, jnp.stack(point))
    for X, point in scene.point_wrenches("world"):
        load = jnp.broadcast_to(jnp.stack(point), wrench.shape)
        carried = added(carried, X, back(rotation, load))
    places = position if position.size else jnp.zeros((segments.h.size, 3), ends.dtype)
    for load in scene.pose_loads:
        X = load.place(scene.rod)
        if X is not None:
            world = jax.vmap(partial(load.wrench, scene.rod, X))(rotation, places)
            carried = added(carried, X, back(rotation, world))
    parts = [turn, wrench - carried]
    if unknown.position is not None:
        parts.append(unknown.position - jnp.concatenate([base[None, :3, 3], position[:-1]]))
    return jnp.concatenate(parts, axis=1)
