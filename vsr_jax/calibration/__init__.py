"""Calibration: fits of a scene's numbers to measured shapes, with standard errors, checks by held-out
data, comparison of models and the choice of the next measurement.

Does not import optimizers or plotting.
"""

from .fitting import fit
from .measurements import Measurements
from .observation import Curvatures, Markers, Observation, Poses, Tensions
from .result import Fit
from .unknowns import Unknown

__all__ = [
    "Curvatures",
    "Fit",
    "Markers",
    "Measurements",
    "Observation",
    "Poses",
    "Tensions",
    "Unknown",
    "fit",
]
