r"""Friction of tendons: the capstan equation $\tau' = \mp \mu \varphi' \tau$ with the turning rate
$\varphi'$ of the tendon's path.

After a change of direction a part of the cable sticks: its tension stays what it was, until the
tension at the start has changed so much that it slips again. For a path of inputs (`after`) the
tension at each section therefore is that before, raised or lowered to the nearer end of

$$T e^{-\mu \varphi(X)} \le T(X) \le T e^{\mu \varphi(X)}.$$

Where the strain jumps, at the end of another tendon or at a point force, or where the routing has a
corner, the path has a kink of angle $\Delta\varphi$. Over a kink the tension changes by the factor
$e^{\mp \mu \Delta\varphi}$.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import CrossSections, Scene
from ..mechanics.coupling import (
    ArmProblem,
    ArmState,
    Carried,
    Coupling,
    Scales,
    Shares,
    ThreadRule,
)
from ..mechanics.sizes import node_weight, pull_of, softest
from ..mechanics.turning import (
    balanced_strain_rate,
    breaks_of,
    kinks_of,
    reaction_rate,
    turned,
    turned_at,
    turning_rate,
)
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.implicit import at_nodes
from ..numerics.quadrature import Grid
from ..numerics.stacked import components


class Memory(NamedTuple):
    """Tension [N] of a cable at the nodes and its derivative along the arm [N/m], for the inputs
    before the present ones."""

    tension: Array
    slope: Array


class Friction(ThreadRule):
    r"""All tendons of an arm with friction. The unknowns are the turning rates $\varphi'$ [rad/m]
    of their paths at the nodes, one array per tendon, and the rows their differences from those of
    the paths.

    - `places`: their places among the threads. `coefficients`: $\pm\mu$ of each, positive for pull.
    - `sections_rate`: $\partial / \partial X$ of the cross-sections at the nodes.
    - `breaks`: 1 for each step that starts at a breakpoint, where paths may have kinks; None if the
      arm has no breakpoints.
    - `memory`: of each, where the arm follows a path of inputs; None without.
    - `by_node`: see `prepared`.
    """

    follows_rate = True
    places: tuple[int, ...] = eqx.field(static=True)
    coefficients: Vector
    sections_rate: CrossSections
    breaks: Array | None
    memory: tuple[Memory, ...] | None = None
    by_node: bool = eqx.field(static=True, default=False)

    def relaxed(self) -> "Friction":
        return self

    def prepared(self) -> "Friction":
        return dataclasses.replace(self, by_node=True)

    def guess(self, forces: Forces, grid: Grid) -> Vector:
        return (jnp.zeros_like(grid.X),) * len(self.places)

    def carried(
        self, x: Vector, xi: Vector, problem: ArmProblem, forces: Forces, carried: Carried
    ) -> Carried:
        shares, gains = list(carried.shares), list(carried.gains)
        sections, grid = problem.sections, problem.grid
        for i, (place, turning, mu) in enumerate(
            zip(self.places, x, self.coefficients, strict=True)
        ):
            kinks = kinks_of(xi, sections, self.breaks, place, grid)
            angle = turned(c.times(sections.reach[place], turning), kinks, grid)
            share, slips = self._share(i, mu * angle, -forces[place], None)
            share = c.times(shares[place], share)
            shares[place] = share
            gains[place] = share if slips is None else slips * share
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
        sections, found = scene.sections(grid.X), list(shares)
        for i, (place, rate, mu) in enumerate(zip(self.places, x, self.coefficients, strict=True)):
            reach, kinks = sections.reach[place], kinks_of(xi, sections, self.breaks, place, grid)
            angle = turned_at(c.times(reach, rate), kinks, grid, X)
            share, _ = self._share(i, mu * angle, -forces[place], (grid.X, X))
            found[place] = c.times(shares[place], share)
        return tuple(found)

    def _share(
        self, i: int, decay: Array, tension: Array, at: tuple[Array, Array] | None
    ) -> tuple[Array, Array | None]:
        """`share_of` a tension; `at`: nodes and abscissas, if these are not the nodes."""
        before = None if self.memory is None else self.memory[i].tension
        if before is not None and at is not None:
            before = jnp.interp(at[1], *(value.T.reshape(-1) for value in (at[0], before)))
        return share_of(tension, decay, before)

    def _slopes(self, x: Vector, at: ArmState) -> Vector:
        r"""Derivatives $\tau'$ along the arm of the forces of all threads."""
        slopes = [jnp.zeros_like(at.xi[0])] * len(at.tau)
        for i, (place, turning, mu) in enumerate(
            zip(self.places, x, self.coefficients, strict=True)
        ):
            slope = -mu * turning * at.tau[place]
            if self.memory is not None:
                share, gain = at.carried.shares[place], at.carried.gains[place]
                assert share is not None
                slope = jnp.where(share > 1.0, -slope, slope)
                slope = jnp.where(gain == 0.0, -self.memory[i].slope, slope)
            slopes[place] = slope
        return tuple(slopes)

    def after(self, x: Vector, at: ArmState, problem: ArmProblem) -> "Friction":
        slopes = self._slopes(x, at)
        memory = tuple(Memory(-at.tau[place], -slopes[place]) for place in self.places)
        return self._with(memory)

    def remembering(self, other: Coupling, X: Array, grid: Grid) -> "Friction":
        assert isinstance(other, Friction)
        if other.memory is None:
            return self
        nodes = X.T.reshape(-1)
        return self._with(
            jax.tree.map(lambda y: jnp.interp(grid.X, nodes, y.T.reshape(-1)), other.memory)
        )

    def _with(self, memory: tuple["Memory", ...]) -> "Friction":
        coefficients = tuple(map(jnp.abs, self.coefficients))
        return Friction(self.places, coefficients, self.sections_rate, self.breaks, memory)

    def residual(
        self, x: Vector, at: ArmState, note: None, problem: ArmProblem, free: tuple[int, ...]
    ) -> Vector:
        reaction = None
        if at.along is not None:
            reaction = components(at.along.wrench), components(at.along.body_density)
        at = at._replace(
            carried=lax.stop_gradient(at.carried),  # tells only where the cables stick
            tau=tuple(jnp.broadcast_to(force, at.xi[0].shape) for force in at.tau),
            loads=None,
            along=None,
        )
        rows = at_nodes(partial(_rows, free)) if self.by_node else partial(_rows, free)
        return rows(self, x, at, reaction, problem.sections)

    def from_rate(self, xi: Vector, rate: Vector, sections: CrossSections) -> Vector:
        return self._rates(xi, c.add(rate, self.sections_rate.rest), sections)

    def _rates(self, xi: Vector, xi_rate: Vector, sections: CrossSections) -> Vector:
        return tuple(
            turning_rate(xi, xi_rate, sections, self.sections_rate, place) for place in self.places
        )

    def moved(self, x: Vector, X: Array, grid: Grid) -> Vector:
        nodes = X.T.reshape(-1)
        return tuple(jnp.interp(grid.X, nodes, rate.T.reshape(-1)) for rate in x)

    def sizes(self, x: Vector, at: ArmState, problem: ArmProblem) -> list[Array]:
        """By the effect of the rates on the tensions."""
        sections, length = problem.sections, problem.length
        pulls = [pull_of(sections, sections.paths[place], length) for place in self.places]
        return [
            length * at.tau[place] * rate * pull
            for place, rate, pull in zip(self.places, x, pulls, strict=True)
        ]

    def row_sizes(self, rows: Vector, at: ArmState, problem: ArmProblem) -> list[Array]:
        return self.sizes(rows, at, problem)

    def scales(self, problem: ArmProblem) -> Scales:
        """Rates of a path count as the angles over an arm that bends as fast."""
        bending = node_weight(problem.grid) * softest(problem.sections.stiffness)
        length = bending / jnp.sqrt(node_weight(problem.grid) * problem.length)
        every = len(self.places)
        return Scales((1 / bending,) * every, (length,) * every)


