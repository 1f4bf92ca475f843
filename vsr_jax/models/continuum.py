r"""The continuous Cosserat model (eq. 12), integrated by diffrax: without loads from the tip, where
$F_i(L) = F_a(L)$, to the base."""

from dataclasses import replace
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.scene import CrossSections, Scene
from ..elements.problem import loading
from ..mechanics.balance import (
    ALL,
    forces_where,
    residual,
    rounding_floor,
    solve_balance,
    strain_norm,
    tangent,
)
from ..mechanics.reaction import react_at
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import locate, make_grid
from ..numerics.se3 import coad, hat, inverse
from ..typing import Pose, Scalar, Twist
from ..validation import count, instance, positive
from .base import Model, Nodes, Outcome, Status, classify
from .shooting import Control, Guess, ShootingUnknown, Shot, integrate, shoot, wrench_scale
from .strain_dependent import StrainDependent

_ALLOWED = 100
"""Largest accepted imbalance or misfit in multiples of the tolerances: arms of the paper have less
than a tenth, and what crosses a bifurcation has far more."""


class Line(NamedTuple):
    """Strain, and pose relative to the base or the tip, at one abscissa or several."""

    xi: Array
    g: Array


class Found(NamedTuple):
    """State of the continuous model: the pose of the tip relative to the base, and the inputs."""

    tip: Pose
    inputs: Array


def cosserat_strain_rate(scene: Scene, tau: Forces, xi: Twist, X: Scalar) -> Twist:
    r"""Right side of eq. (12): $\xi' = (\Sigma - A)^{-1} (a - b - c)$.

    With $r = F_i - F_a$ the balance (8) is $r' + \mathrm{ad}^*_\xi r = 0$, and $r' = H \xi' +
    \partial r / \partial X$: so $\xi' = -H^{-1} (\partial r / \partial X + \mathrm{ad}^*_\xi r)$,
    where $-\partial r / \partial X = a - c$ of eq. (13) is taken by forward differentiation of the
    sections and $\mathrm{ad}^*_\xi r$ is b.
    """
    parts = c.split(xi)

    def imbalance(x: Scalar) -> tuple[Array, CrossSections]:
        sections = scene.sections(x)
        return c.join(residual(parts, sections, tau)), sections

    r, change, sections = jax.jvp(imbalance, (X,), (jnp.ones_like(X),), has_aux=True)
    H = c.cholesky(tangent(parts, sections, tau))
    return -c.join(c.cholesky_solve(H, c.split(change + coad(xi) @ r)))


