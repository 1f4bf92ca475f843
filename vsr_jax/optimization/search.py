"""Settings of a search: how many starts and steps, which optimizer, when to stop."""

import equinox as eqx
import numpy as np
import optax

from ..validation import count, numbers, positive
from .descent import History, adam

_LEAST_GAIN = 1e-4
"""Relative decrease of the objective over `patience` steps below which a search stops."""


class Search(eqx.Module):
    """How `design` searches.

        vsr.design(scene, free, objective, inputs, search=vsr.Search(starts=16, steps=1500))

    **Arguments:**
    - `starts`: number of starts. The first is the scene itself; every other is the best of
      `candidates` points drawn between the bounds from `seed`.
    - `steps`, `learning_rate`: of Adam, whose learning rate decays along a cosine.
    - `optimizer`: an optax optimizer instead of Adam; `learning_rate` is then unused.
    - `stop_at`: objective at which to stop, once all constraints are satisfied.
    - `patience`: number of steps over which the objective must decrease by 0.01 %, otherwise the
      search stops.

    **Raises:** `ValueError` for numbers out of range.
    """

    starts: int = eqx.field(static=True)
    steps: int = eqx.field(static=True)
    learning_rate: float = eqx.field(static=True)
    candidates: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)
    stop_at: float | None = eqx.field(static=True)
    patience: int | None = eqx.field(static=True)
    optimizer: optax.GradientTransformation | None = eqx.field(static=True)

    def __init__(
        self,
        *,
        starts: int = 8,
        steps: int = 400,
        learning_rate: float = 0.05,
        candidates: int = 64,
        seed: int = 0,
        stop_at: float | None = None,
        patience: int | None = None,
        optimizer: optax.GradientTransformation | None = None,
    ):
        self.starts = count("Search.starts", starts)
        self.steps = count("Search.steps", steps)
        self.learning_rate = positive("Search.learning_rate", learning_rate)
        self.candidates = count("Search.candidates", candidates)
        self.seed = count("Search.seed", seed, least=0)
        self.stop_at = None if stop_at is None else float(numbers("Search.stop_at", stop_at))
        self.patience = None if patience is None else count("Search.patience", patience)
        self.optimizer = optimizer

    @property
    def update_rule(self) -> optax.GradientTransformationExtraArgs:
        """The optimizer, Adam by default."""
        if self.optimizer is None:
            return adam(self.learning_rate, self.steps)
        return optax.with_extra_args_support(self.optimizer)

    def finished(self, history: History) -> bool:
        """Whether to stop after the steps of a history."""
        done = len(history.objective)
        if not done:
            return False
        feasible = np.where(history.violation <= 0, history.objective, np.inf)
        best = np.minimum.accumulate(np.min(feasible, axis=1))
        if done >= self.steps or (self.stop_at is not None and best[-1] <= self.stop_at):
            return True
        if self.patience is None or done <= self.patience:
            return False
        before = best[-1 - self.patience]
        return bool(np.isfinite(before) and before - best[-1] <= _LEAST_GAIN * abs(before))
