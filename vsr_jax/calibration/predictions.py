r"""Residuals of all shapes and their derivatives by the numbers that a fit changes: $f_s(p)$ and
$\partial f_s / \partial p$ from one compiled program, by the implicit derivatives of the equilibria
in forward mode."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.scene import Scene
from ..arm.scene_numbers import parameters, replaced
from ..models.base import Model, Near, Outcome
from ..numerics.compiling import program
from ..numerics.se3 import stacked_rotation
from ..solution.equilibrium import Equilibrium
from ..solution.solver import outcome_of
from .observation import Observation
from .unknowns import INPUTS, POSITION, ROTATION, Slot

CHUNK = 16
"""Most shapes that one call of the program solves side by side."""


class Predictor(eqx.Module):
    """The model of what is measured.

    **Fields:** `scene`, `model`; `observations`, without their values; `slots`, the numbers that a
    fit changes.
    """

    scene: Scene
    model: Model
    observations: tuple[Observation, ...]
    slots: tuple[Slot, ...] = eqx.field(static=True)

    @classmethod
    def of(
        cls, scene: Scene, model: Model, observations: Sequence[Observation], slots: Sequence[Slot]
    ) -> "Predictor":
        """A model of what is measured. The values are arguments of its program, which so serves
        other measurements too."""
        empty = tuple(
            eqx.tree_at(lambda o: (o.value, o.sd), one, (None, None), is_leaf=lambda x: x is None)
            for one in observations
        )
        # a stage may have an offset: the ranges of inputs are those of the recorded ones
        return cls(scene.without_bounds(), model, empty, tuple(slots))

    def set_up(self, numbers: Float[Array, " slots"]) -> tuple[Scene, tuple[Observation, ...]]:
        """The scene and the observations with given numbers."""
        scene = replaced(self.scene, self._changed(self.scene, numbers, ""))
        position, rotation = (
            self._entries(name, jnp.zeros(3, numbers.dtype), numbers)
            for name in (POSITION, ROTATION)
        )
        if position is not None or rotation is not None:
            scene = _moved(scene, position, rotation)
        observations = tuple(
            replaced(one, self._changed(one, numbers, f"{one.name}.")) for one in self.observations
        )
        return scene, observations

    def inputs(self, numbers: Float[Array, " slots"], recorded: Array) -> Array:
        """The inputs of a shape, at least the lowest that the scene admits."""
        changed = self._entries(INPUTS, recorded, numbers)
        if changed is None:
            return recorded
        lowest = jnp.array([one.low for one in self.scene.inputs], recorded.dtype)
        return jnp.where(changed > lowest, changed, lowest)

    def residual(
        self,
        numbers: Float[Array, " slots"],
        recorded: Array,
        values: tuple[Array, ...],
        guess: Outcome,
    ) -> tuple[Array, Outcome]:
        """Residuals of one shape, shape (residuals,), and the outcome of its solve, which starts
        from that of numbers near by."""
        scene, observations = self.set_up(numbers)
        inputs = self.inputs(numbers, recorded)
        near = Near(self.model, self.scene.at(inputs), guess.forces, guess.state)
        outcome = outcome_of(scene, inputs, self.model, near)
        eq = Equilibrium(scene, inputs, self.model, outcome)
        parts = [
            one.residual(eq, value).reshape(-1)
            for one, value in zip(observations, values, strict=True)
        ]
        return jnp.concatenate(parts), outcome

    def unguessed(self, inputs: Float[Array, "shapes actuators"]) -> Outcome:
        """Guesses where nothing is known: straight arms without forces. A solve that does not get
        on from there starts as without a guess."""

        def solved(inputs: Array) -> Outcome:
            return outcome_of(self.scene, inputs, self.model)

        kind = eqx.filter_eval_shape(jax.vmap(solved), inputs)
        outcome = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), kind)
        return outcome._replace(state=self.model.straight(outcome.state))

    def _changed(self, part: eqx.Module, numbers: Array, prefix: str) -> dict[str, Array]:
        found = {
            name: self._entries(prefix + name, parameter.value, numbers)
            for name, parameter in parameters(part).items()
        }
        return {name: value for name, value in found.items() if value is not None}

    def _entries(self, name: str, value: Array, numbers: Array) -> Array | None:
        """An array with its changed entries; None if none is changed."""
        places = [i for i, slot in enumerate(self.slots) if slot[0] == name]
        if not places:
            return None
        entries = jnp.array([self.slots[i][1] for i in places])
        flat = value.reshape(-1).at[entries].set(numbers[jnp.array(places)])
        return flat.reshape(value.shape)


def _moved(scene: Scene, position: Array | None, rotation: Array | None) -> Scene:
    """The scene with its base displaced, and turned about its origin by a rotation vector, both in
    the world's axes."""
    dtype = scene.rod.length.dtype
    base = jnp.eye(4, dtype=dtype) if scene.rod.base is None else scene.rod.base
    if rotation is not None:
        base = base.at[:3, :3].set(stacked_rotation(rotation) @ base[:3, :3])
    if position is not None:
        base = base.at[:3, 3].add(position)
    return eqx.tree_at(lambda s: s.rod.base, scene, base, is_leaf=lambda x: x is None)


