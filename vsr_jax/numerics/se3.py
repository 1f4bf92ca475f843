r"""The group of rigid motions SE(3) and its Lie algebra, angular part first (appendices A and B of
the paper).

A twist is $\xi = (k, u)$, a wrench $F = (M, N)$, a pose the matrix $g = \begin{pmatrix} R & r \\ 0
& 1 \end{pmatrix}$. Every function takes one twist or one pose; batch with `jax.vmap`. The functions
whose names begin with `stacked_` take arrays with the components in front (see `stacked`), for the
kernels; there a pose is the upper part (R, r) of its matrix, shape (3, 4, ...).
"""

import math
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..typing import ArrayLike, MatrixLike, Pose, Twist, VectorLike, real
from . import stacked
from .once import once
from .stacked import columns, cross, product, rows

_TERMS = 12
"""Terms of the series: the first neglected one is below double precision for $\\theta^2 < 4$."""
_SWITCH = 4.0
"""Value of $\\theta^2$ where the closed form takes over; below it loses digits, and its derivatives
lose more."""


def exp_coefficients(x: Array) -> tuple[Array, Array, Array]:
    r"""Coefficients $\sin\theta/\theta$, $(1-\cos\theta)/\theta^2$, $(\theta-\sin\theta)/\theta^3$
    as entire functions of $x = \theta^2$.

    A Taylor series below $\theta = 2$ and the closed form above. Each branch is evaluated at a
    harmless argument where the other one is used, so that values and derivatives of any order are
    finite and exact to rounding at every angle.
    """
    near = x < _SWITCH
    below, above = jnp.where(near, x, 0.0), jnp.where(near, _SWITCH, x)
    theta = jnp.sqrt(above)
    sine, half = jnp.sin(theta), jnp.sin(0.5 * theta)
    closed = (sine / theta, 2.0 * half * half / above, (theta - sine) / (above * theta))
    c2, c3 = _stumpff(below, 2)
    series = (1.0 - below * c3, c2, c3)
    a, b, c3 = (jnp.where(near, s, f) for s, f in zip(series, closed, strict=True))
    return a, b, c3


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _stumpff(x: Array, n: int) -> tuple[Array, Array]:
    r"""Series of the Stumpff functions $c_n$ and $c_{n+1}$, $c_n(x) = \sum_j (-x)^j / (2 j + n)!$,
    for $0 \le x < 4$.

    Their derivatives are $c_n' = -\frac12 (c_{n+1} - n\,c_{n+2})$, of which one further pair is
    new.
    """
    first = second = jnp.zeros_like(x)
    for j in reversed(range(_TERMS)):
        first = 1.0 / math.factorial(2 * j + n) - x * first
        second = 1.0 / math.factorial(2 * j + n + 1) - x * second
    return first, second


@_stumpff.defjvp
def _stumpff_jvp(n: int, primals: tuple[Array], tangents: tuple[Array]) -> tuple[Any, Any]:
    (x,), (dx,) = primals, tangents
    first, second = _stumpff(x, n)
    third, fourth = _stumpff(x, n + 2)
    rates = second - n * third, third - (n + 1) * fourth
    return (first, second), tuple(-0.5 * rate * dx for rate in rates)


def _rotation(k: Array, cosine: Array, a: Array, b: Array) -> Array:
    r"""$\cos\theta \, 1 + a \tilde k + b k k^T$ of a vector with the norm $\theta$."""
    diagonal = cosine * stacked.identity(k[None])
    return diagonal + a * stacked.skew(k) + (b * k)[:, None] * k[None]


def stacked_rotation(k: Array) -> Array:
    r"""Rotation $\exp \tilde k$ of a vector (3, ...), shape (3, 3, ...)."""
    square = stacked.dot(k, k)
    a, b, _ = exp_coefficients(square)
    a, b = once(a), once(b)
    return _rotation(k, 1.0 - b * square, a, b)


def stacked_turn(k: Array, change: Array) -> Array:
    r"""Rotation $\epsilon$ in the body frame by a change of a rotation vector (3, ...),
    $\tilde\epsilon = R^T \delta R$ for $R = \exp \tilde k$."""
    _, b, c3 = (once(x) for x in exp_coefficients(stacked.dot(k, k)))
    across = cross(k, change)
    return change + c3 * cross(k, across) - b * across


def stacked_exp(omega: Array) -> Array:
    """`exp` of a twist (6, ...): rotation and translation, shape (3, 4, ...)."""
    k, u = rows(omega, 0, 3), rows(omega, 3, 6)
    square = stacked.dot(k, k)
    a, b, c3 = (once(x) for x in exp_coefficients(square))
    ku = once(cross(k, u))
    translation = u + b * ku + c3 * cross(k, ku)
    # rounded by itself: else the last bit depends on whether a batch is alone or in a loop
    cosine = once(1.0 - b * square)
    return once(jnp.concatenate([_rotation(k, cosine, a, b), translation[:, None]], axis=1))


