r"""Eigenvalues of the tangent stiffness, scaled so that an arm without forces has the eigenvalue 1;
the least is the stability margin.

The tangent is the derivative of the discrete residual (see `mechanics.arm_balance`), where the
wrenches of supports and contacts keep their sizes, restricted to the changes of strain that held
sections, contacts and taut cables allow. Threads whose force gives way with their length are
springs, $\partial \tau / \partial l \, w w^T$ with the wrench w of a unit force.
"""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from ..arm.scene import CrossSections, Scene
from ..elements.chords import chords_of
from ..elements.driven_threads import driven_of, thread_length
from ..elements.problem import loading
from ..mechanics.arm_balance import ArmUnknown, imbalance_of, state_of
from ..mechanics.balance import tangent, unit_wrench
from ..mechanics.coupling import ArmProblem, Constraint
from ..mechanics.reaction import rotations
from ..models.base import Nodes
from ..numerics import component as c, lu, stacked
from ..numerics.component import Vector, free_block, free_components, spread
from ..numerics.implicit import change_of
from ..numerics.lanczos import Operator, extreme_pairs
from ..numerics.loops import alike
from ..numerics.quadrature import Grid

_HOLDING = 0.5
"""Entry in the corner of a tangent system below which its row holds the arm: 1 where it does
not."""


def extreme_supported(
    problem: ArmProblem, unknown: ArmUnknown, free: tuple[int, ...], *, greatest: bool = False
) -> Array:
    """As `extreme`, of an arm with held sections or contacts."""
    (arm,) = alike(_supported(problem, unknown, free))
    return _extreme(arm, -1 if greatest else 0)


def extreme(
    scene: Scene, inputs: Array, forces: Vector, nodes: Nodes, *, greatest: bool = False
) -> Array:
    r"""Least or greatest eigenvalue of $\Sigma^{-1/2} H \Sigma^{-1/2}$: node by node without loads,
    of the whole arm with loads, straight tendons or laws of actuators.

    For the whole arm it is that of the symmetric part of the whole tangent, restricted to the
    changes of strain that the taut cables allow; NaN if the Lanczos method does not converge.
    Otherwise cables are ignored: a finite number of them cannot stiffen every section.
    """
    if scene.reacts or _yielding(scene):
        (arm,) = alike(arm_of(scene, inputs, forces, nodes))
        return _extreme(arm, -1 if greatest else 0)
    lower = free_block(tangent(nodes.xi, nodes.sections, nodes.tau(forces)), scene.free)
    root = jnp.sqrt(c.join(free_components(nodes.sections.stiffness, scene.free)))
    values = jnp.linalg.eigvalsh(
        c.join_matrix(c.symmetric(lower)) / (root[..., :, None] * root[..., None, :])
    )
    if nodes.sections.flexible is not None:
        bends = nodes.sections.flexible[..., None] > 0
        values = jnp.where(bends, values, -jnp.inf if greatest else jnp.inf)
    return jnp.max(values) if greatest else jnp.min(values)


