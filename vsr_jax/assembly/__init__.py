"""Arms that are joined with bodies and with each other: parallel robots, closed loops.

Builds on the solve of one arm; must not know how one is computed.
"""

from .assembly import Assembly
from .body import Body
from .joint import Joint
from .solved import AssemblyEquilibrium
from .solving import solve_assembly

__all__ = ["Assembly", "AssemblyEquilibrium", "Body", "Joint", "solve_assembly"]
