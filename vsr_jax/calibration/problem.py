"""A fit as a least-squares problem: residuals in standard deviations as a function of the unknowns,
for all shapes or some of them, with standard deviations that are given or estimated."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array

from ..arm.scene import Scene
from ..models.base import Outcome, Status
from ..models.strain_dependent import StrainDependent
from ..typing import cast
from .least_squares import Box, Minimum, Residuals, loss_of, minimise, normal_matrix
from .measurements import Measurements
from .plausible_data import check_positions
from .predictions import CHUNK, Predictor, linearised, residuals
from .unknowns import Column, Free, affine, columns_of, slots_of

_ROUNDS = 30
"""Most times that standard deviations are estimated again."""
_SAME = 0.005
"""Relative change of a standard deviation below which it is left."""
_NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal number."""


class Evaluation(NamedTuple):
    """Residuals of all shapes in their own units, shape (shapes, residuals), their derivatives by
    the unknowns, whether each shape was `solved`, and the outcomes of the solves."""

    residual: np.ndarray
    slopes: np.ndarray
    solved: np.ndarray
    outcome: Outcome


class Adjusted(NamedTuple):
    """A minimum: the unknowns `x`; the standard deviation of each residual, shape (shapes,
    residuals); the residuals in standard deviations are in `minimum`; the `outcome` of each
    solve."""

    x: np.ndarray
    sd: np.ndarray
    minimum: Minimum
    outcome: Outcome


