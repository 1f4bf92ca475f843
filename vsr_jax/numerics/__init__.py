"""Numerical methods: twists and poses, quadrature, Newton's method, implicit derivatives, small
linear algebra.

Independent of rods, threads and loads: everything here takes arrays and functions.
"""

from . import se3
from .compiling import quick_compilation
from .magnus import step_twist, zanna_step

__all__ = ["quick_compilation", "se3", "step_twist", "zanna_step"]
