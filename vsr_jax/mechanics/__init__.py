"""The equilibrium equations of an arm, their linearisations and their solution: cross-sections,
internal reaction, the whole arm; the interfaces of loads and couplings.

Works on arrays of stiffnesses, strains and thread paths at quadrature points, and knows neither the
models nor any load, constraint or rule of threads by its kind.
"""

from .balance import residual, tangent

__all__ = ["residual", "tangent"]
