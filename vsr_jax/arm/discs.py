"""The discs of tendons that run straight from hole to hole: where they are, and the lengths of the
chords between them on the arm at rest."""

from collections.abc import Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.compiling import program
from ..numerics.component import dot, times
from ..numerics.magnus import step_poses
from ..numerics.quadrature import Grid, make_grid, piece_edges
from ..typing import Scalar
from .actuator import Actuator
from .rod import Rod
from .routing import thread_tangent

_SAME = 1e-6
"""Distance of two abscissas, as a share of the length, below which they are one disc."""


def _own_discs(
    rod: Rod, actuators: Sequence[Actuator]
) -> Iterator[tuple[Actuator, Array, list[int]]]:
    """Each straight tendon of an arm, its holes, and the places among them of the discs between its
    ends. Evenly spaced discs on the whole arm that several tendons share come once."""
    known: set[float] = set()
    for actuator in actuators:
        if not actuator.straight:
            continue
        holes, number = actuator.holes(rod.length), actuator.even_discs
        places = range(1, holes.size - 1)
        yield actuator, holes, [i for i in places if number is None or i / number not in known]
        if number is not None:
            known.update(i / number for i in places)


def inner_discs(rod: Rod, actuators: Sequence[Actuator]) -> Iterator[Scalar]:
    """Abscissas [m] of the discs between the ends of the straight tendons of an arm. Evenly spaced
    discs on the whole arm that several tendons share come once."""
    for _, holes, places in _own_discs(rod, actuators):
        yield from (holes[i] for i in places)


def disc_places(rod: Rod, actuators: Sequence[Actuator]) -> list[Scalar]:
    """Abscissas [m] of all discs of straight tendons, with those at their ends; none without such
    tendons. Those that several tendons name by abscissas come several times."""
    straight = [actuator for actuator in actuators if actuator.straight]
    places = list(inner_discs(rod, straight))
    if any(actuator.start is None for actuator in straight):
        places.append(jnp.zeros_like(rod.length))
    if any(actuator.end is None for actuator in straight):
        places.append(rod.length)
    given = (x for actuator in straight for x in (actuator.start, actuator.end))
    return [*places, *(x for x in given if x is not None)]


def distinct_discs(rod: Rod, actuators: Sequence[Actuator]) -> Float[np.ndarray, " discs"]:
    """`disc_places` of known numbers, ascending, each once."""
    X = np.sort(np.array(disc_places(rod, actuators), float))
    return X[np.append(np.diff(X) > _SAME * float(rod.length), True)] if X.size else X


def shared_discs(rod: Rod, actuators: Sequence[Actuator]) -> int:
    """Most breakpoints of straight tendons that lie where another one does, and leave a piece of
    the arm empty: all but those of the tendon with the most."""
    own = [
        len(places) + (actuator.start is not None) + (actuator.end is not None)
        for actuator, _, places in _own_discs(rod, actuators)
    ]
    return sum(own) - max(own, default=0)


def check_discs(name: str, actuator: Actuator, length: Scalar) -> None:
    """Raises `ValueError` for known discs that are not between the ends of their tendon."""
    holes = np.asarray(actuator.holes(length))
    if np.any(np.diff(holes) <= 0):
        raise ValueError(
            f"{name}.disc_places: got {holes[1]:g} to {holes[-2]:g} m, need ascending abscissas "
            f"between the ends of the tendon, {holes[0]:g} and {holes[-1]:g} m"
        )


def steps_before(grid: Grid, X: Array) -> Array:
    """Number of steps before abscissas X (places,) at which steps start; empty ones count or not.
    The middles of the steps are compared, which rounding of X does not change."""
    middle = grid.start + 0.5 * grid.h
    return jnp.sum(middle < X.reshape(-1, *(1,) * middle.ndim), axis=1)


@program("rest_length")
def rest_length(rod: Rod, actuator: Actuator) -> Scalar:
    """Length [m] of a thread on the arm at rest: of its path, or the sum of its chords."""
    holes = actuator.holes(rod.length)
    breaks = (*rod.breakpoints, *actuator.breakpoints, *holes)
    grid = make_grid(piece_edges(rod.length, breaks), 32, 3)
    X = grid.X.reshape(-1)
    rest = jax.vmap(rod.rest)(X)
    if not actuator.straight:
        t_c = thread_tangent(rest, jax.vmap(actuator.routing.path)(X))
        per_length, reach = jnp.sqrt(dot(t_c, t_c)), jax.vmap(actuator.reach)(X)
        return jnp.sum(grid.weight.reshape(-1) * times(reach, per_length))
    poses = step_poses(tuple(x.reshape(grid.X.shape) for x in rest), grid.h)
    points = points_at(actuator, holes, poses[steps_before(grid, holes)])
    return jnp.sum(jnp.linalg.norm(jnp.diff(points, axis=0), axis=1))


def points_at(
    actuator: Actuator, X: Float[Array, " places"], poses: Float[Array, "places 4 4"]
) -> Float[Array, "places 3"]:
    """Points [m] where a thread crosses sections at abscissas X with given poses."""
    y, z = jax.vmap(actuator.routing)(X)
    return poses[:, :3, 3] + poses[:, :3, 1] * y[:, None] + poses[:, :3, 2] * z[:, None]


def on_chords(
    points: Float[Array, "holes 3"], holes: Float[Array, " holes"], X: Float[Array, " stations"]
) -> Float[Array, "stations 3"]:
    """Points [m] of the chords between holes at abscissas X, in proportion."""
    return jax.vmap(lambda x: jnp.interp(X, holes, x), in_axes=1, out_axes=1)(points)
