"""What a solve returns: the status, and the shape, strains, stability and thread lengths computed
when asked for."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..arm.scene import Scene
from ..mechanics.balance import forces_where
from ..mechanics.cable import cable_of, path_length
from ..mechanics.reaction import loading, react_at
from ..models.base import Model, Nodes, Outcome, Status
from ..numerics import component as c
from ..numerics.component import Vector
from ..numerics.quadrature import onto
from ..typing import Pose, Scalar
from ..validation import ROUNDING, is_traced, on_arm
from .estimate import Error, error_of
from .stability import extreme


class Equilibrium(eqx.Module):
    """A solved scene.

    Every quantity is computed when it is asked for, so that a program that only needs the tip
    computes only the tip. Where the solve failed every quantity is NaN and `status` says why. A
    quantity at abscissas X [m] takes one or several in a row, from 0 to the arm's length. It raises
    `ValueError` for an X beyond the arm where both are known, and is NaN there under `jax.jit`.

    **Fields:** `scene`, `inputs` [of the actuators], `model`; `status`, a `Status` as an integer;
    `steps`, the Newton steps taken (integration steps for `Continuum`).
    """

    scene: Scene
    inputs: Float[Array, " inputs"]
    model: Model
    status: Array
    steps: Array
    _forces: Vector
    _state: Any

    def __init__(
        self, scene: Scene, inputs: Float[Array, " inputs"], model: Model, outcome: Outcome
    ):
        self.scene, self.inputs, self.model = scene, inputs, model
        self._state, self._forces, self.status, self.steps = outcome

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the result is an equilibrium, balanced to rounding."""
        return self.status == Status.CONVERGED

    @property
    def message(self) -> str:
        """The status in words."""
        return Status(int(self.status)).message

    @property
    def q(self) -> Float[Array, " dofs"]:
        """Coordinates of the strain in the model's basis: those of `Prescribed`, the thread forces
        (eq. 20) for `StrainDependent`."""
        self._refuse_batch()
        return self._mask(self.model.coordinates(self.scene, self._sound_forces, self._state))

    @property
    def tip(self) -> Pose:
        """Pose of the arm's end, shape (4, 4), position in metres."""
        self._refuse_batch()
        return self._tip()

    def pose(self, X: Any) -> Float[Array, "... 4 4"]:
        """Pose $g(X)$ at one abscissa [m] or at many, shape (4, 4) or (stations, 4, 4)."""
        return self._poses(self._abscissas(X))

    def position(self, X: Any) -> Float[Array, "... 3"]:
        """Position $r(X)$ [m] of the axis at one abscissa [m] or at many."""
        return self.pose(X)[..., :3, 3]

    def strain(self, X: Any) -> Float[Array, "... 6"]:
        r"""Strain $\xi(X) = (k\,[1/m], u\,[-])$ at one abscissa [m] or at many."""
        return self._strain(self._abscissas(X))

    @property
    def stability(self) -> Scalar:
        r"""Stability margin: the least eigenvalue of $\Sigma^{-1/2} (\Sigma - A) \Sigma^{-1/2}$
        over the nodes; where loads tie the nodes to each other, of the whole tangent scaled the
        same way (its symmetric part) among the changes of strain that taut cables of given length
        allow.

        1 for an arm without forces, at least 1 for tendons alone up to rounding, 0 where the
        equilibrium ceases to be stable. Loads that have no potential (dead moments in space,
        follower loads) leave a part that is not symmetric: with them a margin below 0 does not
        prove instability. With loads it is found by Lanczos' method, and NaN in the rare case that
        its residual stays above the root of the machine's epsilon. Where the least eigenvalue is
        multiple it has no derivative.
        """
        self._refuse_batch()
        return self._extreme()

    @property
    def condition(self) -> Scalar:
        """Condition number of the scaled tangent stiffness of `stability`, greatest by least
        eigenvalue: it magnifies rounding."""
        self._refuse_batch()
        return self._extreme(greatest=True) / jnp.abs(self._extreme())

    @property
    def error(self) -> Error:
        """Estimates of the errors of tip [m] and strain, from a coarser solution or a finer one
        that start from this one; NaN where it failed."""
        self._refuse_batch()
        return self._error()

    @property
    def lengths(self) -> Float[Array, " threads"]:
        """Length of each thread's path, $l_i = \\int |t_{ci}| dX$ [m]."""
        self._refuse_batch()
        return self._lengths()

    @property
    def forces(self) -> Float[Array, " threads"]:
        r"""Signed force $\tau$ [N] of each thread at its start: minus the tension of a tendon,
        given or found."""
        self._refuse_batch()
        return self._mask(jnp.array(self._sound_forces, self.inputs.dtype))

    @property
    def slack(self) -> Float[Array, " threads"]:
        """Length of cable [m] that hangs loose in each tendon driven by its length; zero while it
        is taut, and for all others."""
        self._refuse_batch()
        return self._slack()

    def reaction(self, X: Any) -> Float[Array, "... 6"]:
        r"""Wrench $\Lambda(X) = (M\,[N m], N\,[N])$ in the body frame that the loads beyond X ask
        of rod and threads together."""
        return self._reaction(self._abscissas(X))

    def thread(self, index: int, X: Any) -> Float[Array, "... 3"]:
        """Position [m] of thread `index` where it crosses the sections at X: $r + R d$.

        **Arguments:** `index`: place of its actuator in the scene, from 0; `X` [m]: between the
        thread's start and end.

        **Raises:** `ValueError` for another index, and for a known X where the thread is not (NaN
        under `jax.jit`).
        """
        X, number = self._abscissas(X), len(self.scene.actuators)
        if (
            isinstance(index, bool)
            or not isinstance(index, int | np.integer)
            or not 0 <= index < number
        ):
            raise ValueError(
                f"index: got {index!r}, need the place of one of the scene's {number} actuators, "
                f"counted from 0"
            )
        on_arm("X", X, self.scene.rod.length, self._ends(int(index)), f"thread {index}")
        return self._thread(int(index), X)

    def __repr__(self) -> str:
        if is_traced(self.status) or jnp.ndim(self.status) > 0:
            return f"Equilibrium(model={type(self.model).__name__}, batch={jnp.shape(self.status)})"
        if not bool(self.converged):
            return f"Equilibrium(model={type(self.model).__name__}, {self.message})"
        x, y, z = (float(v) for v in self.tip[:3, 3])
        name = type(self.model).__name__
        return f"Equilibrium(model={name}, converged, tip=({x:.6g}, {y:.6g}, {z:.6g}) m)"

    @property
    def _sound_forces(self) -> Vector:
        return forces_where(self.converged, self._forces)

    def _mask(self, value: Array) -> Array:
        return jnp.where(self.converged, value, jnp.nan)

    def _refuse_batch(self) -> None:
        if jnp.ndim(self.status) > 0:
            raise ValueError(
                f"Equilibrium: got a batch of shape {jnp.shape(self.status)}, need jax.vmap, as "
                f"in jax.vmap(lambda eq: eq.tip)(eqs)"
            )

    def _abscissas(self, X: Any) -> Array:
        self._refuse_batch()
        array = jnp.asarray(X, self.inputs.dtype)
        if array.ndim > 1:
            raise ValueError(f"X: got shape {array.shape}, need one abscissa or several in a row")
        on_arm("X", array, self.scene.rod.length)
        return array

    def _ends(self, index: int) -> tuple[Any, Any]:
        """Where a thread begins and ends [m]."""
        actuator = self.scene.actuators[index]
        start, end = actuator.start, actuator.end
        return 0.0 if start is None else start, self.scene.rod.length if end is None else end

    def _at(
        self, X: Array, quantity: Callable[[Array], Array], ends: tuple[Any, Any] | None = None
    ) -> Array:
        """A quantity at abscissas, in its first axis; NaN beyond the arm, or the ends, and where
        the solve failed."""
        length = self.scene.rod.length
        x, near = onto(X, *((0.0, length) if ends is None else ends), ROUNDING * length)
        value = quantity(jnp.atleast_1d(x))
        known = jnp.atleast_1d(near & self.converged).reshape(-1, *(1,) * (value.ndim - 1))
        return jnp.where(known, value, jnp.nan).reshape(*X.shape, *value.shape[1:])

    @eqx.filter_jit
    def _tip(self) -> Pose:
        return self._mask(self.model.tip(self.scene, self._sound_forces, self._state))

    @eqx.filter_jit
    def _poses(self, X: Array) -> Array:
        return self._at(
            X, lambda x: self.model.poses(self.scene, self._sound_forces, self._state, x)
        )

    @eqx.filter_jit
    def _thread(self, index: int, X: Array) -> Array:
        def place(x: Array) -> Array:
            g, path = self._poses(x), self.scene.sections(x).paths[index]
            return g[:, :3, 3] + g[:, :3, 1] * path.y[:, None] + g[:, :3, 2] * path.z[:, None]

        return self._at(X, place, self._ends(index))

    @eqx.filter_jit
    def _strain(self, X: Array) -> Array:
        return self._at(
            X, lambda x: c.join(self.model.strain(self.scene, self._sound_forces, self._state, x))
        )

    def _nodes(self) -> Nodes:
        return self.model.nodes(self.scene, self._sound_forces, self._state)

    def _path_lengths(self, nodes: Nodes) -> Array:
        places = range(len(self.scene.actuators))
        return jnp.array(
            [path_length(nodes.xi, nodes.sections, i, nodes.grid) for i in places],
            self.inputs.dtype,
        )

    @eqx.filter_jit
    def _error(self) -> Error:
        error = error_of(self.model, self.scene, self.inputs, self._sound_forces, self._state)
        return Error(self._mask(error.tip), self._mask(error.strain))

    @eqx.filter_jit
    def _lengths(self) -> Array:
        return self._mask(self._path_lengths(self._nodes()))

    @eqx.filter_jit
    def _slack(self) -> Array:
        nodes, scene = self._nodes(), self.scene
        lengths, slack = self._path_lengths(nodes), jnp.zeros_like(self.inputs)
        for place in scene.length_driven:
            cable = cable_of(scene, self.inputs[place], place, nodes.sections, nodes.grid)
            tension = -self._sound_forces[place]
            loose = cable.slack(tension, lengths[place], nodes.shares[place], nodes.grid)
            slack = slack.at[place].set(jnp.where(tension > 0, 0.0, loose))
        return self._mask(slack)

    @eqx.filter_jit
    def _extreme(self, *, greatest: bool = False) -> Scalar:
        return self._mask(extreme(self.scene, self._sound_forces, self._nodes(), greatest=greatest))

    @eqx.filter_jit
    def _reaction(self, X: Array) -> Array:
        nodes = self._nodes()
        loads = loading(self.scene, nodes.grid)
        return self._at(
            X,
            lambda x: (
                jnp.zeros((x.size, 6), x.dtype)
                if loads is None
                else c.join(react_at(nodes.xi, nodes.grid, loads, x))
            ),
        )
