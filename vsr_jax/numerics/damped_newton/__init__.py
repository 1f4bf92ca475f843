"""Newton's method with Levenberg damping, for residuals that are nearly the gradient of an energy;
several problems side by side.

`solver` holds the iteration. Each other module holds one part of it: `problem` what is solved,
`state` the variables, `descent` the next step, `convergence` how fast steps shrink, `acceptance`
whether a step is accepted and the damping, `termination` when a problem is done, `continuation`
load levels and restarts, `probe` the test of stability at the end.
"""

from .continuation import FIRST_DAMPING, HARDENING_STAGES, LOAD_INCREMENTS, SOFT_STAGES
from .descent import MAX_TURN
from .problem import Damped, Measures, Schedule, Stage
from .solver import damped_newton

__all__ = [
    "FIRST_DAMPING",
    "HARDENING_STAGES",
    "LOAD_INCREMENTS",
    "MAX_TURN",
    "SOFT_STAGES",
    "Damped",
    "Measures",
    "Schedule",
    "Stage",
    "damped_newton",
]
