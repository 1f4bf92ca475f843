"""Models that compute and describe an equilibrium: strain-dependent, prescribed basis, continuum.

They use scenes and mechanics, and are independent of what is done with the result.
"""

from .base import Model, Near, Nodes, Outcome, Status, SteppedModel, classify
from .basis import (
    AbstractBasis,
    Basis,
    Family,
    FunctionBasis,
    Functions,
    Legendre,
    Monomial,
    PiecewiseConstant,
    Trigonometric,
)
from .prescribed import Prescribed, actuation_matrix, jacobian, project, stiffness_matrix
from .refinement import Refinement
from .strain_dependent import StrainDependent

__all__ = [
    "AbstractBasis",
    "Basis",
    "Family",
    "FunctionBasis",
    "Functions",
    "Legendre",
    "Model",
    "Monomial",
    "Near",
    "Nodes",
    "Outcome",
    "PiecewiseConstant",
    "Prescribed",
    "Refinement",
    "Status",
    "SteppedModel",
    "StrainDependent",
    "Trigonometric",
    "actuation_matrix",
    "classify",
    "jacobian",
    "project",
    "stiffness_matrix",
]
