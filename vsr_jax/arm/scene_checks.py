"""Checks of the known numbers of a scene: sizes and properties, the paths of threads, places on the
arm, and the room that obstacles leave to it."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.compiling import program
from ..numerics.se3 import base_pose
from ..typing import Scalar
from ..validation import ROUNDING, concrete, is_traced, numbers
from .actuator import Actuator
from .discs import SAME, Discs
from .held import Support
from .loads import Load
from .obstacles import Obstacle
from .plausible import Measures, doubts, measures_at
from .profile import Limits
from .rigid_piece import check_pieces
from .rod import Rod
from .thread_lines import hole_places

_PROBES = 65
"""Evenly spaced abscissas at which limits are checked, besides the breakpoints and the middles
between them."""


def check_numbers(
    rod: Rod,
    actuators: Sequence[Actuator],
    loads: Sequence[Load],
    edges: Callable[[], Float[Array, " edges"]],
) -> tuple[str, ...]:
    """Sentences about implausible numbers of a scene.

    **Raises:** `ValueError` for a size or a property beyond its limits, a thread outside the
    section, and a thread end or a load beyond the arm.

    **Arguments:** `edges`: function that returns the ends of the smooth pieces of the arm [m]; it
    is called after the check of the length.
    """
    length = float(numbers("Scene.rod.length", rod.length, positive=True))
    _check_places(length, rod, actuators, loads)
    probe = _probe(rod, tuple(actuators), edges())
    if any(map(is_traced, jax.tree.leaves(probe))):
        return ()
    X, limited, clearances, measures = jax.tree.map(np.asarray, probe)
    for (name, needed), (values, room) in limited.items():
        if not np.all(room > 0):
            i, is_length = int(np.argmin(room)), name.startswith("section") or "radius" in name
            unit = " m" if is_length else ""
            raise ValueError(
                f"Scene.rod.{name}: got {values[i]:g}{unit} at X = {X[i]:g} m, need {needed} "
                f"everywhere"
            )
    for i, values in enumerate(clearances):
        j = int(np.argmin(values))
        if not values[j] > -ROUNDING * length:
            guide = rod.rim
            outside, needed = (
                ("section", "the section (or give the rod discs with a radius)")
                if guide is None
                else ("section and the discs", f"the discs' radius of {float(guide):g} m")
            )
            raise ValueError(
                f"Scene.actuators[{i}].routing: the thread is {-values[j]:.3g} m outside the "
                f"{outside} at X = {X[j]:g} m; need a path inside {needed}"
            )
    return tuple(doubts(rod, actuators, loads, measures))


def _check_places(
    length: float, rod: Rod, actuators: Sequence[Actuator], loads: Sequence[Load]
) -> None:
    """Raises `ValueError` for rigid pieces that the arm cannot have, and if a thread end, a disc or
    a point load is beyond the arm."""
    check_pieces("Scene.rod.rigid", rod.rigid, length)
    beyond = length * (1 + ROUNDING)
    for i, actuator in enumerate(actuators):
        for name, x in (("start", actuator.start), ("end", actuator.end)):
            if x is not None and (float(x) > beyond or (name == "start" and float(x) >= length)):
                raise ValueError(
                    f"Scene.actuators[{i}].{name}: got {float(x):g} m, need a place on the "
                    f"arm of {length:g} m"
                )
        if actuator.straight:
            _check_straight(f"Scene.actuators[{i}]", actuator, rod)
    for name, x in rod.material.places.items():
        if float(x) > beyond:
            raise ValueError(
                f"Scene.rod.material.{name}: got {float(x):g} m, need a place on the arm of "
                f"{length:g} m"
            )
    if rod.discs is not None:
        _check_discs(rod.discs, length)
    for i, load in enumerate(loads):
        X = load.place(rod)
        if X is not None and float(X) > beyond:
            raise ValueError(
                f"Scene.loads[{i}].X: got {float(X):g} m, need a place on the arm of {length:g} m"
            )


def _check_discs(discs: Discs, length: float) -> None:
    """Raises `ValueError` for a disc beyond an arm of a known length, or on another one."""
    X = np.asarray(discs.along(length))
    if X[-1] > length * (1 + ROUNDING):
        raise ValueError(
            f"Scene.rod.discs: got a disc at {X[-1]:g} m, need places on the arm of {length:g} m"
        )
    room = float(np.min(np.diff(X, prepend=0.0)))
    if discs.thickness is not None and not float(discs.thickness) < room * (1 - ROUNDING):
        raise ValueError(
            f"Scene.rod.discs.thickness: got {float(discs.thickness):g} m, need less than the "
            f"{room:g} m from disc to disc"
        )


def _check_straight(name: str, actuator: Actuator, rod: Rod) -> None:
    """Raises `ValueError` for a straight tendon without discs, or with a known end in none."""
    if rod.discs is None:
        raise ValueError(f"{name}.straight: got True on a rod without discs, need Rod(discs=...)")
    length = float(rod.length)
    places = np.asarray(hole_places(rod))
    for end, X in (("start", actuator.start), ("end", actuator.end)):
        if X is not None and np.min(np.abs(places - float(X))) > SAME * length:
            near = places[np.argmin(np.abs(places - float(X)))]
            raise ValueError(
                f"{name}.{end}: got {float(X):g} m, need the place of a disc, such as {near:g} m, "
                f"for a straight tendon"
            )


def check_held(rod: Rod, held: Sequence[Support]) -> None:
    """Raises `ValueError` if a held section is beyond the arm or is held twice."""
    length, places = float(rod.length), [float(one.place(rod)) for one in held]
    for i, X in enumerate(places):
        if length * (1 + ROUNDING) < X:
            raise ValueError(
                f"Scene.held[{i}].X: got {X:g} m, need a place on the arm of {length:g} m"
            )
        if X in places[:i]:
            raise ValueError(
                f"Scene.held[{i}].X: got {X:g} m, where Scene.held[{places.index(X)}] holds the "
                f"arm already; need one Held per section"
            )


@program("Scene")
def _probe(
    rod: Rod, actuators: tuple[Actuator, ...], edges: Array
) -> tuple[Array, Limits, list[Array], Measures]:
    """Abscissas X [m] along the arm and, at each, the numbers of the rod that have limits, the
    clearance of each thread [m] and what tells whether numbers are plausible."""
    # between the breakpoints too, where a short piece may lie between evenly spaced abscissas
    X = jnp.concatenate(
        [jnp.linspace(0, 1, _PROBES) * rod.length, edges, 0.5 * (edges[1:] + edges[:-1])]
    )

    def clearance(actuator: Actuator, x: Scalar) -> Array:
        inside, reach = rod.clearance(*actuator.routing(x), x), actuator.reach(x)
        return inside if reach is None else jnp.where(reach > 0, inside, jnp.inf)

    return (
        X,
        jax.vmap(rod.limits)(X),
        [jax.vmap(lambda x, a=a: clearance(a, x))(X) for a in actuators],
        jax.vmap(lambda x: measures_at(rod, x))(X),
    )


def check_obstacles(
    rod: Rod, obstacles: Sequence[Obstacle], edges: Callable[[], Float[Array, " edges"]]
) -> None:
    """Raises `ValueError` for an obstacle of no size, a tube narrower than the arm, and an arm that
    starts where it cannot be, for known numbers.

    **Arguments:** `edges`: as for `check_numbers`.
    """
    if not obstacles:
        return
    start, radii = map(concrete, _room_needed(rod, edges()))
    if start is None or radii is None:
        return
    for i, obstacle in enumerate(obstacles):
        name = f"Scene.obstacles[{i}]"
        for size, value in obstacle.sizes.items():
            known = concrete(value)
            if known is not None and not known > 0:
                raise ValueError(f"{name}.{size}: got {known:g}, need a number > 0")
        obstacle.check(name, float(np.max(radii)))
        distance = concrete(_distance(obstacle, start))
        if distance is None:
            continue
        gap = float(distance - radii[0])
        if not gap > -ROUNDING * float(rod.length):
            at, needed = ("outside", "in") if obstacle.encloses else ("inside", "outside")
            raise ValueError(
                f"{name}: the arm starts {-gap:.3g} m {at} the {obstacle.effect} at X = 0 m, its "
                f"outline of {radii[0]:g} m included; need an arm that starts {needed} the "
                f"{obstacle.effect}"
            )


@program("Scene")
def _room_needed(rod: Rod, edges: Array) -> tuple[Array, Array]:
    """Position of the start of the arm [m], and radii of its outline [m] from there on."""
    X = jnp.concatenate([jnp.linspace(0, 1, _PROBES) * rod.length, edges])
    return jnp.asarray(base_pose(rod.frame, X.dtype))[:3, 3], jax.vmap(rod.outline)(X)


@program("Scene")
def _distance(obstacle: Obstacle, position: Array) -> Array:
    return obstacle.distance(position)