class ScaledTangent(Operator):
    r"""Symmetric part of $W^{1/2} \Sigma^{-1/2} (\partial r / \partial \xi) \Sigma^{-1/2} W^{-1/2}$
    with W the weights of the nodes, on arrays of shape (free strains, stages, steps), where changes
    of strain are allowed: not on rigid pieces, at nodes of zero weight, and where something ties
    them.

    **Fields:** `problem` and `unknown`: the arm and its solution; `units` scales changes of the
    free strains, $\Sigma^{-1/2} W^{-1/2}$; `ties`: the scaled changes that held sections, contacts
    and taut cables prevent, rows C, and `share`, $(C C^T)^{-1} C$; `springs`: the scaled wrenches
    of threads that are springs, times the roots of the sizes of their stiffnesses, and the `signs`
    of these.
    """

    problem: ArmProblem
    unknown: ArmUnknown
    units: Float[Array, "strains stages steps"]
    ties: Float[Array, "ties changes"]
    share: Float[Array, "ties changes"]
    springs: Float[Array, "springs changes"]
    signs: Float[Array, " springs"]
    free: tuple[int, ...] = eqx.field(static=True)

    @property
    def like(self) -> Array:
        return self.units

    def allowed(self, v: Array) -> Array:
        v = jnp.where(self.units > 0, v, 0.0)
        if not len(self.ties):
            return v
        return v - (self.ties.T @ (self.share @ v.reshape(-1))).reshape(v.shape)

    def product(self) -> Callable[[Array], Array]:
        _, change = jax.linearize(self._imbalance, jnp.zeros_like(self.units))
        back = jax.linear_transpose(change, self.like)

        def times(v: Array) -> Array:
            v = self.allowed(v)
            return self.allowed(0.5 * (change(v) + back(v)[0]) + self._sprung(v))

        return times

    def form(self, v: Array) -> Array:
        """$v^T S v$ with S the scaled tangent."""
        v = self.allowed(v)
        change = jax.jvp(self._imbalance, (jnp.zeros_like(v),), (v,))[1] + self._sprung(v)
        return jnp.sum(v * change)

    def _sprung(self, v: Array) -> Array:
        """Product with the springs."""
        if not len(self.springs):
            return jnp.zeros_like(v)
        return (self.springs.T @ (self.signs * (self.springs @ v.reshape(-1)))).reshape(v.shape)

    def _imbalance(self, v: Array) -> Array:
        """The scaled residual after a scaled change of strain."""
        change = spread(tuple(self.units * v), self.free)
        xi = tuple(x + y for x, y in zip(self.unknown.xi, change, strict=True))
        unknown = self.unknown._replace(xi=xi)
        at = state_of(xi, unknown.coupled, self.problem)
        wrench = imbalance_of(unknown, at, self.problem, self.free).wrench
        return self.problem.grid.weight * self.units * jnp.stack(wrench)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _extreme(arm: ScaledTangent, place: int) -> Array:
    return extreme_pairs(arm).values[place]


