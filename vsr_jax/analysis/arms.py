"""`Arms`, what objectives and constraints are functions of."""

from collections.abc import Callable

import equinox as eqx
import jax
from jaxtyping import Array, Float, PyTree

from ..arm.scene import Scene
from ..models.base import Model, Outcome
from ..solution.equilibrium import Equilibrium


class Arms(eqx.Module):
    """A scene solved for several sets of inputs.

    **Fields:** `scene`; `inputs`, shape (sets, actuators); `model`; the `outcome` of each set.
    """

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    model: Model
    outcome: Outcome

    @classmethod
    def of(cls, eq: Equilibrium) -> "Arms":
        """One arm: the scene solved for one set of inputs."""
        sets = jax.tree.map(lambda x: x[None], (eq.inputs, eq.outcome))
        return cls(eq.given_scene, sets[0], eq.model, sets[1])

    def each(self, function: Callable, *arrays: Array) -> PyTree:
        """`jax.vmap` of `function` over the `Equilibrium` of each set, and over the first axis of
        `arrays`."""

        def one(inputs: Array, outcome: Outcome, *more: Array) -> PyTree:
            return function(Equilibrium(self.scene, inputs, self.model, outcome), *more)

        return jax.vmap(one)(self.inputs, self.outcome, *arrays)

    def each_scene(self, function: Callable[[Scene], Array]) -> Array:
        """`function` of the scene of each set or, where no input changes it, of the one scene, with
        a leading axis."""
        if not self.scene.driven:
            return function(self.scene)[None]
        return jax.vmap(lambda u: function(self.scene.at(u)))(self.inputs)
