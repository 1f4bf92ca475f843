r"""The continuous model of a loaded arm: a boundary value problem, solved by multiple shooting with
diffrax.

With $\Lambda = F_i - F_a$ eq. 8 reads $\Lambda' = -\mathrm{ad}^*_\xi \Lambda - (c, f)$ and eq. 12
becomes

$$\xi' = (\Sigma - A)^{-1} (\Lambda' - \partial r / \partial X + B_\tau \tau'), \quad
g' = g \hat\xi,$$

with $\Lambda = r(\xi)$. The rotation is known at the base and the reaction at the tip. Single
shooting over a long soft arm is ill-conditioned, so the arm is divided into segments, also at its
breakpoints. The unknowns are the rotation and the reaction at the start of each segment, continuous
except for point loads. The initial guess is a solution on steps.
"""

from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import CrossSections, Scene, shared
from ..mechanics.arm_balance import shares_at
from ..mechanics.balance import residual, solve_balance
from ..mechanics.friction import balanced_strain_rate, reaction_rate
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid
from ..numerics.se3 import base_pose, hat, rotation_components, unskew

_SHOTS = 12
"""Bound on the Newton steps of the shooting; from a solution on steps they converge
quadratically."""
_INSIDE = 1e-10
"""Distance from the ends of a segment, as a fraction of it, at which it is evaluated there: at a
jump the values are those inside the segment."""


class Guess(NamedTuple):
    """A solution on steps: its grid, strain there, the thread forces at their start and the turning
    rates of tendons with friction."""

    grid: Grid
    xi: Vector
    forces: Forces
    turning: Vector


class ShootingUnknown(NamedTuple):
    """Rotation (3, 3) and reaction (6,) at the start of each segment."""

    rotation: Array
    reaction: Array


class Line(NamedTuple):
    """State integrated over a segment: the strain, and the pose relative to the start."""

    xi: Array
    g: Array


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
    rotation: Array,
    reaction: Array,
    part: Array,
) -> tuple[Line, Array, Array]:
    """Strain and pose relative to the start of a segment at a fraction `part` of it, whether
    diffrax succeeded, and its steps."""
    free = scene.free

    def at(t: Array) -> tuple[Array, CrossSections, Vector]:
        x = start + h * (_INSIDE + (1 - 2 * _INSIDE) * t)
        shares = shares_at(scene, guess.xi, guess.turning, guess.grid, x)
        return x, scene.sections(x), shared(guess.forces, shares)

    def field(t: Any, line: Line, _: None) -> Line:
        (x, sections, tau), rate = jax.jvp(at, (jnp.asarray(t, h.dtype),), (jnp.ones((), h.dtype),))
        per_length = jnp.where(h > 0, h, 1.0)
        rate = jax.tree.map(lambda v: v / per_length, rate)
        xi = c.split(line.xi)
        wrench = residual(xi, sections, tau)
        density = _body_density(scene, x, rotation @ line.g[:3, :3])
        xi_rate = balanced_strain_rate(
            xi, tau, rate[2], reaction_rate(xi, wrench, density), sections, rate[1], free
        )
        return Line(h * c.join(xi_rate), h * (line.g @ hat(line.xi)))

    _, sections, tau = at(jnp.zeros_like(h))
    xi = c.join(solve_balance(sections, tau, c.split(reaction), free).xi)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        control.solver,
        t0=jnp.zeros_like(h),
        t1=jnp.maximum(part, _INSIDE),
        dt0=None,
        y0=Line(xi, jnp.eye(4, dtype=h.dtype)),
        saveat=diffrax.SaveAt(t1=True),
        stepsize_controller=diffrax.PIDController(rtol=control.rtol, atol=control.atol),
        max_steps=control.max_steps,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    assert solution.ys is not None
    line = jax.tree.map(lambda y: y[0], solution.ys)
    return line, solution.result == diffrax.RESULTS.successful, solution.stats["num_steps"]


def _body_density(scene: Scene, X: Array, rotation: Array) -> Vector:
    """Density (c, f) of all loads in the body frame."""
    total = (jnp.zeros_like(X),) * 6
    dead, follower = scene.density(X, "world"), scene.density(X, "body")
    if dead is not None:
        total = c.add(
            total,
            c.split(
                jnp.concatenate(
                    [rotation.T @ jnp.stack(dead[:3]), rotation.T @ jnp.stack(dead[3:])]
                )
            ),
        )
    return total if follower is None else c.add(total, follower)