def stacked_bracket(a: Array, b: Array) -> Array:
    r"""Lie bracket $[a, b] = \mathrm{ad}_a b$ of two twists (6, ...)."""
    (turn, slide), (other, along) = ((rows(x, 0, 3), rows(x, 3, 6)) for x in (a, b))
    return jnp.concatenate([cross(turn, other), cross(turn, along) + cross(slide, other)])


def stacked_product(g: Array, increment: Array) -> Array:
    """Product of two poses (3, 4, ...)."""
    further = product(columns(g, 0, 3), increment)
    return further + jnp.pad(columns(g, 3, 4), [(0, 0), (3, 0), *[(0, 0)] * (g.ndim - 2)])


def skew(v: VectorLike) -> Float[Array, "3 3"]:
    r"""Matrix $\tilde v$ with $\tilde v w = v \times w$."""
    return stacked.skew(real(v))


def unskew(matrix: Float[Array, "*batch n n"]) -> Float[Array, "*batch 3"]:
    r"""Vector $v$ of the skew part of a matrix, $\tilde v = (A - A^T) / 2$ of its upper left block
    of three rows."""
    m = matrix
    parts = (m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1])
    return 0.5 * jnp.stack(parts, axis=-1)


def hat(xi: VectorLike) -> Pose:
    r"""Matrix of a twist (eq. 2).

    $\hat\xi = \begin{pmatrix} \tilde k & u \\ 0 & 0 \end{pmatrix}$, so that a pose obeys $g' = g
    \hat\xi$.

    **Arguments:** `xi`: twist $(k, u)$, shape (6,).

    **Returns:** the matrix $\hat\xi$, shape (4, 4).
    """
    xi = real(xi)
    top = jnp.concatenate([skew(xi[:3]), xi[3:, None]], axis=1)
    return jnp.concatenate([top, jnp.zeros_like(top[:1])])


def vee(matrix: MatrixLike) -> Twist:
    r"""Twist of a matrix of se(3), the inverse of `hat`: the skew part of $\tilde k$ is taken.

    **Arguments:** `matrix`: $\hat\xi$, shape (4, 4).

    **Returns:** $\xi = (k, u)$, shape (6,).
    """
    matrix = real(matrix)
    return jnp.concatenate([unskew(matrix), matrix[:3, 3]])


def pose(rotation: ArrayLike, position: ArrayLike) -> Float[Array, "*batch 4 4"]:
    """Matrix $g$ of shape (..., 4, 4) from the components of $R$, shape (3, 3, ...), and of $r$,
    shape (3, ...), arrays or tuples of arrays."""
    R, r = real(rotation), real(position)
    return whole_pose(jnp.concatenate([R, r[:, None]], axis=1))


def whole_pose(g: Array) -> Float[Array, "*batch 4 4"]:
    """Matrices (..., 4, 4) of poses (3, 4, ...)."""
    upper = jnp.moveaxis(g, (0, 1), (-2, -1))
    last = jnp.broadcast_to(jnp.asarray([[0.0, 0.0, 0.0, 1.0]], g.dtype), (*upper.shape[:-2], 1, 4))
    return jnp.concatenate([upper, last], axis=-2)


def nearest_pose(g: MatrixLike) -> Pose:
    r"""The pose with the rotation nearest to a matrix R that is nearly one, as with six digits, by
    two steps $R \gets \tfrac12 R (3 - R^T R)$ (Higham, Functions of Matrices, 2008, chapter 8)."""
    g = real(g)
    R = g[:3, :3]
    for _ in range(2):
        R = 1.5 * R - 0.5 * product(R, product(R.swapaxes(0, 1), R))
    return g.at[:3, :3].set(R)


def base_pose(base: Array | None, dtype: Any) -> Array | np.ndarray:
    """Pose of the base, shape (4, 4) or (4, 4, arms); the identity for None."""
    return np.eye(4, dtype=dtype) if base is None else base


def exp(omega: VectorLike) -> Pose:
    r"""Exponential map (eq. 24).

    $\exp\hat\Omega = I + \hat\Omega + \frac{1-\cos\theta}{\theta^2}\hat\Omega^2 +
    \frac{\theta-\sin\theta}{\theta^3}\hat\Omega^3$, with $\theta$ the norm of the angular part.

    **Arguments:** `omega`: twist $\Omega$, shape (6,).

    **Returns:** the pose, shape (4, 4). Derivatives are exact at $\theta = 0$ too.
    """
    return whole_pose(stacked_exp(real(omega)))


def inverse(g: MatrixLike) -> Pose:
    r"""Inverse pose $g^{-1} = (R^T, -R^T r)$, shape (4, 4)."""
    g = real(g)
    rotation = g[:3, :3].T
    top = jnp.concatenate([rotation, -(rotation @ g[:3, 3])[:, None]], axis=1)
    return jnp.concatenate([top, g[3:]])


