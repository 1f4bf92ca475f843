"""A scene: a rod with its actuators, and what they present to the models at each cross-section."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._check import concrete, instance, is_traced, numbers
from ._types import Scalar, cast
from .actuator import Actuator
from .component import Vector
from .quadrature import piece_edges
from .rod import Rod
from .routing import Path


class CrossSections(NamedTuple):
    r"""What a balance knows of the cross-sections at some X: the diagonal of $\Sigma$ (6), $\xi^*$ (6), each thread's `Path`."""

    stiffness: Vector
    rest: Vector
    paths: tuple[Path, ...]


class Scene(eqx.Module):
    """A rod and the actuators laid through it.

    **Arguments:**
    - `rod`: the arm.
    - `actuators`: `Thread`, `Tendon` and `Chamber` in the order of the inputs.

    **Raises:** `ValueError` if a thread leaves the section (or the rod's `guide_radius`), or if a size is not positive
    somewhere; both are looked at only while the numbers are known, not under `jax.jit`.
    """

    rod: Rod
    actuators: tuple[Actuator, ...]

    def __init__(self, rod: Rod, actuators: Sequence[Actuator]):
        self.rod = instance("Scene.rod", rod, Rod, "a Rod")
        if isinstance(actuators, Actuator):
            actuators = (actuators,)
        self.actuators = tuple(
            instance(f"Scene.actuators[{i}]", a, Actuator, "a Thread, Tendon or Chamber") for i, a in enumerate(actuators)
        )
        self._check_sizes_and_threads()

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where the strain or a derivative of it jumps."""
        return (*self.rod.breakpoints, *(x for a in self.actuators for x in a.routing.breakpoints))

    def edges(self, more: tuple[Scalar, ...] = ()) -> Float[Array, " edges"]:
        """Ends of the smooth pieces of the arm [m], `more` breakpoints included."""
        return piece_edges(self.rod.length, (*self.breakpoints, *more))

    def sections(self, X: Array) -> CrossSections:
        """Stiffness, rest strain and thread paths at abscissas X of any shape, in component arrays of that shape."""

        def at(x: Scalar) -> CrossSections:
            paths = tuple(actuator.routing.path(x) for actuator in self.actuators)
            return CrossSections(self.rod.stiffness(x), self.rod.rest(x), paths)

        if X.ndim == 0:
            return at(X)
        nodes = jax.vmap(at)(X.reshape(-1))
        return jax.tree.map(lambda leaf: leaf.reshape(X.shape), nodes)

    def forces(self, inputs: Float[Array, " inputs"]) -> Vector:
        r"""Signed thread forces $\tau$ [N] for the inputs, one scalar a thread."""
        return tuple(actuator.force(value) for actuator, value in zip(self.actuators, inputs, strict=True))

    def admits(self, inputs: Float[Array, " inputs"]) -> Bool[Array, ""]:
        """Whether every input is finite and in its actuator's range."""
        checks = [actuator.admits(value) for actuator, value in zip(self.actuators, inputs, strict=True)]
        return jnp.all(jnp.stack(checks)) if checks else jnp.array(True)

    def check_inputs(self, inputs: Any) -> Float[Array, " inputs"]:
        """`inputs` as an array, one number an actuator.

        **Raises:** `ValueError` for a wrong number of inputs and, while their values are known, for NaN, infinities and
        values outside an actuator's range.
        """
        array = numbers("inputs", inputs, None, finite=False)
        kinds = ", ".join(type(a).__name__ for a in self.actuators)
        if array.shape != (len(self.actuators),):
            raise ValueError(
                f"inputs: got shape {array.shape}, need ({len(self.actuators)},), one number each for {kinds}; for a batch use jax.vmap"
            )
        known = concrete(array)
        if known is None:
            return array
        for i, (actuator, value) in enumerate(zip(self.actuators, known, strict=True)):
            if not (np.isfinite(value) and value >= actuator.lowest):
                needed = "a finite number" if np.isinf(actuator.lowest) else f"a finite number >= {actuator.lowest:g}"
                raise ValueError(f"inputs[{i}]: got {value:g}, need {needed} [{actuator.unit}] for a {type(actuator).__name__}")
        return array

    def astype(self, dtype: Any) -> "Scene":
        """The same scene with its floating-point numbers in `dtype`."""
        return cast(self, dtype)

    def _check_sizes_and_threads(self) -> None:
        if any(is_traced(leaf) for leaf in jax.tree.leaves((self.rod, self.actuators))):
            return
        X, sizes, clearances = jax.tree.map(concrete, _probe(self))
        if X is None:
            return
        for name, values in sizes.items():
            if not np.all(values > 0):
                i = int(np.argmin(values))
                raise ValueError(f"Scene.rod.section.{name}: got {values[i]:g} m at X = {X[i]:g} m, need a size > 0 everywhere")
        for i, values in enumerate(clearances):
            j = int(np.argmin(values))
            if not values[j] > -1e-6 * float(self.rod.length):
                raise ValueError(
                    f"Scene.actuators[{i}].routing: the thread lies {-values[j]:.3g} m outside the section at X = {X[j]:g} m; "
                    "need a path inside the section (or give the rod a guide_radius)"
                )


@eqx.filter_jit
def _probe(scene: Scene) -> tuple[Array, dict[str, Array], list[Array]]:
    rod = scene.rod
    X = jnp.linspace(0, 1, 65) * rod.length
    sizes = {name: jax.vmap(lambda x, f=f: f(x, rod.length))(X) for name, f in rod.section.sizes.items()}
    clearances = [jax.vmap(lambda x, a=a: rod.clearance(*a.routing(x), x))(X) for a in scene.actuators]
    return X, sizes, clearances
