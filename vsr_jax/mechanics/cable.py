r"""Tendons with prescribed length.

A cable of free length $l^* + \delta$ under the tension T has the length $(l^* + \delta)(1 + T /
k)$; its slack is that length minus the length of the path, $l = \int |t_c| dX$. The unknown is T
and its row

$$\min(T, k_0 s) = 0, \quad s = (l^* + \delta)(1 + T / k) - l,$$

the complementarity of tension and slack, where the stiffness $k_0$ [N/m] only scales the two.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..arm.scene import CrossSections, Scene
from ..chain.border import Border
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid
from ..numerics.stacked import stack
from ..typing import Scalar
from .balance import largest_force_scale, thread_direction, thread_wrench
from .chords import Pull, discs_of
from .coupling import ArmProblem, ArmState, Coupling
from .loading import Loading
from .reaction import react
from .sizes import pull_of


class Cable(NamedTuple):
    r"""A tendon with prescribed length: its free length $l^* + \delta$ [m], its compliance $1/k$
    [1/N] (None if inextensible) and a stiffness $k_0$ [N/m] that scales slack to tension."""

    length: Array
    compliance: Array | None
    scale: Array

    def slack(self, tension: Array, path: Array, share: Array | None, grid: Grid) -> Array:
        """Slack on a path of a given length [m], negative if the cable is too short."""
        return self.length - path + tension * self.stretch(share, grid)

    def stretch(self, share: Array | None, grid: Grid) -> Array:
        """Stretch per unit of the tension at the start [m/N]; `share` is the fraction of it at the
        nodes."""
        if self.compliance is None:
            return jnp.zeros_like(self.length)
        if share is None:
            return self.length * self.compliance
        reached = jnp.sum(jnp.where(share > 0, grid.weight, 0.0), axis=(0, 1))
        mean = jnp.sum(grid.weight * share, axis=(0, 1)) / reached
        return self.length * self.compliance * mean


class Lengths(Coupling):
    """All tendons of an arm with prescribed lengths; the unknowns are their tensions [N], shape
    (cables, ...). `places`: their places among the threads."""

    places: tuple[int, ...] = eqx.field(static=True)
    cables: tuple[Cable, ...]

    def relaxed(self) -> "Lengths":
        longer = tuple(cable._replace(length=2 * cable.length) for cable in self.cables)
        return Lengths(self.places, longer)

    def guess(self, forces: Forces, grid: Grid) -> Float[Array, "cables ..."]:
        tensions = [jnp.broadcast_to(-forces[place], grid.h.shape[1:]) for place in self.places]
        return jnp.stack(tensions)

    def forces(self, x: Array, forces: Forces) -> Forces:
        found = list(forces)
        for place, tension in zip(self.places, x, strict=True):
            found[place] = -tension
        return tuple(found)

    def note(self, x: Array, at: ArmState, problem: ArmProblem) -> Vector:
        """Slack of each [m]."""
        shares = at.carried.shares
        return tuple(
            cable.slack(tension, self._length(place, at, problem), shares[place], problem.grid)
            for place, cable, tension in zip(self.places, self.cables, x, strict=True)
        )

    def _length(self, place: int, at: ArmState, problem: ArmProblem) -> Array:
        pull = _pull_of(at, place)
        if pull is not None:
            return pull.length(place)
        return path_length(at.xi, problem.sections, place, problem.grid)

    def _wrenches(self, at: ArmState, problem: ArmProblem) -> tuple[list[Vector], list[Vector]]:
        """Wrenches at the nodes by which each residual changes with the tension, and each length
        with the strain."""
        pulls, lengths = [], []
        for place in self.places:
            pull = _pull_of(at, place)
            if pull is None or at.along is None:
                path = problem.sections.paths[place]
                wrench = thread_wrench(thread_direction(at.xi, path)[0], path)
                pulls.append(c.times(at.carried.gains[place], wrench))
                lengths.append(c.times(problem.sections.reach[place], wrench))
            else:
                wrench = pull.unit(place, at.along.rotation)
                pulls.append(wrench)
                lengths.append(wrench)
        return pulls, lengths

    def residual(
        self, x: Array, at: ArmState, note: Vector, problem: ArmProblem, free: tuple[int, ...]
    ) -> Array:
        scaled = [cable.scale * slack for cable, slack in zip(self.cables, note, strict=True)]
        pairs = zip(x, scaled, strict=True)
        return jnp.stack([jnp.where(tension < slack, tension, slack) for tension, slack in pairs])

    def border(self, x: Array, at: ArmState, note: Vector, problem: ArmProblem) -> Border:
        grid, gains = problem.grid, at.carried.gains
        pulls, lengths = self._wrenches(at, problem)
        factors, corner = [], []
        for place, cable, tension, slack in zip(self.places, self.cables, x, note, strict=True):
            loose = tension < cable.scale * slack
            factors.append(jnp.where(loose, 0.0, -cable.scale))
            stretch = cable.scale * cable.stretch(gains[place], grid)
            corner.append(jnp.where(loose, 1.0, stretch))
        return Border(
            _stacked(pulls),
            _stacked(lengths),
            jnp.stack(factors),
            jnp.stack(corner),
        )

    def sizes(self, x: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        sections, length = problem.sections, problem.length
        return [
            tension * pull_of(sections, sections.paths[place], length)
            for place, tension in zip(self.places, x, strict=True)
        ]

    def row_sizes(self, rows: Array, at: ArmState, problem: ArmProblem) -> list[Array]:
        """Slack per length of the arm."""
        axial = largest_force_scale(problem.sections)
        return [row / axial for row in rows]

    def units(self, problem: ArmProblem) -> tuple[Array, Array]:
        change = jnp.stack([jnp.sqrt(cable.scale) for cable in self.cables])
        return 1 / change, change

    def radians(self, problem: ArmProblem) -> Array:
        weight = problem.grid.weight
        axial = jnp.sum(weight * problem.sections.stiffness[3]) / problem.length
        return jnp.broadcast_to(1 / axial, (len(self.cables),))


def _stacked(wrenches: list[Vector]) -> Vector:
    return tuple(stack(parts) for parts in zip(*wrenches, strict=True))


def lengths_of(scene: Scene, inputs: Array, sections: CrossSections, grid: Grid) -> Lengths | None:
    """The cables of a scene, for changes of their lengths [m]; None if it has none."""
    places = scene.length_driven
    cables = tuple(cable_of(scene, inputs[place], place, sections, grid) for place in places)
    return Lengths(places, cables) if places else None


def cable_of(
    scene: Scene, change: Scalar, place: int, sections: CrossSections, grid: Grid
) -> Cable:
    """The cable of a tendon with prescribed length, for a change of its length [m]."""
    stiffness = scene.actuators[place].cable_stiffness
    length = thread_length(scene, sections.rest, sections, place, grid) + change
    compliance = None if stiffness is None else 1 / stiffness
    scale = largest_force_scale(sections) / scene.rod.length
    return Cable(length, compliance, scale)


def _pull_of(at: ArmState, place: int) -> Pull | None:
    """The chords of an arm, if a tendon runs straight; None if it runs along its path."""
    pull = None if at.along is None else at.along.pull
    return pull if pull is not None and place in pull.discs.places else None


def thread_length(
    scene: Scene, xi: Vector, sections: CrossSections, place: int, grid: Grid
) -> Array:
    """Length of a thread [m], from the strain at the nodes: of its path, or the sum of its
    chords."""
    if not scene.actuators[place].straight:
        return path_length(xi, sections, place, grid)
    return chords_of(scene, xi, grid).length(place)


def chords_of(scene: Scene, xi: Vector, grid: Grid) -> Pull:
    """The chords of the straight tendons of a scene without their forces."""
    zero = (jnp.zeros_like(scene.rod.length),) * len(scene.actuators)
    only = Loading(None, None, None, (), (), discs_of(scene, grid), scene.rod.frame)
    pull = react(xi, grid, only, zero).pull
    assert pull is not None  # see `Scene.straight`
    return pull


def path_length(xi: Vector, sections: CrossSections, place: int, grid: Grid) -> Array:
    r"""Length of a thread's path, $\int |t_c| dX$ [m], from the strain at the nodes."""
    length, reach = thread_direction(xi, sections.paths[place])[1], sections.reach[place]
    return jnp.sum(grid.weight * c.times(reach, length), axis=(0, 1))