@dataclass(frozen=True)
class FitProblem:
    """What a fit minimises.

    **Fields:** `predictor`, the model of what is measured; `data`; `columns`, the unknowns; `loss`;
    `steps`, the most that one minimisation takes; `order`, by the name of unlabelled markers the
    index of the measured position of each point, shape (shapes, points), once they are assigned.
    """

    predictor: Predictor
    data: Measurements
    columns: tuple[Column, ...]
    loss: str
    steps: int
    order: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Label of each unknown, fixed ones included."""
        return tuple(column.label for column in self.columns)

    @cached_property
    def box(self) -> Box:
        """Bounds and priors."""
        rows = [(c.low, c.high, c.mean, c.sd) for c in self.columns]
        return Box(*np.array(rows).T)

    @cached_property
    def start(self) -> np.ndarray:
        """Values of the unknowns in the scene that is fitted."""
        return np.array([column.start for column in self.columns])

    @cached_property
    def owner(self) -> np.ndarray:
        """Index of the observation that each residual belongs to."""
        sizes = [one.present[0].size for one in self.data.observations]
        return np.repeat(np.arange(len(sizes)), sizes)

    @cached_property
    def estimated(self) -> np.ndarray:
        """Whether the standard deviation of each observation is estimated."""
        return np.array([one.sd is None for one in self.data.observations])

    @cached_property
    def unit_sd(self) -> np.ndarray:
        """Given standard deviations, shape (shapes, residuals); where they are estimated, their
        ratios."""
        parts = []
        for one in self.data.observations:
            sd = one.ratio if one.sd is None else np.asarray(one.sd, float)
            parts.append(np.broadcast_to(sd, one.present.shape).reshape(len(self.data), -1))
        return np.concatenate(parts, axis=1)

    def evaluate(
        self,
        x: np.ndarray,
        inputs: Array,
        series: Sequence[str],
        values: tuple[Array, ...],
        guess: Outcome | None = None,
    ) -> Evaluation:
        """Residuals of any shapes; `guess`: outcomes for unknowns near by."""
        b, A = affine(self.columns, self.predictor.slots, np.asarray(inputs, float), series)
        chunk = min(CHUNK, len(self.data))
        found = linearised(self.predictor, b + A @ x, inputs, values, guess=guess, chunk=chunk)
        slopes = np.einsum("srl,slk->srk", found.slopes, A)
        solved = np.asarray(found.outcome.status) == Status.CONVERGED
        # at a singular tangent an equilibrium has no derivatives
        solved &= np.all(np.isfinite(slopes), axis=(1, 2))
        return Evaluation(found.residual, slopes, solved, found.outcome)

    @property
    def _values(self) -> tuple[Array, ...]:
        return tuple(one.value for one in self.data.observations)

    def at(self, x: np.ndarray, guess: Outcome | None = None) -> Evaluation:
        """Residuals of the measured shapes."""
        return self.evaluate(x, self.data.inputs, self.data.series, self._values, guess)

    def cost(self, x: np.ndarray, near: Adjusted) -> float:
        """Cost at other values of the unknowns, without derivatives, with the standard deviations
        of a minimum; infinite beyond the bounds and where a shape that counts there is lost."""
        if np.any((x < self.box.low) | (x > self.box.high)):
            return float("inf")
        data, counts = self.data, near.minimum.residuals.solved
        b, A = affine(self.columns, self.predictor.slots, np.asarray(data.inputs), data.series)
        residual, outcome = residuals(
            self.predictor,
            b + A @ x,
            data.inputs,
            self._values,
            guess=near.outcome,
            chunk=min(CHUNK, len(data)),
        )
        if np.any(counts & (np.asarray(outcome.status) != Status.CONVERGED)):
            return float("inf")
        counted = counts[:, None] & data.present
        half, _, _ = loss_of(self.loss, np.where(counted, residual / near.sd, 0.0))
        return float(np.sum(half)) + self.box.prior_cost(x)

    def adjust(
        self,
        start: np.ndarray,
        *,
        used: np.ndarray | None = None,
        box: Box | None = None,
        sd: np.ndarray | None = None,
        guess: Outcome | None = None,
        report: Any = lambda step, cost: None,
    ) -> Adjusted:
        """The minimum nearest to a start.

        **Arguments:** `used`: which shapes count; `box`: other bounds and priors; `sd`: standard
        deviations, which then are not estimated; `guess`: outcomes for unknowns near by.
        """
        box = self.box if box is None else box
        used = np.ones(len(self.data), bool) if used is None else used
        known = sd is not None or not np.any(self.estimated)
        first = self.at(start, guess)
        if sd is None:
            lost = np.zeros(self.owner.size)
            sd = self.unit_sd if known else self.unit_sd * self._factors(first, used, lost)

        def evaluate(x: np.ndarray, near: Residuals | None, sd: np.ndarray) -> Residuals:
            at = first if near is None else self.at(x, near.source.outcome)
            return self._scaled(at, sd, used)

        minimum = partial(minimise, box=box, loss=self.loss, steps=self.steps, report=report)
        found = minimum(partial(evaluate, sd=sd), start)
        at = found.residuals.source
        for _ in range(0 if known else _ROUNDS):
            old = sd
            sd = self.unit_sd * self._factors(at, used, self.lost(found, box))
            if np.all(np.abs(sd / old - 1) < _SAME):
                break
            found = minimum(partial(evaluate, sd=sd), found.x, near=found.residuals)
            at = found.residuals.source
        scaled = self._scaled(at, sd, used)
        found = found._replace(residuals=scaled, weights=loss_of(self.loss, scaled.value)[1])
        return Adjusted(found.x, sd, found, at.outcome)

    def _scaled(self, at: Evaluation, sd: np.ndarray, used: np.ndarray) -> Residuals:
        """Residuals in standard deviations, zero where there is nothing to count."""
        count = (at.solved & used)[:, None] & self.data.present
        value = np.where(count, at.residual / sd, 0.0)
        slopes = np.where(count[..., None], at.slopes / sd[..., None], 0.0)
        return Residuals(value, slopes, at.solved | ~used, at)

    def _factors(self, at: Evaluation, used: np.ndarray, lost: np.ndarray) -> np.ndarray:
        """Estimated standard deviation of each residual in units of `unit_sd`; `lost`: degrees of
        freedom that each residual lost to the unknowns, summed over the shapes."""
        solved = at.solved & used
        factors = np.ones(self.owner.size)
        for i in np.flatnonzero(self.estimated):
            mine = self.owner == i
            count = self.data.present[:, mine] & solved[:, None]
            f = (at.residual[:, mine] / self.unit_sd[:, mine])[count]
            free = max(f.size - float(np.sum(lost[mine])), 1.0)
            if self.loss == "linear":
                factors[mine] = np.sqrt(np.sum(f**2) / free)
            elif f.size:
                factors[mine] = np.median(np.abs(f)) / _NORMAL_MEDIAN * np.sqrt(f.size / free)
        return np.where(factors > 0, factors, np.finfo(float).tiny ** 0.25)

    def lost(self, found: Minimum, box: Box) -> np.ndarray:
        """Degrees of freedom that each residual lost to the unknowns, summed over the shapes."""
        slopes, weights = found.residuals.slopes, found.weights
        A = normal_matrix(found.residuals, weights) + np.diag(box.sd**-2.0)
        free = (box.high > box.low) & (np.diag(A) > 0)
        inverse = np.zeros_like(A)
        inverse[np.ix_(free, free)] = np.linalg.pinv(A[np.ix_(free, free)], hermitian=True)
        return np.einsum("sr,srk,kl,srl->r", weights, slopes, inverse, slopes)


def formulate(
    scene: Scene, free: Free, data: Measurements, model: Any, loss: str, steps: int
) -> FitProblem:
    """The problem of a fit; arguments and errors as for `fit`."""
    dtype = data.inputs.dtype
    for row in data.inputs:
        scene.check_inputs(row)
    for one in data.observations:
        one.check(scene)
    columns = columns_of(scene, data, free)
    check_positions(scene, data, columns)
    unknown = sum(column.high > column.low for column in columns)
    priors = sum(column.high > column.low and np.isfinite(column.sd) for column in columns)
    measured = int(np.sum(data.present))
    if unknown > measured + priors:
        raise ValueError(
            f"free: got {unknown} unknowns for {measured} measured numbers and {priors} priors, "
            f"need at most as many unknowns"
        )
    chosen = StrainDependent() if model is None else model
    predictor = Predictor.of(scene, chosen, data.observations, slots_of(columns))
    predictor, data = cast((predictor, data), dtype)
    return FitProblem(predictor, data, columns, loss, steps)
