"""Round channels across the threads at rest, cut by the planes of the sections."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..arm.actuator import Actuator
from ..arm.routing import thread_tangent
from ..arm.scene import Scene
from ..numerics.compiling import program
from ..numerics.loops import fori_loop
from ..typing import Scalar
from .stations import Stations, in_blocks, polygon_size

_FEWEST_CORNERS = 32
_ITERATIONS = 60


def channel_rings(
    scene: Scene, stations: Stations, bores: Float[np.ndarray, " threads"], tolerance: float
) -> tuple[list[np.ndarray], np.ndarray]:
    """Points (y, z) [m] of the channels in the sections, (stations, corners, 2) for each thread,
    and how far [m] each is from the channel's surface at worst, (stations, threads). The polygons
    have the area of their channels.
    """
    angles = [
        2 * np.pi / polygon_size(bore / 2, tolerance, _FEWEST_CORNERS) if bore > 0 else np.pi / 16
        for bore in bores
    ]
    radii = [bore / 2 * np.sqrt(a / np.sin(a)) for bore, a in zip(bores, angles, strict=True)]
    dtype = scene.rod.length.dtype
    around = [jnp.arange(0, 2 * np.pi - a / 2, a, dtype) for a in angles]
    size = [jnp.asarray(radius, dtype) for radius in radii]
    found = in_blocks(lambda X: _rings(scene, X, size, around), stations.inside)
    rings, off = zip(*found, strict=True) if found else ([], [])
    return list(rings), np.stack(off, axis=1) if off else np.zeros((stations.X.size, 0))


@program("export")
def _rings(
    scene: Scene, X: Array, radii: list[Array], around: list[Array]
) -> list[tuple[Array, Array]]:
    return [
        jax.vmap(lambda x, a=actuator, r=radius, at=angles: _ring(scene, a, x, r, at))(X)
        for actuator, radius, angles in zip(scene.actuators, radii, around, strict=True)
    ]


def _ring(
    scene: Scene, actuator: Actuator, X: Scalar, radius: Scalar, angles: Float[Array, " corners"]
) -> tuple[Float[Array, "corners 2"], Scalar]:
    r"""The curve in which the plane of a section cuts the tube around a thread.

    Near the section the thread runs along $c(\delta) = (t_x \delta, d(X + \delta) + m \delta)$ in
    the section's axes, where $t$ is its tangent at rest and $m = (t_y, t_z) - d'(X)$.
    With its unit tangent $T$, the point of the tube for the direction $e$ is $c + r (e - (e \cdot
    T) (e_x + T) / (1 + T_x))$. It is in the plane where $t_x \delta = r e \cdot T(\delta)$, which
    is solved by iteration.
    """
    routing, rod = actuator.routing, scene.rod
    here = routing.path(X)
    t = thread_tangent(rod.rest(X), here)
    drift = jnp.stack((t[1] - here.slope_y, t[2] - here.slope_z))
    direction = jnp.stack((jnp.cos(angles), jnp.sin(angles)), axis=-1)

    def along(delta: Array) -> tuple[Array, Array]:
        """Position and unit tangent, of a straight continuation beyond the ends of the arm."""
        x = jnp.clip(X + delta, 0.0, rod.length)
        path = jax.vmap(routing.path)(x)
        slope = jnp.stack((path.slope_y, path.slope_z), axis=-1)
        place = jnp.stack((path.y, path.z), axis=-1) + slope * (X + delta - x)[:, None]
        tangent = jnp.concatenate((jnp.full((x.size, 1), t[0]), slope + drift), axis=-1)
        unit = tangent / jnp.linalg.norm(tangent, axis=-1, keepdims=True)
        return place + drift * delta[:, None], unit

    def improved(_: Array | int, delta: Array) -> Array:
        return radius / t[0] * jnp.sum(direction * along(delta)[1][:, 1:], axis=-1)

    delta = fori_loop(0, _ITERATIONS, improved, jnp.zeros_like(angles))
    off = jnp.max(jnp.abs(improved(0, delta) - delta)) * t[0]
    place, unit = along(delta)
    share = jnp.sum(direction * unit[:, 1:], axis=-1, keepdims=True) / (1 + unit[:, :1])
    return place + radius * (direction - share * unit[:, 1:]), off
