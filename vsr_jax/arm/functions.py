"""Functions of the position in space, such as magnetic fields and distances."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from ..typing import ArrayLike

Position = Float[Array, "3"]


class FunctionOfPosition(eqx.Module):
    """A user's function of the position, without numbers that can be differentiated."""

    function: Callable = eqx.field(static=True)

    def __call__(self, position: Position) -> ArrayLike:
        return self.function(position)

    def __repr__(self) -> str:
        return f"{getattr(self.function, '__name__', 'function')}(r)"


def function_of_position(function: Callable[[Position], ArrayLike]) -> Callable:
    """`function` as a part of a scene; an equinox module, whose numbers can be differentiated, is
    returned as it is."""
    whole: Any = function
    return whole if isinstance(function, eqx.Module) else FunctionOfPosition(function)
