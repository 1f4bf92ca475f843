"""The result of a fit: the calibrated scene, its numbers with standard errors, residuals, and what
the data do not determine."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..arm.scene_numbers import matching
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import ArrayLike, VectorLike, cast
from ..validation import numbers
from .assignment import adjusted
from .measurements import Measurements
from .observation import Markers
from .plausible_data import check_positions
from .predictions import Predictor, linearised
from .problem import Adjusted, FitProblem
from .report import report
from .uncertainty import covariance_of, in_words, undetermined
from .unknowns import affine, for_series


class Estimate(NamedTuple):
    """One unknown of a fit: value, standard error and unit; whether it is `at_bound`. The error is
    NaN for a fixed number and at a bound, infinite for what nothing determines."""

    value: float
    error: float
    unit: str
    at_bound: bool


class Prediction(NamedTuple):
    """Positions on the axis [m], shape (shapes, stations, 3), and the standard deviation of each
    coordinate by the covariance of the unknowns; `X` [m]."""

    X: Float[Array, " stations"]
    position: np.ndarray
    sd: np.ndarray


@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Result of `fit`; `print` it for a report.

    **Fields:** `problem` and `adjusted`: what was minimised, and the minimum. `start_costs`: the
    cost that each start reached.
    """

    problem: FitProblem
    adjusted: Adjusted
    start_costs: tuple[float, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Label of each unknown, in the order of `x` and `covariance`."""
        return self.problem.names

    @property
    def x(self) -> np.ndarray:
        """Values of the unknowns."""
        return self.adjusted.x

    @property
    def converged(self) -> bool:
        """Whether the minimum was found to far less than the standard errors."""
        return self.adjusted.minimum.converged

    @property
    def reason(self) -> str:
        """Why the steps ended."""
        return self.adjusted.minimum.reason

    @property
    def steps(self) -> int:
        """Steps of the last minimisation."""
        return self.adjusted.minimum.steps

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the unknowns, see `uncertainty`."""
        return covariance_of(self.adjusted.minimum, self.problem.box, self.problem.loss)

    @property
    def correlation(self) -> np.ndarray:
        """Correlation of the unknowns; NaN where the standard error is none."""
        sd = np.sqrt(np.diag(self.covariance))
        with np.errstate(invalid="ignore"):
            return self.covariance / np.outer(sd, sd)

    @cached_property
    def numbers(self) -> dict[str, Estimate]:
        """The unknowns by name."""
        errors, box = np.sqrt(np.diag(self.covariance)), self.problem.box
        at_bound = (box.high > box.low) & ((self.x <= box.low) | (self.x >= box.high))
        return {
            column.label: Estimate(float(value), float(error), column.unit, bool(bound))
            for column, value, error, bound in zip(
                self.problem.columns, self.x, errors, at_bound, strict=True
            )
        }

    @property
    def failed(self) -> tuple[int, ...]:
        """Shapes without an equilibrium, or whose measurements have no derivatives there: they do
        not count."""
        return tuple(np.flatnonzero(~self.adjusted.minimum.residuals.solved).tolist())

    @cached_property
    def undetermined(self) -> tuple[str, ...]:
        """Combinations that the data leave open by more than their bounds, in words. Priors, where
        there are any, determine them."""
        found = undetermined(self.adjusted.minimum, self.problem.box)
        return tuple(in_words(one, self.names, self.x) for one in found)

    @property
    def order(self) -> Mapping[str, np.ndarray]:
        """By the name of unlabelled markers the index of the measured position that each point was
        assigned to, shape (shapes, points). The data of `problem` are in that order."""
        return self.problem.order

    @property
    def chi_squared(self) -> float:
        r"""Sum of squares of the residuals in standard deviations, $\chi^2$."""
        return float(np.sum(self.adjusted.minimum.residuals.value**2))

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom: measured numbers that count, less those that the unknowns take up. A
        free unknown takes up one, with a prior that says more than the data less."""
        lost = self.problem.lost(self.adjusted.minimum, self.problem.box)
        return float(np.sum(self.counted) - np.sum(lost))

    @property
    def reduced_chi_squared(self) -> float:
        r"""$\chi^2$ per degree of freedom; 1 where the standard deviations are right, and by
        construction where they are estimated."""
        return self.chi_squared / self.freedom if self.freedom > 0 else float("nan")

    @property
    def counted(self) -> np.ndarray:
        """Whether each number was measured and its shape solved, shape (shapes, residuals)."""
        solved = self.adjusted.minimum.residuals.solved
        return self.problem.data.present & solved[:, None]

    @cached_property
    def residuals(self) -> dict[str, np.ndarray]:
        """Predicted minus measured values by label, shape (shapes, components) and in the unit of
        the measurement; NaN where nothing was measured or the solve failed."""
        scaled = self.adjusted.minimum.residuals.value * self.adjusted.sd
        return by_label(self.problem, np.where(self.counted, scaled, np.nan))

    def rms(self, series: str | None = None) -> dict[str, float]:
        """Root mean square length of the residual of each label, of all shapes or of a series."""
        here = np.array([series in (None, one) for one in self.problem.data.series])
        return {label: rms_length(one[here]) for label, one in self.residuals.items()}

    @property
    def scene(self) -> Scene:
        """The calibrated scene, with the base pose of the first series."""
        return self.scene_of(self.problem.data.groups[0])

    def scene_of(self, series: str) -> Scene:
        """The calibrated scene with the base pose of a series."""
        return self._set_up(series)[0]

    def inputs(self, recorded: ArrayLike) -> Array:
        """Inputs of the calibrated scene for recorded ones, by the gains and offsets that were
        found; shape (actuators,) or (shapes, actuators)."""
        given = numbers("recorded", recorded, None).astype(self.problem.data.inputs.dtype)
        rows = jnp.atleast_2d(given)
        b, A = self._affine(rows, "")
        local = jnp.asarray(b + A @ self.x, rows.dtype)
        return jax.vmap(self.problem.predictor.inputs)(local, rows).reshape(given.shape)

    def solve(self, recorded: VectorLike, series: str | None = None) -> Equilibrium:
        """The equilibrium of the calibrated scene for recorded inputs."""
        group = self.problem.data.groups[0] if series is None else series
        return solve(
            self.scene_of(group), self.inputs(recorded), model=self.problem.predictor.model
        )

    def predict(
        self, recorded: ArrayLike, X: int | VectorLike = 13, series: str | None = None
    ) -> Prediction:
        """Positions on the axis for new inputs, with the uncertainty that the data leave.

        **Arguments:** `recorded`: inputs, shape (shapes, actuators); `X`: number of stations or
        their abscissas [m]; `series`: whose base pose to use, the first by default.

        **Raises:** `ValueError` for wrong inputs and abscissas beyond the arm.
        """
        problem, group = self.problem, self.problem.data.groups[0] if series is None else series
        rows = numbers("recorded", recorded, None).astype(problem.data.inputs.dtype)
        scene = problem.predictor.scene
        length = scene.rod.length
        stations = (
            jnp.linspace(0, length, X) if isinstance(X, int) else jnp.atleast_1d(jnp.array(X))
        )
        places = jnp.zeros((len(rows), stations.size, 3), rows.dtype)
        axis = Markers(places, stations, name="axis")
        axis.check(scene)
        model, slots = problem.predictor.model, problem.predictor.slots
        predictor = Predictor.of(scene, model, (axis,), slots)
        b, A = self._affine(rows, group)
        found = linearised(predictor, b + A @ self.x, rows, (axis.value,), chunk=len(rows))
        slopes = np.einsum("srl,slk->srk", found.slopes, A)
        free = np.isfinite(np.diag(self.covariance))
        variance = np.einsum(
            "srk,kl,srl->sr",
            slopes[..., free],
            self.covariance[np.ix_(free, free)],
            slopes[..., free],
        )
        shape = axis.value.shape
        assert axis.X is not None
        return Prediction(axis.X, found.residual.reshape(shape), np.sqrt(variance).reshape(shape))

    def cost(self, x: VectorLike) -> float:
        """What the fit minimises, at other values of the unknowns (in the order of `names`): minus
        the logarithm of the posterior density up to a constant. For optimisers and samplers of your
        own; without derivatives. Infinite beyond the bounds, and where a shape that counts in the
        fit has no equilibrium.

        **Raises:** `ValueError` for another number of unknowns.
        """
        return self.problem.cost(
            np.asarray(numbers("x", x, (len(self.names),)), float), self.adjusted
        )

    def refit(
        self,
        fixed: Mapping[str, float] | None = None,
        *,
        shared: Sequence[str] = (),
    ) -> "Fit":
        """The fit again with fewer unknowns, by the same compiled program.

        **Arguments:** `fixed`: values of unknowns by label, `[*]` for every index; `shared`: labels
        with `[*]` whose unknowns become one.

        **Raises:** `ValueError` for labels that are no unknowns of the fit.
        """
        columns, x = list(self.problem.columns), list(self.x)
        for pattern, value in (fixed or {}).items():
            for label in matching(pattern, dict.fromkeys(column.label for column in columns)):
                i = [column.label for column in columns].index(label)
                columns[i] = columns[i].fixed(value)
                x[i] = value
        for pattern in shared:
            labels = matching(pattern, dict.fromkeys(column.label for column in columns))
            members = [i for i, column in enumerate(columns) if column.label in labels]
            acts = tuple(act for i in members for act in columns[i].acts)
            columns[members[0]] = columns[members[0]]._replace(label=pattern, acts=acts)
            x[members[0]] = float(np.mean([x[i] for i in members]))
            columns = [c for i, c in enumerate(columns) if i not in members[1:]]
            x = [value for i, value in enumerate(x) if i not in members[1:]]
        problem = replace(self.problem, columns=tuple(columns))
        return Fit(
            problem,
            problem.adjust(
                np.clip(x, problem.box.low, problem.box.high), guess=self.adjusted.outcome
            ),
        )

    def on(self, data: Measurements) -> "Fit":
        """The fit tested on other measurements: base poses of their series are fitted, unless all
        series share them, and nothing else. By the same compiled program for as many shapes.

        **Arguments:** `data`: the same kinds of observations.

        **Raises:** `ValueError` for other kinds, inputs out of range, and markers that the arm
        cannot reach.
        """
        names, own = (
            tuple(one.name for one in some.observations) for some in (data, self.problem.data)
        )
        if names != own:
            raise ValueError(f"data: got {', '.join(names)}, need {', '.join(own)}, as the fit")
        columns = for_series(self.problem.columns, self.x, data.groups)
        check_positions(self.problem.predictor.scene, data, columns)
        for row in data.inputs:
            self.problem.predictor.scene.check_inputs(row)
        data = cast(data, self.problem.data.inputs.dtype)
        problem = replace(self.problem, columns=columns, data=data, order={})
        return Fit(*adjusted(problem, problem.start))

    def _affine(self, rows: Array, series: str) -> tuple[np.ndarray, np.ndarray]:
        problem = self.problem
        return affine(
            problem.columns, problem.predictor.slots, np.asarray(rows, float), [series] * len(rows)
        )

    def _set_up(self, series: str) -> tuple[Scene, tuple]:
        b, A = self._affine(self.problem.data.inputs[:1], series)
        local = jnp.asarray((b + A @ self.x)[0], self.problem.data.inputs.dtype)
        return self.problem.predictor.set_up(local)

    def __str__(self) -> str:
        return report(self)

    __repr__ = __str__


def by_label(problem: FitProblem, values: np.ndarray) -> dict[str, np.ndarray]:
    """Numbers of shape (shapes, residuals) as arrays (shapes, components) by label."""
    found, first = {}, 0
    for one in problem.data.observations:
        _, rows, components = one.present.shape
        block = values[:, first : first + rows * components].reshape(-1, rows, components)
        found |= {label: block[:, i] for i, label in enumerate(one.labels)}
        first += rows * components
    return found


def rms_length(residual: np.ndarray) -> float:
    """Root mean square length of vectors, shape (shapes, components), without missing ones; NaN if
    all are missing."""
    whole = np.all(np.isfinite(residual), axis=1)
    return float(np.sqrt(np.mean(np.sum(residual[whole] ** 2, axis=1)))) if whole.any() else np.nan
