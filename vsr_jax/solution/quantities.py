"""The table of the quantities of an equilibrium: name, unit, dimensions and function of each.

`Equilibrium` shows every entry as an attribute; `vsr.sweep`, its store, the reports and the
documentation read unit, dimensions and description here. A new quantity is one entry:

    @quantity("m")
    def height(eq):
        "Height of the tip above the base [m]."
        return eq.tip[2, 3] - eq.position(0.0)[2]

    eq.value("height"); vsr.sweep(scene, inputs, outputs="height")
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Generic, TypeVar, overload

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..arm.scene import Scene
from ..models.base import Status
from ..numerics.compiling import Program
from ..numerics.quadrature import onto
from ..typing import VectorLike
from ..validation import ROUNDING, choice, on_arm

T = TypeVar("T")


class Solved(eqx.Module):
    """The part of an equilibrium that entries of the table use."""

    scene: eqx.AbstractVar[Scene]
    inputs: eqx.AbstractVar[Float[Array, " inputs"]]
    status: eqx.AbstractVar[Array]

    @property
    def converged(self) -> Bool[Array, "..."]:
        """Whether the result is an equilibrium, balanced to rounding."""
        return self.status == Status.CONVERGED

    def refuse_batch(self) -> None:
        """Raises `ValueError` for a batch of equilibria."""
        if jnp.ndim(self.status) > 0:
            raise ValueError(
                f"Equilibrium: got a batch of shape {jnp.shape(self.status)}, need jax.vmap, as "
                f"in jax.vmap(lambda eq: eq.tip)(eqs)"
            )

    def masked(self, tree: T) -> T:
        """Arrays, NaN where the solve failed."""
        return jax.tree.map(lambda x: jnp.where(self.converged, x, jnp.nan), tree)

    def value(self, name: str) -> Any:
        """The quantity of the table with that name, also one that was added to it.

        **Raises:** `ValueError` for a name that the table does not have.
        """
        entry = QUANTITIES.get(name)
        if entry is None:
            raise ValueError(f"name: got {name!r}, need one of {', '.join(QUANTITIES)}")
        return entry.__get__(self)


class _Entry:
    """What all entries of the table have: the function and what its name and docstring say."""

    def __init__(self, compute: Callable, unit: str):
        self.name, self.unit, self.compute = compute.__name__, unit, compute
        self.__doc__ = compute.__doc__
        text = " ".join((compute.__doc__ or self.name).split())
        self.description = text.split(". ")[0].strip(".")


class Quantity(_Entry, Generic[T]):
    """An entry of the table: a function of an equilibrium, compiled, NaN where the solve failed.

    As an attribute of `Equilibrium` it is the value; called with an equilibrium it is the same.

    **Fields:** `name`; `unit`, as "1/m and 1" where it differs along an axis; `dims`, names of the
    value's axes, None for a value that is not one array; `description`, the first sentence of the
    function's docstring.
    """

    def __init__(self, compute: Callable[..., T], unit: str, dims: tuple[str, ...] | None):
        super().__init__(compute, unit)
        self.dims = dims
        self._program = Program(self._masked, self.name)

    def _masked(self, eq: Solved) -> T:
        return eq.masked(self.compute(eq))

    def __call__(self, eq: Solved) -> T:
        eq.refuse_batch()
        return self._program(eq)

    @overload
    def __get__(self, eq: None, owner: Any = None) -> "Quantity[T]": ...
    @overload
    def __get__(self, eq: Solved, owner: Any = None) -> T: ...
    def __get__(self, eq: Any, owner: Any = None) -> Any:
        return self if eq is None else self(eq)


class AlongArm(_Entry):
    """An entry of the table that is a function of abscissas X [m]: one, shape (), or several in a
    row, which become the first axis of the value. NaN beyond the arm where X is traced.

    **Fields:** as `Quantity`; `dims` without that of the abscissas; `of`, the entry whose value the
    function takes in place of X, None for a function of X.
    """

    def __init__(
        self, compute: Callable[..., Array], unit: str, dims: tuple[str, ...], of: str | None
    ):
        super().__init__(compute, unit)
        self.dims, self.of = dims, of
        self._program = Program(self.at, self.name)

    def at(self, eq: Solved, X: Array) -> Array:
        """The value at abscissas that are checked."""
        if self.of is None:
            return masked_along(eq, X, partial(self.compute, eq))
        entry = QUANTITIES[self.of]
        assert isinstance(entry, AlongArm)
        return self.compute(eq, entry.at(eq, X))

    def __call__(self, eq: Solved, X: VectorLike) -> Array:
        return self._program(eq, abscissas(eq, X))

    @overload
    def __get__(self, eq: None, owner: Any = None) -> "AlongArm": ...
    @overload
    def __get__(self, eq: Solved, owner: Any = None) -> Callable[[VectorLike], Array]: ...
    def __get__(self, eq: Any, owner: Any = None) -> Any:
        return self if eq is None else partial(self, eq)


QUANTITIES: dict[str, Quantity[Any] | AlongArm] = {}
"""The table, by name."""


def quantity(unit: str, *dims: str) -> Callable[[Callable[..., T]], Quantity[T]]:
    """Decorator that puts a function of an equilibrium into the table under its own name.

    **Arguments:** `unit`, "1" for a number without; `dims`: names of the value's axes.

    **Raises:** `ValueError` for a name that the table has already.
    """
    return lambda compute: _entered(Quantity(compute, unit, dims))


def structure(unit: str) -> Callable[[Callable[..., T]], Quantity[T]]:
    """`quantity` for a value that is not one array; a sweep cannot store it."""
    return lambda compute: _entered(Quantity(compute, unit, None))


def along_arm(
    unit: str, *dims: str, of: str | None = None
) -> Callable[[Callable[..., Array]], AlongArm]:
    """`quantity` for a function of an equilibrium and abscissas, shape (stations,), with the
    stations in the value's first axis; `dims` are those of its other axes. With `of`, the name of
    another entry along the arm, the function takes that entry's value in place of the abscissas.

    **Raises:** `ValueError` for a name that the table has already, and for an `of` that is no entry
    along the arm.
    """
    return lambda compute: _entered(AlongArm(compute, unit, dims, of))


Entry = TypeVar("Entry", bound="Quantity[Any] | AlongArm")


def _entered(entry: Entry) -> Entry:
    if entry.name in QUANTITIES:
        raise ValueError(f"quantity: got {entry.name!r}, need a name that the table does not have")
    if isinstance(entry, AlongArm) and entry.of is not None:
        along = [name for name, known in QUANTITIES.items() if isinstance(known, AlongArm)]
        choice("of", entry.of, along)
    QUANTITIES[entry.name] = entry
    return entry


def abscissas(eq: Solved, X: VectorLike, name: str = "X") -> Array:
    """Abscissas [m] on the arm, one or several in a row, in the precision of the equilibrium.

    **Arguments:** `name`: the argument's name in messages.

    **Raises:** `ValueError` for a batch of equilibria, another shape, and an X beyond the arm where
    it is known.
    """
    eq.refuse_batch()
    array = jnp.asarray(X, eq.inputs.dtype)
    if array.ndim > 1:
        raise ValueError(f"{name}: got shape {array.shape}, need one abscissa or several in a row")
    on_arm(name, array, eq.scene.rod.length)
    return array


def masked_along(
    eq: Solved,
    X: Array,
    compute: Callable[[Array], Array],
    ends: tuple[Any, Any] | None = None,
) -> Array:
    """A function of abscissas; NaN beyond the arm, or the ends, and where the solve failed."""
    length = eq.scene.rod.length
    x, near = onto(X, *((0.0, length) if ends is None else ends), ROUNDING * length)
    value = compute(jnp.atleast_1d(x))
    known = jnp.atleast_1d(near & eq.converged).reshape(-1, *(1,) * (value.ndim - 1))
    return jnp.where(known, value, jnp.nan).reshape(*X.shape, *value.shape[1:])
