"""Design by gradient: objectives, constraints, descent from many starts, checkpoints, design files.

Imports optax only when a design is set up. Does not import plotting.
"""

from . import constraint, objective

__all__ = ["constraint", "objective"]
