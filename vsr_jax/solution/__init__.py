"""One equilibrium: how it is asked for, what it tells, how stable it is and how large its error.

Must not know of many solves: what needs them lies in `analysis`.
"""

from .equilibrium import Equilibrium
from .estimate import Error
from .solver import SolveError, outcome_of, solve
from .step_choice import Plan, plan

__all__ = ["Equilibrium", "Error", "Plan", "SolveError", "outcome_of", "plan", "solve"]
