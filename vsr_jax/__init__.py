"""Differentiable statics of soft manipulators: Cosserat rods bent by tendons and fluidic chambers."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from . import constraint as constraint, objective as objective, se3 as se3
from .actuator import Chamber as Chamber, Tendon as Tendon, Thread as Thread
from .basis import (
    Basis as Basis,
    FunctionBasis as FunctionBasis,
    Functions as Functions,
    Legendre as Legendre,
    Monomial as Monomial,
    PiecewiseConstant as PiecewiseConstant,
    Trigonometric as Trigonometric,
)
from .continuation import Branch as Branch, trace as trace
from .discrete import (
    Prescribed as Prescribed,
    actuation_matrix as actuation_matrix,
    jacobian as jacobian,
    stiffness_matrix as stiffness_matrix,
)
from .equilibrium import Equilibrium as Equilibrium
from .estimate import Error as Error
from .health import Health as Health, check as check
from .inverse import Reach as Reach, reach as reach
from .kinematics import step_twist as step_twist, zanna_step as zanna_step
from .load import (
    DistributedWrench as DistributedWrench,
    Gravity as Gravity,
    PointWrench as PointWrench,
    TipWrench as TipWrench,
)
from .material import Material as Material
from .model import Status as Status
from .parameters import Parameter as Parameter, parameters as parameters
from .plan import Plan as Plan, plan as plan
from .profile import (
    Constant as Constant,
    FunctionProfile as FunctionProfile,
    Piecewise as Piecewise,
    PolynomialProfile as PolynomialProfile,
    SplineProfile as SplineProfile,
    Taper as Taper,
)
from .rod import Rod as Rod
from .routing import (
    Function as Function,
    Helix as Helix,
    Linear as Linear,
    Parallel as Parallel,
    Polynomial as Polynomial,
    Spline as Spline,
)
from .scene import Scene as Scene
from .section import (
    Annular as Annular,
    Circular as Circular,
    Elliptic as Elliptic,
    Joined as Joined,
    Rectangular as Rectangular,
)
from .sensitivity import (
    Ellipsoid as Ellipsoid,
    Sensitivity as Sensitivity,
    compliance as compliance,
    compliance_ellipsoid as compliance_ellipsoid,
    manipulability as manipulability,
    sensitivity as sensitivity,
    tip_jacobian as tip_jacobian,
)
from .solve import SolveError as SolveError, solve as solve
from .strain_dependent import StrainDependent as StrainDependent
from .sweep import Sweep as Sweep, sweep as sweep

if TYPE_CHECKING:
    from .continuum import Continuum as Continuum
    from .optimize import Design as Design, design as design

__version__ = "0.1.0"


_LATER = {"Continuum": "continuum", "Design": "optimize", "design": "optimize"}
"""Where names lie that only some programs need: diffrax and optax take a third of the import time."""


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(import_module(f".{_LATER[name]}", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
