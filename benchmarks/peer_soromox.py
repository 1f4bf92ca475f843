"""SoRoMoX in `bench_peers`: equilibrium as the minimum of an energy built from SoRoMoX's own
functions.

SoRoMoX (0.5) has no static solver. Its authors' scripts solve K q + G(q) = A(q) u by Newton's
method from q = 0. This is one of the rows for arms without loads; it diverges on the loaded arm B1,
which is very soft relative to its loads. `FORMULATIONS` lists the other formulations that were
tried. The one used is the fastest by far:

- an energy instead of the assembled forces: elastic energy, plus tension times path length, minus
  the work of the loads. Its reverse-mode gradient costs about three evaluations of the kinematics;
  the forces need a recurrence of Jacobians;
- coordinates whitened by the Cholesky factor of SoRoMoX's stiffness matrix, in which BFGS with unit
  steps converges after 10 to 15 gradients, without a Hessian or load steps;
- kinematics that evaluate all cells in a batch, with only the product of their steps in a scan
  (`cells`). SoRoMoX's own kinematics scan over the cells and take up to twice as long.

The conventions below follow SoRoMoX's sources and are confirmed by the convergence of its tip to
the reference. Strains are angular first, the rod is along x, the strain acts on the right of the
pose. The base pose is a quaternion (x, y, z, w) and a position; "horizontal" is the identity (the
default is "upright"). The input of a tendon is its tension >= 0, its coordinate minus the length of
its path.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix  # pyright: ignore[reportMissingImports]
from jax import Array
from peer_scenes import NEWTON
from soromox.actuation import ThreadlikeActuator, ThreadlikeRouting  # pyright: ignore[reportMissingImports]
from soromox.actuation.threadlike import BaseThreadlikeRoutingParams  # pyright: ignore[reportMissingImports]
from soromox.systems.components import JointSpec, LinkSpec  # pyright: ignore[reportMissingImports]
from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec  # pyright: ignore[reportMissingImports]
from soromox.utils.geometry.poses import spatial_mounting_pose  # pyright: ignore[reportMissingImports]
from soromox.utils.lie_algebra import se3  # pyright: ignore[reportMissingImports]

BFGS = "energy, BFGS, cells side by side (used)"


class Setting(NamedTuple):
    """Order of the basis of all six strains, Gauss points along the arm, step size in whitened
    coordinates that ends the iteration, family of the basis, and the formulation, a key of
    `UNLOADED`."""

    order: int
    points: int
    tolerance: float
    family: str = "legendre"
    way: str = BFGS

    def __str__(self) -> str:
        way = "" if self.way == BFGS else ", Newton"
        return f"{self.family} {self.order}, {self.points} points, step < {self.tolerance:g}{way}"


class HelixPath(BaseThreadlikeRoutingParams):
    """The numbers of a helical path, those of `vsr.Helix`, each of shape (1,)."""

    radius: Array
    angle: Array
    phase: Array
    start_segment_index: tuple[int, ...] = eqx.field(static=True, default=(0,))
    end_segment_index: tuple[int, ...] = eqx.field(static=True, default=(0,))

    @property
    def num_paths(self) -> int:
        """Number of paths."""
        return 1

    def validate_structure(self) -> None:
        """Part of SoRoMoX's protocol; nothing to check."""

    def validate_values(self) -> None:
        """Part of SoRoMoX's protocol; nothing to check."""


class Arm(NamedTuple):
    """A robot of SoRoMoX, the force on its tip [N], None for an arm without loads, and the matrix
    from whitened coordinates to those of the robot."""

    robot: Any
    force: Array | None
    whiten: Array


def offset(path: HelixPath, s: Array) -> Array:
    """Position [m] of the path in the section at s, in the body frame."""
    phi = path.phase + s / (path.radius * jnp.tan(path.angle))
    return jnp.stack([jnp.zeros_like(phi), path.radius * jnp.cos(phi), path.radius * jnp.sin(phi)])


def offset_slope(path: HelixPath, s: Array) -> Array:
    """Derivative of `offset` along the arm."""
    return jax.jvp(partial(offset, path), (s,), (jnp.ones_like(s),))[1]


def tendon(path: HelixPath) -> ThreadlikeActuator:
    """A tendon along the path."""
    return ThreadlikeActuator.tendons(
        ThreadlikeRouting(params=path, offset_fn=offset, derivative_fn=offset_slope)
    )


