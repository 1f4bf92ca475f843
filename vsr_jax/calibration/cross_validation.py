"""Held-out error of a fit: folds of shapes, or one series after another, left out and predicted."""

from typing import Literal, NamedTuple

import numpy as np

from ..validation import count
from .problem import FitProblem
from .result import Fit, by_label, rms_length


class CrossValidation(NamedTuple):
    """Result of `cross_validate`; `print` it for a table.

    - `residuals`: predicted minus measured values by label, shape (shapes, components), each from a
      fit that did not see the shape; NaN where nothing was measured or a solve failed.
    - `fold`: index of the fold of each shape. `series`: of each shape.
    - `x`: the unknowns of each fold, shape (folds, unknowns).
    - `mean_square`: mean square of the held-out residuals in standard deviations of the fit.
    - `unsolved`: held-out shapes without an equilibrium.
    """

    residuals: dict[str, np.ndarray]
    fold: np.ndarray
    series: tuple[str, ...]
    x: np.ndarray
    mean_square: float
    unsolved: tuple[int, ...]

    def rms(self, series: str | None = None) -> dict[str, float]:
        """Root mean square length of the held-out residual of each label, of all shapes or of a
        series."""
        here = np.array([series in (None, one) for one in self.series])
        return {label: rms_length(one[here]) for label, one in self.residuals.items()}

    def __str__(self) -> str:
        groups = tuple(dict.fromkeys(self.series))
        size = np.sqrt(self.mean_square)
        lines = [f"{len(self.x)} folds, root mean square of held-out residuals {size:.3g} sd"]
        for group in groups if len(groups) > 1 else (None,):
            row = ", ".join(f"{label} {value:.3g}" for label, value in self.rms(group).items())
            lines.append(f"rms{f' of {group}' if group else ''}: {row}")
        if self.unsolved:
            lines.append(f"no equilibrium: shapes {', '.join(map(str, self.unsolved))}")
        return "\n".join(lines)

    __repr__ = __str__


def cross_validate(
    fit: Fit, folds: int | Literal["series"] = 5, *, seed: int = 0
) -> CrossValidation:
    """Errors of predictions of shapes that a fit has not seen, by the compiled program of the fit.

    **Arguments:**
    - `folds`: number of random folds, at most that of the shapes (leave one out); or `"series"`,
      each series in turn. The base pose of a series that is held out altogether is fitted to it,
      and nothing else.
    - `seed`: of the random folds.

    **Returns:** a `CrossValidation`.

    **Raises:** `ValueError` for fewer than two folds or series.
    """
    problem = fit.problem
    fold = _folds(problem, folds, seed)
    residual = np.full(fit.adjusted.sd.shape, np.nan)
    x, unsolved = [], []
    for k in range(fold.max() + 1):
        held = fold == k
        found = problem.adjust(fit.x, used=~held, sd=fit.adjusted.sd, guess=fit.adjusted.outcome).x
        found = _rebased(fit, found, held)
        at = problem.at(found, fit.adjusted.outcome)
        keep = (held & at.solved)[:, None] & problem.data.present
        residual = np.where(keep, at.residual, residual)
        unsolved += np.flatnonzero(held & ~at.solved).tolist()
        x.append(found)
    scaled = residual / fit.adjusted.sd
    return CrossValidation(
        by_label(problem, residual),
        fold,
        problem.data.series,
        np.array(x),
        float(np.nanmean(scaled**2)),
        tuple(unsolved),
    )


def _folds(problem: FitProblem, folds: int | str, seed: int) -> np.ndarray:
    """Index of the fold of each shape."""
    shapes, groups = len(problem.data), problem.data.groups
    if folds == "series":
        if len(groups) < 2:
            raise ValueError("folds: got 'series' for one series, need at least two")
        return np.array([groups.index(one) for one in problem.data.series])
    number = count("folds", folds, least=2)
    if number > shapes:
        raise ValueError(f"folds: got {number} for {shapes} shapes, need at most as many")
    fold = np.arange(shapes) % number
    return np.random.default_rng(seed).permutation(fold)


def _rebased(fit: Fit, x: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The unknowns with the base poses of series that are held out altogether fitted to them."""
    series = np.array(fit.problem.data.series)
    out = set(series[held]) - set(series[~held])
    mine = np.array(
        [
            all(kind == "series" and group in out for _, kind, group in column.acts)
            for column in fit.problem.columns
        ]
    )
    if not np.any(mine):
        return x
    box = fit.problem.box
    box = box._replace(low=np.where(mine, box.low, x), high=np.where(mine, box.high, x))
    start = np.where(mine, fit.problem.start, x)
    return fit.problem.adjust(
        start, used=held, box=box, sd=fit.adjusted.sd, guess=fit.adjusted.outcome
    ).x
