"""One equilibrium: the solve, the table of its quantities, its stability margin and its error.

Must not import code that needs several solves; that code is in `analysis`.
"""

from .bearing import Contact
from .energy import Energy
from .equilibrium import Equilibrium
from .estimate import Error
from .quantities import QUANTITIES, along_arm, quantity
from .solver import SolveError, outcome_of, solve
from .step_choice import Plan, plan
from .summary import Summary

__all__ = [
    "QUANTITIES",
    "Contact",
    "Energy",
    "Equilibrium",
    "Error",
    "Plan",
    "SolveError",
    "Summary",
    "along_arm",
    "outcome_of",
    "plan",
    "quantity",
    "solve",
]
