r"""The nearest points of the steps of an arm to obstacles (see `touch`).

All steps, obstacles and arms are searched side by side, in arrays (obstacles, steps, *arms). The
position on a step is a polynomial, whose derivatives are known; so a point of the search costs one
distance and its derivatives along the axis. Only these depend on the kind of an obstacle: those of
one kind share a program, and all kinds share the rest.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..arm.obstacles import Obstacle
from ..arm.rod import Rod
from ..numerics.batching import arms_in
from ..numerics.loops import alike, while_loop
from ..numerics.once import once
from ..numerics.quadrature import Grid, interpolation, weighted
from ..numerics.stacked import cross, matvec

_SAMPLES, _ITERATIONS = 5, 8
"""Points of a step from which the nearest one starts, and bound on the Newton steps from it."""


class Nearest(NamedTuple):
    """The nearest points, arrays (..., obstacles, steps, *arms).

    **Fields:** `sigma`, place in the step; `gap` there [m], and `raised` by the term in epsilon;
    `outline`: radius of the arm [m]; `normal` (3) and `place` (3) in the world; `bend` (3, 3):
    derivative of the normal by the place; `moved` (6) and `slide`: the nearest point slides in the
    step by their product with a motion of the section; `nearer`: 1 or -1 where points beyond the
    end or the start of the step are nearer, else 0.
    """

    sigma: Array
    gap: Array
    raised: Array
    outline: Array
    normal: Array
    place: Array
    bend: Array
    moved: Array
    slide: Array
    nearer: Array


def nearest_points(
    obstacles: tuple[Obstacle, ...],
    rod: Rod,
    flatness: Array,
    starts: Array,
    axis: Array,
    grid: Grid,
) -> Nearest:
    """The nearest points of all steps to all obstacles, and behind them in the axis of obstacles
    the ends of all steps for those of `lying`.

    **Arguments:** `starts`: positions (3, steps, *arms) of the starts of the steps; `axis`: p' (3,
    stages, steps, *arms) at the nodes.
    """
    kinds, order = _kinds(obstacles)
    powers = once(_polynomial(starts, axis, grid.h)[:, :, None])
    curves = _Curves(kinds, rod, flatness, powers, grid.start, grid.h)
    curves, s = curves.begun()
    s = _search(*lax.stop_gradient((curves, s)))
    rate, curvature = curves.lines(s)
    curvature = lax.stop_gradient(curvature)
    inside = (s > 0) & (s < 1) & (curvature > 0)
    curvature = jnp.where(inside, curvature, 1.0)
    # its derivative by the shape is that of the root of the slope
    s = once(jnp.clip(s - jnp.where(inside, rate / curvature, 0.0), 0.0, 1.0))
    slope, slide = lax.stop_gradient(rate), jnp.where(inside, -1 / curvature, 0.0)
    nearer = ((s >= 1) & (slope < 0)).astype(s.dtype) - ((s <= 0) & (slope > 0)).astype(s.dtype)
    given = s, curves.excess(s), slide, nearer
    kinds, order, given = _with_ends(lying(obstacles), kinds, order, given)
    found = curves._replace(kinds=kinds).point(*given)
    if order == sorted(order):
        return found
    back = np.argsort(order)
    return jax.tree.map(lambda x: jnp.take(x, back, axis=x.ndim - s.ndim), found)


def lying(obstacles: tuple[Obstacle, ...]) -> list[int]:
    """The places of obstacles that the ends of steps may touch too: those without friction, since
    with it more of the arms that slip along them would be refused."""
    return [i for i, one in enumerate(obstacles) if one.lies_along and one.friction is None]


class _Kind(eqx.Module):
    """Obstacles of one kind as one whose numbers have their axis in front, and how many they
    are."""

    numbers: Obstacle
    count: int = eqx.field(static=True)


class _Curves(NamedTuple):
    """All steps near all obstacles: these kind by kind; the rod; epsilon; coefficients (stages + 1,
    3, 1, steps, *arms) of the position by powers of the place in the step; start and length of the
    steps."""

    kinds: tuple["_Kind", ...]
    rod: Rod
    epsilon: Array
    powers: Array
    X: Array
    h: Array

    def begun(self) -> tuple["_Curves", Array]:
        """The curves with less epsilon the more the gaps bulge, and the best samples of places."""
        samples = np.linspace(0.0, 1.0, _SAMPLES).tolist()
        gaps = jax.vmap(self.gaps)(jnp.asarray(samples, self.h.dtype))
        middle = gaps[_SAMPLES // 2]
        bulge = jnp.maximum(0.5 * (gaps[0] + gaps[-1]) - middle, 0.0) / self.epsilon
        curves = self._replace(epsilon=once(self.epsilon * jnp.exp(-(bulge**2))))
        best, least = jnp.zeros_like(middle), jnp.full_like(middle, jnp.inf)
        for s, gap in zip(samples, gaps, strict=True):
            raised = gap + curves.excess(s)
            best = jnp.where(raised < least, s, best)
            least = jnp.minimum(raised, least)
        return curves, best

    def point(self, s: Array, excess: Array, slide: Array, nearer: Array) -> Nearest:
        """What is known of points at places in the steps, the rest given."""
        place, along, _ = self.places(s)
        distance, normal, bend = self.shapes(place)
        outline = self.outlines(s)
        gap = distance - outline
        moved = jnp.concatenate([cross(along, normal), matvec(bend, along)])
        return Nearest(s, gap, gap + excess, outline, normal, place, bend, moved, slide, nearer)

    def places(self, s: Array) -> tuple[Array, Array, Array]:
        """Positions (3, ...) at places in the steps, and their first two derivatives."""
        place = self.powers[-1]
        first = second = jnp.zeros_like(place)
        for power in self.powers[-2::-1]:
            second = 2 * first + s * second
            first = place + s * first
            place = power + s * place
        return place, first, second

    def shapes(self, place: Array) -> tuple[Array, Array, Array]:
        """Distances at positions, their gradients and their second derivatives.

        These are the changes of the gradients of all points by their motion along each axis: arms
        stay the last axis."""

        def slopes(place: Array) -> tuple[Array, Array]:
            distance, normal = self.of_obstacles(_slope, place)
            return normal, distance

        def bent(axis: Array) -> tuple[Array, Array, Array]:
            along = jnp.broadcast_to(axis.reshape(3, *(1,) * (place.ndim - 1)), place.shape)
            at, along = alike(place, along)
            normal, change, distance = jax.jvp(slopes, (at,), (along,), has_aux=True)
            return distance, normal, change

        return jax.vmap(bent, out_axes=(None, None, 1))(jnp.eye(3, dtype=place.dtype))

    def gaps(self, s: Array) -> Array:
        """Gaps at places in the steps."""
        (distance,) = self.of_obstacles(_distance, self.places(s)[0])
        return distance - self.outlines(s)

    def excess(self, s: Array | float) -> Array:
        """What is added to the gaps, the term in epsilon."""
        return self.epsilon * (2 * s - 1) ** 2

    def lines(self, s: Array) -> tuple[Array, Array]:
        """First and second derivative of the raised gaps."""
        slope, curvature = self.of_obstacles(_along, *self.places(s))
        first, second = self.of_outlines(_outline_along, s)
        slope = slope - first + 4 * self.epsilon * (2 * s - 1)
        return slope, curvature - second + 8 * self.epsilon

    def outlines(self, s: Array) -> Array:
        """Radii of the outline."""
        return self.of_outlines(lambda rod, X, h: (rod.outline(X),), s)[0]

    def of_obstacles(self, function: Callable, *vectors: Array) -> tuple[Array, ...]:
        """Arrays by a function of every obstacle and vectors (3, ...) of one step of one arm."""
        found, first = [], 0
        for kind in self.kinds:
            own = [
                jnp.broadcast_to(x, (3, kind.count, *x.shape[2:]))
                if x.shape[1] == 1
                else lax.slice_in_dim(x, first, first + kind.count, axis=1)
                for x in vectors
            ]
            found.append(self._each(function, kind.numbers, 0, *own))
            first += kind.count
        place = -1 - self.h.ndim
        return tuple(jnp.concatenate(x, axis=x[0].ndim + place) for x in zip(*found, strict=True))

    def of_outlines(self, function: Callable, s: Array) -> tuple[Array, ...]:
        """Arrays by a function of the rod, an abscissa and the length of its step."""
        X = jnp.broadcast_arrays(self.X + s * self.h, self.h[None])[0]
        return self._each(function, self.rod, None, X, jnp.broadcast_to(self.h, X.shape))

    def _each(self, function: Callable, of: Any, axis: int | None, *given: Array) -> Any:
        """A function of every obstacle, step and arm, whose axes come last. `axis`: that of the
        obstacles in the numbers that the function is of, None without."""
        behind = self.h.ndim - 1
        if behind:
            arms = arms_in((of, given), behind)
            of, given = jax.tree.map(
                lambda x: jnp.broadcast_to(x, (*x.shape[: x.ndim - behind], *arms)), (of, given)
            )
            function = jax.vmap(function, -1, -1)
        steps, obstacles = -1 - behind, -2 - behind
        function = jax.vmap(function, (None, *(steps for _ in given)), steps)
        return jax.vmap(function, (axis, *(obstacles for _ in given)), obstacles)(of, *given)


def _with_ends(
    ends: list[int], kinds: tuple[_Kind, ...], order: list[int], given: tuple[Array, ...]
) -> tuple[tuple[_Kind, ...], list[int], tuple[Array, ...]]:
    """Kinds, their order and numbers (obstacles, steps, *arms) of points, with the ends of steps as
    further obstacles, behind all others in the order."""
    first, places, parts, counted = 0, [], [], []
    for kind in kinds:
        own, last = order[first : first + kind.count], first + kind.count
        part = [lax.slice_in_dim(x, first, last) for x in given]
        places, first = places + own, last
        if own[0] in ends:
            none = jnp.zeros_like(part[0])
            tip = none + 1.0, none, none, none
            part = [jnp.concatenate(x) for x in zip(part, tip, strict=True)]
            twice = jax.tree.map(lambda x: jnp.concatenate([x, x]), kind.numbers)
            kind = _Kind(twice, 2 * kind.count)
            places = places + [len(order) + ends.index(i) for i in own]
        parts.append(part)
        counted.append(kind)
    return tuple(counted), places, tuple(jnp.concatenate(x) for x in zip(*parts, strict=True))


def _distance(obstacle: Obstacle, place: Array) -> tuple[Array]:
    return (obstacle.distance(place),)


def _along(obstacle: Obstacle, place: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """First and second derivative of the distance along a curve."""

    def slope(place: Array, first: Array) -> Array:
        return jax.jvp(obstacle.distance, (place,), (first,))[1]

    place, first, second = alike(place, first, second)
    return jax.jvp(slope, (place, first), (first, second))


def _outline_along(rod: Rod, X: Array, h: Array) -> tuple[Array, Array]:
    """First and second derivative of the outline by the place in a step."""

    def slope(X: Array) -> Array:
        return jax.jvp(rod.outline, (X,), (h,))[1]

    X, h = alike(X, h)
    return jax.jvp(slope, (X,), (h,))


def _slope(obstacle: Obstacle, place: Array) -> tuple[Array, Array]:
    """The distance at a place and its gradient."""
    return jax.value_and_grad(obstacle.distance)(place)


def _search(curves: _Curves, first: Array) -> Array:
    """The places where the raised gaps are least, by Newton's method."""
    tolerance = jnp.finfo(first.dtype).eps ** 0.5

    def closer(state: tuple) -> tuple:
        s, last, count = state
        slope, curvature = curves.lines(s)
        change = jnp.where(curvature > 0, slope / curvature, jnp.sign(slope))
        next = jnp.clip(s - jnp.clip(change, -0.25, 0.25), 0.0, 1.0)
        next = jnp.where(last > tolerance, next, s)
        return next, jnp.abs(next - s), count + 1

    def going(state: tuple) -> Array:
        return jnp.any(state[1] > tolerance) & (state[2] < _ITERATIONS)

    return while_loop(going, closer, (first, jnp.ones_like(first), jnp.array(0)))[0]


def _polynomial(starts: Array, axis: Array, h: Array) -> Array:
    """Coefficients (stages + 1, 3, steps, *arms) of the position by powers of the place in the
    step."""
    stages = axis.shape[1]
    integrals = interpolation(stages) / np.arange(1, stages + 1)[:, None]
    within = jnp.moveaxis(weighted(integrals, axis, axis=1), 1, 0)
    return jnp.concatenate([starts[None], h * within])


def _kinds(obstacles: tuple[Obstacle, ...]) -> tuple[tuple[_Kind, ...], list[int]]:
    """The obstacles kind by kind, and the place of each of these among all. Those of a kind have
    numbers of the same shapes."""
    alike: dict[Any, list[int]] = {}
    for i, obstacle in enumerate(obstacles):
        leaves, form = jax.tree.flatten(obstacle)
        alike.setdefault((form, tuple(jnp.shape(leaf) for leaf in leaves)), []).append(i)
    kinds = [
        _Kind(jax.tree.map(lambda *x: jnp.stack(x), *(obstacles[i] for i in places)), len(places))
        for places in alike.values()
    ]
    return tuple(kinds), [i for places in alike.values() for i in places]
