r"""Kinematics: from strain to pose, $g' = g \hat\xi$, by Magnus steps on Gauss points.

With the strain on the right of the pose, the commutators have the opposite sign of those printed
for $Y' = A Y$.
"""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..typing import Pose, Scalar, Twist
from ..validation import choice
from . import component as c
from .component import Matrix, Vector
from .se3 import (
    adjoint,
    base_pose,
    bracket_components,
    compose_components,
    exp,
    exp_components,
    inverse,
    pose,
    vee,
)

ORDERS = (2, 4, 6)
"""Orders of the steps; order 2 s uses s Gauss points per step."""


def step_components(stages: tuple[Vector, ...], h: Array) -> Vector:
    r"""`step_twist` on component arrays: the twist of each step from the strains at its Gauss
    points."""
    if len(stages) == 1:
        return c.scale(h, stages[0])
    if len(stages) == 2:
        mean = c.scale(0.5 * h, c.add(*stages))
        return c.add(mean, c.scale(math.sqrt(3) / 12 * h * h, bracket_components(*stages)))
    first, middle, last = stages
    a1 = c.scale(h, middle)
    a2 = c.scale(math.sqrt(15) / 3 * h, c.subtract(last, first))
    a3 = c.scale(10 / 3 * h, c.add(c.subtract(first, c.scale(2.0, middle)), last))
    return magnus_6(a1, a2, a3, bracket_components)


def magnus_6(
    a1: c.Tree, a2: c.Tree, a3: c.Tree, bracket: Callable[[c.Tree, c.Tree], c.Tree]
) -> c.Tree:
    r"""Sixth-order Magnus expansion for the strain $(\alpha_1 + \alpha_2 x + \alpha_3 x^2) / h$, $x
    \in [-1/2, 1/2]$ (see `step_twist`), for component arrays or arrays."""
    c1 = bracket(a2, a1)
    c2 = c.scale(1 / 60, bracket(a1, c.add(c.scale(2.0, a3), c1)))
    left = c.add(c.subtract(c.scale(-20.0, a1), a3), c1)
    inner = bracket(c.add(a2, c2), left)
    return c.add(a1, c.add(c.scale(1 / 12, a3), c.scale(1 / 240, inner)))


def step_twist(strains: Float[Array, "stages 6"], h: Scalar) -> Twist:
    r"""Magnus increment of one step, of order 2, 4 or 6 with one, two or three Gauss points.

    Order 2: $\Omega = h \xi_1$. Order 4: eq. (5), see `zanna_step`. Order 6, with $\alpha_1 = h
    \xi_2$, $\alpha_2 = \frac{\sqrt{15}}{3} h (\xi_3 - \xi_1)$, $\alpha_3 = \frac{10}{3} h (\xi_3 -
    2 \xi_2 + \xi_1)$, $c_1 = -[\alpha_1, \alpha_2]$, $c_2 = \frac{1}{60} [\alpha_1, 2 \alpha_3 +
    c_1]$: $\Omega = \alpha_1 + \frac{\alpha_3}{12} - \frac{1}{240} [-20 \alpha_1 - \alpha_3 + c_1,
    \alpha_2 + c_2]$.

    **Arguments:**
    - `strains`: strain at the Gauss points of the step, shape (1, 6), (2, 6) or (3, 6).
    - `h`: step length [m].

    **Returns:** the twist $\Omega$, shape (6,); `se3.exp` of it advances the pose.

    **Raises:** `ValueError` for another number of Gauss points.

    **Source:** Blanes, Casas, Oteo and Ros, The Magnus expansion, Physics Reports 470 (2009), eq.
    (254) ff., with the brackets reversed for $g' = g \hat\xi$.
    """
    choice("strains.shape[0]", strains.shape[0], (1, 2, 3))
    return jnp.stack(step_components(tuple(c.split(xi) for xi in strains), h))


