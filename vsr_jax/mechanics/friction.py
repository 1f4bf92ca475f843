r"""Friction of tendons: the capstan equation $\tau' = \mp \mu \varphi' \tau$ with the turning rate
$\varphi'$ of the tendon's path.

Where the strain jumps, at the end of another tendon or at a point force, or where the routing has a
corner, the path has a kink of angle $\Delta\varphi$. Over a kink the tension changes by the factor
$e^{\mp \mu \Delta\varphi}$.

The unit tangent of the path in the world frame is $R t$, so $\varphi' = |t' + k \times t|$. The
derivative of the strain along the arm follows from the balance, $H \xi' = \Lambda' - \partial r /
\partial X + B_\tau \tau'$, without finite differences.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..arm.routing import thread_tangent
from ..arm.scene import CrossSections, Scene
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, beyond, interpolation, locate, weighted, within
from ..numerics.stacked import components
from .balance import actuation_wrench, completed, free_block, free_components, residual, tangent
from .coupling import ArmProblem, ArmState, Coupling, Shares
from .sizes import node_weight, pull_of, softest


class Friction(Coupling):
    r"""All tendons of an arm with friction. The unknowns are the turning rates $\varphi'$ [rad/m]
    of their paths at the nodes, one array per tendon, and the rows their differences from those of
    the paths.

    - `places`: their places among the threads. `coefficients`: $\pm\mu$ of each, positive for pull.
    - `sections_rate`: $\partial / \partial X$ of the cross-sections at the nodes.
    - `breaks`: 1 for each step that starts at a breakpoint, where paths may have kinks; None if the
      arm has no breakpoints.
    """

    follows_rate = True
    places: tuple[int, ...] = eqx.field(static=True)
    coefficients: Vector
    sections_rate: CrossSections
    breaks: Array | None

    def relaxed(self) -> "Friction":
        return self

    def guess(self, forces: Forces, grid: Grid) -> Vector:
        return (jnp.zeros_like(grid.X),) * len(self.places)

    def shares(
        self, x: Vector, xi: Vector, sections: CrossSections, grid: Grid, shares: Shares
    ) -> Shares:
        found = list(shares)
        for place, turning, mu in zip(self.places, x, self.coefficients, strict=True):
            kinks = kinks_of(xi, sections, self.breaks, place, grid)
            found[place] = share_left(found[place], turning, kinks, mu, grid)
        return tuple(found)

    def shares_at(
        self, x: Vector, xi: Vector, scene: Scene, grid: Grid, X: Array, shares: Shares
    ) -> Shares:
        sections, found = scene.sections(grid.X), list(shares)
        for place, rate, mu in zip(self.places, x, self.coefficients, strict=True):
            reach, kinks = sections.reach[place], kinks_of(xi, sections, self.breaks, place, grid)
            found[place] = c.times(
                shares[place], decay_at(c.times(reach, rate), kinks, mu, grid, X)
            )
        return tuple(found)

    def residual(
        self, x: Vector, at: ArmState, note: None, problem: ArmProblem, free: tuple[int, ...]
    ) -> Vector:
        xi, sections = at.xi, problem.sections
        slopes = [jnp.zeros_like(xi[0])] * len(at.tau)
        for place, turning, mu in zip(self.places, x, self.coefficients, strict=True):
            slopes[place] = -mu * turning * at.tau[place]
        change = None
        if at.along is not None:
            wrench, density = components(at.along.wrench), components(at.along.body_density)
            change = reaction_rate(xi, wrench, density)
        tau = tuple(jnp.broadcast_to(force, xi[0].shape) for force in at.tau)
        xi_rate = balanced_strain_rate(
            xi, tau, tuple(slopes), change, sections, self.sections_rate, free
        )
        return c.subtract(x, self._rates(xi, xi_rate, sections))

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
        length = problem.length
        pulls = [pull_of(problem.sections, place, length) for place in self.places]
        return [
            length * at.tau[place] * rate * pull
            for place, rate, pull in zip(self.places, x, pulls, strict=True)
        ]

    def row_sizes(self, rows: Vector, at: ArmState, problem: ArmProblem) -> list[Array]:
        return self.sizes(rows, at, problem)

    def units(self, problem: ArmProblem) -> tuple[Vector, Vector]:
        turn = jnp.sqrt(node_weight(problem.grid) * softest(problem.sections.stiffness))
        return (turn,) * len(self.places), (1 / turn,) * len(self.places)

    def radians(self, problem: ArmProblem) -> Vector:
        return (jnp.sqrt(problem.grid.weight * problem.length),) * len(self.places)


def friction_of(scene: Scene, grid: Grid) -> Friction | None:
    """The friction of a scene's tendons on a grid; None without."""
    places = scene.frictional
    if not places:
        return None
    _, rate = jax.jvp(scene.sections, (grid.X,), (jnp.ones_like(grid.X),))
    coefficients = tuple(_coefficient(scene, place) for place in places)
    return Friction(places, coefficients, rate, breaks_of(scene.breakpoints, grid))


def _coefficient(scene: Scene, place: int) -> Array:
    friction = scene.actuators[place].signed_friction
    assert friction is not None  # see Scene.frictional
    return friction


def decay(turning: Array, kinks: Array | None, coefficient: Array, grid: Grid) -> Array:
    r"""Remaining share of the tension at the nodes, $e^{-\mu \varphi(X)}$, from the rates
    $\varphi'$ there and the kinks before each step."""
    angle = jnp.sum(grid.weight * turning, axis=(0, 1)) - beyond(turning[None], grid)[0]
    return jnp.exp(-coefficient * (angle if kinks is None else angle + jnp.cumsum(kinks, axis=0)))


