"""Parts of an arm: profiles, sections, materials, routings, actuators, loads, the rod, and the
scene that combines them.

Data and their geometry only. Must not know how an equilibrium is found or how a scene is stored.
"""

from .actuator import Actuator, Chamber, Tendon, Thread
from .loads import DistributedWrench, Frame, Gravity, Load, PointWrench, TipWrench
from .material import Material
from .placement import pose
from .pose_loads import (
    MagneticDensity,
    MagneticMoment,
    Payload,
    PoseLoad,
    Spinning,
    Spring,
)
from .profile import (
    Constant,
    FunctionProfile,
    Piecewise,
    PolynomialProfile,
    Profile,
    SplineProfile,
    Taper,
)
from .rigid_piece import RigidPiece
from .rod import STRAINS, Rod
from .routing import Function, Helix, Linear, Parallel, Polynomial, Routing, Spline
from .scene import CrossSections, Scene
from .scene_numbers import Parameter, parameters
from .section import Annular, Circular, Elliptic, Joined, Rectangular, Section

__all__ = [
    "STRAINS",
    "Actuator",
    "Annular",
    "Chamber",
    "Circular",
    "Constant",
    "CrossSections",
    "DistributedWrench",
    "Elliptic",
    "Frame",
    "Function",
    "FunctionProfile",
    "Gravity",
    "Helix",
    "Joined",
    "Linear",
    "Load",
    "MagneticDensity",
    "MagneticMoment",
    "Material",
    "Parallel",
    "Parameter",
    "Payload",
    "Piecewise",
    "PointWrench",
    "Polynomial",
    "PolynomialProfile",
    "PoseLoad",
    "Profile",
    "Rectangular",
    "RigidPiece",
    "Rod",
    "Routing",
    "Scene",
    "Section",
    "Spinning",
    "Spline",
    "SplineProfile",
    "Spring",
    "Taper",
    "Tendon",
    "Thread",
    "TipWrench",
    "parameters",
    "pose",
]
