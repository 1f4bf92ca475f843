r"""Damped Gauss-Newton steps within bounds, with priors and robust losses.

$\min_\theta \frac12 \sum_i \rho(f_i(\theta)^2) + \frac12 \sum_k ((\theta_k - m_k) / s_k)^2, \quad
l_k \le \theta_k \le h_k$

Each step solves $(A + C + \lambda D) \delta = -g$ with $A = J^T W J + S^{-2}$, $W = \rho'(f^2)$
and D the diagonal of A. $C \approx \sum_i w_i f_i \nabla^2 f_i$, from the Jacobians of successive
points by symmetric rank-one updates, matters in long valleys, where residuals stay large; it is
used while it foresees the decrease of the cost better than $C = 0$. Components that are pushed
against a bound stay there; the others continue along a bound that a step meets. The steps end where
the undamped step would lower the cost by less than $10^{-6}$ of the variance of a residual: far
less than the noise can tell.

**Source:** Moré, The Levenberg-Marquardt algorithm (1978), for the scaling; Nielsen, Damping
parameter in Marquardt's method (1999), for $\lambda$; Dennis, Gay, Welsch, An adaptive nonlinear
least-squares algorithm (1981), for C; James, Roos, MINUIT (1975), for the end.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

LOSSES = ("linear", "huber", "cauchy")
_HUBER, _CAUCHY = 1.345, 2.385
"""Residuals, in standard deviations, beyond which a loss bends: 95 % efficient for normal noise."""
_LEAST_GAIN = 1e-6
_NOISE_GAIN = 1e-2
"""Expected decrease below which a step that gains nothing means rounding, not failure."""
_FIRST_DAMPING, _TRIALS, _LEAST_RATIO = 1e-3, 9, 1e-4
"""Damping of the first step; how often it is raised, by 2, 4, 8 ..., for one step; share of the
foreseen decrease that a step has to bring."""
_IDLE = 3
"""Steps in a row with a decrease below `_LEAST_GAIN` that are the last ones."""

_KNOWN = 1e-6
"""Cosine of two directions above which an update of C is made; below, its denominator is nearly
zero."""


class Residuals(NamedTuple):
    """Residuals in standard deviations, shape (shapes, residuals), zero where nothing is known, and
    their derivatives (shapes, residuals, unknowns); whether each shape was `solved`; the `source`
    that they were computed from."""

    value: np.ndarray
    slopes: np.ndarray
    solved: np.ndarray
    source: Any = None


class Box(NamedTuple):
    """Bounds of the unknowns, and mean and standard deviation of their priors."""

    low: np.ndarray
    high: np.ndarray
    mean: np.ndarray
    sd: np.ndarray

    def prior_cost(self, x: np.ndarray) -> float:
        """Cost of the priors."""
        return 0.5 * float(np.sum(((x - self.mean) / self.sd) ** 2))


class Minimum(NamedTuple):
    """Where the steps ended: the unknowns `x`, the residuals there and their `weights`
    $\\rho'(f^2)$; `cost`, `steps`; whether it `converged`, and the `reason` to stop."""

    x: np.ndarray
    residuals: Residuals
    weights: np.ndarray
    cost: float
    steps: int
    converged: bool
    reason: str


