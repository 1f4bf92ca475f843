"""The result of a solve: the status, and the quantities of the table, each computed on demand."""

from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..arm.scene import Scene
from ..arm.thread_lines import hole_places, on_chords, points_at
from ..elements.driven_threads import driven_of, thread_length
from ..mechanics.arm_balance import ArmUnknown
from ..mechanics.balance import forces_where
from ..mechanics.coupling import ArmProblem
from ..mechanics.reaction import react_at
from ..models.base import Model, Nodes, Outcome, Status
from ..numerics import component as c
from ..numerics.compiling import program
from ..numerics.component import Vector
from ..typing import Pose, Scalar, VectorLike
from ..validation import is_traced, on_arm
from .bearing import Contact, contacts_of, no_contact, supports_of
from .energy import Energy, energy_of
from .estimate import Error, error_of
from .quantities import (
    Solved,
    abscissas,
    along_arm,
    masked_along,
    quantity,
    structure,
)
from .stability import extreme, extreme_supported
from .summary import Summary, summary_of

_LOOSENED = "constraints, on the way to the solution"
"""What a report says of an equilibrium that is `loosened`."""
_RESTARTED = "from rest: it may lie on another branch than its start"
"""What a report says of an equilibrium that is `restarted`."""


class Equilibrium(Solved):
    """A solved scene.

    Each quantity is computed on demand by its own compiled program: a program that only needs the
    tip computes only the tip. Where the solve failed, every quantity is NaN and `status` gives the
    reason. A quantity at abscissas X [m] takes a scalar or a 1-D array with values from 0 to the
    arm's length. It raises `ValueError` for an X beyond the arm if both are concrete, and is NaN
    there under `jax.jit`.

    **Fields:** `scene`, with its driven numbers at the inputs; `inputs` [units of the actuators and
    driven numbers]; `model`; `status`, a `Status` as an integer; `steps`, the number of Newton
    steps (integration steps for `Continuum`); `state`, the internal state of the model.
    """

    scene: Scene
    inputs: Float[Array, " inputs"]
    model: Model
    status: Array
    steps: Array
    _forces: Vector
    state: Any
    _loosened: Array | None
    _restarted: Array | None
    _given: Scene | None

    def __init__(
        self, scene: Scene, inputs: Float[Array, " inputs"], model: Model, outcome: Outcome
    ):
        self.inputs, self.model = inputs, model
        self.scene, self._given = scene, None
        if scene.driven:  # at inputs that are refused, the scene as it is: nothing becomes NaN
            sound = jnp.where(scene.admits(inputs), inputs, scene.rest_inputs)
            self.scene, self._given = scene.at(sound), scene
        self.state, self._forces, self.status, self.steps = outcome[:4]
        self._loosened, self._restarted = outcome.loosened, outcome.restarted

    @property
    def given_scene(self) -> Scene:
        """The scene that was solved, with its driven numbers as it was made."""
        return self.scene if self._given is None else self._given

    @property
    def outcome(self) -> Outcome:
        """The outcome of its model, from which an equal `Equilibrium` can be made."""
        forces = self.sound_forces
        loosened, restarted = self._loosened, self._restarted
        return Outcome(self.state, forces, self.status, self.steps, None, loosened, restarted)

    @property
    def loosened(self) -> Bool[Array, "..."]:
        """Whether constraints were loosened: the solve, or the one that it started from, found no
        stable equilibrium without. The result is balanced all the same, and held sections are exact
        in it. Contacts stay loosened: between them the arm may pass an obstacle by up to
        $h^2 / (8 L)$, with steps of length h on an arm of length L. Of several equilibria the
        result may be another one than that without. Always false without held sections and
        obstacles."""
        if self._loosened is None:
            return jnp.zeros(jnp.shape(self.status), bool)
        return self._loosened

    @property
    def restarted(self) -> Bool[Array, "..."]:
        """Whether the solve gave up its `start` and began again from rest. The answer may then lie
        on another branch of equilibria: a rod that was twisted beyond its critical angle comes back
        whole turns away, an arch on its other side. `vsr.follow_branch` follows one branch. Always
        false without `start`."""
        if self._restarted is None:
            return jnp.zeros(jnp.shape(self.status), bool)
        return self._restarted

    @property
    def message(self) -> str:
        """Message of the status."""
        return Status(int(self.status)).message

    @property
    def heading(self) -> tuple[str, ...]:
        """First lines of a report of one equilibrium: its status, its effects and whether it is
        `loosened` or `restarted`."""
        method = f"{type(self.model).__name__}, {self.inputs.dtype}, {int(self.steps)} steps"
        effects = ", ".join(self.scene.effects) or "none"
        lines = f"  status     {self.message} ({method})", f"  effects    {effects}"
        loosened = (f"  loosened   {_LOOSENED}",) if bool(self.loosened) else ()
        restarted = (f"  restarted  {_RESTARTED}",) if bool(self.restarted) else ()
        return (*lines, *loosened, *restarted)

    def summary(self, X: VectorLike = 61, values: Sequence[str] = ()) -> Summary:
        """All quantities along the arm, from one compiled program, and selected other ones.

        **Arguments:** `X`: number of stations, evenly spaced on the arm, or their abscissas [m];
        `values`: names of quantities that are not functions of X, as in `("tip", "stability")`.

        **Returns:** a `Summary`, with every quantity along the arm as an attribute, and the
        positions of the threads and of the outer wall.

        **Raises:** `ValueError` for a batch of equilibria, abscissas beyond the arm, and an unknown
        name.
        """
        return summary_of(self, X, values)

    @quantity("1 and m", "row", "column")
    def tip(self) -> Pose:
        """Pose of the tip, axes of its section and position [m], shape (4, 4)."""
        return self.model.tip(self.scene, self.sound_forces, self.state)

    @along_arm("1 and m", "row", "column")
    def pose(self, X: Array) -> Float[Array, "stations 4 4"]:
        """Pose $g(X)$, shape (4, 4) or (stations, 4, 4)."""
        return self.model.poses(self.scene, self.sound_forces, self.state, X)

    @along_arm("m", "axis", of="pose")
    def position(self, pose: Float[Array, "... 4 4"]) -> Float[Array, "... 3"]:
        """Position $r(X)$ [m] of the axis."""
        return pose[..., :3, 3]

    @along_arm("1/m and 1", "strain")
    def strain(self, X: Array) -> Float[Array, "stations 6"]:
        r"""Strain $\xi(X) = (k\,[1/m], u\,[-])$."""
        return c.join(self.model.strain(self.scene, self.sound_forces, self.state, X))

    @along_arm("1/m", of="strain")
    def curvature(self, strain: Float[Array, "... 6"]) -> Float[Array, "..."]:
        r"""Curvature by bending, $\kappa(X) = \sqrt{k_y^2 + k_z^2}$ [1/m]."""
        return c.norm(c.split(strain[..., 1:3]))

    @along_arm("N m and N", "wrench")
    def reaction(self, X: Array) -> Float[Array, "stations 6"]:
        r"""Internal wrench $\Lambda(X) = (M, N)$ in the body frame that balances the loads beyond
        X. The rod and the threads carry it together."""
        nodes = self.nodes
        loads = self.model.loading(self.scene, self.state, nodes.grid)
        loads = None if loads is None else loads.without_threads()
        if loads is None:
            return jnp.zeros((X.size, 6), X.dtype)
        return c.join(react_at(nodes.xi, nodes.grid, loads, X))

    @quantity("1")
    def stability(self) -> Scalar:
        r"""Stability margin, the least eigenvalue of the scaled tangent stiffness.

        The matrix is $\Sigma^{-1/2} (\Sigma - A) \Sigma^{-1/2}$ at each node. Where loads couple
        the nodes, it is the symmetric part of the whole tangent, scaled the same way and restricted
        to the changes of strain that held sections, contacts that push and taut cables of given
        length allow.

        The margin is 1 for an arm without forces, at least 1 for tendons alone up to rounding, and
        0 where the equilibrium loses stability. Loads without a potential (dead moments in space,
        follower loads) make the tangent nonsymmetric: with them a margin below 0 does not prove
        instability. With loads the margin comes from the Lanczos method; it is NaN in the rare case
        that the residual stays above the square root of machine epsilon. It has no derivative where
        the least eigenvalue is multiple.
        """
        return self._extreme(greatest=False)

    @quantity("1")
    def condition(self) -> Scalar:
        """Condition number of the scaled tangent stiffness of `stability`: it magnifies
        rounding."""
        return self._extreme(greatest=True) / jnp.abs(self.stability)

    @structure("N m and N")
    def supports(self) -> Float[Array, "supports 6"]:
        """Support reactions: the moment [N m] and force [N] in the world frame by which each held
        section is held."""
        if not self.scene.held:
            return jnp.zeros((0, 6), self.inputs.dtype)
        return supports_of(*self._balance)

    @structure("m and N")
    def contacts(self) -> Contact:
        """Contacts with the obstacles: where, gap [m] and force [N]."""
        if not self.scene.obstacles:
            return no_contact(self.inputs.dtype)
        return contacts_of(*self._balance)

    @structure("m, and as the strain")
    def error(self) -> Error:
        """Estimates of the errors of tip [m] and strain, from a coarser solution or a finer one
        that start from this one."""
        return error_of(self.model, self.scene, self.inputs, self.sound_forces, self.state)

    @quantity("J", "part")
    def energy(self) -> Energy:
        r"""Potential energy [J]: elastic, of stretched cables, of the actuation, of the loads.

        The potential $\Pi$ is stationary at the equilibrium; it is returned in four parts and their
        `total`, see `Energy`. Follower loads and dead moments have no potential and are left out.
        With friction no potential exists, and the part of the actuation is
        $-\int \tau |t_c| dX$.
        """
        return energy_of(self.scene, self.inputs, self.sound_forces, self.nodes, self.pose)

    @quantity("m", "actuator")
    def lengths(self) -> Float[Array, " threads"]:
        r"""Length of each thread's path [m], $l_i = \int \lVert t_{ci} \rVert dX$, or of its chords
        between discs."""
        nodes, places = self.nodes, range(len(self.scene.actuators))
        scene, xi, grid = self.scene, nodes.xi, nodes.grid
        lengths = [thread_length(scene, xi, nodes.sections, i, grid) for i in places]
        return jnp.array(lengths, self.inputs.dtype)

    @quantity("N", "actuator")
    def forces(self) -> Float[Array, " threads"]:
        r"""Signed force $\tau$ [N] of each thread at its start: minus the tension of a tendon,
        given or found."""
        return jnp.array(self.sound_forces, self.inputs.dtype)

    @quantity("m", "actuator")
    def slack(self) -> Float[Array, " threads"]:
        """Slack of each tendon that is driven by its length [m]. Zero while it is taut, and for all
        other threads."""
        nodes, scene = self.nodes, self.scene
        slack = jnp.zeros(len(scene.actuators), self.inputs.dtype)
        for place in scene.length_driven:
            cable = driven_of(scene, self.inputs[place], place, nodes.sections, nodes.grid)
            tension = -self.sound_forces[place]
            path = thread_length(scene, nodes.xi, nodes.sections, place, nodes.grid)
            loose = cable.slack(tension, path, nodes.shares[place], nodes.grid)
            slack = slack.at[place].set(jnp.where(tension > 0, 0.0, loose))
        return slack

    @quantity("N, or 1/m and 1", "dof")
    def q(self) -> Float[Array, " dofs"]:
        """Coordinates of the strain in the model's basis. For `StrainDependent` they are the thread
        forces (eq. 20)."""
        return self.model.coordinates(self.scene, self.sound_forces, self.state)

    def thread(self, index: int, X: VectorLike) -> Float[Array, "... 3"]:
        """Position [m] of thread `index` where it crosses the sections at X: $r + R d$. Between
        discs it is the point of the chord that divides it as X divides the arm there.

        **Arguments:** `index`: index of its actuator in the scene, from 0; `X` [m]: between the
        start and the end of the thread.

        **Raises:** `ValueError` for an invalid index, and for a concrete X outside the thread (NaN
        under `jax.jit`).
        """
        X, number = abscissas(self, X), len(self.scene.actuators)
        if (
            isinstance(index, bool)
            or not isinstance(index, int | np.integer)
            or not 0 <= index < number
        ):
            raise ValueError(
                f"index: got {index!r}, need the index of one of the scene's {number} actuators, "
                f"counted from 0"
            )
        on_arm("X", X, self.scene.rod.length, self._ends(int(index)), f"thread {index}")
        return self._thread(int(index), X)

    def __repr__(self) -> str:
        name = type(self.model).__name__
        if is_traced(self.status) or jnp.ndim(self.status) > 0:
            return f"Equilibrium({name}, {self.inputs.dtype}, batch={jnp.shape(self.status)})"
        if not bool(self.converged):
            return f"Equilibrium({name}, {self.inputs.dtype}, {self.message})"
        x, y, z = (float(v) for v in self.tip[:3, 3])
        return (
            f"Equilibrium({name}, {self.inputs.dtype}, converged in {int(self.steps)} steps, "
            f"tip=({x:.6g}, {y:.6g}, {z:.6g}) m)"
        )

    def __str__(self) -> str:
        if is_traced(self.status) or jnp.ndim(self.status) > 0 or not bool(self.converged):
            return repr(self)
        tip, error = self.tip, self.error.tip
        loosened = (f"  loosened         {_LOOSENED}",) if bool(self.loosened) else ()
        restarted = (f"  restarted        {_RESTARTED}",) if bool(self.restarted) else ()
        return "\n".join(
            (
                f"Equilibrium: converged in {int(self.steps)} steps",
                f"  model            {self.model!r}, {self.inputs.dtype}",
                f"  tip              ({', '.join(f'{float(x):.6g}' for x in tip[:3, 3])}) m",
                f"  estimated error  {float(error):.1e} m",
                f"  stability margin {float(self.stability):.3g}",
                *loosened,
                *restarted,
            )
        )

    @property
    def sound_forces(self) -> Vector:
        """Force [N] of each thread at its start, one scalar each; zero where the solve failed."""
        return forces_where(self.converged, self._forces)

    @property
    def nodes(self) -> Nodes:
        """Quadrature points of the model, with the strain and the cross-sections there."""
        return self.model.nodes(self.scene, self.sound_forces, self.state)

    @property
    def _balance(self) -> tuple[ArmProblem, ArmUnknown]:
        return self.model.balance(self.scene, self.sound_forces, self.state)

    def _extreme(self, *, greatest: bool) -> Scalar:
        if self.scene.held or self.scene.obstacles:
            return extreme_supported(*self._balance, self.scene.free, greatest=greatest)
        forces = self.sound_forces
        return extreme(self.scene, self.inputs, forces, self.nodes, greatest=greatest)

    def _ends(self, index: int) -> tuple[Any, Any]:
        """Abscissas [m] of the start and the end of a thread."""
        actuator = self.scene.actuators[index]
        start, end = actuator.start, actuator.end
        return 0.0 if start is None else start, self.scene.rod.length if end is None else end

    @program("thread")
    def _thread(self, index: int, X: Array) -> Array:
        actuator = self.scene.actuators[index]

        def place(x: Array) -> Array:
            if not actuator.straight:
                return points_at(actuator, x, self.pose(x))
            holes = hole_places(self.scene.rod)
            return on_chords(points_at(actuator, holes, self.pose(holes)), holes, x)

        return masked_along(self, X, place, self._ends(index))