def shoot(
    scene: Scene,
    guess: Guess,
    first: ShootingUnknown,
    segments: Grid,
    control: Control,
    tolerance: float,
) -> Shot:
    """Rotations and reactions at the start of the segments for which neighbours match."""

    def over(start: Array, h: Array, rotation: Array, reaction: Array) -> tuple[Array, tuple]:
        """Reaction and rotation at the end, as one array."""
        line, done, steps = integrate(
            scene, guess, control, start, h, rotation, reaction, jnp.ones_like(h)
        )
        x = start + h * (1 - _INSIDE)
        tau = shared(guess.forces, shares_at(scene, guess.xi, guess.turning, guess.grid, x))
        wrench = c.join(residual(c.split(line.xi), scene.sections(x), tau))
        return jnp.concatenate([wrench, (rotation @ line.g[:3, :3]).reshape(-1)]), (
            line.g,
            done,
            steps,
        )

    count = segments.h.size
    scale = _scale(scene, first, count)

    def turned(R: Array, k: Array) -> Array:
        return R @ c.join_matrix(rotation_components(c.split(k)))

    def place(z: Array) -> ShootingUnknown:
        return ShootingUnknown(
            jax.vmap(turned)(first.rotation, z[:, :3]), first.reaction + z[:, 3:]
        )

    def misfit(z: Array, ends: Array) -> Array:
        return _misfit(scene, place(z), ends, segments) / scale

    def step(carry: tuple) -> tuple:
        z, _, taken, _, _, _ = carry

        def one(
            z_row: Array, R: Array, reaction: Array, start: Array, h: Array
        ) -> tuple[Array, tuple]:
            end, aux = over(start, h, turned(R, z_row[:3]), reaction + z_row[3:])
            return end, (end, aux)

        rows = (z, first.rotation, first.reaction, segments.start, segments.h)
        slopes, (ends, (g, done, steps)) = jax.vmap(jax.jacfwd(one, has_aux=True))(*rows)
        linear = jax.jacfwd(lambda z_: misfit(z_, ends + jnp.einsum("sij,sj->si", slopes, z_ - z)))(
            z
        )
        size = z.size
        off = misfit(z, ends)
        dz = jnp.linalg.solve(linear.reshape(size, size), off.reshape(size)).reshape(z.shape)
        return z - dz, jnp.max(jnp.abs(off)), taken + 1, jnp.all(done), jnp.max(steps), g

    def proceed(carry: tuple) -> Array:
        return (carry[2] < _SHOTS) & (carry[1] > tolerance)

    z0 = jnp.zeros((count, 9), segments.h.dtype)
    start = (
        z0,
        jnp.asarray(jnp.inf, z0.dtype),
        0,
        jnp.array(True),
        jnp.zeros((), int),
        jnp.zeros((count, 4, 4), z0.dtype),
    )
    z, off, _, done, steps, g = lax.while_loop(proceed, step, start)
    unknown = place(z)
    base = jnp.eye(4, dtype=z.dtype).at[:3, :3].set(unknown.rotation[0])
    last, starts = lax.scan(lambda pose, increment: (pose @ increment, pose), base, g)
    return Shot(
        segments, unknown, jnp.concatenate([starts, last[None]]), done & (off <= tolerance), steps
    )


def _scale(scene: Scene, first: ShootingUnknown, count: int) -> Array:
    """Scales of the unknowns of each segment: 1 rad, and the reaction or, if larger, the wrench
    that bends the arm by 1 rad."""
    length = scene.rod.length
    moment = jnp.max(jnp.stack(scene.rod.stiffness(0.5 * length)[:3])) / length
    size = jnp.maximum(
        jnp.max(jnp.abs(first.reaction), axis=0),
        jnp.repeat(jnp.stack([moment, moment / length]), 3),
    )
    return jnp.broadcast_to(jnp.concatenate([jnp.ones_like(size[:3]), size]), (count, 9))


def _misfit(scene: Scene, unknown: ShootingUnknown, ends: Array, segments: Grid) -> Array:
    """Mismatch of the segments: rotation (3) at the start against the end of the segment before,
    reaction (6) at the end against the start of the next."""
    base = base_pose(scene.rod.base, ends.dtype)[:3, :3]
    wrench, rotation = ends[:, :6], ends[:, 6:].reshape(-1, 3, 3)
    before = jnp.concatenate([base[None], rotation[:-1]])
    m = jnp.einsum("sji,sjk->sik", before, unknown.rotation)
    turn = unskew(m)
    carried = jnp.concatenate([unknown.reaction[1:], jnp.zeros_like(wrench[:1])])
    for frame in ("world", "body"):
        for X, point in scene.point_wrenches(frame):
            # the segment that ends where the load acts
            here = jnp.arange(segments.h.size) == jnp.sum(segments.start < X) - 1
            load = jnp.stack(point)
            if frame == "world":
                load = jnp.concatenate(
                    [jnp.einsum("sji,j->si", rotation, part) for part in (load[:3], load[3:])],
                    axis=1,
                )
            carried = carried + jnp.where(here[:, None], load, 0.0)
    return jnp.concatenate([turn, wrench - carried], axis=1)
