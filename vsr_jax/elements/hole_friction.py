r"""Friction of straight tendons in the holes of discs: the capstan equation at each.

A tendon leaves the hole of a disc at the angle $\varphi_i$ to its direction before it. Over the
hole its tension changes by the factor $e^{\mp \mu \varphi_i}$: minus while it is pulled, plus while
it is released. Between the holes it is the same. Along a path of inputs a chord keeps its tension,
raised or lowered to the nearer end of

$$T e^{-\mu \sum \varphi_i} \le T_i \le T e^{\mu \sum \varphi_i}$$

with the tension T of the first chord and the holes before the chord.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.scene import Scene
from ..arm.thread_lines import runs_between
from ..mechanics.applied_load import Exerted
from ..mechanics.coupling import (
    ArmProblem,
    ArmState,
    Carried,
    Coupling,
    Scales,
    Shares,
    ThreadRule,
)
from ..mechanics.sizes import softest
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, locate
from ..numerics.stacked import cross, dot
from .chords import pull_on, spans_of
from .friction import coefficient_of, share_of


class HoleFriction(ThreadRule):
    r"""All straight tendons of an arm with friction. The unknowns are the angles $\varphi_i$ [rad]
    at the starts of the spans between discs, one array (spans,) per tendon, zero where a tendon
    does not come from the span before; the rows are their differences from those of the chords.

    - `places`: their places among the threads. `coefficients`: $\pm\mu$ of each, positive for pull.
    - `inside`: 1 where a step lies in a span, (spans, steps); `opens`: for the first step of each.
    - `turns`: 1 where a tendon comes from the span before, (tendons, spans).
    - `memory`: tension [N] of each in the spans, where the arm follows a path of inputs.
    """

    follows_rate = True
    places: tuple[int, ...] = eqx.field(static=True)
    coefficients: Vector
    inside: Array
    opens: Array
    turns: Array
    memory: Vector | None = None

    def relaxed(self) -> "HoleFriction":
        return self

    def guess(self, forces: Forces, grid: Grid) -> Vector:
        none = jnp.zeros((self.turns.shape[1], *grid.h.shape[1:]), grid.h.dtype)
        return (none,) * len(self.places)

    def note(
        self, x: Vector, at: ArmState, own: tuple[Exerted, ...], problem: ArmProblem
    ) -> Vector:
        """The angles of the chords."""
        return tuple(self._angles(i, at) for i in range(len(self.places)))

    def _angles(self, i: int, at: ArmState) -> Array:
        pull = pull_on(at.exerted, self.places[i])
        assert pull is not None  # such a tendon runs along chords
        e = pull.direction[:, pull.tendons.places.index(self.places[i])]
        after = jnp.sum(self.opens * e[:, None], axis=2)
        before = jnp.concatenate([after[:, :1], after[:, :-1]], axis=1)
        normal = cross(before, after)
        square = dot(normal, normal)
        sine = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        return self.turns[i] * jnp.arctan2(sine, dot(before, after))

    def residual(
        self, x: Vector, at: ArmState, note: Vector, problem: ArmProblem, free: tuple[int, ...]
    ) -> Vector:
        return c.subtract(x, note)

    def carried(
        self, x: Vector, xi: Vector, problem: ArmProblem, forces: Forces, carried: Carried
    ) -> Carried:
        shares, gains = list(carried.shares), list(carried.gains)
        for i, place in enumerate(self.places):
            share, slips = self._share(i, x[i], -forces[place])
            share = c.times(shares[place], self._at_nodes(share, problem.grid))
            shares[place] = gains[place] = share
            if slips is not None:
                gains[place] = self._at_nodes(slips, problem.grid) * share
        return Carried(tuple(shares), tuple(gains))

    def shares_at(
        self,
        x: Vector,
        xi: Vector,
        scene: Scene,
        grid: Grid,
        X: Array,
        forces: Forces,
        shares: Shares,
    ) -> Shares:
        found, step = list(shares), locate(grid, X)[0]
        for i, place in enumerate(self.places):
            share, _ = self._share(i, x[i], -forces[place])
            found[place] = c.times(shares[place], self._at_nodes(share, grid)[0][step])
        return tuple(found)

    def _at_nodes(self, share: Array, grid: Grid) -> Array:
        """Values (spans,) at the nodes, zero beyond the last disc."""
        of_step = jnp.sum(share[:, None] * self.inside, axis=0)
        return jnp.broadcast_to(of_step, (grid.X.shape[0], *of_step.shape))

    def _share(self, i: int, x: Array, tension: Array) -> tuple[Array, Array | None]:
        """`share_of` the tension at the start in each span."""
        decay = self.coefficients[i] * jnp.cumsum(x, axis=0)
        return share_of(tension, decay, None if self.memory is None else self.memory[i])

    def after(self, x: Vector, at: ArmState, problem: ArmProblem) -> "HoleFriction":
        assert at.along is not None  # such tendons are loads
        forces = at.along.pose.forces
        return self._with(tuple(jnp.sum(self.opens * -forces[i], axis=1) for i in self.places))

    def remembering(self, other: Coupling, X: Array, grid: Grid) -> "HoleFriction":
        assert isinstance(other, HoleFriction)
        return self if other.memory is None else self._with(other.memory)

    def _with(self, memory: Vector) -> "HoleFriction":
        coefficients = tuple(map(jnp.abs, self.coefficients))
        return HoleFriction(self.places, coefficients, self.inside, self.opens, self.turns, memory)

    def scales(self, problem: ArmProblem) -> Scales:
        """Angles are compared by the energy of an arm that bends by them."""
        bends = softest(problem.sections.stiffness) / problem.length
        bends = jnp.max(bends, axis=(0, 1))
        every = len(self.places)
        return Scales((1 / bends,) * every, (bends,) * every)


def hole_friction_of(scene: Scene, grid: Grid) -> HoleFriction | None:
    """The friction of a scene's straight tendons on a grid; None without."""
    places = tuple(i for i in scene.straight if scene.actuators[i].frictional)
    if not places:
        return None
    tendons = [scene.actuators[i] for i in places]
    runs = jnp.stack([runs_between(scene.rod, tendon) for tendon in tendons])
    turns = jnp.pad(runs[:, 1:] * runs[:, :-1], [(0, 0), (1, 0)])
    span, first, _ = spans_of(scene.rod, grid)
    inside = span == jnp.arange(runs.shape[1])[:, None]
    opens = inside & (first == jnp.arange(grid.h.size))
    coefficients = tuple(coefficient_of(scene, i) for i in places)
    dtype = grid.h.dtype
    return HoleFriction(places, coefficients, inside.astype(dtype), opens.astype(dtype), turns)
