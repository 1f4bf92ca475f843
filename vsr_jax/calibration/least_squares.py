r"""Damped Gauss-Newton steps within bounds, with priors and robust losses.

$\min_\theta \frac12 \sum_i \rho(f_i(\theta)^2) + \frac12 \sum_k ((\theta_k - m_k) / s_k)^2, \quad
l_k \le \theta_k \le h_k$

Each step solves $(A + \lambda D) \delta = -g$ with $A = J^T W J + S^{-2}$, $W = \rho'(f^2)$ and D
the diagonal of A. Components that are pushed against a bound stay there; the others continue along
a bound that a step meets. The steps end where the undamped step would lower the cost by less than
$10^{-6}$ of the variance of a residual: far less than the noise can tell.

**Source:** Moré, The Levenberg-Marquardt algorithm (1978), for the scaling; Nielsen, Damping
parameter in Marquardt's method (1999), for $\lambda$; James, Roos, MINUIT (1975), for the end.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

LOSSES = ("linear", "huber", "cauchy")
_HUBER, _CAUCHY = 1.345, 2.385
"""Residuals, in standard deviations, beyond which a loss bends: 95 % efficient for normal noise."""
_LEAST_GAIN = 1e-6
_NOISE_GAIN = 1e-2
"""Expected decrease below which a step that gains nothing means rounding, not failure."""
_MOST_DAMPING = 1e12


class Residuals(NamedTuple):
    """Residuals in standard deviations, shape (shapes, residuals), zero where nothing is known, and
    their derivatives (shapes, residuals, unknowns); whether each shape was `solved`."""

    value: np.ndarray
    slopes: np.ndarray
    solved: np.ndarray


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
    evaluate: Callable[[np.ndarray], Residuals],
    start: np.ndarray,
    box: Box,
    *,
    loss: str = "linear",
    steps: int = 100,
    report: Callable[[int, float], None] = lambda step, cost: None,
) -> Minimum:
    """Steps from a start to a minimum.

    **Arguments:** `report`: called with the number of steps and the cost.
    """
    x, damping, growth, scale = start, 1e-3, 2.0, np.zeros(start.size)
    here = evaluate(x)
    cost, reason, converged, step = _cost(here, here.solved, x, box, loss), "", False, 0
    while True:
        _, weights, _ = loss_of(loss, here.value)
        A = normal_matrix(here, weights) + np.diag(box.sd**-2.0)
        slope = np.einsum("sr,sr,srk->k", weights, here.value, here.slopes)
        slope = slope + (x - box.mean) / box.sd**2
        fixed = (
            (box.low == box.high) | ((x <= box.low) & (slope > 0)) | ((x >= box.high) & (slope < 0))
        )
        gain = _expected(A, slope, fixed) / _variance(here.value, start.size)
        if gain <= _LEAST_GAIN:
            return Minimum(x, here, weights, cost, step, True, "converged")
        if step == steps:
            return Minimum(x, here, weights, cost, step, False, f"stopped after {steps} steps")
        scale = np.maximum(scale, np.diag(A))
        while True:
            trial = _step(x, A, slope, damping * np.where(scale > 0, scale, 1.0), fixed, box)
            change = trial - x
            there = evaluate(trial) if np.any(change) else here
            kept = bool(np.all(there.solved | ~here.solved))
            old = _cost(here, here.solved & there.solved, x, box, loss)
            new = _cost(there, here.solved & there.solved, trial, box, loss)
            foreseen = -(slope @ change) - 0.5 * change @ A @ change
            ratio = (old - new) / foreseen if foreseen > 0 and kept and new < old else 0.0
            if ratio > 1e-4:
                damping *= max(1 / 3, 1 - (2 * ratio - 1) ** 3)
                growth = 2.0
                break
            damping, growth = damping * growth, growth * 2
            if damping > _MOST_DAMPING or not np.any(change):
                done = gain <= _NOISE_GAIN
                reason = "converged to rounding" if done else "no step lowers the cost"
                return Minimum(x, here, weights, cost, step, done, reason)
        x, here, step = trial, there, step + 1
        cost = _cost(here, here.solved, x, box, loss)
        report(step, cost)


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