def build(setting: Setting, scene: dict[str, Any]) -> tuple[Arm, HelixPath]:
    """The arm with its loads, and its thread's path, from the numbers of the scene."""
    path = HelixPath(*(jnp.array([scene["helix"][name]]) for name in ("radius", "angle", "phase")))
    link = LinkSpec.circular(
        length=scene["length"],
        radius=scene["radius"],
        density=scene["density"],
        reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
        young_modulus=scene["young"],
        shear_modulus=scene["shear"],
    )
    basis = StrainBasisSpec(type=setting.family, strain_selector=[1] * 6, basis_order=setting.order)
    segment = GVSSegment(
        link=link, joint=JointSpec(type="fixed"), basis=basis, num_gauss_points=setting.points
    )
    mounting = spatial_mounting_pose("horizontal")
    gravity = jnp.array(scene["gravity"] or (0.0, 0.0, 0.0))
    robot = GVS.from_segments(
        [segment], gravity=gravity, base_pose=mounting, actuators=tendon(path)
    )
    whiten = jnp.linalg.inv(jnp.linalg.cholesky(robot.stiffness_matrix())).T
    return Arm(
        robot, None if scene["tip_force"] is None else jnp.array(scene["tip_force"]), whiten
    ), path


def own_kinematics(robot: Any, q: Array) -> Array:
    """Poses at the ends of all cells, by SoRoMoX's own scan over them."""
    return robot._forward_kinematics_gauss(robot._min_size_gathered(q))[0, 1:]


def cells(robot: Any, q: Array) -> Array:
    """The same poses with the cells in a batch: SoRoMoX's bases, two-point Magnus step and
    exponential."""
    q = robot._min_size_gathered(q)[0, 1]
    width = robot.segment_lengths[0] * robot.cell_widths[0][:, None]
    lower, upper = robot.B_Z1[0] @ q + robot.xi_ref_Z1[0], robot.B_Z2[0] @ q + robot.xi_ref_Z2[0]
    bracket = jax.vmap(se3.small_adjoint_action)(lower, upper)
    twists = width / 2 * (lower + upper) + jnp.sqrt(3) / 12 * width**2 * bracket
    steps = jax.vmap(se3.exp, (0, None))(twists, robot.global_eps)
    return jax.lax.scan(lambda pose, step: (pose @ step,) * 2, robot.g0, steps)[1]


def tip(arm: Arm, z: Array) -> Array:
    """Position of the tip [m] at whitened coordinates z."""
    return cells(arm.robot, arm.whiten @ z)[-1, :3, 3]


def energy(
    arm: Arm, path: HelixPath, tau: Array, z: Array, share: Any = 1.0, kinematics: Callable = cells
) -> Array:
    """Energy [J] at whitened coordinates z under the signed thread force tau [N], shape (1,), and a
    share of the loads."""
    robot, q = arm.robot, arm.whiten @ z
    own = robot.elastic_energy(q) + tau @ tendon(path).coordinates(robot, q)
    if arm.force is None:
        return own  # needs no kinematics
    positions = kinematics(robot, q)[:, :3, 3]
    masses = robot.inner_weighted_mass_diagonals[0, :, 3]
    return own - share * (masses @ (positions[:-1] @ robot.g[3:]) + positions[-1] @ arm.force)


def slope(arm: Arm, path: HelixPath, tau: Array, z: Array, share: Any = 1.0) -> Array:
    """Gradient of the energy with respect to z, zero at equilibrium."""
    return jax.grad(energy, argnums=3)(arm, path, tau, z, share)


def minimise(value_and_grad: Callable, z: Array, tolerance: float, max_steps: int = 60) -> Array:
    """BFGS from z with unit steps, halved while the energy does not decrease, until a step is
    shorter than the tolerance."""

    def step(state: tuple) -> tuple:
        z, value, slope, inverse, length, _, count = state
        move = -length * (
            inverse @ slope
        )  # zero in the first iteration, which evaluates value and slope at the start
        new_value, new_slope = value_and_grad(z + move)
        change = new_slope - slope
        curvature, image = move @ change, inverse @ change
        weighted = (1 + change @ image / curvature) * move - image
        update = (jnp.outer(weighted, move) - jnp.outer(move, image)) / curvature
        fell = new_value <= value + 1e-4 * (move @ slope) + 1e-15
        z, value, slope = (
            jnp.where(fell, new, old)
            for new, old in ((z + move, z), (new_value, value), (new_slope, slope))
        )
        inverse = jnp.where(curvature > 0, inverse + update, inverse)
        moved = jnp.where(fell & (count > 0), jnp.linalg.norm(move), jnp.inf)
        return z, value, slope, inverse, jnp.where(fell, 1.0, length / 2), moved, count + 1

    def unfinished(state: tuple) -> Array:
        return (state[5] > tolerance) & (state[6] < max_steps)

    start = (
        z,
        jnp.array(jnp.inf),
        jnp.zeros_like(z),
        jnp.eye(len(z)),
        jnp.array(1.0),
        jnp.array(jnp.inf),
        0,
    )
    return jax.lax.while_loop(unfinished, step, start)[0]


