"""Everything along an arm at once, from one compiled program."""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..typing import VectorLike
from ..validation import choice, is_traced
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
        for table in ("along", "values"):
            if name in self.__dict__.get(table, {}):
                return self.__dict__[table][name]
        raise AttributeError(
            f"Summary has no {name!r}; it has {', '.join([*self.along, *self.values])}"
        )


def summary_of(eq: Solved, X: VectorLike = 61, values: Sequence[str] = ()) -> Summary:
    """The summary of an equilibrium.

    **Arguments:** `X`: how many stations, evenly spaced on the arm, or their abscissas [m];
    `values`: other quantities of the table that the same program computes, by name.

    **Raises:** `ValueError` for a batch of equilibria, abscissas beyond the arm, and a name that
    the table does not have.
    """
    known = [name for name, entry in QUANTITIES.items() if isinstance(entry, Quantity)]
    names = tuple(choice("values", name, known) for name in values)
    return _compiled(eq, abscissas(eq, _stations(eq, X)), names)


def _stations(eq: Solved, X: VectorLike) -> Any:
    if isinstance(X, int | np.integer) and not isinstance(X, bool):
        return jnp.linspace(0.0, 1.0, int(X)) * eq.scene.rod.length
    return X if is_traced(X) else jnp.atleast_1d(jnp.asarray(X))


def compiled_summary(eq: Solved, X: Array) -> Callable[[Solved, Array], Summary]:
    """The program of `summary_of`, compiled: for this equilibrium and for all of the same model and
    kind of scene."""
    X = X.astype(eq.inputs.dtype)
    program = _compiled.lower(eq, X, ()).compile()  # pyright: ignore[reportFunctionMemberAccess]
    return lambda eq, X: program(eq, X.astype(eq.inputs.dtype), ())


@eqx.filter_jit
def _compiled(eq: Solved, X: Array, names: tuple[str, ...]) -> Summary:
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
    values = {name: eq.value(name) for name in names}
    return Summary(X, along, jnp.swapaxes(carried[0], 0, 1), carried[1], values)


def _place(path: Any) -> Array:
    return jnp.stack((path.y, path.z), axis=-1)


def _carried(pose: Array, yz: Array) -> Array:
    """Points (stations, points, 3) [m] of sections carried along the poses."""
    R, r = pose[:, None, :3, 1:3], pose[:, None, :3, 3]
    return r + R[..., 0] * yz[..., :1] + R[..., 1] * yz[..., 1:]