def rotation_vector(rotation: MatrixLike) -> Float[Array, "3"]:
    r"""Axis times angle [rad] of a rotation, $\theta$ with $R = \exp \tilde\theta$, $|\theta| \le
    \pi$.

    Smooth except at half a turn, where both signs are right. The axis is that of the skew part,
    $\sin\theta\, n$, and for large angles that of the symmetric part, $(1 - \cos\theta)\, n n^T$.
    """
    rotation = real(rotation)
    axis = unskew(rotation)
    cosine = 0.5 * (jnp.trace(rotation) - 1)
    square = jnp.dot(axis, axis)
    near, large = (square < 1e-8) & (cosine > 0), cosine < -0.5
    sine = jnp.sqrt(jnp.where(near | large, 1.0, square))
    factor = jnp.where(
        near, 1 + square / 6, jnp.arctan2(sine, jnp.where(near | large, 1.0, cosine)) / sine
    )
    outer = 0.5 * (rotation + rotation.T) - cosine * jnp.eye(3, dtype=rotation.dtype)
    outer = jnp.where(large, outer, jnp.eye(3, dtype=rotation.dtype))
    column = outer[:, jnp.argmax(jnp.diagonal(outer))]
    n = column / jnp.sqrt(jnp.dot(column, column))
    turned = jnp.arctan2(jnp.dot(n, axis), jnp.where(large, cosine, -1.0)) * n
    return jnp.where(large, turned, factor * axis)


def log(g: MatrixLike) -> Twist:
    r"""Logarithm of a pose: the twist $\Omega$ with $\exp \hat\Omega = g$ and an angle up to half a
    turn.

    $\Omega = (\theta, r - \frac12 \theta \times r + \frac{c_3 - 2 c_4}{2 c_2} \theta \times (\theta
    \times r))$ with the rotation vector $\theta$ and the Stumpff functions $c_n(|\theta|^2)$.
    """
    g = real(g)
    theta, r = rotation_vector(g[:3, :3]), g[:3, 3]
    x = jnp.dot(theta, theta)
    near = x < _SWITCH
    _, c2, c3 = exp_coefficients(x)
    c4 = jnp.where(
        near, _stumpff(jnp.where(near, x, 0.0), 3)[1], (0.5 - c2) / jnp.where(near, 1.0, x)
    )
    across = jnp.cross(theta, r)
    factor = 0.5 * (c3 - 2 * c4) / c2
    return jnp.concatenate([theta, r - 0.5 * across + factor * jnp.cross(theta, across)])


def _blocks(a: Array, b: Array, c_: Array, d: Array) -> Float[Array, "6 6"]:
    return jnp.concatenate([jnp.concatenate([a, b], axis=1), jnp.concatenate([c_, d], axis=1)])


def adjoint(g: MatrixLike) -> Float[Array, "6 6"]:
    r"""Adjoint map of a pose; it maps twists from the body frame to the world frame.

    $\mathrm{Ad}_g = \begin{pmatrix} R & 0 \\ \tilde r R & R \end{pmatrix}$, shape (6, 6).
    """
    g = real(g)
    rotation = g[:3, :3]
    return _blocks(rotation, jnp.zeros_like(rotation), skew(g[:3, 3]) @ rotation, rotation)


def coadjoint(g: MatrixLike) -> Float[Array, "6 6"]:
    r"""Co-adjoint map of a pose; it maps wrenches from the body frame to the world frame.

    $\mathrm{Ad}^*_g = \begin{pmatrix} R & \tilde r R \\ 0 & R \end{pmatrix} =
    \mathrm{Ad}_{g^{-1}}^T$, shape (6, 6).
    """
    g = real(g)
    rotation = g[:3, :3]
    return _blocks(rotation, skew(g[:3, 3]) @ rotation, jnp.zeros_like(rotation), rotation)


def ad(xi: VectorLike) -> Float[Array, "6 6"]:
    r"""Adjoint map of a twist, the Lie bracket $\mathrm{ad}_\xi \eta = [\xi, \eta]$.

    $\mathrm{ad}_\xi = \begin{pmatrix} \tilde k & 0 \\ \tilde u & \tilde k \end{pmatrix}$, shape (6,
    6).
    """
    xi = real(xi)
    k, u = skew(xi[:3]), skew(xi[3:])
    return _blocks(k, jnp.zeros_like(k), u, k)


def coad(xi: VectorLike) -> Float[Array, "6 6"]:
    r"""Co-adjoint map of a twist, so that $(\mathrm{Ad}^*_g)' = \mathrm{Ad}^*_g \mathrm{ad}^*_\xi$
    along an arm.

    $\mathrm{ad}^*_\xi = \begin{pmatrix} \tilde k & \tilde u \\ 0 & \tilde k \end{pmatrix} =
    -\mathrm{ad}_\xi^T$, shape (6, 6).
    """
    xi = real(xi)
    k, u = skew(xi[:3]), skew(xi[3:])
    return _blocks(k, u, jnp.zeros_like(k), k)
