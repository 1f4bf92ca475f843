"""Results that need many solves: derivatives, constraints, inverse statics, health, branches of
equilibria, sweeps.

Does not import optimizers or plotting.
"""

from . import constraint
from .branches import Branch, follow_branch
from .derivatives import (
    Ellipsoid,
    Sensitivity,
    compliance,
    compliance_ellipsoid,
    manipulability,
    sensitivity,
    tip_jacobian,
)
from .following import follow
from .health import Health, check
from .inverse import Reach, reach
from .path_finding import InputPath, find_path
from .sweeping import Sweep, sweep

__all__ = [
    "Branch",
    "Ellipsoid",
    "Health",
    "InputPath",
    "Reach",
    "Sensitivity",
    "Sweep",
    "check",
    "compliance",
    "compliance_ellipsoid",
    "constraint",
    "find_path",
    "follow",
    "follow_branch",
    "manipulability",
    "reach",
    "sensitivity",
    "sweep",
    "tip_jacobian",
]
