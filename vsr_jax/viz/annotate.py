"""Annotations of an arm in 3D, drawn after `plot.arm`: frames of sections, arrows of loads,
ellipsoids of the tip."""

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array
from matplotlib.typing import ColorType
from mpl_toolkits.mplot3d import Axes3D

from ..analysis.derivatives import Ellipsoid
from ..arm.loads import Frame
from ..arm.pose_loads import PoseLoad
from ..solution.equilibrium import Equilibrium
from .plot import COLORS, equal_scale

_SHARE = 0.08
"""Length of the axes of a frame relative to the arm; load arrows are twice as long."""


def frames(
    eq: Equilibrium, ax: Axes3D | None = None, *, stations: int = 6, size: float | None = None
) -> Axes3D:
    """Frames of sections along the arm: x along the arm, y and z, in three colours.

    **Arguments:** `ax`: 3D axes, new ones by default; `stations`: number of sections; `size`:
    length of the axes [m].

    **Returns:** the axes.
    """
    ax, length = _axes(ax), float(eq.scene.rod.length)
    poses = np.asarray(eq.pose(jnp.linspace(0, length, stations)))
    for i, (name, color) in enumerate(zip("xyz", (COLORS[1], COLORS[2], COLORS[0]), strict=True)):
        arrows = _SHARE * length if size is None else size
        ax.quiver(
            *poses[:, :3, 3].T,
            *(arrows * poses[:, :3, i].T),
            color=color,
            linewidth=1.2,
            arrow_length_ratio=0.0,
            label=name,
        )
    equal_scale(ax)
    return ax


def loads(eq: Equilibrium, ax: Axes3D | None = None, *, color: ColorType = COLORS[1]) -> Axes3D:
    """Forces of the loads as arrows, at points and along the arm.

    Point forces [N] have one scale and densities [N/m] another: the longest arrow of each is 16 %
    of the arm. Moments are not drawn.

    **Arguments:** `ax`: 3D axes, new ones by default; `color`: of the arrows.

    **Returns:** the axes.
    """
    ax, length = _axes(ax), float(eq.scene.rod.length)
    for groups in (_point_forces(eq), _densities(eq, length)):
        longest = max((_longest(force) for _, force in groups), default=0.0)
        for here, force in groups:
            if _longest(force) == 0:
                continue
            arrows = 2 * _SHARE * length / longest * force
            ax.quiver(*here.T, *arrows.T, color=color, linewidth=1.2, arrow_length_ratio=0.25)
            # without had_data the limits would contain only these ends
            ax.auto_scale_xyz(*(here + arrows).T, had_data=True)
    equal_scale(ax)
    return ax


def _longest(force: np.ndarray) -> float:
    return float(np.max(np.linalg.norm(force, axis=-1), initial=0.0))


_FRAMES: tuple[Frame, ...] = ("world", "body")


def _point_forces(eq: Equilibrium) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions [m] and forces [N] in the world's axes of the dead and the follower loads at
    points."""
    found = []
    for frame in _FRAMES:
        points = eq.scene.point_wrenches(frame)
        if points:
            force = jnp.stack([jnp.stack(wrench[3:]) for _, wrench in points])
            found.append(_placed(eq, jnp.stack([x for x, _ in points]), force, frame))
    for load in eq.scene.pose_loads:
        X = load.place(eq.scene.rod)
        if X is not None:
            found.append(_posed(eq, load, X[None]))
    return found


def _densities(eq: Equilibrium, length: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Positions [m] and forces per length [N/m] in the world's axes of the dead and the follower
    loads along the arm."""
    X, found = jnp.linspace(0, length, 12), []
    for frame in _FRAMES:
        density = eq.scene.density(X, frame)
        if density is not None:
            found.append(_placed(eq, X, jnp.stack(density[3:], axis=-1), frame))
    along = [load for load in eq.scene.pose_loads if load.place(eq.scene.rod) is None]
    return found + [_posed(eq, load, X) for load in along]


def _posed(eq: Equilibrium, load: PoseLoad, X: Array) -> tuple[np.ndarray, np.ndarray]:
    """Positions at abscissas X, and the force there of a load that depends on the pose."""
    poses = eq.pose(X)
    wrench = jax.vmap(lambda x, g: load.wrench(eq.scene.rod, x, g[:3, :3], g[:3, 3]))(X, poses)
    return np.asarray(poses[:, :3, 3]), np.asarray(wrench[:, 3:])


def _placed(eq: Equilibrium, X: Array, force: Array, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """Positions at abscissas X, and the vectors there in the world's axes."""
    poses, vectors = np.asarray(eq.pose(X)), np.asarray(force)
    if frame == "body":
        vectors = np.einsum("xij,xj->xi", poses[:, :3, :3], vectors)
    return poses[:, :3, 3], vectors


def ellipsoid(
    shape: Ellipsoid,
    ax: Axes3D | None = None,
    *,
    scale: float = 1.0,
    color: ColorType = COLORS[2],
    alpha: float = 0.3,
) -> Axes3D:
    """An ellipsoid in space, as returned by `manipulability` and `compliance_ellipsoid`.

    **Arguments:** `ax`: 3D axes, new ones by default; `scale`: factor on the semi-axes.

    **Returns:** the axes.
    """
    ax = _axes(ax)
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 19), np.linspace(0, 2 * np.pi, 37))
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    points = np.asarray(shape.centre)[:, None, None] + scale * np.einsum(
        "ij,jab->iab", np.asarray(shape.axes), ball
    )
    ax.plot_surface(*points, color=color, alpha=alpha, linewidth=0, rasterized=True)
    equal_scale(ax)
    return ax


def _axes(ax: Axes3D | None) -> Axes3D:
    if ax is None:
        ax = plt.figure(figsize=(6, 5)).add_subplot(projection="3d")
        ax.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    return ax
