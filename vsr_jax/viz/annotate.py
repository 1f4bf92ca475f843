"""Annotations of an arm in 3D, drawn after `plot.arm`: frames of sections, arrows of loads,
obstacles, ellipsoids of the tip."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from matplotlib.typing import ColorType
from mpl_toolkits.mplot3d import Axes3D

from ..analysis.derivatives import Ellipsoid
from ..arm.loads import Load
from ..arm.pose_loads import PoseLoad
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..solution.equilibrium import Equilibrium
from ..validation import instance
from .body import sample
from .obstacles import draw_obstacles
from .space import FRAME_COLORS, checked_space, equal_scale
from .style import COLORS

_SHARE = 0.08
"""Length of the axes of a frame relative to the arm; load arrows are twice as long."""
_STATIONS = 12
"""Arrows of a load along the arm."""


def frames(
    eq: Equilibrium, ax: Axes3D | None = None, *, stations: int = 6, size: float | None = None
) -> Axes3D:
    """Frames of sections along the arm: x along the arm, y and z, in three colours.

    **Arguments:** `ax`: 3D axes, new ones by default; `stations`: number of sections; `size`:
    length of the axes [m].

    **Returns:** the axes.
    """
    ax, length = checked_space(ax), float(eq.scene.rod.length)
    poses = np.asarray(eq.pose(jnp.linspace(0, length, stations)))
    for i, (name, color) in enumerate(zip("xyz", FRAME_COLORS, strict=True)):
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


def loads(
    eq: Equilibrium,
    ax: Axes3D | None = None,
    *,
    color: ColorType | None = None,
    legend: bool = True,
) -> Axes3D:
    """Forces and moments of the loads as arrows: at points, and in rows along the arm.

    Point forces [N], forces per length [N/m] and moments (dashed) each have a scale of their own:
    the longest arrow of each is 16 % of the arm.

    **Arguments:** `ax`: 3D axes, new ones by default; `color`: of all arrows, by default one for
    points and one for rows; `legend`: whether to name the loads, with their greatest values.

    **Returns:** the axes.

    **Raises:** `ValueError` for an equilibrium that did not converge.
    """
    instance("eq", eq, Equilibrium, "an Equilibrium, before the axes")
    if not bool(eq.converged):
        raise ValueError(f"eq: got a solve that failed ({eq.message}), need a converged one")
    ax, length = checked_space(ax), float(eq.scene.rod.length)
    rows = rows_of(eq)
    longest = {row.unit: max(r.greatest for r in rows if r.unit == row.unit) for row in rows}
    for row in rows:
        arrows = 2 * _SHARE * length / longest[row.unit] * row.vectors
        _draw_arrows(ax, row, arrows, color)
        # without had_data the limits would contain only these ends
        ax.auto_scale_xyz(*(row.places + arrows).T, had_data=True)
    equal_scale(ax)
    if legend and rows:
        ax.legend(loc="upper left")
    return ax


def obstacles(eq: Equilibrium, ax: Axes3D | None = None, *, stations: int = 60) -> Axes3D:
    """The obstacles around an arm as translucent surfaces. Of endless ones the part near
    the arm is drawn, as of a `Field`.

    **Arguments:** `ax`: 3D axes, new ones by default; `stations`: number of stations of the arm.

    **Returns:** the axes.

    **Raises:** `ValueError` for an equilibrium that did not converge.
    """
    instance("eq", eq, Equilibrium, "an Equilibrium, before the axes")
    ax = checked_space(ax)
    draw_obstacles(ax, eq.scene.obstacles, np.asarray(sample(eq, stations).wall).reshape(-1, 3))
    equal_scale(ax)
    return ax


class Row(NamedTuple):
    """Forces or moments of one load in the world's axes: `places` [m] and `vectors`, shape (n, 3),
    and their unit."""

    name: str
    unit: str
    places: np.ndarray
    vectors: np.ndarray

    @property
    def at_point(self) -> bool:
        """Whether the load acts at points, not per length."""
        return not self.unit.endswith("/m")

    @property
    def color(self) -> str:
        """Colour of its arrows."""
        return COLORS[3] if self.at_point else COLORS[4]

    @property
    def caption(self) -> str:
        """Its text in a legend."""
        what = "moment" if self.moment else "force"
        return f"{self.name}: {what} {self.greatest:.3g} {self.unit}"

    @property
    def moment(self) -> bool:
        """Whether these are moments."""
        return self.unit.startswith("N m")

    @property
    def greatest(self) -> float:
        """The greatest magnitude, 0 without numbers."""
        return float(np.max(np.linalg.norm(self.vectors, axis=-1), initial=0.0))


def rows_of(eq: Equilibrium) -> list[Row]:
    """Forces and moments of the loads, supports and contacts of an equilibrium, without those that
    are zero."""
    return rows_from_wrenches(eq.scene, wrenches_of(eq))


Acting = tuple[Array, Array]
"""Poses of the sections on which a load acts, shape (places, 4, 4), and its moment [N m] and force
[N] there in the world's axes, shape (places, 6); per length for a load along the arm."""


