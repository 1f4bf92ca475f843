"""Numerical methods that know no arm: twists and poses, quadrature, Newton's method, implicit
derivatives, small linear algebra.

Must not know what a rod, a thread or a load is: everything here takes arrays and functions.
"""

from . import se3
from .magnus import step_twist, zanna_step

__all__ = ["se3", "step_twist", "zanna_step"]
