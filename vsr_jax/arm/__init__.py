"""Parts of an arm: profiles, sections, materials, routings, actuators, loads, the rod, obstacles
around it, and the scene that combines them.

Data and their geometry only. Must not know how an equilibrium is found or how a scene is stored.
"""

from .actuator import Actuator, Chamber, Tendon, Thread, ThreadState
from .composite import Composite, Inclusion
from .discs import Discs
from .driven import Input, InputRange
from .elasticity import Elasticity
from .held import Held, Support
from .loads import DistributedWrench, Frame, Gravity, Load, PointWrench, TipWrench
from .material import Material
from .obstacles import Box, Cylinder, Field, Obstacle, Plane, Sphere
from .placement import pose
from .plausible import UnitWarning
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
from .rubber import NeoHookean, Ogden
from .scene import CrossSections, Scene
from .scene_numbers import Parameter, parameters
from .section import Annular, Circular, Elliptic, Joined, Rectangular, Section
from .section_law import LinearLaw, SectionLaw
from .stiffness import Stiffness
from .tube import Tube

__all__ = [
    "STRAINS",
    "Actuator",
    "Annular",
    "Box",
    "Chamber",
    "Circular",
    "Composite",
    "Constant",
    "CrossSections",
    "Cylinder",
    "Discs",
    "DistributedWrench",
    "Elasticity",
    "Elliptic",
    "Field",
    "Frame",
    "Function",
    "FunctionProfile",
    "Gravity",
    "Held",
    "Helix",
    "Inclusion",
    "Input",
    "InputRange",
    "Joined",
    "Linear",
    "LinearLaw",
    "Load",
    "MagneticDensity",
    "MagneticMoment",
    "Material",
    "NeoHookean",
    "Obstacle",
    "Ogden",
    "Parallel",
    "Parameter",
    "Payload",
    "Piecewise",
    "Plane",
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
    "SectionLaw",
    "Sphere",
    "Spinning",
    "Spline",
    "SplineProfile",
    "Spring",
    "Stiffness",
    "Support",
    "Taper",
    "Tendon",
    "Thread",
    "ThreadState",
    "TipWrench",
    "Tube",
    "UnitWarning",
    "parameters",
    "pose",
]
