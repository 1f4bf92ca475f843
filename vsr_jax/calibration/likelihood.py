r"""Profile likelihood: how the cost rises as one unknown moves away and all others follow.

$D(\theta_k) = 2 \min_{\theta_j,\, j \ne k} F(\theta) - 2 F(\hat\theta)$; the values with $D \le
3.84$ are the 95 % confidence interval, also where it is not symmetric or ends at a bound.

**Source:** Venzon and Moolgavkar, A method for computing profile-likelihood-based confidence
intervals (1988).
"""

from typing import NamedTuple

import numpy as np

from ..validation import choice, count, positive
from .result import Fit

_QUANTILE = 3.841458820694124
"""Quantile of 95 % of chi squared with one degree of freedom."""


class LikelihoodProfile(NamedTuple):
    """Profile of one unknown.

    - `name`; `values` of the unknown, increasing; `rise`, $D$ at each of them.
    - `low`, `high`: ends of the 95 % interval; infinite where the profile does not reach its level
      within the values.
    """

    name: str
    values: np.ndarray
    rise: np.ndarray
    low: float
    high: float


def likelihood_profile(
    fit: Fit, name: str, *, points: int = 11, spread: float = 3.0
) -> LikelihoodProfile:
    """Profile likelihood of one unknown, by the compiled program of the fit.

    **Arguments:**
    - `name`: label of the unknown, one of `fit.names`.
    - `points`: number of values; `spread`: how far they reach, in standard errors; between the
      bounds where there is no finite standard error.

    **Raises:** `ValueError` for a name that is no free unknown of the fit.
    """
    number, box = count("points", points, least=5), fit.problem.box
    free = [n for n, low, high in zip(fit.names, box.low, box.high, strict=True) if high > low]
    k = fit.names.index(choice("name", name, free))
    error, best = fit.numbers[name].error, fit.x[k]
    reach = positive("spread", spread) * error if np.isfinite(error) else np.inf
    ends = max(box.low[k], best - reach), min(box.high[k], best + reach)
    values = np.unique(np.append(np.linspace(*ends, number), best))
    middle = int(np.searchsorted(values, best))
    rise = np.zeros(values.size)
    for side in (range(middle - 1, -1, -1), range(middle + 1, values.size)):
        near, guess = fit.x, fit.adjusted.outcome
        for i in side:
            start = near.copy()
            start[k] = values[i]
            low, high = (np.where(np.arange(start.size) == k, start, end) for end in box[:2])
            fixed = box._replace(low=low, high=high)
            found = fit.problem.adjust(start, box=fixed, sd=fit.adjusted.sd, guess=guess)
            near, guess = found.x, found.outcome
            # the prior of the unknown itself belongs to the cost, although it is fixed
            rise[i] = 2 * (found.minimum.cost - fit.adjusted.minimum.cost)
    low, high = _crossing(values, rise, middle, -1), _crossing(values, rise, middle, 1)
    return LikelihoodProfile(name, values, rise, low, high)


def _crossing(values: np.ndarray, rise: np.ndarray, middle: int, step: int) -> float:
    """Where the square root of the rise, which is nearly straight, reaches its level."""
    level, i = np.sqrt(_QUANTILE), middle
    size = np.sqrt(np.maximum(rise, 0.0))
    while 0 <= i + step < values.size:
        if size[i + step] >= level:
            share = (level - size[i]) / (size[i + step] - size[i])
            return float(values[i] + share * (values[i + step] - values[i]))
        i += step
    return step * np.inf