def wrenches_of(eq: Equilibrium) -> list[Acting]:
    """Where and how each load, each held section and each obstacle of an equilibrium acts;
    `jax.jit` goes through it."""
    rod, loads, held = eq.scene.rod, eq.scene.loads, eq.scene.held
    found = []
    if loads or held:
        along = jnp.linspace(0, 1, _STATIONS) * rod.length
        X = [along if (x := load.place(rod)) is None else x[None] for load in loads]
        X += [one.place(rod)[None] for one in held]
        ends = np.cumsum([x.size for x in X])[:-1]
        poses = jnp.split(eq.pose(jnp.concatenate(X)), ends)
        placed = list(zip(X, poses, strict=True))
        for load, (x, pose) in zip(loads, placed, strict=False):
            found.append((pose, _wrench(load, rod, x, pose)))
        supports = eq.supports
        for i, (_, pose) in enumerate(placed[len(loads) :]):
            found.append((pose, supports[i][None]))
    if eq.scene.obstacles:
        contacts = eq.contacts
        touching = contacts.gap < _TOUCHING * jnp.vectorize(rod.outline)(contacts.X)
        pushes = contacts.force[..., None] * contacts.normal + contacts.friction
        pushes = jnp.where(touching[..., None], pushes, 0.0)
        wrenches = jnp.concatenate([jnp.zeros_like(pushes), pushes], axis=-1)
        poses = jnp.zeros((*contacts.X.shape, 4, 4), wrenches.dtype)
        found += list(zip(poses.at[..., :3, 3].set(contacts.position), wrenches, strict=True))
    return found


def rows_from_wrenches(scene: Scene, wrenches: Sequence[Acting]) -> list[Row]:
    """Loads, supports and contacts of a scene from their `wrenches_of`, without those that are
    zero."""
    named = [(x.effects[0], "" if x.place(scene.rod) is not None else "/m") for x in scene.loads]
    named += [("support", "") for _ in scene.held]
    named += [(f"contact with {obstacle.effect}", "") for obstacle in scene.obstacles]
    found = []
    for (name, per), (pose, wrench) in zip(named, jax.tree.map(np.asarray, wrenches), strict=True):
        for unit, vectors in (("N", wrench[:, 3:]), ("N m", wrench[:, :3])):
            size = np.linalg.norm(vectors, axis=-1)
            there = size > _SHOWN * np.max(size, initial=0.0)
            row = Row(name, unit + per, pose[there, :3, 3], vectors[there])
            found += [row] if row.greatest > 0 else []
    return found


_SHOWN, _TOUCHING = 1e-6, 0.1
"""Share of the greatest wrench of a load above which it is drawn at a place, and gap, as a fraction
of the outline, below which a contact is: farther away forces are rounding."""


def _wrench(load: Load, rod: Rod, X: Array, poses: Array) -> Array:
    """Moments and forces at abscissas X in the world's axes, shape (X, 6)."""
    if isinstance(load, PoseLoad):
        return jax.vmap(lambda x, g: load.wrench(rod, x, g[:3, :3], g[:3, 3]))(X, poses)
    point = load.point(rod)
    if point is not None:
        wrench = jnp.stack(point[1])[None]
    else:
        wrench = jax.vmap(lambda x: jnp.stack(load.density(rod, x) or ()))(X)
    if load.frame == "world":
        return wrench
    return jnp.einsum("xij,xkj->xki", poses[:, :3, :3], wrench.reshape(-1, 2, 3)).reshape(-1, 6)


def _draw_arrows(ax: Axes3D, row: Row, arrows: np.ndarray, color: ColorType | None) -> None:
    color = row.color if color is None else color
    style: dict[str, Any] = {"color": color, "linewidth": 2.2 if row.at_point else 0.9}
    dashes: dict[str, Any] = {"linestyle": (0.0, (2.0, 1.0))} if row.moment else {}
    ax.quiver(*row.places.T, *arrows.T, arrow_length_ratio=0.25, **style, **dashes)
    if not row.at_point:
        ax.plot(*(row.places + arrows).T, **{**style, "linewidth": 0.6})
    ax.plot([], [], [], label=row.caption, **style, **dashes)


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
    ax = checked_space(ax)
    theta, phi = np.meshgrid(np.linspace(0, np.pi, 19), np.linspace(0, 2 * np.pi, 37))
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])
    points = np.asarray(shape.centre)[:, None, None] + scale * np.einsum(
        "ij,jab->iab", np.asarray(shape.axes), ball
    )
    ax.plot_surface(*points, color=color, alpha=alpha, linewidth=0, rasterized=True)
    equal_scale(ax)
    return ax