def _rows(
    free: tuple[int, ...],
    friction: Friction,
    x: Vector,
    at: ArmState,
    reaction: tuple[Vector, Vector] | None,
    sections: CrossSections,
) -> Vector:
    """Rows of the friction at the nodes, each from what is given at its node alone; `reaction`: the
    reaction to the loads and their density."""
    change = None if reaction is None else reaction_rate(at.xi, *reaction)
    slopes = friction._slopes(x, at)
    xi_rate = balanced_strain_rate(
        at.xi, at.tau, slopes, change, sections, friction.sections_rate, free
    )
    return c.subtract(x, friction._rates(at.xi, xi_rate, sections))


def share_of(tension: Array, decay: Array, before: Array | None) -> tuple[Array, Array | None]:
    """Share of the tension at the start that is left after a `decay`, the exponent of it, where the
    tension was `before`; and 1 where the cable slips, 0 where it sticks. Without a memory, None,
    it slips everywhere."""
    least = jnp.exp(-decay)
    if before is None:
        return least, None
    most = jnp.exp(decay)
    sticks = (before > tension * least) & (before < tension * most)
    kept = before / jnp.where(sticks, tension, 1.0)
    slipping = jnp.where(before >= tension * most, most, least)
    return jnp.where(sticks, kept, slipping), jnp.where(sticks, 0.0, 1.0)


def friction_of(scene: Scene, grid: Grid) -> Friction | None:
    """The friction of a scene's tendons along their paths on a grid; None without."""
    places = tuple(i for i in scene.frictional if i not in scene.straight)
    if not places:
        return None
    _, rate = jax.jvp(scene.sections, (grid.X,), (jnp.ones_like(grid.X),))
    coefficients = tuple(coefficient_of(scene, place) for place in places)
    return Friction(places, coefficients, rate, breaks_of(scene.breakpoints, grid))


def coefficient_of(scene: Scene, place: int) -> Array:
    """Coefficient of friction of a thread, positive for pull."""
    friction = scene.actuators[place].signed_friction
    assert friction is not None  # see Scene.frictional
    return friction