def loss_of(name: str, f: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    r"""Half the loss $\rho(f^2) / 2$ of each residual, its weight $\rho'(f^2)$, and the derivative
    of weight times residual by the residual."""
    if name == "huber":
        far = np.abs(f) > _HUBER
        size = np.where(far, np.abs(f), 1.0)
        half = np.where(far, _HUBER * (np.abs(f) - _HUBER / 2), f**2 / 2)
        return half, np.where(far, _HUBER / size, 1.0), np.where(far, 0.0, 1.0)
    if name == "cauchy":
        u = (f / _CAUCHY) ** 2
        return _CAUCHY**2 / 2 * np.log1p(u), 1 / (1 + u), (1 - u) / (1 + u) ** 2
    return f**2 / 2, np.ones_like(f), np.ones_like(f)


def normal_matrix(residuals: Residuals, weights: np.ndarray) -> np.ndarray:
    """$J^T W J$ of the data, shape (unknowns, unknowns)."""
    J = (residuals.slopes * np.sqrt(weights)[..., None]).reshape(-1, residuals.slopes.shape[-1])
    return J.T @ J


def minimise(
    evaluate: Callable[[np.ndarray, Residuals | None], Residuals],
    start: np.ndarray,
    box: Box,
    *,
    loss: str = "linear",
    steps: int = 100,
    near: Residuals | None = None,
    report: Callable[[int, float], None] = lambda step, cost: None,
) -> Minimum:
    """Steps from a start to a minimum.

    **Arguments:** `evaluate`: residuals at a point, given those of a point near by, if there is
    one; `near`: those for the start; `report`: called with the number of steps and the cost.
    """
    here, damping, scale = evaluate(start, near), _FIRST_DAMPING, np.zeros(start.size)
    curvature, curved = np.zeros((start.size, start.size)), False
    x, step, idle = start, 0, 0
    while True:
        weights, cost = loss_of(loss, here.value)[1], _cost(here, here.solved, x, box, loss)
        if step:
            report(step, cost)
        A, slope, fixed = _quadratic(here, weights, x, box)
        H = A + curvature if curved and _convex(A + curvature, fixed) else A
        variance = _variance(here.value, start.size)
        gain = _expected(H, slope, fixed) / variance
        if gain <= _LEAST_GAIN:
            return Minimum(x, here, weights, cost, step, True, "converged")
        if step == steps:
            return Minimum(x, here, weights, cost, steps, False, f"stopped after {steps} steps")
        scale = np.maximum(scale, np.diag(A))
        size = np.where(scale > 0, scale, 1.0)
        model = (H, slope, fixed)
        found = None
        if idle < _IDLE:
            found = _descend(evaluate, x, here, model, size, damping, box, loss)
        if found is None:
            done = gain <= _NOISE_GAIN
            reason = "converged to rounding" if done else "no step lowers the cost"
            return Minimum(x, here, weights, cost, step, done, reason)
        ahead, there, damping = found
        move = ahead - x
        gained = cost - _cost(there, here.solved, ahead, box, loss)
        idle = idle + 1 if 2 * gained <= _LEAST_GAIN * variance else 0
        foreseen = -(slope @ move) - 0.5 * move @ A @ move
        curved = abs(foreseen - 0.5 * move @ curvature @ move - gained) < abs(foreseen - gained)
        curvature = _updated(curvature, here, there, move, np.sqrt(size), loss)
        x, here = ahead, there
        step += 1


def _quadratic(
    here: Residuals, weights: np.ndarray, x: np.ndarray, box: Box
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix and gradient of the quadratic model of the cost, and which unknowns are pushed against
    a bound."""
    A = normal_matrix(here, weights) + np.diag(box.sd**-2.0)
    slope = np.einsum("sr,sr,srk->k", weights, here.value, here.slopes)
    slope = slope + (x - box.mean) / box.sd**2
    pushed = ((x <= box.low) & (slope > 0)) | ((x >= box.high) & (slope < 0))
    return A, slope, pushed | (box.low == box.high)


def _convex(H: np.ndarray, fixed: np.ndarray) -> bool:
    """Whether the quadratic model has a minimum in the free unknowns."""
    free = ~fixed
    scale = np.sqrt(np.maximum(np.diag(H)[free], 0.0))
    if not np.all(scale > 0):
        return False
    values = np.linalg.eigvalsh(H[np.ix_(free, free)] / np.outer(scale, scale))
    return bool(np.all(values > np.finfo(float).eps * values.size))


def _updated(
    C: np.ndarray,
    before: Residuals,
    after: Residuals,
    move: np.ndarray,
    scale: np.ndarray,
    loss: str,
) -> np.ndarray:
    """Rank-one update of C, so that it gives the change of the gradient beyond that of $J^T W J$;
    C is first scaled down to the size of that change. `scale` makes the unknowns comparable."""
    both = (before.solved & after.solved)[:, None]
    pull = np.where(both, loss_of(loss, after.value)[1] * after.value, 0.0)
    change = np.einsum("sr,srk->k", pull, after.slopes - before.slopes)
    told, there = abs(move @ C @ move), abs(move @ change)
    C = C * (there / told if told > there else 1.0)
    short = change - C @ move
    by = short @ move
    known = abs(by) > _KNOWN * np.linalg.norm(short / scale) * np.linalg.norm(scale * move)
    return C + np.outer(short, short) / by if known else C


def _descend(
    evaluate: Callable[[np.ndarray, Residuals | None], Residuals],
    x: np.ndarray,
    here: Residuals,
    model: tuple[np.ndarray, np.ndarray, np.ndarray],
    scale: np.ndarray,
    damping: float,
    box: Box,
    loss: str,
) -> tuple[np.ndarray, Residuals, float] | None:
    """A point of lower cost at which no shape is lost, its residuals and the next damping; None if
    there is none nearby."""
    A, slope, fixed = model
    growth = 2.0
    for _ in range(_TRIALS):
        trial = _step(x, A, slope, damping * scale, fixed, box)
        change = trial - x
        foreseen = -(slope @ change) - 0.5 * change @ A @ change
        if foreseen <= 0:
            return None
        there = evaluate(trial, here)
        old = _cost(here, here.solved, x, box, loss)
        new = _cost(there, here.solved, trial, box, loss)
        ratio = (old - new) / foreseen if np.all(there.solved | ~here.solved) else -1.0
        if ratio > _LEAST_RATIO:
            return trial, there, damping * max(1 / 3, float(1 - (2 * ratio - 1) ** 3))
        damping, growth = damping * growth, growth * 2
    return None


def _cost(residuals: Residuals, count: np.ndarray, x: np.ndarray, box: Box, loss: str) -> float:
    half, _, _ = loss_of(loss, residuals.value[count])
    return float(np.sum(half)) + box.prior_cost(x)


def _variance(f: np.ndarray, unknowns: int) -> float:
    """Variance of the residuals; 1 if their standard deviations are right or too large."""
    return max(1.0, float(np.sum(f**2)) / max(1, np.count_nonzero(f) - unknowns))


def _expected(A: np.ndarray, slope: np.ndarray, fixed: np.ndarray) -> float:
    """Twice the decrease of the cost that an undamped step of the free unknowns promises."""
    free = ~fixed
    if not np.any(free):
        return 0.0
    scale = np.sqrt(np.where(np.diag(A) > 0, np.diag(A), 1.0))[free]
    values, vectors = np.linalg.eigh(A[np.ix_(free, free)] / np.outer(scale, scale))
    along = vectors.T @ (slope[free] / scale)
    known = values > np.finfo(float).eps * values.size * values[-1]
    return float(np.sum(along[known] ** 2 / values[known]))


def _step(
    x: np.ndarray,
    A: np.ndarray,
    slope: np.ndarray,
    damping: np.ndarray,
    fixed: np.ndarray,
    box: Box,
) -> np.ndarray:
    """The next point: a damped step; unknowns that meet a bound stop there, the others solve
    again."""
    change, fixed = np.zeros(x.size), fixed.copy()
    damped = A + np.diag(damping)
    while not np.all(fixed):
        free = ~fixed
        pull = slope[free] + A[np.ix_(free, fixed)] @ change[fixed]
        change[free] = -np.linalg.solve(damped[np.ix_(free, free)], pull)
        beyond = free & ((x + change < box.low) | (x + change > box.high))
        if not np.any(beyond):
            break
        change[beyond] = np.clip(x + change, box.low, box.high)[beyond] - x[beyond]
        fixed |= beyond
    return np.clip(x + change, box.low, box.high)
