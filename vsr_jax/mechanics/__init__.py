"""The equations of balance of an arm and their linearisations: sections, internal reaction, cables,
friction, the arm as a whole.

Works on arrays of stiffnesses, strains and thread paths at quadrature points. Must not know which
model asks.
"""

from .balance import residual, tangent

__all__ = ["residual", "tangent"]
