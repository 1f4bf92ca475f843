r"""Threads whose force follows from a law of the actuator, $f(\tau, l, a) = 0$, of the force $\tau$
at its start, the length l of its path and the input a.

The unknown is the pull $T = -\tau$ and its row the law. A thread that stretches by $T / k$ of its
length needs so much less: the law gets the length of its path without that stretch. The law of a
cable of the free length $l^* + \delta$ is

$$\min(T, k_0 s) = 0, \quad s = (l^* + \delta)(1 + T / k) - l,$$

the complementarity of tension and slack, where the stiffness $k_0$ [N/m] only scales the two. It
is that of the arm at rest along the thread: with a stiffer one Newton's method takes threads for
slack when the arm has not followed yet (`test_lengths_that_rub_start_from_one_another` in
tests/test_discs.py).

On the way to a solution that Newton's method does not find at once, the changes of length
$\delta$ come by increments, as the loads do.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.actuator import Actuator, ThreadState
from ..arm.scene import CrossSections, Scene
from ..chain import Border
from ..mechanics.applied_load import Exerted, finite
from ..mechanics.balance import largest_force_scale, thread_direction, unit_wrench
from ..mechanics.coupling import ArmProblem, ArmState, Scales, ThreadRule
from ..mechanics.sizes import pull_of
from ..numerics import component as c
from ..numerics.batching import of_each_arm
from ..numerics.component import Forces, Vector, select
from ..numerics.quadrature import Grid
from ..numerics.stacked import stack
from ..typing import Scalar
from .chords import chords_of, pull_on


class Driven(NamedTuple):
    r"""A thread with a law.

    **Fields:** its `actuator` and `input`; the length [m] of its path at `rest`, and that of the
    unstretched thread, `free`; its compliance $1/k$ [1/N], None if it cannot be stretched; a
    stiffness $k_0$ [N/m] that scales lengths to forces; `idle`: 1 where it exerts no force,
    whatever its law; `missing`: what has not come yet of the change of its free length [m], None
    for nothing.
    """

    actuator: Actuator
    input: Array
    rest: Array
    free: Array
    compliance: Array | None
    scale: Array
    idle: Array
    missing: Array | None = None

    def law(self, tension: Array, path: Array, share: Array | None, grid: Grid) -> "Law":
        """The law at a tension, a length of the path and a share of the tension along it."""
        length = path - tension * self.stretch(share, grid)
        length = length if self.missing is None else length + self.missing
        given = self.actuator, self.input, self.rest, self.scale, -tension, length
        arms = jnp.broadcast_shapes(tension.shape, path.shape)
        found = of_each_arm(_law_and_slopes, arms, *given)
        none = Law(tension, jnp.ones_like(tension), jnp.zeros_like(tension))
        return select(self.idle > 0, none, found)

    def gives(self, law: "Law", gain: Array | None, grid: Grid) -> Array:
        """Derivative of the law by the tension at a given length of the path, with the stretch by
        the `gain` of the tension along it."""
        return law.by_tension - law.by_length * self.stretch(gain, grid)

    def slack(self, tension: Array, path: Array, share: Array | None, grid: Grid) -> Array:
        """Slack on a path of a given length [m], negative if the thread is too short."""
        return self.free - path + tension * self.stretch(share, grid)

    def stretch(self, share: Array | None, grid: Grid) -> Array:
        """Stretch per unit of the tension at the start [m/N]; `share` is the fraction of it at the
        nodes."""
        if self.compliance is None:
            return jnp.zeros_like(self.free)
        if share is None:
            return self.free * self.compliance
        reached = jnp.sum(jnp.where(share > 0, grid.weight, 0.0), axis=(0, 1))
        mean = jnp.sum(grid.weight * share, axis=(0, 1)) / reached
        return self.free * self.compliance * mean


class Law(NamedTuple):
    """Value of a law [N] and its derivatives by the tension and by the length of the path."""

    value: Array
    by_tension: Array
    by_length: Array


def _law_and_slopes(
    actuator: Actuator, value: Array, rest: Array, scale: Array, force: Array, length: Array
) -> Law:
    def law(force: Array, length: Array) -> Array:
        return jnp.asarray(actuator.law(ThreadState(force, length, rest, scale), value))

    out, (by_force, by_length) = jax.value_and_grad(law, (0, 1))(force, length)
    return Law(out, -by_force, by_length)


class DrivenThreads(ThreadRule):
    """All threads of an arm with a law; the unknowns are their tensions [N], shape (threads, ...).
    `places`: their places among the threads."""

    places: tuple[int, ...] = eqx.field(static=True)
    threads: tuple[Driven, ...]
    by_increments = True

    def relaxed(self) -> "DrivenThreads":
        """Threads without force."""
        idle = (one._replace(idle=jnp.ones_like(one.idle)) for one in finite(self.threads))
        return DrivenThreads(self.places, tuple(idle))

    def scaled(self, share: Array) -> "DrivenThreads":
        found = (one._replace(missing=(1 - share) * (one.free - one.rest)) for one in self.threads)
        return DrivenThreads(self.places, tuple(found))

    def guess(self, forces: Forces, grid: Grid) -> Float[Array, "threads ..."]:
        tensions = [jnp.broadcast_to(-forces[place], grid.h.shape[1:]) for place in self.places]
        return jnp.stack(tensions)

    def forces(self, x: Array, forces: Forces) -> Forces:
        found = list(forces)
        for place, tension in zip(self.places, x, strict=True):
            found[place] = -tension
        return tuple(found)

    def note(
        self, x: Array, at: ArmState, own: tuple[Exerted, ...], problem: ArmProblem
    ) -> tuple[Law, ...]:
        """The laws."""
        shares = at.carried.shares
        return tuple(
            thread.law(tension, self._length(place, at, problem), shares[place], problem.grid)
            for place, thread, tension in zip(self.places, self.threads, x, strict=True)
        )

    def _length(self, place: int, at: ArmState, problem: ArmProblem) -> Array:
        pull = pull_on(at.exerted, place)
        if pull is not None:
            return pull.path_length(place)
        return path_length(at.xi, problem.sections, place, problem.grid)

    def _wrenches(self, at: ArmState, problem: ArmProblem) -> tuple[list[Vector], list[Vector]]:
        """Wrenches at the nodes by which each residual changes with the tension, and each length
        with the strain."""
        pulls, lengths = [], []
        for place in self.places:
            pull = pull_on(at.exerted, place)
            if pull is None or at.along is None:
                path = problem.sections.paths[place]
                wrench = unit_wrench(at.xi, path)
                pulls.append(c.times(at.carried.gains[place], wrench))
                lengths.append(c.times(problem.sections.reach[place], wrench))
            else:
                rotation = at.along.pose.rotation
                pulls.append(pull.unit(place, rotation, at.carried.gains[place]))
                lengths.append(pull.unit(place, rotation))
        return pulls, lengths

    def residual(
        self,
        x: Array,
        at: ArmState,
        note: tuple[Law, ...],
        problem: ArmProblem,
        free: tuple[int, ...],
    ) -> Array:
        return jnp.stack([law.value for law in note])

    def border(self, x: Array, at: ArmState, note: tuple[Law, ...], problem: ArmProblem) -> Border:
        pulls, lengths = self._wrenches(at, problem)
        corner = [
            thread.gives(law, at.carried.gains[place], problem.grid)
            for place, thread, law in zip(self.places, self.threads, note, strict=True)
        ]
        by_length = jnp.stack([law.by_length for law in note])
        # a pull that grows as its thread becomes shorter makes the arm less stable
        resists = jnp.where(by_length > 0, -1, 1)
        return Border(_stacked(pulls), _stacked(lengths), by_length, jnp.stack(corner), resists)

    def sizes(self, x: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        sections, length = problem.sections, problem.length
        return [
            tension * pull_of(sections, sections.paths[place], length)
            for place, tension in zip(self.places, x, strict=True)
        ]

    def scales(self, problem: ArmProblem) -> Scales:
        """The stiffness of the arm along each thread, and its length."""
        return Scales(jnp.stack([one.scale for one in self.threads]), problem.length)


def _stacked(wrenches: list[Vector]) -> Vector:
    return tuple(stack(parts) for parts in zip(*wrenches, strict=True))


def driven_threads_of(
    scene: Scene, inputs: Array, sections: CrossSections, grid: Grid
) -> DrivenThreads | None:
    """The threads of a scene with a law; None if it has none."""
    places = scene.law_driven
    threads = tuple(driven_of(scene, inputs[place], place, sections, grid) for place in places)
    return DrivenThreads(places, threads) if places else None


def driven_of(
    scene: Scene, value: Scalar, place: int, sections: CrossSections, grid: Grid
) -> Driven:
    """A thread with a law, for its input."""
    actuator = scene.actuators[place]
    stiffness = actuator.cable_stiffness
    rest = thread_length(scene, sections.rest, sections, place, grid)
    compliance = None if stiffness is None else 1 / stiffness
    free = actuator.free_length(rest, value)
    axial = scene.rod.length / largest_force_scale(sections)
    scale = 1 / (axial + _compliance_of_arm(sections, place, grid))
    return Driven(actuator, value, rest, free, compliance, scale, jnp.zeros_like(scale))


def _compliance_of_arm(sections: CrossSections, place: int, grid: Grid) -> Array:
    r"""By how much the path of a thread becomes shorter per unit of its tension, at rest [m/N]:
    $\int b^T \Sigma^{-1} b \, dX$ of the wrench b of a unit force."""
    path = sections.paths[place]
    wrench = unit_wrench(sections.rest, path)
    parts = [part**2 / s for part, s in zip(wrench, sections.stiffness, strict=True)]
    per_length = c.times(sections.flexible, sum(parts[1:], parts[0]))
    return jnp.sum(grid.weight * c.times(sections.reach[place], per_length), axis=(0, 1))


def thread_length(
    scene: Scene, xi: Vector, sections: CrossSections, place: int, grid: Grid
) -> Array:
    """Length of a thread [m], from the strain at the nodes: of its path, or the sum of its
    chords."""
    if not scene.actuators[place].straight:
        return path_length(xi, sections, place, grid)
    return chords_of(scene, xi, grid).path_length(place)


def path_length(xi: Vector, sections: CrossSections, place: int, grid: Grid) -> Array:
    r"""Length of a thread's path, $\int |t_c| dX$ [m], from the strain at the nodes."""
    length, reach = thread_direction(xi, sections.paths[place])[1], sections.reach[place]
    return jnp.sum(grid.weight * c.times(reach, length), axis=(0, 1))
