"""Files for the workshop: the body with its channels, thread curves, hole tables, lengths.

Knows solved scenes. Must not know how many of them are searched or swept.
"""

from .exporting import Fabrication, export

__all__ = ["Fabrication", "export"]
