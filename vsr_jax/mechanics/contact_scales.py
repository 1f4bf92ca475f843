"""The contacts of a scene: how stiff and how smooth they are, from the numbers of the arm."""

import jax.numpy as jnp
from jaxtyping import Array

from ..arm.obstacles import Obstacle
from ..arm.scene import CrossSections, Scene
from ..numerics.quadrature import Grid
from ..numerics.se3 import base_pose
from ..typing import DTypeLike
from .contact import LAST, Contacts
from .nearest import lying
from .sizes import softest

_FIRST = 0.1, 2e-2
"""Length b, as a fraction of the arm's, and compliance c to begin with."""

_ROOMY = 0.3
"""Room between arm and wall, as a fraction of the arm's length, below which both are smaller from
the start."""

_FLATNESS = 1e-3
"""Bound on the excess of the gap at the nearest point of a step over the least one, as a fraction
of the outline."""

_GRIP = 10.0
"""Stiffness c of `slip`, in units of that of the arm up to the contact."""

_AT_HELD = 1e-6
"""Distance of a held section from the end of a step that is at it, as a fraction of the length."""


def contacts_of(scene: Scene, sections: CrossSections, grid: Grid) -> Contacts | None:
    """The contacts of a scene; None if it has no obstacles."""
    if not scene.obstacles:
        return None
    base = jnp.asarray(base_pose(scene.rod.base, grid.h.dtype))[:3, 3]
    length = jnp.sum(grid.h)
    bending = jnp.sum(grid.weight * softest(sections.stiffness)) / length
    flatness = _FLATNESS * scene.rod.outline(0.5 * scene.rod.length)
    stiffness, friction = 3 * bending / length**3, _friction(scene.obstacles, grid.h.dtype)
    ends = jnp.maximum(jnp.cumsum(grid.h, axis=0), grid.h[:1])
    return Contacts(
        scene.obstacles,
        scene.rod,
        base,
        stiffness,
        flatness,
        _lift(scene, grid),
        LAST[0] * length,
        jnp.full_like(length, LAST[1]),
        _first(scene, length),
        jnp.zeros_like(length),
        grid.h.shape[0],
        friction,
        None if friction is None else _GRIP * stiffness * (length / ends) ** 3,
    )


def _lift(scene: Scene, grid: Grid) -> Array:
    """What is added to the gaps: the end of a step that is held in its place need not touch what it
    may be held on."""
    length, ends = jnp.sum(grid.h), lying(scene.obstacles)
    held = [held.place(scene.rod) for held in scene.held if held.position is not None]
    if not ends or not held:
        return jnp.zeros_like(length)
    apart = jnp.abs(grid.start + grid.h - jnp.stack(held).reshape(-1, 1))
    there = jnp.any(apart < _AT_HELD * length, axis=0).astype(length.dtype)
    nearest = jnp.zeros((len(scene.obstacles), len(there)), length.dtype)
    return 1e3 * length * jnp.concatenate([nearest, jnp.stack([there] * len(ends))])


def _friction(obstacles: tuple[Obstacle, ...], dtype: DTypeLike) -> Array | None:
    """Coefficients of friction of the contacts of a step; None if no obstacle has any."""
    if all(obstacle.friction is None for obstacle in obstacles):
        return None
    each = [0.0 if obstacle.friction is None else obstacle.friction for obstacle in obstacles]
    each += [0.0] * len(lying(obstacles))
    return jnp.stack([jnp.asarray(x, dtype) for x in each])


def _first(scene: Scene, length: Array) -> Array:
    """Length b, as a fraction of the arm's, and compliance c to begin with: smaller where a lumen
    leaves the arm little room."""
    blur, give = (jnp.full_like(length, x) for x in _FIRST)
    for obstacle in scene.obstacles:
        room = obstacle.room
        if room is not None:
            room = (room - scene.rod.outline(0.5 * scene.rod.length)) / length
            narrow = jnp.clip(room / _ROOMY, 1e-3, 1.0).astype(length.dtype)
            blur, give = (
                jnp.minimum(blur, narrow * _FIRST[0]),
                jnp.minimum(give, narrow * _FIRST[1]),
            )
    return jnp.stack([blur, give])