class Linearised(NamedTuple):
    """Residuals (shapes, residuals), their derivatives by the numbers (shapes, residuals, slots),
    in double precision on the host, NaN where a solve failed; the outcomes of the solves."""

    residual: np.ndarray
    slopes: np.ndarray
    outcome: Outcome


def linearised(
    predictor: Predictor,
    numbers: np.ndarray,
    inputs: Float[Array, "shapes actuators"],
    values: tuple[Array, ...],
    *,
    guess: Outcome | None = None,
    chunk: int = CHUNK,
) -> Linearised:
    """Residuals of shapes and their derivatives.

    **Arguments:** `numbers`, shape (shapes, slots); `guess`: outcomes for numbers near by, from
    which the solves start; `chunk`: shapes that one call of the program solves side by side.
    """
    found = _in_chunks(_linearised, predictor, numbers, (inputs, values, guess), chunk)
    residual, slopes, outcome = found
    return Linearised(residual.astype(float), slopes.astype(float), outcome)


def residuals(
    predictor: Predictor,
    numbers: np.ndarray,
    inputs: Float[Array, "shapes actuators"],
    values: tuple[Array, ...],
    *,
    guess: Outcome | None = None,
    chunk: int = CHUNK,
) -> tuple[np.ndarray, Outcome]:
    """Residuals of shapes (shapes, residuals) without derivatives, and the outcomes of the solves;
    arguments as for `linearised`."""
    found = _in_chunks(_residuals, predictor, numbers, (inputs, values, guess), chunk)
    return found[0].astype(float), found[1]


def _in_chunks(
    program: Callable[..., tuple],
    predictor: Predictor,
    numbers: np.ndarray,
    known: tuple[Array, tuple[Array, ...], Outcome | None],
    chunk: int,
) -> tuple:
    """Results of a program for all shapes, on the host."""
    inputs, values, guess = known
    shapes, parts = len(inputs), []
    guess = predictor.unguessed(inputs) if guess is None else guess
    for first in range(0, shapes, chunk):
        # the last rows are filled up with copies, so that one program serves any number of shapes
        rows = np.minimum(np.arange(first, first + chunk), shapes - 1)
        here = jnp.asarray(numbers[rows], inputs.dtype)
        some = jax.tree.map(lambda x, rows=rows: x[rows], (inputs, values, guess))
        parts.append(program(predictor, here, *some))
    return jax.tree.map(
        lambda *pieces: np.concatenate([np.asarray(piece) for piece in pieces])[:shapes], *parts
    )


@program("fit")
def _residuals(predictor: Predictor, numbers: Array, *known: Any) -> tuple[Array, Outcome]:
    return jax.vmap(predictor.residual)(numbers, *known)


@program("fit")
def _linearised(
    predictor: Predictor,
    numbers: Array,
    inputs: Array,
    values: tuple[Array, ...],
    guess: Outcome,
) -> tuple[Array, Array, Outcome]:
    def one(numbers: Array, *known: Any) -> tuple[Array, Array, Outcome]:
        def residual(x: Array) -> tuple[Array, tuple[Array, Outcome]]:
            found, outcome = predictor.residual(x, *known)
            return found, (found, outcome)

        slopes, (found, outcome) = jax.jacfwd(residual, has_aux=True)(numbers)
        return found, slopes, outcome

    return jax.vmap(one)(numbers, inputs, values, guess)
