"""Models that find an equilibrium and describe its state: strain-dependent, prescribed basis,
continuum.

Know scenes and mechanics. Must not know what is done with the answer.
"""

from .base import Model, Nodes, Outcome, Status, SteppedModel, classify
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
    "Nodes",
    "Outcome",
    "PiecewiseConstant",
    "Prescribed",
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
