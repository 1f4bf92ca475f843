"""The lines of threads in space: along their paths, or straight between the discs of the arm."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..numerics.compiling import program
from ..numerics.component import dot, times
from ..numerics.magnus import step_poses
from ..numerics.quadrature import Grid, make_grid, piece_edges
from ..typing import Scalar
from .actuator import Actuator
from .discs import SAME
from .rod import Rod
from .routing import thread_tangent


def hole_places(rod: Rod) -> Float[Array, " places"]:
    """Abscissas [m] of the ends of the holes of an arm with discs: at its base and at the faces of
    the discs. In a disc with a thickness a straight tendon has a chord too, of constant length."""
    assert rod.discs is not None  # see `check_numbers`
    return jnp.concatenate([jnp.zeros_like(rod.length)[None], rod.discs.faces(rod.length)])


def runs_between(rod: Rod, actuator: Actuator) -> Float[Array, " spans"]:
    """1 for each span between neighbouring holes of an arm through which a straight tendon runs,
    else 0: from the first hole at its start or beyond to the last one before its end or there."""
    X, near = hole_places(rod), SAME * rod.length
    there = jnp.ones(X.size - 1, bool)
    if actuator.start is not None:
        there &= X[:-1] >= actuator.start - near
    if actuator.end is not None:
        there &= X[1:] <= actuator.end + near
    return there.astype(X.dtype)


def steps_before(grid: Grid, X: Array) -> Array:
    """Number of steps before abscissas X (places,) at which steps start; empty ones count or not.
    The middles of the steps are compared, which rounding of X does not change."""
    middle = grid.start + 0.5 * grid.h
    return jnp.sum(middle < X.reshape(-1, *(1,) * middle.ndim), axis=1)


@program("rest_length")
def rest_length(rod: Rod, actuator: Actuator) -> Scalar:
    """Length [m] of a thread on the arm at rest: of its path, or the sum of its chords."""
    holes = hole_places(rod) if actuator.straight else jnp.zeros(0, rod.length.dtype)
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
    chords = jnp.linalg.norm(jnp.diff(points, axis=0), axis=1)
    return jnp.sum(runs_between(rod, actuator) * chords)


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