def equilibrium(
    arm: Arm, path: HelixPath, tau: Array, tolerance: float, kinematics: Callable = cells
) -> Array:
    """Whitened coordinates of the equilibrium, found from rest."""
    evaluate = jax.value_and_grad(energy, argnums=3)
    return minimise(
        lambda z: evaluate(arm, path, tau, z, 1.0, kinematics),
        jnp.zeros(len(arm.whiten)),
        tolerance,
    )


def height_gradient(
    arm: Arm, path: HelixPath, tau: Array, tolerance: float, solve: Callable = equilibrium
) -> HelixPath:
    """Derivative of the tip's height with respect to the numbers of the path, by implicit
    differentiation; the adjoint comes from conjugate gradients with Hessian products."""
    z = solve(arm, path, tau, tolerance)
    right = jax.grad(lambda z: tip(arm, z)[2])(z)
    _, hessian = jax.linearize(partial(slope, arm, path, tau), z)
    adjoint, _ = jax.scipy.sparse.linalg.cg(hessian, right, tol=1e-4)
    return jax.grad(lambda path: -slope(arm, path, tau, z) @ adjoint)(path)


def _forces(arm: Arm, path: HelixPath, tau: Array, z: Array, share: Any) -> Array:
    """Residual of SoRoMoX's authors, with the tip force through the Jacobian: K q - A(q) u
    + share (G(q) - J^T f)."""
    robot, q = arm.robot, arm.whiten @ z
    loads = robot.gravitational_force(q) - robot.jacobian_tips(q)[-1, 3:].T @ arm.force
    return arm.whiten.T @ (robot.elastic_force(q) - robot.actuation_force(q, -tau) + share * loads)


def _newton(residual: Callable, arm: Arm, path: HelixPath, tau: Array, tolerance: float) -> Array:
    """Newton's method with `jax.jacfwd`: one step at each of eight shares of the loads, then four
    more at full load."""

    def step(z: Array, share: Array) -> tuple[Array, None]:
        at = partial(residual, arm, path, tau, share=share)
        return z - jnp.linalg.solve(jax.jacfwd(at)(z), at(z)), None

    shares = jnp.minimum(jnp.arange(1, 13) / 8, 1.0)
    return jax.lax.scan(step, jnp.zeros(len(arm.whiten)), shares)[0]


def _optimistix(arm: Arm, path: HelixPath, tau: Array, tolerance: float) -> Array:
    solver = optimistix.BFGS(rtol=tolerance / 10, atol=tolerance / 10)
    rest = jnp.zeros(len(arm.whiten))
    return optimistix.minimise(
        lambda z, _: energy(arm, path, tau, z), solver, rest, max_steps=100, throw=False
    ).value


def _newton_from_rest(
    arm: Arm, path: HelixPath, tau: Array, tolerance: float, max_steps: int = 30
) -> Array:
    """Solution of K q = A(q) u, the form of SoRoMoX's authors, by Newton's method until a step is
    shorter than the tolerance; without loads."""

    def residual(z: Array) -> Array:
        q = arm.whiten @ z
        return arm.whiten.T @ (arm.robot.elastic_force(q) - arm.robot.actuation_force(q, -tau))

    def step(state: tuple) -> tuple:
        z, _, count = state
        move = jnp.linalg.solve(jax.jacfwd(residual)(z), residual(z))
        return z - move, jnp.linalg.norm(move), count + 1

    start = jnp.zeros(len(arm.whiten)), jnp.array(jnp.inf), 0
    return jax.lax.while_loop(
        lambda state: (state[1] > tolerance) & (state[2] < max_steps), step, start
    )[0]


FORMULATIONS: dict[str, Callable] = {
    "forces, Newton by jacfwd, 8 load steps": partial(_newton, _forces),
    "energy, Newton by jacfwd, 8 load steps": partial(_newton, slope),
    "energy, optimistix.BFGS": _optimistix,
    "energy, BFGS, SoRoMoX's own kinematics": partial(equilibrium, kinematics=own_kinematics),
    BFGS: equilibrium,
}
UNLOADED: dict[str, Callable] = {BFGS: equilibrium, NEWTON: _newton_from_rest}
