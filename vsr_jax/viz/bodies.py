"""Bodies of an assembly in space: the polygon of their joints, and their axes."""

import numpy as np
from matplotlib.typing import ColorType
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..assembly import AssemblyEquilibrium
from .space import FRAME_COLORS

_AXIS = 0.08
"""Length of the axes of a body, as a share of the mean length of the arms."""
_FLAT = 1e-3
"""Joints nearer to a line than this share of their extent span no plate."""


def draw_bodies(ax: Axes3D, eq: AssemblyEquilibrium, color: ColorType) -> None:
    """Each body as a translucent plate between its joints, or as lines to them, with its axes x, y
    and z in vermilion, green and blue."""
    length = np.mean([float(arm.rod.length) for arm in eq.assembly.arms])
    for b, pose in enumerate(np.asarray(eq.poses)):
        joints = [joint for joint in eq.assembly.joints if joint.body == b]
        places = np.array([(pose @ np.asarray(joint.pose))[:3, 3] for joint in joints])
        corners = _around(places)
        if corners is None:
            lines = [[pose[:3, 3], place] for place in places]
            ax.add_collection3d(Line3DCollection(lines, colors=[color], linewidths=2.0))
        else:
            plate = Poly3DCollection([corners], facecolors=[color], edgecolors=[color], alpha=0.35)
            ax.add_collection3d(plate)
        for axis, shade in zip(pose[:3, :3].T, FRAME_COLORS, strict=True):
            end = pose[:3, 3] + _AXIS * length * axis
            ax.plot(*np.transpose([pose[:3, 3], end]), color=shade, linewidth=1.5)


def _around(places: np.ndarray) -> np.ndarray | None:
    """Points in order around their middle, in the plane that is nearest to them; None where they
    span none."""
    if len(places) < 3:
        return None
    off = places - places.mean(axis=0)
    _, sizes, axes = np.linalg.svd(off)
    if sizes[1] < _FLAT * sizes[0]:
        return None
    y, x = off @ axes[1], off @ axes[0]
    return places[np.argsort(np.arctan2(y, x))]
