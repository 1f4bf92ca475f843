"""Design by gradient: objectives, descent from many starts, checkpoints, design files.

Imports optax only when a design is set up. Does not import plotting.
"""

from . import objective

__all__ = ["objective"]
