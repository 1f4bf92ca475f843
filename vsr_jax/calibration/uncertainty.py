r"""How sure the unknowns of a fit are: covariance, and the combinations that data do not determine.

With the residuals $f$ in standard deviations, $J = \partial f / \partial\theta$ and priors of
standard deviations $s_k$, the covariance at a minimum is $(J^T J + S^{-2})^{-1}$. With a robust
loss of influence $\psi$ it is $H^{-1} V H^{-1}$, $H = \overline{\psi'} J^T J + S^{-2}$, $V =
\overline{\psi^2} J^T J + S^{-2}$.

**Source:** Huber, Robust Statistics (1981), section 7.6.
"""

from typing import NamedTuple

import numpy as np

from .least_squares import Box, Minimum, loss_of, normal_matrix

_SINGULAR = 1e-13
"""Least eigenvalue of a matrix with ones on its diagonal that is not rounding."""
_MEMBER = 0.05
"""Share of the largest change below which an unknown is no member of a combination."""
_SHARP = 1e-3
"""Share of a combination below which an unknown counts as determined."""


class Combination(NamedTuple):
    """A combination of unknowns that the data do not determine: index and change of each member.
    The data leave it uncertain by more than the range between the bounds."""

    members: tuple[int, ...]
    change: tuple[float, ...]


def covariance_of(minimum: Minimum, box: Box, loss: str) -> np.ndarray:
    """Covariance of the unknowns, shape (unknowns, unknowns): infinite variance for those in a
    combination that nothing determines, NaN for those fixed or at a bound."""
    f, x = minimum.residuals.value, minimum.x
    free = (x > box.low) & (x < box.high)
    covariance = np.full((x.size, x.size), np.nan)
    covariance[np.ix_(free, free)] = 0.0
    if not np.any(free):
        return covariance
    information = normal_matrix(minimum.residuals, np.ones_like(f))[np.ix_(free, free)]
    prior = np.diag(box.sd[free] ** -2.0)
    slope, spread = _influence(f, loss, int(np.sum(free)))
    inverse, vague = _inverse(slope * information + prior)
    found = inverse @ (spread * information + prior) @ inverse
    found[np.diag_indices_from(found)] = np.where(vague, np.inf, np.diag(found))
    covariance[np.ix_(free, free)] = found
    return covariance


def _influence(f: np.ndarray, loss: str, unknowns: int) -> tuple[float, float]:
    """Means of $\\psi'$ and of $\\psi^2$ over the residuals."""
    if loss == "linear":
        return 1.0, 1.0
    counted = f[f != 0]
    _, weight, slope = loss_of(loss, counted)
    freedom = max(counted.size - unknowns, 1)
    return float(np.mean(slope)), float(np.sum((weight * counted) ** 2)) / freedom


def _inverse(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse on the determined combinations, and which unknowns are in one of the others."""
    scale = np.sqrt(np.where(np.diag(matrix) > 0, np.diag(matrix), 1.0))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    known = values > _SINGULAR * max(1.0, values[-1])
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T
    vague = np.sum(vectors[:, ~known] ** 2, axis=1) > _SHARP**2
    return inverse / np.outer(scale, scale), vague


def undetermined(minimum: Minimum, box: Box) -> tuple[Combination, ...]:
    """Combinations that the data alone leave uncertain by more than the range of the bounds."""
    free = np.flatnonzero(box.high > box.low)
    span = (box.high - box.low)[free]
    slopes = minimum.residuals.slopes[..., free]
    slopes = (slopes * np.sqrt(minimum.weights)[..., None]).reshape(-1, free.size) * span
    values, vectors = np.linalg.eigh(slopes.T @ slopes)
    vague = vectors[:, values < 1]
    if not vague.shape[1]:
        return ()
    found = []
    for change in _sparse(vague):
        members = np.flatnonzero(np.abs(change) > _MEMBER * np.max(np.abs(change)))
        moved = change[members] * span[members]
        found.append(Combination(tuple(free[members].tolist()), tuple(moved.tolist())))
    return tuple(found)


def _sparse(vectors: np.ndarray) -> np.ndarray:
    """Other vectors that span the same space, with few entries each: one is 1 in each of them and
    0 in all others."""
    rows, taken = vectors.T.copy(), []
    for k in range(len(rows)):
        rest = np.abs(rows[k:])
        rest[:, taken] = 0.0
        i, j = np.unravel_index(np.argmax(rest), rest.shape)
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, j], rows[k])
        taken.append(j)
    return rows


def in_words(one: Combination, names: tuple[str, ...], x: np.ndarray) -> str:
    """What the data leave open, as a sentence."""
    labels = [names[i] for i in one.members]
    if len(labels) == 1:
        return f"{labels[0]}: not determined by the data"
    relative = [
        change / x[i] if x[i] != 0 else np.inf
        for i, change in zip(one.members, one.change, strict=True)
    ]
    if len(labels) == 2 and np.all(np.isfinite(relative)):
        for sign, word in ((1, "ratio"), (-1, "product")):
            if abs(relative[0] - sign * relative[1]) < 0.1 * abs(relative[0]):
                return f"{labels[0]} and {labels[1]}: the data determine only their {word}"
    changes = [f"{label} by {c:+.3g}" for label, c in zip(labels, one.change, strict=True)]
    return f"the data do not notice a joint change of {', '.join(changes)}"
