"""Formulation of a design problem: free numbers and their bounds, objective, constraints, uncertain
numbers."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.arms import Arms
from ..analysis.constraint import Constraint, Inside
from ..arm.driven import check_free
from ..arm.scene import Scene
from ..arm.scene_numbers import matching, parameters, replaced
from ..models.base import Model
from ..models.strain_dependent import StrainDependent
from ..solution.solver import outcome_of
from ..typing import ArrayLike, Scalar, cast
from ..validation import instance, instances, numbers, positive
from .descent import DesignProblem, Numbers
from .objective import Measure, Objective

INPUTS = "inputs"
"""Name of the inputs among the free numbers."""

_DRAWS = 8
"""Scenes over which an uncertain objective is averaged: four draws, each with its opposite."""

Bounds = Sequence[ArrayLike] | None
"""Least and greatest value of a number; None for a phase without bounds."""


class Terms(eqx.Module):
    """Objective and margins as a function of the free numbers, which may include `inputs`.

    `factors`: random factors of each uncertain number, shape (draws,). The objective is averaged
    over the draws, and the margins of all draws count.
    """

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    model: Model
    objective: Objective
    constraints: tuple[Constraint, ...]
    factors: dict[str, Array]

    def __call__(self, free: Numbers) -> tuple[Scalar, list[Array]]:
        def one(factors: dict[str, Array]) -> tuple[Scalar, list[Array]]:
            arms = self.arms(free, factors)
            return self.objective(arms), [constraint(arms) for constraint in self.constraints]

        if not self.factors:
            return one({})
        objective, margins = jax.vmap(one)(self.factors)
        return jnp.mean(objective), margins

    def substitute(self, free: Numbers) -> tuple[Scene, Array]:
        """The scene and the inputs with the given free numbers."""
        return replaced(
            self.scene, {name: x for name, x in free.items() if name != INPUTS}
        ), free.get(INPUTS, self.inputs)

    def arms(self, free: Numbers, factors: Mapping[str, Array]) -> Arms:
        """The scene solved for every set of inputs."""
        scene, inputs = self.substitute(free)
        known = parameters(scene) if factors else {}
        scene = replaced(
            scene, {name: known[name].value * factor for name, factor in factors.items()}
        )
        return Arms(
            scene, inputs, self.model, jax.vmap(lambda u: outcome_of(scene, u, self.model))(inputs)
        )


def formulate(
    scene: Scene,
    free: Mapping[str, Bounds],
    objective: Objective | Callable[[Arms], Scalar],
    inputs: ArrayLike,
    constraints: Sequence[Constraint],
    uncertain: Mapping[str, float],
    model: Model | None,
) -> tuple[DesignProblem, Terms, Numbers]:
    """The problem, its terms, and the free numbers of the initial scene; arguments and errors as
    for `design`."""
    instance("scene", scene, Scene, "a Scene")
    sets = _sets(scene, inputs)
    minimised = objective if isinstance(objective, Objective) else Measure(_function(objective))
    checked = instances("constraints", constraints, Constraint, "a Constraint")
    inside = () if any(isinstance(one, Inside) for one in checked) else (Inside(),)
    known = {name: parameter.value for name, parameter in parameters(scene).items()} | {
        INPUTS: sets
    }
    low, high = _bounds(free, known)
    open_ends = {name: np.asarray(high[name] > low[name]).reshape(-1) for name in low}
    moved = ((name, i) for name, some in open_ends.items() for i in np.flatnonzero(some).tolist())
    check_free(scene, scene.driven, moved)
    minimised.check(sets.shape[0], high.get("rod.length", scene.rod.length))
    if INPUTS in low:
        for end in (low[INPUTS], high[INPUTS]):
            for row in np.asarray(end):
                scene.check_inputs(row)
    solver = (
        StrainDependent()
        if model is None
        else instance("model", model, Model, "StrainDependent(), Prescribed(basis) or Continuum()")
    )
    factors = _factors(uncertain, known)
    vague = ((name, i) for name in factors for i in range(known[name].size))
    check_free(scene, scene.driven, vague)
    terms = Terms(scene, sets, solver, minimised, (*inside, *checked), factors)
    low, high, terms, given = cast(
        (low, high, terms, {name: known[name] for name in low}), sets.dtype
    )
    return DesignProblem(low, high, terms), terms, given


def _sets(scene: Scene, inputs: ArrayLike) -> Float[Array, "sets inputs"]:
    sets = numbers("inputs", inputs, None, finite=False)
    if sets.ndim != 2 or not len(sets):
        raise ValueError(
            f"inputs: got shape {sets.shape}, need (sets, {len(scene.inputs)}), one row per "
            f"set of inputs"
        )
    for row in sets:
        scene.check_inputs(row)
    return sets


def _function(objective: Callable[[Arms], Scalar]) -> Callable[[Arms], Scalar]:
    if not callable(objective):
        raise ValueError(
            f"objective: got {objective!r}, need an Objective such as TipError or CurveError, or "
            f"a function of Arms"
        )
    return objective


def _bounds(free: Mapping[str, Bounds], known: Mapping[str, Array]) -> tuple[Numbers, Numbers]:
    """Least and greatest value of every free number by its name."""
    low, high = {}, {}
    for pattern, pair in free.items():
        for name in matching(pattern, known):
            low[name], high[name] = _ends(f"free[{pattern!r}]", pair, name, known[name])
    if not any(np.any(np.asarray(high[name]) > np.asarray(low[name])) for name in low):
        raise ValueError(
            f"free: got {dict(free)!r}, need at least one number with different bounds"
        )
    return low, high


def _ends(label: str, pair: Bounds, name: str, value: Array) -> tuple[Array, Array]:
    """Bounds of a number with the shape of its value; infinite for a phase without bounds."""
    if pair is None and name.endswith(".phase"):
        return jnp.full_like(value, -jnp.inf), jnp.full_like(value, jnp.inf)
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise ValueError(
            f"{label}: got {pair!r}, need a pair, the least and the greatest value (or None for a "
            f"phase)"
        )
    ends = [numbers(f"{label}[{i}]", end, None) for i, end in enumerate(pair)]
    for i, end in enumerate(ends):
        if end.shape not in ((), value.shape):
            raise ValueError(
                f"{label}[{i}]: got shape {end.shape}, need one number or {value.shape}, as {name}"
            )
    if np.any(np.asarray(ends[0]) > np.asarray(ends[1])):
        raise ValueError(f"{label}: got {pair!r}, need the least value first")
    low, high = (jnp.broadcast_to(end, value.shape) for end in ends)
    return low, high


def _factors(uncertain: Mapping[str, float], known: Mapping[str, Array]) -> dict[str, Array]:
    """Random factors exp(s n) of the uncertain numbers, n standard normal, each draw with its
    opposite."""
    factors, generator = {}, np.random.default_rng(0)
    for pattern, deviation in uncertain.items():
        size = positive(f"uncertain[{pattern!r}]", deviation)
        if pattern == INPUTS:
            raise ValueError("uncertain: got 'inputs', need numbers of the scene")
        for name in matching(pattern, known):
            half = generator.standard_normal(_DRAWS // 2)
            factors[name] = jnp.exp(size * jnp.asarray([*half, *-half], known[name].dtype))
    return factors
