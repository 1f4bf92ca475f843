"""Poses of an arm's base from the direction in which the arm points."""

from typing import Literal, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..numerics.component import norm, split
from ..typing import Pose, ScalarLike, VectorLike
from ..validation import choice, concrete, numbers

Direction = Literal["forward", "back", "left", "right", "up", "down"]

_DIRECTIONS = dict(
    zip(
        get_args(Direction),
        ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)),
        strict=True,
    )
)


def pose(
    position: VectorLike = (0.0, 0.0, 0.0),
    *,
    pointing: Direction | VectorLike = "forward",
    roll: ScalarLike = 0.0,
) -> Pose:
    r"""Rigid transform of a base whose arm starts at a point and points in a direction:
    $g = \begin{pmatrix} R(t)\,R_x(\varphi) & r \\ 0 & 1 \end{pmatrix}$.

    $R(t)$ is the shortest rotation from the world's x axis to the direction $t$, by half a turn
    about z for $t = -x$; it leaves the y axis where it is for directions in the xz plane. $R_x$
    rotates the section about the arm. `vsr.Rod(..., base=vsr.pose(pointing="down"))` hangs from the
    origin: its x axis is the world's -z, its y axis the world's y, its z axis the world's x.

    **Arguments:**
    - `position`: $r$ [m], shape (3,).
    - `pointing`: `"forward"` (x), `"back"` (-x), `"left"` (y), `"right"` (-y), `"up"` (z) or
      `"down"` (-z), or $t$ as a vector of any length, shape (3,).
    - `roll`: $\varphi$ [rad].

    **Returns:** the pose, shape (4, 4).

    **Raises:** `ValueError` for an unknown word, wrong shapes, numbers that are not finite and a
    direction of zeros.
    """
    if isinstance(pointing, str):
        pointing = _DIRECTIONS[choice("pose.pointing", pointing, get_args(Direction))]
    r = numbers("pose.position", position, (3,))
    t = numbers("pose.pointing", pointing, (3,))
    angle = numbers("pose.roll", roll)
    known = concrete(t)
    if known is not None and not np.any(known):
        raise ValueError(f"pose.pointing: got {pointing!r}, need a direction, not zeros")
    dtype = jnp.result_type(r, t, angle)
    R = _shortest(t.astype(dtype)) @ _about_x(angle.astype(dtype))
    last = jnp.array([[0.0, 0.0, 0.0, 1.0]], dtype)
    return jnp.concatenate([jnp.column_stack([R, r.astype(dtype)]), last])


def _shortest(t: Float[Array, "3"]) -> Float[Array, "3 3"]:
    r"""Shortest rotation from the x axis to $t = (a, b, c)$: its lower block is
    $1 - (b, c)^T (b, c) / (1 + a)$ for unit $t$."""
    a, b, c = split(t / norm(split(t)))
    across = b * b + c * c
    straight_back = (a < 0) & (across == 0)
    # 1 / (1 + a) has no digits near a = -1; there it is (1 - a) / (b^2 + c^2)
    factor = jnp.where(
        a < 0,
        (1 - a) / jnp.where(across == 0, 1.0, across),
        1 / (1 + jnp.maximum(a, 0.0)),
    )
    yy = jnp.where(straight_back, -1.0, 1 - factor * b * b)
    yz, zz = -factor * b * c, 1 - factor * c * c
    return jnp.array([[a, -b, -c], [b, yy, yz], [c, yz, zz]])


def _about_x(angle: Array) -> Float[Array, "3 3"]:
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return jnp.array([[1.0, 0.0, 0.0], [0.0, cosine, -sine], [0.0, sine, cosine]], angle.dtype)
