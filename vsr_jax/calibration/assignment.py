r"""Unlabelled markers: which measured position belongs to which point of the arm.

$\min_\theta \sum_s \min_{\pi_s} \sum_j \left| \frac{h_{sj}(\theta) - y_{s \pi_s(j)}}{\sigma_j}
\right|^2$

over the permutations $\pi_s$ of the positions of each shape, alternately by the unknowns (least
squares) and by the permutations (linear assignment). Neither raises the sum, so both come to rest.

**Source:** Kuhn, The Hungarian method for the assignment problem (1955); Besl and McKay, A method
for registration of 3-D shapes (1992), for the alternation.
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..models.base import Outcome
from .observation import Markers, Observation
from .problem import Adjusted, FitProblem

_ROUNDS = 50
"""Most times that positions are assigned."""


def adjusted(
    problem: FitProblem,
    start: np.ndarray,
    *,
    sd: np.ndarray | None = None,
    report: Any = lambda step, cost: None,
) -> tuple[FitProblem, Adjusted]:
    """The minimum nearest to a start, and the problem with the positions of unlabelled markers in
    the order of their points.

    **Arguments:** as for `FitProblem.adjust`.
    """
    if not any(_unlabelled(one) for one in problem.data.observations):
        return problem, problem.adjust(start, sd=sd, report=report)
    problem, outcome = _assigned(problem, start, None)
    found = problem.adjust(start, sd=sd, guess=outcome, report=report)
    for _ in range(_ROUNDS):
        after, _ = _assigned(problem, found.x, found.outcome)
        if all(np.array_equal(after.order[name], old) for name, old in problem.order.items()):
            return problem, found
        problem = after
        found = problem.adjust(found.x, sd=sd, guess=found.outcome, report=report)
    ended = found.minimum._replace(converged=False, reason="markers keep changing their points")
    return problem, found._replace(minimum=ended)


def _unlabelled(one: Observation) -> bool:
    return isinstance(one, Markers) and not one.labelled


def _assigned(
    problem: FitProblem, x: np.ndarray, guess: Outcome | None
) -> tuple[FitProblem, Outcome]:
    """The problem with the positions of each shape that can be solved in the order of the points
    that they are closest to, all together; and the outcomes of the solves."""
    data = problem.data
    blank = tuple(jnp.broadcast_to(one.blank, one.value.shape) for one in data.observations)
    at = problem.evaluate(x, data.inputs, data.series, blank, guess)
    observations, orders, first = [], dict(problem.order), 0
    for one in data.observations:
        shape = one.present.shape
        last = first + shape[1] * shape[2]
        if _unlabelled(one):
            places, sd = at.residual[:, first:last].reshape(shape), problem.unit_sd[:, first:last]
            order = _orders(places, np.asarray(one.value, float), sd.reshape(shape), at.solved)
            moved = jnp.take_along_axis(one.value, jnp.asarray(order)[..., None], axis=1)
            before = orders.get(one.name, np.tile(np.arange(shape[1]), (shape[0], 1)))
            orders[one.name] = np.take_along_axis(before, order, axis=1)
            one = eqx.tree_at(lambda o: o.value, one, moved)
        observations.append(one)
        first = last
    data = eqx.tree_at(lambda d: d.observations, data, tuple(observations))
    return replace(problem, data=data, order=orders), at.outcome


def _orders(places: np.ndarray, value: np.ndarray, sd: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Index of the position of each point, shape (shapes, points); missing positions go to the
    points that are left."""
    # of all users of the package only those of unlabelled markers need it, and it loads slowly
    from scipy.optimize import linear_sum_assignment

    orders = np.tile(np.arange(value.shape[1]), (len(value), 1))
    for i in np.flatnonzero(known):
        gap = (places[i][:, None] - value[i][None]) / sd[i][:, None]
        cost = np.nan_to_num(np.sum(gap**2, axis=2), nan=0.0)
        orders[i] = linear_sum_assignment(cost)[1]
    return orders
