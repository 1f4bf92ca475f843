"""One arm in space: its shape at stations, its tensions, its discs, and how they are drawn; also of
an arm whose solve failed."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.typing import ColorType
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D

from ..arm.plausible import quietly
from ..arm.scene import Scene
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..solution.summary import Summary, stations as checked_stations
from ..typing import VectorLike
from .style import ink, shade
from .tendons import Scales, draw_threads, is_slack, pressure_scale, tension_scale

_ANGLES = np.linspace(0.0, 2 * np.pi, 33)

_WALL, _RIGID_WALL = 0.18, 0.5
"""Opacity of the wall, and of that of rigid pieces."""

_THIN, _DRAWN = 0.01, 0.03
"""Radius of an arm relative to its extent below which its section is drawn wider, and how wide."""


def sample(eq: Equilibrium, stations: VectorLike = 60) -> Summary:
    """The summary of an equilibrium in NumPy arrays; `arm` and `strains` take it in place of `eq`.

    **Arguments:** `stations`: number of stations, evenly spaced on the arm, or their abscissas [m].

    **Raises:** `ValueError` for a batch of equilibria, for one that did not converge and for
    stations beyond the arm.
    """
    if np.ndim(eq.status) > 0:
        raise ValueError(f"eq: got a batch of shape {np.shape(eq.status)}, need one equilibrium")
    if not bool(eq.converged):
        raise ValueError(f"eq: got a solve that failed ({eq.message}), need a converged one")
    at = checked_stations(eq, stations, "stations")
    return jax.tree.map(np.asarray, eq.summary(at, ("forces",)))


class Body(NamedTuple):
    """An arm as it is drawn: its `samples`; the `tension` of its threads [N], NaN for chambers, the
    `pressure` of its chambers [Pa], NaN for other threads, and which threads are `slack`, None
    where they are not known; its `discs` [m], shape (discs, angles, 3); whether it is `rigid`
    between each station and the next, shape (stations - 1,); the `failure` of the solve, in which
    case the shape is that at rest."""

    samples: Summary
    tension: np.ndarray | None
    pressure: np.ndarray | None
    slack: np.ndarray | None
    discs: np.ndarray
    rigid: np.ndarray
    failure: str | None = None

    def widened(self, factor: float) -> "Body":
        """The arm with everything across it larger by a factor."""
        axis = np.asarray(self.samples.position)
        wall = axis[:, None] + factor * (self.samples.wall - axis[:, None])
        threads = axis + factor * (self.samples.threads - axis)
        middle = self.discs.mean(axis=1, keepdims=True)
        samples = eqx.tree_at(lambda s: (s.wall, s.threads), self.samples, (wall, threads))
        return self._replace(samples=samples, discs=middle + factor * (self.discs - middle))

    @property
    def parts(self) -> list[tuple[slice, bool]]:
        """Stations of each part that bends and of each that is rigid, in order, and whether it is
        rigid."""
        jumps = np.flatnonzero(np.diff(self.rigid)) + 1
        edges = pairwise([0, *jumps.tolist(), self.rigid.size])
        return [(slice(a, b + 1), bool(np.any(self.rigid[a:b]))) for a, b in edges]

    @property
    def points(self) -> np.ndarray:
        """All points that are drawn [m], shape (points, 3)."""
        return np.concatenate([self.samples.wall.reshape(-1, 3), self.discs.reshape(-1, 3)])

    @property
    def widening(self) -> float:
        """Factor by which the section must be wider for its threads to be told apart, 1 for an arm
        that is not thin; two digits."""
        axis = np.asarray(self.samples.position)
        radius = np.max(np.linalg.norm(self.samples.wall - axis[:, None], axis=-1))
        if self.discs.size:
            middle = self.discs.mean(axis=1, keepdims=True)
            radius = max(radius, np.max(np.linalg.norm(self.discs - middle, axis=-1)))
        extent = np.max(np.ptp(axis, axis=0))
        return float(f"{_DRAWN * extent / radius:.2g}") if radius < _THIN * extent else 1.0


def body_of(eq: Equilibrium | Summary, stations: VectorLike = 60) -> Body:
    """The arm of an equilibrium; of one that failed the arm at rest.

    **Raises:** `ValueError` as `sample`, except for a solve that failed.
    """
    if isinstance(eq, Summary):
        return Body(eq, None, None, None, np.zeros((0, 1, 3)), np.zeros(len(eq.X) - 1, bool))
    if np.ndim(eq.status) == 0 and not bool(eq.converged):
        return body_of(at_rest(eq), stations)._replace(failure=eq.message)
    if (eq.scene.rod.rigid or eq.scene.rod.discs) and np.ndim(eq.status) == 0:
        stations = with_parts(eq.scene, checked_stations(eq, stations, "stations"))
    return body_from_samples(eq, sample(eq, stations))


def with_parts(scene: Scene, X: Float[Array, " stations"]) -> Float[Array, " more"]:
    """Ascending stations [m], with the ends of rigid pieces and the discs."""
    parts = [x for piece in scene.rod.rigid for x in piece.breakpoints]
    parts += [] if scene.rod.discs is None else [*scene.rod.discs.faces(scene.rod.length)]
    inside = [jnp.clip(x, X[0], X[-1]) for x in parts]
    return jnp.sort(jnp.concatenate([X, jnp.stack(inside)])) if inside else X


def body_from_samples(eq: Equilibrium, samples: Summary) -> Body:
    """The arm of a converged equilibrium from its `samples`, as `sample` returns them."""
    actuators = eq.scene.actuators
    areas = [np.nan if x.pressure_area is None else float(x.pressure_area) for x in actuators]
    area, unknown = np.array(areas), np.array([x.law_driven for x in actuators], bool)
    forces, inflated = np.asarray(samples.values["forces"]), ~np.isnan(area)
    given = np.asarray(eq.inputs)[: len(area)]
    tension = np.where(inflated, np.nan, -forces)
    pressure = np.where(inflated, np.where(unknown, forces / area, given), np.nan)
    between = jnp.asarray(samples.X[1:] + samples.X[:-1]) / 2
    flexible = eq.scene.rod.flexible(between)
    rigid = np.zeros(between.shape, bool) if flexible is None else np.asarray(flexible) == 0
    return Body(samples, tension, pressure, is_slack(eq, tension), _discs(eq, samples), rigid)


def at_rest(eq: Equilibrium) -> Equilibrium:
    """The arm without loads and inputs."""
    with quietly():
        scene = Scene(eq.scene.rod, eq.scene.actuators, free_strains=eq.scene.free_strains)
    return solve(scene, jnp.zeros(len(scene.actuators), eq.inputs.dtype), model=eq.model)


def thread_scales(bodies: Sequence[Body]) -> Scales:
    """The colours of the threads of some arms."""
    return Scales(
        tension_scale([body.tension for body in bodies if body.tension is not None]),
        pressure_scale([1e-3 * body.pressure for body in bodies if body.pressure is not None]),
    )


def _discs(eq: Equilibrium, samples: Summary) -> np.ndarray:
    """Rims of the faces of the discs: shape (discs, angles, 3)."""
    rod, radius = eq.scene.rod, eq.scene.rod.rim
    if rod.discs is None or radius is None:
        return np.zeros((0, len(_ANGLES), 3))
    places = np.asarray(rod.discs.faces(rod.length))
    chosen = np.unique(np.argmin(np.abs(samples.X - places[:, None]), axis=1))
    pose = np.asarray(samples.pose)[chosen]
    rim = float(radius) * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
    return pose[:, None, :3, 3] + np.einsum("dij,ja->dai", pose[:, :3, 1:3], rim)


def draw_body(
    ax: Axes3D,
    body: Body,
    *,
    color: ColorType,
    surface: bool = True,
    threads: bool = True,
    scales: Scales | None = None,
    **line: Any,
) -> None:
    """The wall with the discs, the threads and the axis of an arm.

    **Arguments:** `scales`: the colours of threads, by default a shade of `color`; `line`:
    properties of the axis. An arm at rest after a solve that failed is grey and dashed.
    """
    if body.failure is not None:
        color, scales = ink(0.45), None
        line = {**line, "linestyle": "--"}
    if surface:
        options = {"linewidth": 0, "rstride": 1, "cstride": 1, "rasterized": True}
        for stations, rigid in body.parts:
            x, y, z = np.moveaxis(np.asarray(body.samples.wall)[stations], -1, 0)
            shown, alpha = (shade(color), _RIGID_WALL) if rigid else (color, _WALL)
            ax.plot_surface(x, y, z, color=shown, alpha=alpha, **options)
        if len(body.discs):
            rims = Poly3DCollection(body.discs, facecolors=[color], edgecolors=[color], alpha=0.2)
            ax.add_collection3d(rims, autolim=False)
            ax.auto_scale_xyz(*body.discs.reshape(-1, 3).T, had_data=True)
    paths = np.asarray(body.samples.threads)[: None if threads else 0]
    if scales is None or body.tension is None or body.pressure is None or body.slack is None:
        for path in paths:
            ax.plot(*path.T, color=shade(color), linewidth=0.8)
    elif threads:
        draw_threads(ax, paths, scales.colors(body.tension, 1e-3 * body.pressure), body.slack)
    width: dict[str, Any] = {} if scales is None else {"linewidth": 0.8}
    ax.plot(*body.samples.position.T, color=color, **(width | line))