@partial(_extreme.defjvp, symbolic_zeros=True)
def _extreme_jvp(place: int, primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    values, vectors = extreme_pairs(primals[0])
    return values[place], change_of(lambda arm: arm.form(vectors[place]), primals, tangents)


def arm_of(scene: Scene, inputs: Array, forces: Vector, nodes: Nodes) -> ScaledTangent:
    """The scaled tangent of an arm under loads, at a solution or at any other strain, for thread
    forces that change with lengths alone, and their shares along the arm."""
    sections, grid = nodes.sections._replace(reach=nodes.shares), nodes.grid
    xi = tuple(jnp.broadcast_to(x, grid.X.shape) for x in nodes.xi)
    problem = ArmProblem(grid, sections, forces, loading(scene, grid), ())
    units = _units_of(sections, grid)
    ties, springs, scale = [], [], grid.weight * units
    for place in scene.law_driven:
        wrench = _unit_wrench(scene, xi, nodes, place)
        row = tuple(jnp.broadcast_to(x, (1, *grid.X.shape)) for x in wrench)
        if place in scene.length_driven:
            ties.append(_ties(row, forces[place][None] < 0, scale, scene.free))
        else:
            thread = driven_of(scene, inputs[place], place, sections, grid)
            length = thread_length(scene, xi, sections, place, grid)
            share = nodes.shares[place]
            law = thread.law(-forces[place], length, share, grid)
            gives = thread.gives(law, share, grid)[None]
            rigid = gives == 0  # as a chamber of given volume
            spring = _spring(-law.by_length, gives, rigid)
            springs.append(_springs(row, spring, scale, scene.free))
            ties.append(_ties(row, rigid, scale, scene.free))
    return _tied(problem, ArmUnknown(xi, ()), units, ties, springs, scene.free)


def _yielding(scene: Scene) -> bool:
    """Whether the force of a thread gives way with its length."""
    return len(scene.law_driven) > len(scene.length_driven)


def _supported(problem: ArmProblem, unknown: ArmUnknown, free: tuple[int, ...]) -> ScaledTangent:
    """The scaled tangent of a solution with what holds the arm."""
    units = _units_of(problem.sections, problem.grid)
    at = state_of(unknown.xi, unknown.coupled, problem)
    ties, springs, scale = [], [], problem.grid.weight * units
    for coupling, x, note in zip(problem.couplings, unknown.coupled, at.notes, strict=True):
        if isinstance(coupling, Constraint):
            rows, corner = coupling.prevents(x, at, note, problem)
        else:
            border = coupling.border(x, at, note, problem)
            if border is None:
                continue
            rows, corner = border.rows, border.corner
            spring = _spring(-border.factors, corner, corner < _HOLDING)
            springs.append(_springs(rows, spring, scale, free))
        ties.append(_ties(rows, corner < _HOLDING, scale, free))
    return _tied(problem, unknown, units, ties, springs, free)


def _tied(
    problem: ArmProblem,
    unknown: ArmUnknown,
    units: Array,
    ties: list[Array],
    springs: list[tuple[Array, Array]],
    free: tuple[int, ...],
) -> ScaledTangent:
    """The scaled tangent from the units of all strains, the ties and the springs."""
    units = units[np.asarray(free)]
    none = jnp.zeros((0, units.size), units.dtype)
    tied = jnp.concatenate([none, *ties])
    share = _shares(tied) if ties else tied
    wrenches = jnp.concatenate([none, *(wrench for wrench, _ in springs)])
    signs = jnp.concatenate([none[:, 0], *(sign for _, sign in springs)])
    return ScaledTangent(problem, unknown, units, tied, share, wrenches, signs, free)


def _unit_wrench(scene: Scene, xi: Vector, nodes: Nodes, place: int) -> Vector:
    """Derivative of a thread's length by the strain at each node."""
    if scene.actuators[place].straight:
        rotation = rotations(stacked.stack(xi[:3]), nodes.grid.h, scene.rod.frame)[1]
        return chords_of(scene, xi, nodes.grid).unit(place, rotation)
    path = nodes.sections.paths[place]
    wrench = unit_wrench(xi, path)
    return c.times(nodes.sections.reach[place], wrench)


def _units_of(sections: CrossSections, grid: Grid) -> Float[Array, "strains stages steps"]:
    r"""Units of changes of all strains, $\Sigma^{-1/2} W^{-1/2}$ with W the weights of the nodes;
    zero on rigid pieces and at nodes of zero weight, where nothing changes."""
    stiffness = jnp.stack([jnp.broadcast_to(s, grid.X.shape) for s in sections.stiffness])
    there = grid.weight > 0
    if sections.flexible is not None:
        there &= sections.flexible > 0
    return jnp.where(there, 1 / jnp.sqrt(jnp.where(there, grid.weight, 1.0) * stiffness), 0.0)


def _ties(
    rows: Vector, holds: Bool[Array, " ties"], scale: Array, free: tuple[int, ...]
) -> Float[Array, "ties changes"]:
    """Unit rows over the scaled changes of the free strains, zero for rows that do not hold the
    arm: also where the free strains have no more than rounding of what all six have, as in the turn
    about its axis of a straight arm without torsion."""
    every = jnp.stack(rows, axis=1) * scale
    row = every[:, np.asarray(free)].reshape(len(every), -1)
    size, whole = (
        jnp.linalg.norm(lax.stop_gradient(x).reshape(len(x), -1), axis=1) for x in (row, every)
    )
    holds &= size > jnp.sqrt(jnp.finfo(size.dtype).eps) * whole
    return jnp.where(holds, 1 / jnp.where(holds, size, 1.0), 0.0)[:, None] * row


def _spring(push: Array, gives: Array, rigid: Array) -> Array:
    """Stiffness of what holds the arm: its force by its length over its force by its own unknown;
    zero where it is rigid, a tie."""
    return jnp.where(rigid, 0.0, push / jnp.where(rigid, 1.0, gives))


def _springs(
    rows: Vector, stiffness: Array, scale: Array, free: tuple[int, ...]
) -> tuple[Float[Array, "springs changes"], Float[Array, " springs"]]:
    """Scaled wrenches of springs, times the roots of the sizes of their stiffnesses, and the signs
    of these."""
    row = (jnp.stack(rows, axis=1) * scale)[:, np.asarray(free)].reshape(len(stiffness), -1)
    there = stiffness != 0  # the root has no derivative at zero
    root = jnp.where(there, jnp.sqrt(jnp.abs(jnp.where(there, stiffness, 1.0))), 0.0)
    return root[:, None] * row, jnp.sign(stiffness)


def _shares(ties: Array) -> Array:
    """The matrix $(C C^T)^{-1} C$ of rows C, some of them zero, some nearly the same."""
    gram, eps = ties @ ties.T, jnp.finfo(ties.dtype).eps
    gram = gram + jnp.diag(jnp.where(jnp.any(ties != 0, axis=1), 16 * eps, 1.0))
    factors = lu.factor(gram)
    return jax.vmap(lambda b: lu.substitute(factors, b), 1, 1)(ties)
