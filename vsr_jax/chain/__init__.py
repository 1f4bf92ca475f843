"""The linear algebra of a chain: the tangent of an arm's balance as a matrix, with its product, its
solution, the signs of its eigenvalues, stiffness across spans of the chain and a border.

Knows neither rods nor loads: everything here takes stiffnesses, wrenches and derivatives at the
nodes of a grid.
"""

from .border import Border, bordered_solve, solved_with
from .coupled import Coupled
from .definiteness import Definiteness
from .matrix import Chain
from .spans import Spans

__all__ = [
    "Border",
    "Chain",
    "Coupled",
    "Definiteness",
    "Spans",
    "bordered_solve",
    "solved_with",
]
