"""Differentiable statics of soft manipulators: Cosserat rods bent by tendons and fluidic
chambers."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .analysis import (
        Branch,
        Ellipsoid,
        Health,
        InputPath,
        Reach,
        Sensitivity,
        Sweep,
        check,
        compliance,
        compliance_ellipsoid,
        constraint,
        find_path,
        follow,
        follow_branch,
        manipulability,
        reach,
        sensitivity,
        sweep,
        tip_jacobian,
    )
    from .arm import (
        Annular,
        Box,
        Chamber,
        Circular,
        Constant,
        Cylinder,
        Discs,
        DistributedWrench,
        Elliptic,
        Field,
        Function,
        FunctionProfile,
        Gravity,
        Held,
        Helix,
        Joined,
        Linear,
        MagneticDensity,
        MagneticMoment,
        Material,
        Parallel,
        Parameter,
        Payload,
        Piecewise,
        Plane,
        PointWrench,
        Polynomial,
        PolynomialProfile,
        Rectangular,
        RigidPiece,
        Rod,
        Scene,
        Sphere,
        Spinning,
        Spline,
        SplineProfile,
        Spring,
        Stiffness,
        Taper,
        Tendon,
        Thread,
        TipWrench,
        Tube,
        parameters,
        pose,
    )
    from .calibration import (
        Comparison,
        CrossValidation,
        Curvatures,
        Fit,
        LikelihoodProfile,
        Markers,
        Measurements,
        NextMeasurement,
        Observation,
        Poses,
        Tensions,
        Unknown,
        compare,
        cross_validate,
        fit,
        likelihood_profile,
        next_measurement,
    )
    from .fabrication import Fabrication, export
    from .files import SceneFile, load, save
    from .models import (
        Basis,
        FunctionBasis,
        Functions,
        Legendre,
        Monomial,
        PiecewiseConstant,
        Prescribed,
        Status,
        StrainDependent,
        Trigonometric,
        actuation_matrix,
        jacobian,
        stiffness_matrix,
    )
    from .models.continuum import Continuum
    from .numerics import quick_compilation, se3, step_twist, zanna_step
    from .optimization import objective
    from .optimization.design_search import Design, design
    from .optimization.search import Search
    from .solution import (
        Contact,
        Energy,
        Equilibrium,
        Error,
        Plan,
        SolveError,
        Summary,
        plan,
        solve,
    )
    from .viewer.page import View, view
    from .viz import annotate, plot, plot_design, plot_fit
    from .viz.animation import film

__version__ = "0.1.0"

__all__ = [
    "Annular",
    "Basis",
    "Box",
    "Branch",
    "Chamber",
    "Circular",
    "Comparison",
    "Constant",
    "Contact",
    "Continuum",
    "CrossValidation",
    "Curvatures",
    "Cylinder",
    "Design",
    "Discs",
    "DistributedWrench",
    "Ellipsoid",
    "Elliptic",
    "Energy",
    "Equilibrium",
    "Error",
    "Fabrication",
    "Field",
    "Fit",
    "Function",
    "FunctionBasis",
    "FunctionProfile",
    "Functions",
    "Gravity",
    "Health",
    "Held",
    "Helix",
    "InputPath",
    "Joined",
    "Legendre",
    "LikelihoodProfile",
    "Linear",
    "MagneticDensity",
    "MagneticMoment",
    "Markers",
    "Material",
    "Measurements",
    "Monomial",
    "NextMeasurement",
    "Observation",
    "Parallel",
    "Parameter",
    "Payload",
    "Piecewise",
    "PiecewiseConstant",
    "Plan",
    "Plane",
    "PointWrench",
    "Polynomial",
    "PolynomialProfile",
    "Poses",
    "Prescribed",
    "Reach",
    "Rectangular",
    "RigidPiece",
    "Rod",
    "Scene",
    "SceneFile",
    "Search",
    "Sensitivity",
    "SolveError",
    "Sphere",
    "Spinning",
    "Spline",
    "SplineProfile",
    "Spring",
    "Status",
    "Stiffness",
    "StrainDependent",
    "Summary",
    "Sweep",
    "Taper",
    "Tendon",
    "Tensions",
    "Thread",
    "TipWrench",
    "Trigonometric",
    "Tube",
    "Unknown",
    "View",
    "actuation_matrix",
    "annotate",
    "check",
    "compare",
    "compliance",
    "compliance_ellipsoid",
    "constraint",
    "cross_validate",
    "design",
    "export",
    "film",
    "find_path",
    "fit",
    "follow",
    "follow_branch",
    "jacobian",
    "likelihood_profile",
    "load",
    "manipulability",
    "next_measurement",
    "objective",
    "parameters",
    "plan",
    "plot",
    "plot_design",
    "plot_fit",
    "pose",
    "quick_compilation",
    "reach",
    "save",
    "se3",
    "sensitivity",
    "solve",
    "step_twist",
    "stiffness_matrix",
    "sweep",
    "tip_jacobian",
    "view",
    "zanna_step",
]

_PACKAGES = (
    "analysis",
    "arm",
    "calibration",
    "files",
    "models",
    "numerics",
    "optimization",
    "solution",
)
"""Packages whose names the face shows, imported together when one of them is first used: importing
JAX takes half a second, which the help of the command and shells that complete names do not need.
"""

_LATER = {
    "Continuum": "models.continuum",
    "Design": "optimization.design_search",
    "Fabrication": "fabrication",
    "Search": "optimization.search",
    "View": "viewer.page",
    "annotate": "viz.annotate",
    "design": "optimization.design_search",
    "export": "fabrication",
    "film": "viz.animation",
    "plot": "viz.plot",
    "plot_design": "viz.plot_design",
    "plot_fit": "viz.plot_fit",
    "view": "viewer.page",
}
"""Modules of the names that only some programs need: diffrax, optax and matplotlib take longer to
import than all the rest."""


def __getattr__(name: str) -> Any:
    if name in _LATER:
        module = import_module(f".{_LATER[name]}", __name__)
        return module if _LATER[name].endswith(f".{name}") else getattr(module, name)
    if name in (*_PACKAGES, "mechanics", "typing", "validation"):
        return import_module(f".{name}", __name__)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    for package in _PACKAGES:
        module = import_module(f".{package}", __name__)
        globals().update({x: getattr(module, x) for x in module.__all__ if x in __all__})
    return globals()[name]


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
