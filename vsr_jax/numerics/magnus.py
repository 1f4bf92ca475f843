r"""Kinematics: from strain to pose, $g' = g \hat\xi$, by Magnus steps on Gauss points.

With the strain on the right of the pose, the commutators have the opposite sign of those printed
for $Y' = A Y$.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..typing import MatrixLike, Pose, Scalar, ScalarLike, Twist, VectorLike, real
from ..validation import choice
from .component import Vector
from .loops import alike, scan
from .once import once
from .se3 import (
    adjoint,
    base_pose,
    exp,
    inverse,
    stacked_bracket,
    stacked_exp,
    stacked_product,
    vee,
    whole_pose,
)
from .stacked import components, stack

ORDERS = (2, 4, 6)
"""Orders of the steps; order 2 s uses s Gauss points per step."""


def stacked_twist(xi: Array, h: Array) -> Array:
    r"""`step_twist` of strains (6, stages, ...) at the Gauss points of steps, shape (6, ...)."""
    stages = components(xi, axis=1)
    if len(stages) == 1:
        return h * stages[0]
    if len(stages) == 2:
        mean = 0.5 * h * (stages[0] + stages[1])
        return mean + math.sqrt(3) / 12 * h * h * stacked_bracket(*stages)
    first, middle, last = stages
    a2 = math.sqrt(15) / 3 * h * (last - first)
    a3 = 10 / 3 * h * (first - 2.0 * middle + last)
    return magnus_6(h * middle, a2, a3, stacked_bracket)


def magnus_6(a1: Array, a2: Array, a3: Array, bracket: Callable[[Array, Array], Array]) -> Array:
    r"""Sixth-order Magnus expansion for the strain $(\alpha_1 + \alpha_2 x + \alpha_3 x^2) / h$, $x
    \in [-1/2, 1/2]$ (see `step_twist`)."""
    c1 = bracket(a2, a1)
    c2 = 1 / 60 * bracket(a1, 2.0 * a3 + c1)
    inner = bracket(a2 + c2, -20.0 * a1 - a3 + c1)
    return a1 + 1 / 12 * a3 + 1 / 240 * inner


def step_twist(strains: MatrixLike, h: ScalarLike) -> Twist:
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
    strains = real(strains)
    choice("strains.shape[0]", strains.shape[0], (1, 2, 3))
    return stacked_twist(strains.T, real(h))


def zanna_step(xi_1: VectorLike, xi_2: VectorLike, h: ScalarLike) -> Twist:
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
    return step_twist(jnp.stack([real(xi_1), real(xi_2)]), h)


def _advanced(
    strain: Vector, h: Float[Array, " steps"], base: Pose | None
) -> tuple[Array, Array, Array]:
    """Poses (3, 4) at the start of the first step and at the end of the last one, and those at the
    ends of all steps, (steps, 3, 4)."""
    increments = jnp.moveaxis(stacked_exp(once(stacked_twist(stack(strain), h))), -1, 0)
    start = jnp.asarray(base_pose(base, h.dtype)[:3], increments.dtype)

    def advance(g: Array, increment: Array) -> tuple[Array, Array]:
        g = stacked_product(g, once(increment))
        return g, g

    end, ends = scan(advance, start, increments)
    return start, end, ends


def tip_pose(strain: Vector, h: Float[Array, " steps"], base: Pose | None = None) -> Pose:
    """Pose at the end of the last step.

    **Arguments:**
    - `strain`: six component arrays of shape (stages, steps), the strain at the Gauss points of
      each step.
    - `h`: step lengths [m].
    - `base`: pose at the start, the identity by default.

    **Returns:** the pose, shape (4, 4).
    """
    return whole_pose(_advanced(strain, h, base)[1])


def step_poses(
    strain: Vector, h: Float[Array, " steps"], base: Pose | None = None
) -> Float[Array, "steps_and_one 4 4"]:
    """Pose at the start and at every step end; arguments as for `tip_pose`."""
    start, _, ends = _advanced(strain, h, base)
    return whole_pose(jnp.moveaxis(jnp.concatenate([start[None], ends]), 0, -1))


def step_jacobian(
    strains: Float[Array, "stages 6"], rates: Float[Array, "stages 6 dofs"], h: Scalar
) -> Float[Array, "6 dofs"]:
    r"""Body twist $(g^{-1} \delta g)^\vee$ of one step per change of the coordinates.

    **Arguments:** `strains` at the step's Gauss points, `rates` $= \partial \xi / \partial q$
    there, `h` [m].

    **Returns:** shape (6, dofs): the exact derivative of the step, which is a quadrature of order
    2, 4 or 6 of $\mathrm{Ad}_{g}^{-1} \int \mathrm{Ad}_g B_q \, ds$ over it (eq. 15).
    """

    strains, rates = alike(strains, rates)

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
    J, _ = scan(advance, start, (strains, rates, h))
    return J
