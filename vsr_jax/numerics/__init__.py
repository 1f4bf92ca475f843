"""Numerical methods: twists and poses, quadrature, Newton's method, implicit derivatives, small
linear algebra.

Independent of rods, threads and loads: everything here takes arrays and functions.
"""

from . import se3
from .magnus import step_twist, zanna_step

__all__ = ["se3", "step_twist", "zanna_step"]
