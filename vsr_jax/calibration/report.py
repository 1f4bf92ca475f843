"""A fit in words: a table of its numbers, residuals, and what the data do not determine."""

from typing import Any

import numpy as np

_LARGE = 2.0
"""Reduced chi squared above which the residuals are larger than the standard deviations say."""


def report(fit: Any) -> str:
    """The report that `print` of a `Fit` shows."""
    return "\n".join([*_head(fit), *_numbers(fit), *_residuals(fit), *_warnings(fit)])


def _head(fit: Any) -> list[str]:
    data = fit.problem.data
    unknowns = sum(column.high > column.low for column in fit.problem.columns)
    return [
        f"fit        {len(data)} shapes, {int(np.sum(data.present))} measured numbers, "
        f"{unknowns} unknowns",
        f"status     {fit.reason}, {fit.steps} steps; chi^2 {fit.chi_squared:.4g} for "
        f"{fit.freedom:.4g} degrees of freedom",
    ]


def _numbers(fit: Any) -> list[str]:
    width = max(map(len, fit.names))
    lines = []
    for name, one in fit.numbers.items():
        error = "at a bound" if one.at_bound else "fixed" if np.isnan(one.error) else None
        text = f"+- {one.error:.2g}" if error is None else error
        lines.append(f"{name:{width}} = {one.value:12.6g} {text} [{one.unit or '?'}]")
    return lines


def _residuals(fit: Any) -> list[str]:
    units = {
        label: unit
        for one in fit.problem.data.observations
        for label, unit in zip(one.labels, one.units, strict=True)
    }
    groups = fit.problem.data.groups
    lines = []
    for group in groups if len(groups) > 1 else (None,):
        row = ", ".join(
            f"{label} {value:.3g} {units[label]}".rstrip()
            for label, value in fit.rms(group).items()
            if np.isfinite(value)
        )
        lines.append(f"rms residual{f' of {group}' if group else ''}: {row}")
    return lines


def _warnings(fit: Any) -> list[str]:
    lines = [f"NOT DETERMINED: {sentence}" for sentence in fit.undetermined]
    if fit.failed:
        shapes = ", ".join(map(str, fit.failed))
        lines.append(
            f"FAILED: {len(fit.failed)} shapes have no equilibrium (or no derivatives there) "
            f"and no weight: {shapes}"
        )
    if not fit.converged:
        lines.append(f"NOT CONVERGED: {fit.reason}")
    if fit.reduced_chi_squared > _LARGE:
        lines.append(
            f"residuals are {np.sqrt(fit.reduced_chi_squared):.3g} times the given sd: the model "
            f"misses an effect or the sd are too small, and so are the standard errors (without "
            f"sd they are estimated)"
        )
    return lines
