r"""Comparison of fits of the same data by different models: which effects does the arm call for?

Held-out error by cross-validation, and Akaike's criterion with its correction for few data,

$\mathrm{AIC_c} = \chi^2 + 2 \sum_i \ln \sigma_i + 2 k + \frac{2 k (k + 1)}{n - k - 1}$

for n measured numbers and k unknowns, estimated standard deviations included.

**Source:** Burnham and Anderson, Model Selection and Multimodel Inference (2002), section 2.4.
"""

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from ..validation import instance
from .cross_validation import CrossValidation, cross_validate
from .result import Fit


class ModelRow(NamedTuple):
    """One model: number of unknowns, $\\chi^2$, AICc, and its cross-validation."""

    unknowns: int
    chi_squared: float
    criterion: float
    held_out: CrossValidation


class Comparison(NamedTuple):
    """Result of `compare`: a `ModelRow` by name; `print` it for a table."""

    models: dict[str, ModelRow]

    @property
    def best(self) -> str:
        """The model with the least held-out error, summed over all residuals in one unit each."""
        return min(self.models, key=lambda name: self.models[name].held_out.mean_square)

    def __str__(self) -> str:
        least = min(row.criterion for row in self.models.values())
        width = max(len("model"), *map(len, self.models))
        lines = [f"{'model':{width}} unknowns   chi^2  AICc - least  rms of held-out residuals"]
        for name, row in self.models.items():
            errors = ", ".join(f"{label} {x:.3g}" for label, x in row.held_out.rms().items())
            lines.append(
                f"{name:{width}} {row.unknowns:8d} {row.chi_squared:7.4g} "
                f"{row.criterion - least:13.4g}  {errors}"
            )
        return "\n".join(lines)

    __repr__ = __str__


def compare(
    fits: Mapping[str, Fit], folds: int | Literal["series"] = 5, *, seed: int = 0
) -> Comparison:
    """Fits of the same measurements by different models.

        full = vsr.fit(scene, free, data)
        plain = full.refit({"actuators[*].friction": 0.0})
        print(vsr.compare({"with friction": full, "without": plain}))

    **Arguments:** `fits` by name; `folds`, `seed`: as for `cross_validate`.

    **Returns:** a `Comparison`.

    **Raises:** `ValueError` for fits of different data.
    """
    if not fits:
        raise ValueError("fits: got none, need at least one fit by name")
    first = next(iter(fits.values()))
    rows = {}
    for name, one in fits.items():
        data = instance(f"fits[{name!r}]", one, Fit, "a Fit").problem.data
        same = data.series == first.problem.data.series and np.array_equal(
            data.present, first.problem.data.present
        )
        if not same or not np.array_equal(data.inputs, first.problem.data.inputs):
            raise ValueError(f"fits[{name!r}]: got other measurements, need the same for all")
        box = one.problem.box
        unknowns = int(np.sum(box.high > box.low))
        held_out = cross_validate(one, folds, seed=seed)
        rows[name] = ModelRow(unknowns, one.chi_squared, _criterion(one, unknowns), held_out)
    return Comparison(rows)


def _criterion(fit: Fit, unknowns: int) -> float:
    counted = fit.counted
    n, k = int(np.sum(counted)), unknowns + int(np.sum(fit.problem.estimated))
    few = 2 * k * (k + 1) / (n - k - 1) if n > k + 1 else np.inf
    return fit.chi_squared + 2 * float(np.sum(np.log(fit.adjusted.sd[counted]))) + 2 * k + few