def share_left(
    reach: Array | None, turning: Array, kinks: Array | None, coefficient: Array, grid: Grid
) -> Array:
    """Share of a thread's force at the nodes, from its reach (None for the whole arm), its turning
    rate and its kinks."""
    return c.times(reach, decay(c.times(reach, turning), kinks, coefficient, grid))


def decay_at(
    turning: Array, kinks: Array | None, coefficient: Array, grid: Grid, X: Array
) -> Array:
    """`decay` at abscissas X."""
    step, sigma = locate(grid, X)
    through = jnp.cumsum(jnp.sum(grid.weight * turning, axis=0))
    before = jnp.append(jnp.zeros_like(through[:1]), through[:-1])
    if kinks is not None:
        before = before + jnp.cumsum(kinks)
    return jnp.exp(-coefficient * (before[step] + within(turning[None], grid, step, sigma)[0]))


def breaks_of(breakpoints: tuple[Array, ...], grid: Grid) -> Array | None:
    """1 for each step of a grid that starts at a breakpoint, 0 for the others; None without
    breakpoints."""
    if not breakpoints:
        return None
    return jnp.any(grid.start[:, None] == jnp.stack(breakpoints), axis=1).astype(grid.h.dtype)


def kinks_of(
    xi: Vector, sections: CrossSections, breaks: Array | None, place: int, grid: Grid
) -> Array | None:
    r"""Angles $\Delta\varphi$ [rad] of a thread's path at the start of each step, between its
    tangents on both sides.

    The tangents are those of the polynomials through the nodes of both steps, so that the angle has
    their order. Both are in the frame of the same section, since rotations do not jump. The ends of
    the thread itself are not kinks.
    """
    if breaks is None:
        return None
    at_start, at_end = interpolation(grid.X.shape[0])[0], interpolation(grid.X.shape[0]).sum(axis=0)
    t_c = jnp.broadcast_arrays(*thread_tangent(xi, sections.paths[place]))
    before = tuple(weighted(at_end, x)[:-1] for x in t_c)
    after = tuple(weighted(at_start, x)[1:] for x in t_c)
    inside, reach = breaks[1:], sections.reach[place]
    if reach is not None:
        inside = inside * reach[-1, :-1] * reach[0, 1:]
    bend = c.cross(before, after)
    square = c.dot(bend, bend)
    kinked = (inside > 0) & (square > 0)
    sine = jnp.sqrt(jnp.where(kinked, square, 1.0))
    angle = jnp.where(kinked, jnp.arctan2(sine, c.dot(before, after)), 0.0)
    return jnp.concatenate([jnp.zeros_like(angle[:1]), angle])


def balanced_strain_rate(
    xi: Vector,
    tau: Forces,
    tau_rate: Forces,
    reaction_rate: Vector | None,
    sections: CrossSections,
    rate: CrossSections,
    free: tuple,
) -> Vector:
    r"""Derivative of the balanced strain along the arm, $\xi' = H^{-1} (\Lambda' - \partial r /
    \partial X + B_\tau \tau')$, six components.

    **Arguments:** `tau_rate`: $\tau'$; `reaction_rate`: $\Lambda'$, None without loads; `rate`: the
    derivative of `sections` along the arm.
    """

    def imbalance(sections: CrossSections) -> Vector:
        return residual(xi, sections, tau)

    change = jax.jvp(imbalance, *_alike((sections,), (rate,)))[1]
    right = c.subtract(actuation_wrench(xi, sections, tau_rate), change)
    right = right if reaction_rate is None else c.add(right, reaction_rate)
    factor = c.cholesky(free_block(tangent(xi, sections, tau), free))
    return completed(c.cholesky_solve(factor, free_components(right, free)), rate.rest, free)


def _alike(values: tuple, rates: tuple) -> tuple[Any, Any]:
    """Values and their rates broadcast to one shape: in a batch of arms either may be the same for
    all."""
    leaves, tree = jax.tree.flatten(values)
    pairs = [
        jnp.broadcast_arrays(x, dx) for x, dx in zip(leaves, jax.tree.leaves(rates), strict=True)
    ]
    return tuple(jax.tree.unflatten(tree, list(side)) for side in zip(*pairs, strict=True))


def turning_rate(
    xi: Vector, xi_rate: Vector, sections: CrossSections, rate: CrossSections, place: int
) -> Array:
    r"""Turning rate of a thread's path, $\varphi' = |t' + k \times t|$ [rad/m]."""
    t_c, t_c_rate = jax.jvp(
        thread_tangent, *_alike((xi, sections.paths[place]), (xi_rate, rate.paths[place]))
    )
    length = jnp.sqrt(c.dot(t_c, t_c))
    t = tuple(x / length for x in t_c)
    along = c.dot(t, t_c_rate)
    turn = c.add(
        tuple((a - along * b) / length for a, b in zip(t_c_rate, t, strict=True)),
        c.cross(xi[:3], t),
    )
    square = c.dot(turn, turn)
    straight = square <= 0
    return jnp.where(straight, 0.0, jnp.sqrt(jnp.where(straight, 1.0, square)))


def reaction_rate(xi: Vector, wrench: Vector, density: Vector) -> Vector:
    r"""Derivative of the reaction along the arm, $\Lambda' = -\mathrm{ad}^*_\xi \Lambda - (c, f)$,
    with the load density in the body frame."""
    k, u, M, N = xi[:3], xi[3:], wrench[:3], wrench[3:]
    moment = c.add(c.add(c.cross(k, M), c.cross(u, N)), density[:3])
    force = c.add(c.cross(k, N), density[3:])
    return c.scale(-1.0, (*moment, *force))
