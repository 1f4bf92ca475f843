r"""Least squares within the unit box: $\min_s \frac12 |f(s)|^2 + \frac12 w^2 |s - s_0|^2$, $0 \le
s_i \le 1$, for a decreasing weight w.

Damped Gauss-Newton steps. The term that they neglect, $S \approx \sum_j f_j \nabla^2 f_j$, is
approximated from the Jacobians of successive points by symmetric rank-one updates. It matters along
the curved set of all s with f(s) = 0, where only the weight determines s: without it Gauss-Newton
steps may not converge there. Components that are pushed against a bound are fixed; steps of the
others continue along a bound that they meet.

The last weight is zero: from the regularised solution s moves to the nearest point with the least
|f|. If |f| is not as small as allowed, the next start is tried with the last two weights only,
which stay close to it. All stages are one loop with one Jacobian per iteration, so that no problem
of a batch waits for another to end a stage.

**Source:** J. E. Dennis, D. M. Gay and R. E. Welsch, An adaptive nonlinear least-squares algorithm,
ACM Trans. Math. Softw. 7 (1981).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..typing import Scalar
from .component import select
from .loops import fori_loop, while_loop

_POWERS = (1 / 8, 3 / 16, 5 / 16)
"""The weights as powers of the machine epsilon; the square of the last is still resolved in the
normal equations."""
_STILL = (1 / 8, 1 / 4, 7 / 16, 5 / 8)
"""Longest step that ends each stage, as powers of the machine epsilon."""
_STEPS = 120
"""Bound on the steps from one start."""
_DAMPING, _LEAST, _GREATEST = 1e-2, 1e-3, 1e4
"""Damping at the start, its minimum in squares of the weight, and the damping at which a stage is
given up."""
_KNOWN = 1e-6
"""Cosine of two directions above which the curvature update is used; below, its denominator is
nearly zero."""


class Nearest(NamedTuple):
    """Result of `nearest`.

    - `share`: the point with the least |f|, next to the regularised solution.
    - `regular`: the regularised solution, for the last weight above zero.
    - `free`: which of its components are not fixed at a bound.
    """

    share: Float[Array, " n"]
    regular: Float[Array, " n"]
    free: Bool[Array, " n"]


class _Point(NamedTuple):
    """A point, f and its Jacobian there."""

    s: Array
    f: Array
    J: Array


class _Search(NamedTuple):
    """State of the search: `ahead` is the next trial point with the predicted `descent`; before the
    first step it is a start."""

    point: _Point
    ahead: Array
    descent: Array
    curvature: Array
    damping: Array
    start: Array
    stage: Array
    steps: Array
    found: Nearest
    best: Nearest
    miss: Array


def last_weight(dtype: Any) -> float:
    """The last weight above zero."""
    return float(jnp.finfo(dtype).eps) ** _POWERS[-1]


def nearest(
    f: Callable[[Array], Array],
    starts: Float[Array, "starts n"],
    rest: Float[Array, " n"],
    allowed: Scalar,
) -> Nearest:
    """Point where |f| is at most `allowed`, from the first start that leads to one, or else the
    point with the least |f| found.

    **Arguments:** `f`: of shape (m,); no step ends where it is not finite. `rest`: $s_0$. The
    result must not be differentiated.
    """
    eps = float(jnp.finfo(rest.dtype).eps)
    weights = jnp.asarray([*(eps**power for power in _POWERS), 0.0], rest.dtype)
    still = jnp.asarray([eps**power for power in _STILL], rest.dtype)
    jacobian = jax.jacfwd(lambda s: (f(s),) * 2, has_aux=True)

    def advance(state: _Search) -> _Search:
        J, value = jacobian(state.ahead)
        w = weights[state.stage]
        least = jnp.maximum(w, last_weight(w.dtype)) ** 2
        moved = jnp.max(jnp.abs(state.ahead - state.point.s))
        short = (moved <= still[state.stage]) & (state.damping <= least)
        state = _judged(state, _Point(state.ahead, value, J), w, rest)
        over = (state.steps > 1) & (short | (state.damping > _GREATEST) | (state.steps > _STEPS))
        regular = Nearest(
            state.point.s, state.point.s, _free(state.point.s, _slope(state.point, w, rest))
        )
        found = select(over & (w > 0), regular, state.found)._replace(share=state.point.s)
        state = state._replace(found=found, stage=state.stage + over)
        return select(
            state.stage == len(weights), _ended(state, starts), _aimed(state, over, weights, rest)
        )

    def pending(state: _Search) -> Array:
        return (state.start <= len(starts)) & (state.miss > allowed)

    return while_loop(pending, advance, _begun(f, starts, allowed)).best


def _begun(f: Callable[[Array], Array], starts: Array, allowed: Scalar) -> _Search:
    s, zero = starts[0], jnp.zeros((), jnp.int32)
    size = jax.eval_shape(f, s).size
    point = _Point(s, jnp.zeros(size, s.dtype), jnp.zeros((size, s.size), s.dtype))
    nowhere = Nearest(s, s, jnp.ones(s.shape, bool))
    one, flat = jnp.ones((), s.dtype), jnp.zeros((s.size, s.size), s.dtype)
    return _Search(
        point, s, one, flat, one, zero, zero, zero, nowhere, nowhere, jnp.full((), jnp.inf, s.dtype)
    )


def _judged(state: _Search, trial: _Point, w: Array, rest: Array) -> _Search:
    """Accept the trial point where it is better, or a start; update damping and curvature."""
    fresh = state.steps == 0
    gain = (_cost(state.point, w, rest) - _cost(trial, w, rest)) / state.descent
    better = fresh | ((gain > 0) & (state.descent > 0))
    factor = jnp.where(better, jnp.where(gain > 0.75, 0.1, jnp.where(gain < 0.25, 3.0, 1.0)), 4.0)
    curvature = jnp.where(better, _updated(state.curvature, state.point, trial), state.curvature)
    return state._replace(
        point=select(better, trial, state.point),
        curvature=jnp.where(fresh, 0.0, curvature),
        damping=jnp.where(fresh, _DAMPING, factor * state.damping),
        steps=state.steps + 1,
    )


def _aimed(state: _Search, over: Array, weights: Array, rest: Array) -> _Search:
    """The next step. At the beginning of a stage damping and curvature are rescaled with the
    weight."""
    w, before = weights[state.stage], weights[jnp.maximum(state.stage - 1, 0)]
    least = jnp.maximum(w, last_weight(w.dtype)) ** 2
    curvature = jnp.where(over, (w / before) ** 2, 1.0) * state.curvature
    damping = jnp.maximum(
        jnp.where(over, jnp.minimum(state.damping, least), state.damping), _LEAST * least
    )
    step, descent = _step(state.point, curvature, damping, w, rest)
    return state._replace(
        ahead=state.point.s + step, descent=descent, curvature=curvature, damping=damping
    )


def _ended(state: _Search, starts: Array) -> _Search:
    """After the last stage: keep its result if it is the best so far, and go to the next start."""
    there = jnp.linalg.norm(state.point.f)
    nearer = there < state.miss
    start = state.start + 1
    return state._replace(
        ahead=starts[start - 1],
        start=start,
        stage=jnp.full_like(state.stage, len(_POWERS) - 1),
        steps=jnp.zeros_like(state.steps),
        best=select(nearer, state.found, state.best),
        miss=jnp.where(nearer, there, state.miss),
    )


def _cost(point: _Point, w: Array, rest: Array) -> Array:
    return (jnp.sum(point.f**2) + w**2 * jnp.sum((point.s - rest) ** 2)) / 2


def _slope(point: _Point, w: Array, rest: Array) -> Array:
    return point.J.T @ point.f + w**2 * (point.s - rest)


def _free(s: Array, slope: Array) -> Array:
    """Which components are not pushed against a bound."""
    return ~(((s <= 0) & (slope > 0)) | ((s >= 1) & (slope < 0)))


def _step(
    point: _Point, curvature: Array, damping: Array, w: Array, rest: Array
) -> tuple[Array, Array]:
    """Step to the minimum of the quadratic model along the faces of the box, and the predicted
    descent."""
    eye = jnp.eye(rest.size, dtype=rest.dtype)
    slope = _slope(point, w, rest)
    H = point.J.T @ point.J + (w**2 + damping) * eye
    convex = jnp.all(jnp.isfinite(jnp.linalg.cholesky(H + curvature)))
    H = jnp.where(convex, H + curvature, H)

    def along(_: Any, state: tuple[Array, Array]) -> tuple[Array, Array]:
        s, free = state
        factor = jax.scipy.linalg.cho_factor(jnp.where(free[:, None] & free[None, :], H, eye))
        way = -jax.scipy.linalg.cho_solve(factor, jnp.where(free, slope + H @ (s - point.s), 0.0))
        end = jnp.where(way < 0, 0.0, 1.0)
        room = jnp.where(way == 0, jnp.inf, (end - s) / jnp.where(way == 0, 1.0, way))
        far = jnp.minimum(jnp.min(room), 1.0)
        hit = room <= far
        return jnp.where(hit, end, s + far * way), free & ~hit

    s, _ = fori_loop(0, rest.size, along, (point.s, _free(point.s, slope)))
    step = s - point.s
    return step, -(jnp.dot(slope, step) + jnp.dot(step, H @ step) / 2)


def _updated(S: Array, before: _Point, after: _Point) -> Array:
    """Rank-one update of S, so that it gives the change of the slope beyond that of $J^T J$; S is
    first scaled down to the size of that change."""
    move = after.s - before.s
    change = (after.J - before.J).T @ after.f
    told, there = jnp.abs(jnp.dot(move, S @ move)), jnp.abs(jnp.dot(move, change))
    S = S * jnp.where(told > there, there / jnp.where(told > 0, told, 1.0), 1.0)
    short = change - S @ move
    by = jnp.dot(short, move)
    known = jnp.abs(by) > _KNOWN * jnp.linalg.norm(short) * jnp.linalg.norm(move)
    return S + jnp.where(known, jnp.outer(short, short) / jnp.where(known, by, 1.0), 0.0)
