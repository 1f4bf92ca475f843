"""Design by gradient: objectives, constraints, descent from many starts, checkpoints, design files.

Imports optax when a design begins. Must not know pictures.
"""

from . import constraint, objective

__all__ = ["constraint", "objective"]
