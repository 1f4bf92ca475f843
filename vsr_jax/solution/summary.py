"""Everything along an arm at once, from one compiled program."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.thread_lines import hole_places, on_chords, points_at
from ..numerics.compiling import program
from ..typing import VectorLike
from ..validation import choice
from .quantities import QUANTITIES, AlongArm, Quantity, Solved, abscissas

ANGLES = 24
"""Points around the wall; a circle drawn with them is round to 1 % of its radius."""


class Summary(eqx.Module):
    """An equilibrium at stations along the arm. The entries of the table are attributes too:
    `summary.pose`, `summary.strain`.

    **Fields:** `X` [m], shape (stations,); `along`, every quantity along the arm by its name, the
    stations in the first axis; `threads` [m], shape (threads, stations, 3), NaN beyond a thread's
    ends; `wall` [m], the outer wall, shape (stations, angles, 3); `values`, other quantities that
    were asked for, by name.
    """

    X: Float[Array, " stations"]
    along: dict[str, Array]
    threads: Float[Array, "threads stations 3"]
    wall: Float[Array, "stations angles 3"]
    values: dict[str, Any]

    def __getattr__(self, name: str) -> Any:
        # copies and pickles ask for attributes before the fields are set
        tables = [self.__dict__.get(field, {}) for field in ("along", "values")]
        for table in tables:
            if name in table:
                return table[name]
        raise AttributeError(
            f"Summary has no {name!r}; it has "
            f"{', '.join(known for table in tables for known in table)}"
        )


def summary_of(eq: Solved, X: VectorLike = 61, values: Sequence[str] = ()) -> Summary:
    """`Equilibrium.summary`."""
    known = [name for name, entry in QUANTITIES.items() if isinstance(entry, Quantity)]
    names = [choice("values", name, known) for name in values]
    at = stations(eq, X)
    along, threads, wall = _along(eq, at)
    return Summary(at, along, threads, wall, {name: eq.value(name) for name in names})


def stations(eq: Solved, X: VectorLike, name: str = "X") -> Float[Array, " stations"]:
    """Abscissas [m] of stations, checked, from their number or from the abscissas themselves.

    **Arguments:** `name`: the argument's name in messages.
    """
    if isinstance(X, int | np.integer) and not isinstance(X, bool):
        X = jnp.linspace(0.0, 1.0, int(X)) * eq.scene.rod.length
    return jnp.atleast_1d(abscissas(eq, X, name))


def compiled_summary(eq: Solved, X: VectorLike) -> Callable[[Solved], Summary]:
    """`summary_of` at given stations, compiled but not run: for this equilibrium and all others of
    the same model and kind of scene."""
    _along.compile(eq, stations(eq, X))
    return lambda eq: summary_of(eq, X)


@program("summary")
def _along(eq: Solved, X: Array) -> tuple[dict[str, Array], Array, Array]:
    """Every quantity along the arm, the threads and the wall."""
    along: dict[str, Array] = {}
    for name, entry in QUANTITIES.items():  # an entry `of` another comes after it
        if isinstance(entry, AlongArm):
            of = entry.of
            along[name] = entry.at(eq, X) if of is None else entry.compute(eq, along[of])
    rod, sections = eq.scene.rod, eq.scene.sections(X)
    angle = jnp.linspace(0.0, 2 * jnp.pi, ANGLES + 1).astype(X.dtype)
    wall = jax.vmap(lambda x: jnp.stack(rod.section.outline(angle, x, rod.length), axis=-1))(X)
    paths = [
        jnp.where((1.0 if reach is None else reach[:, None]) > 0, _place(path), jnp.nan)
        for path, reach in zip(sections.paths, sections.reach, strict=True)
    ]
    threads = jnp.stack(paths, axis=1) if paths else jnp.zeros((X.size, 0, 2), X.dtype)
    carried = [_carried(along["pose"], yz) for yz in (threads, wall)]
    lines = jnp.swapaxes(carried[0], 0, 1)
    for i in eq.scene.straight:
        lines = lines.at[i].set(jnp.where(jnp.isnan(lines[i]), jnp.nan, _chords(eq, i, X)))
    return along, lines, carried[1]


def _chords(eq: Solved, place: int, X: Array) -> Array:
    """Points [m] of a straight tendon at abscissas X."""
    actuator = eq.scene.actuators[place]
    holes = hole_places(eq.scene.rod)
    return on_chords(points_at(actuator, holes, eq.value("pose")(holes)), holes, X)


def _place(path: Any) -> Array:
    return jnp.stack((path.y, path.z), axis=-1)


def _carried(pose: Array, yz: Array) -> Array:
    """Points (stations, points, 3) [m] of sections carried along the poses."""
    R, r = pose[:, None, :3, 1:3], pose[:, None, :3, 3]
    return r + R[..., 0] * yz[..., :1] + R[..., 1] * yz[..., 1:]