class Continuum(Model):
    """The continuous model: an initial value problem in X, or with loads or jumps a boundary value
    problem (see `shooting`).

    Derivatives are implicit. The solution of eq. (8) satisfies the balance (21) at every X, so its
    exact derivative is that of the balance, computed by `derivative`, a `StrainDependent` model;
    the adaptive integration is never differentiated.

    **Arguments:**
    - `solver`: a diffrax solver, `diffrax.Dopri8()` by default.
    - `rtol`, `atol`: tolerances of the step size control, at least four times the machine epsilon.
    - `max_steps`: bound on the number of steps.
    - `segments`: segments of the multiple shooting, for arms with loads, jumps, prescribed thread
      lengths or friction.
    - `derivative`: the model that computes derivatives. For shooting it also gives the initial
      guess, and the tensions by thread lengths and friction.

    **Raises:** `ValueError` on solving a scene with held sections or obstacles, or whose tendons
    run straight from disc to disc.
    """

    solver: diffrax.AbstractSolver = eqx.field(static=True)
    rtol: float = eqx.field(static=True)
    atol: float = eqx.field(static=True)
    max_steps: int = eqx.field(static=True)
    segments: int = eqx.field(static=True)
    derivative: StrainDependent
    balanced_everywhere = True

    def __init__(
        self,
        solver: diffrax.AbstractSolver | None = None,
        rtol: float = 1e-8,
        atol: float = 1e-10,
        max_steps: int = 4096,
        segments: int = 8,
        derivative: StrainDependent | None = None,
    ):
        chosen = diffrax.Dopri8() if solver is None else solver
        self.solver = instance(
            "Continuum.solver", chosen, diffrax.AbstractSolver, "a diffrax solver"
        )
        self.rtol = positive("Continuum.rtol", rtol)
        self.atol = positive("Continuum.atol", atol)
        self.max_steps = count("Continuum.max_steps", max_steps)
        self.segments = count("Continuum.segments", segments)
        steps = StrainDependent(64) if derivative is None else derivative
        self.derivative = instance(
            "Continuum.derivative", steps, StrainDependent, "a StrainDependent model"
        )

    def solve(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        self.refuse_whole_arm(scene)
        tip, forces, status, steps = _tip(self, scene, inputs)
        return Outcome(Found(tip, inputs), forces, status, steps)

    def strain(
        self, scene: Scene, forces: Forces, state: Found, X: Float[Array, " stations"]
    ) -> Vector:
        return c.split(_line(self, scene, state.inputs, X).xi)

    def tip(self, scene: Scene, forces: Forces, state: Found) -> Pose:
        return _from_base(scene, state.tip)

    def poses(
        self, scene: Scene, forces: Forces, state: Found, X: Float[Array, " stations"]
    ) -> Float[Array, "stations 4 4"]:
        return _from_base(scene, _line(self, scene, state.inputs, X).g)

    def nodes(self, scene: Scene, forces: Forces, state: Found) -> Nodes:
        grid = self.derivative.grid(scene)
        xi = tuple(
            x.reshape(grid.X.shape) for x in self.strain(scene, forces, state, grid.X.reshape(-1))
        )
        if not scene.frictional:
            sections = scene.sections(grid.X)
            return Nodes(grid, xi, sections, sections.reach)
        on_steps = self.derivative.solve(scene, state.inputs).state
        return Nodes(
            grid,
            xi,
            scene.sections(grid.X),
            on_steps.shares_at(scene, grid, grid.X, forces),
        )

    def finer(self) -> "Continuum":
        return replace(self, rtol=0.01 * self.rtol, atol=0.01 * self.atol)

    def _control(self, dtype: Any) -> Control:
        finest = 4 * float(jnp.finfo(dtype).eps)
        return Control(self.solver, max(self.rtol, finest), max(self.atol, finest), self.max_steps)


def _from_base(scene: Scene, g: Array) -> Array:
    frame = scene.rod.frame
    return g if frame is None else frame @ g


def _initial_value(scene: Scene) -> bool:
    """Whether the arm is a single initial value problem: no coupling, no jumps, all strains
    free."""
    return not scene.coupled and not scene.breakpoints and scene.free == ALL


@eqx.filter_custom_jvp
def _tip(model: Continuum, scene: Scene, inputs: Array) -> tuple[Pose, Vector, Array, Array]:
    """Pose of the tip relative to the base, the thread forces, the status and the number of
    steps."""
    if not _initial_value(scene):
        shot, guess, status = _shoot(model, scene, inputs)
        sound = status == Status.CONVERGED
        tip = jnp.where(sound, _relative(scene, shot.poses[-1]), jnp.eye(4, dtype=shot.poses.dtype))
        return tip, forces_where(sound, guess.forces), status, shot.steps.astype(jnp.int32)
    ys, status, steps = _integrate(model, scene, inputs, diffrax.SaveAt(t1=True))
    line = jax.tree.map(lambda y: y[0], ys)
    tau, sections = scene.forces(inputs), scene.sections(jnp.zeros_like(scene.rod.length))
    imbalance = strain_norm(residual(c.split(line.xi), sections, tau), sections.stiffness)
    # Past a jump or a bifurcation the integration continues but is no longer balanced.
    control = model._control(line.xi.dtype)
    balanced = imbalance <= rounding_floor(sections.stiffness, tau) + _ALLOWED * (
        control.rtol + control.atol
    )
    status = jnp.where(
        (status == Status.CONVERGED) & ~balanced, Status.NOT_CONVERGED, status
    ).astype(jnp.int32)
    tip = jnp.where(status == Status.CONVERGED, inverse(line.g), jnp.eye(4, dtype=line.g.dtype))
    return tip, tau, status, steps


@_tip.def_jvp
def _tip_jvp(primals: tuple, tangents: tuple) -> tuple:
    def derivative(model: Continuum, scene: Scene, inputs: Array) -> tuple[Pose, Vector]:
        found = model.derivative.solve(scene, inputs)
        return model.derivative.tip(_at_origin(scene), found.forces, found.state), found.forces

    _, change = eqx.filter_jvp(derivative, primals, tangents)
    return _tip(*primals), (*change, None, None)


@eqx.filter_custom_jvp
def _line(model: Continuum, scene: Scene, inputs: Array, X: Array) -> Line:
    """Strain and pose relative to the base at abscissas X in any order."""
    if not _initial_value(scene):
        return _line_of_shot(model, scene, inputs, X)
    order = jnp.argsort(-X)
    line, _, _ = _integrate(model, scene, inputs, diffrax.SaveAt(ts=jnp.append(X[order], 0.0)))
    from_base = inverse(line.g[-1]) @ line.g[:-1]
    return jax.tree.map(lambda y: jnp.zeros_like(y).at[order].set(y), Line(line.xi[:-1], from_base))


@_line.def_jvp
def _line_jvp(primals: tuple, tangents: tuple) -> tuple[Line, Line]:
    def derivative(model: Continuum, scene: Scene, inputs: Array, X: Array) -> Line:
        steps = model.derivative
        found = steps.solve(scene, inputs)
        xi = c.join(steps.strain(scene, found.forces, found.state, X))
        poses = steps.poses(scene, found.forces, found.state, X)
        base = scene.rod.frame
        return Line(xi, poses if base is None else inverse(base) @ poses)

    _, change = eqx.filter_jvp(derivative, primals, tangents)
    return _line(*primals), change


def _relative(scene: Scene, g: Array) -> Array:
    """Poses relative to the base, from poses with the base's origin but the world's axes."""
    frame = scene.rod.frame
    if frame is None:
        return g
    turn = jnp.eye(4, dtype=g.dtype).at[:3, :3].set(frame[:3, :3].T)
    return turn @ g


def _shoot(model: Continuum, scene: Scene, inputs: Array) -> tuple[Shot, Guess, Array]:
    """Multiple shooting from the solution of `derivative`, and the status."""
    steps = model.derivative
    found = steps.solve(scene, inputs)
    grid, segments = steps.grid(scene), make_grid(scene.edges(), model.segments, 1)
    guess = Guess(grid, found.state, found.forces)
    loads = loading(scene, grid)
    zero = jnp.zeros_like(segments.start)
    wrench = (zero,) * 6 if loads is None else react_at(found.state.xi, grid, loads, segments.start)
    poses = steps.poses(scene, found.forces, found.state, segments.start)
    position = poses[:, :3, 3] if scene.needs_positions else None
    first = ShootingUnknown(poses[:, :3, :3], c.join(wrench), position)
    control = model._control(grid.h.dtype)
    shot = shoot(scene, guess, first, segments, control, _ALLOWED * max(control.rtol, control.atol))
    failed = jnp.where(found.status == Status.CONVERGED, Status.NOT_CONVERGED, found.status)
    return (
        shot,
        guess,
        jnp.where(shot.fits & (found.status == Status.CONVERGED), Status.CONVERGED, failed).astype(
            jnp.int32
        ),
    )


def _line_of_shot(model: Continuum, scene: Scene, inputs: Array, X: Array) -> Line:
    shot, guess, _ = _shoot(model, scene, inputs)
    segments, control = shot.segments, model._control(X.dtype)
    segment, part = locate(segments, X)
    unit = wrench_scale(scene, shot.unknown.reaction)

    def at(j: Array, part: Array) -> Line:
        begin = jax.tree.map(lambda x: x[j], shot.unknown)
        line, _, _ = integrate(
            scene, guess, control, segments.start[j], segments.h[j], begin, part, unit
        )
        return Line(line.xi, shot.poses[j] @ line.g)

    line = jax.vmap(at)(segment, part)
    return Line(line.xi, _relative(scene, line.g))


def _at_origin(scene: Scene) -> Scene:
    return eqx.tree_at(lambda s: s.rod.base, scene, None, is_leaf=lambda x: x is None)


def _integrate(
    model: Continuum, scene: Scene, inputs: Array, saveat: diffrax.SaveAt
) -> tuple[Line, Array, Array]:
    """Strain and pose relative to the tip at the abscissas of `saveat`, the status and the number
    of steps."""
    tau, length = scene.forces(inputs), scene.rod.length
    sections = scene.sections(length)
    end = solve_balance(sections, tau)
    status = classify(end.xi, sections, tau, end.balanced, end.definite)
    sound = status == Status.CONVERGED
    xi = jnp.where(sound, c.join(end.xi), c.join(sections.rest))
    tau = forces_where(sound, tau)

    def field(x: Any, line: Line, _: None) -> Line:
        return Line(cosserat_strain_rate(scene, tau, line.xi, x), line.g @ hat(line.xi))

    control = model._control(xi.dtype)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(field),
        model.solver,
        t0=length,
        t1=jnp.zeros_like(length),
        dt0=None,
        y0=Line(xi, jnp.eye(4, dtype=xi.dtype)),
        saveat=saveat,
        stepsize_controller=diffrax.PIDController(rtol=control.rtol, atol=control.atol),
        max_steps=model.max_steps,
        adjoint=diffrax.ForwardMode(),
        throw=False,
    )
    assert solution.ys is not None
    completed = solution.result == diffrax.RESULTS.successful
    status = jnp.where(sound & ~completed, Status.NOT_CONVERGED, status)
    return solution.ys, status, solution.stats["num_steps"].astype(jnp.int32)
