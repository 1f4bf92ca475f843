r"""Choice of the next measurement: the inputs that would tell most about the unknowns of a fit.

A shape with derivatives $J$ of its residuals, in standard deviations, lowers the entropy of the
unknowns by $\frac12 \ln \det(1 + J C J^T)$ (D-optimality); $C$ is their covariance, with the range
of the bounds as a prior. Candidates are chosen one after another, each with the covariance that
those before it leave.

**Source:** Atkinson, Donev, Tobias, Optimum Experimental Designs, with SAS (2007), chapter 11.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..typing import ArrayLike
from ..validation import choice, count, numbers
from .least_squares import normal_matrix
from .result import Fit


class NextMeasurement(NamedTuple):
    """Result of `next_measurement`.

    - `chosen`: indices of the candidates, the best first; `inputs`: theirs.
    - `gain`: entropy [nat] by which each of them lowers that of the unknowns, after those before.
    - `errors`: standard error of each unknown by label, with all of them measured.
    - `unsolved`: candidates without an equilibrium.
    """

    chosen: tuple[int, ...]
    inputs: np.ndarray
    gain: np.ndarray
    errors: dict[str, float]
    unsolved: tuple[int, ...]


def next_measurement(
    fit: Fit, candidates: ArrayLike, number: int = 1, *, series: str | None = None
) -> NextMeasurement:
    """The inputs that would tell most about the unknowns, by the compiled program of the fit.

    **Arguments:**
    - `candidates`: inputs, as recorded, shape (candidates, actuators).
    - `number`: how many to choose; each candidate can be chosen once.
    - `series`: the series in which they will be measured, the first by default.

    **Returns:** a `NextMeasurement`; every shape would be measured as those of the fit.

    **Raises:** `ValueError` for inputs out of range and fewer candidates than `number`.
    """
    problem, data = fit.problem, fit.problem.data
    group = choice("series", data.groups[0] if series is None else series, data.groups)
    rows = numbers("candidates", candidates, None)
    if rows.ndim != 2 or len(rows) < count("number", number):
        raise ValueError(
            f"candidates: got shape {rows.shape}, need (candidates, actuators), at least {number}"
        )
    for row in rows:
        problem.predictor.scene.check_inputs(row)
    rows = rows.astype(data.inputs.dtype)
    values = tuple(
        jnp.broadcast_to(one.blank, (len(rows), *one.blank.shape)) for one in data.observations
    )
    at = problem.evaluate(fit.x, rows, [group] * len(rows), values)
    box = problem.box
    free = box.high > box.low
    slopes = (at.slopes / np.mean(fit.adjusted.sd, axis=0)[:, None])[..., free]
    slopes[~at.solved] = 0.0
    minimum = fit.adjusted.minimum
    information = normal_matrix(minimum.residuals, minimum.weights)[np.ix_(free, free)]
    span = (box.high - box.low)[free]
    information += np.diag(box.sd[free] ** -2.0 + 12 / span**2)
    chosen, gains = [], []
    for _ in range(number):
        gain = _gains(slopes, np.linalg.inv(information))
        gain[chosen] = -np.inf
        chosen.append(int(np.argmax(gain)))
        gains.append(gain[chosen[-1]])
        information += slopes[chosen[-1]].T @ slopes[chosen[-1]]
    errors = np.sqrt(np.diag(np.linalg.inv(information)))
    labels = [label for label, kept in zip(fit.names, free, strict=True) if kept]
    return NextMeasurement(
        tuple(chosen),
        np.asarray(rows)[chosen],
        np.array(gains),
        dict(zip(labels, errors.tolist(), strict=True)),
        tuple(np.flatnonzero(~at.solved).tolist()),
    )


def _gains(slopes: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    spread = np.einsum("crk,kl,cql->crq", slopes, covariance, slopes)
    return 0.5 * np.linalg.slogdet(np.eye(spread.shape[1]) + spread)[1]