def zanna_step(xi_1: Twist, xi_2: Twist, h: Scalar) -> Twist:
    r"""Fourth-order Magnus increment of one step (eq. 5).

    $\Omega = \frac h2 (\xi_1 + \xi_2) + \frac{\sqrt 3 h^2}{12} [\xi_1, \xi_2]$

    **Arguments:**
    - `xi_1`, `xi_2`: strain at the two Gauss points of the step, shape (6,), (k [1/m], u [-]), the
      lower one first.
    - `h`: step length [m].

    **Returns:** the twist $\Omega$, shape (6,); `se3.exp` of it advances the pose. Local error
    O(h^5).

    **Source:** eq. (5) of Renda et al. 2020; A. Zanna, SIAM J. Numer. Anal. 36 (1999).
    """
    return step_twist(jnp.stack([xi_1, xi_2]), h)


def base_components(base: Pose | None, like: Array) -> tuple[Matrix, Vector]:
    """Rotation and position of the base as components of `like`'s shape and dtype; the identity for
    None."""
    matrix = base_pose(base, like.dtype)
    rows = tuple(tuple(jnp.broadcast_to(x, like.shape) for x in row) for row in matrix[:3])
    return tuple(row[:3] for row in rows), tuple(row[3] for row in rows)


def _twists(strain: Vector, h: Array) -> Vector:
    stages = strain[0].shape[0]
    return step_components(tuple(tuple(x[i] for x in strain) for i in range(stages)), h)


def tip_pose(strain: Vector, h: Float[Array, " steps"], base: Pose | None = None) -> Pose:
    """Pose at the end of the last step.

    **Arguments:**
    - `strain`: six component arrays of shape (stages, steps), the strain at the Gauss points of
      each step.
    - `h`: step lengths [m].
    - `base`: pose at the start, the identity by default.

    **Returns:** the pose, shape (4, 4).
    """
    twists = _twists(strain, h)
    start = base_components(base, twists[0][0])
    end, _ = lax.scan(
        lambda g, omega: (compose_components(g, exp_components(omega)), None), start, twists
    )
    return pose(*end)


def step_poses(
    strain: Vector, h: Float[Array, " steps"], base: Pose | None = None
) -> Float[Array, "steps_and_one 4 4"]:
    """Pose at the start and at every step end; arguments as for `tip_pose`."""
    twists = _twists(strain, h)
    start = base_components(base, twists[0][0])

    def advance(g: Any, omega: Vector) -> tuple[Any, Any]:
        g = compose_components(g, exp_components(omega))
        return g, g

    _, ends = lax.scan(advance, start, twists)
    return jnp.concatenate([pose(*start)[None], pose(*ends)])


def step_jacobian(
    strains: Float[Array, "stages 6"], rates: Float[Array, "stages 6 dofs"], h: Scalar
) -> Float[Array, "6 dofs"]:
    r"""Body twist $(g^{-1} \delta g)^\vee$ of one step per change of the coordinates.

    **Arguments:** `strains` at the step's Gauss points, `rates` $= \partial \xi / \partial q$
    there, `h` [m].

    **Returns:** shape (6, dofs): the exact derivative of the step, which is a quadrature of order
    2, 4 or 6 of $\mathrm{Ad}_{g}^{-1} \int \mathrm{Ad}_g B_q \, ds$ over it (eq. 15).
    """

    def column(rate: Float[Array, "stages 6"]) -> Twist:
        g, rate_of_g = jax.jvp(lambda xi: exp(step_twist(xi, h)), (strains,), (rate,))
        return vee(inverse(g) @ rate_of_g)

    return jax.vmap(column, in_axes=-1, out_axes=-1)(rates)


def accumulate_jacobian(
    strains: Float[Array, "steps stages 6"],
    rates: Float[Array, "steps stages 6 dofs"],
    h: Float[Array, " steps"],
) -> Float[Array, "6 dofs"]:
    r"""Geometric Jacobian at the end of the last step (eq. 15): $J_{k+1} =
    \mathrm{Ad}_{\exp\hat\Omega_k}^{-1} J_k + $ `step_jacobian`."""

    def advance(J: Array, step: tuple[Array, Array, Array]) -> tuple[Array, None]:
        xi, rate, width = step
        increment = exp(step_twist(xi, width))
        return adjoint(inverse(increment)) @ J + step_jacobian(xi, rate, width), None

    start = jnp.zeros((6, rates.shape[-1]), rates.dtype)
    J, _ = lax.scan(advance, start, (strains, rates, h))
    return J
