"""Calibration: fits of a scene's numbers to measured shapes, with standard errors, checks by
held-out data, comparison of models and the choice of the next measurement.

Does not import optimizers or plotting.
"""

from .cross_validation import CrossValidation, cross_validate
from .fitting import fit
from .force_observations import ContactForces, Reactions, Tensions
from .likelihood import LikelihoodProfile, likelihood_profile
from .measurements import Measurements
from .model_comparison import Comparison, compare
from .next_inputs import NextMeasurement, next_measurement
from .observation import Curvatures, Markers, Observation, Poses
from .result import Fit
from .unknowns import Unknown

__all__ = [
    "Comparison",
    "ContactForces",
    "CrossValidation",
    "Curvatures",
    "Fit",
    "LikelihoodProfile",
    "Markers",
    "Measurements",
    "NextMeasurement",
    "Observation",
    "Poses",
    "Reactions",
    "Tensions",
    "Unknown",
    "compare",
    "cross_validate",
    "fit",
    "likelihood_profile",
    "next_measurement",
]
