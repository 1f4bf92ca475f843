"""The equilibrium equations of an arm and their linearisations: cross-sections, internal reaction,
cables, friction, the whole arm.

Works on arrays of stiffnesses, strains and thread paths at quadrature points, and is independent of
the models.
"""

from .balance import residual, tangent

__all__ = ["residual", "tangent"]
