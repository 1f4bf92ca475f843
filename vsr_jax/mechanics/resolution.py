r"""Estimate of whether the steps along an arm resolve its shape, from the strain at the nodes and
the paths of the threads.

The estimate is an error of the tip: of its position as a fraction of the arm's length, and of its
angle. $|\cdot|$ is a root mean square along the arm with the weight $1 - 0.7 X/L$, since curvature
near the base moves the tip most while curvature near the tip only rotates it; s is the number of
Gauss nodes per step.

- Quadrature. For a wave of curvature with amplitude a and phase $\psi$ per step the relative error
  of Gauss-Legendre quadrature is $\epsilon = \psi^{2s} (s!)^4 / ((2s + 1) (2s)!^3)$, at most 1. The
  errors of N steps have phases too: their total is $1 / (N |\sin(\psi / 2)|)$ of the sum of their
  sizes, between $N^{-1/2}$ and 1. The larger of two waves counts: that through neighbouring nodes,
  whose second and first difference are $a (1 - \cos \varphi)$ and $a \sin \varphi$, and that by the
  path of each thread, $\psi = h |d'| / |d|$, $a = |\tau d / EI|$, which is known even where the
  nodes alias it. The shear $|\tau d'| / (GA - \tau)$ of that wave is included; it grows without
  bound where a pushing thread cancels the shear stiffness.
- Boundary layers. A force $|N|$ on a section bends the arm over a length $\sqrt{EI / |N|}$ at a
  clamp, or at a tip with a moment. Where that is shorter than $h / \pi$, the angle $h |\delta k|$
  over the step is unresolved.
- Magnus series. Its first neglected term where the curvature changes by $\delta k$ over a step,
  $c_s (h |k|)^{2s-1} |\delta k|$ with $c_s = 1/12, 1/720, 1/30240$ (Bernoulli numbers; the series
  diverges beyond $2 \pi$).

Rigid pieces are left out: the steps on both sides of one are neighbours.
"""

import math

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import CrossSections, together
from ..numerics import component as c
from ..numerics.component import Forces, Vector
from ..numerics.quadrature import Grid, gauss_legendre
from ..numerics.stacked import stack
from ..typing import Scalar
from .balance import residual

COARSE = 0.1
"""Estimated error of the tip, as a fraction of the arm's length, above which a shape is
under-resolved: the series behind the estimate then say little of its true size."""

_TAPER = 0.7
"""Decrease of the weight from base to tip; below 1, so that the angle of the tip still counts."""
_MIN_SHEAR = 1e-3
"""Fraction of the shear stiffness that is kept where threads push: it bounds the shear."""
_NEGLECTED = {1: 1 / 12, 2: 1 / 720, 3: 1 / 30240}
"""Coefficient of the first neglected term of the Magnus series by the number of nodes per step."""


def step_error(
    xi: Vector, sections: CrossSections, forces: Forces, grid: Grid, *, loaded: bool
) -> Scalar:
    """Estimate of the error of the tip by the steps, as a fraction of the arm's length.

    **Arguments:** strain and cross-sections at the nodes of `grid`, component arrays of shape
    (stages, steps); the force of each thread at its start; whether there are external loads.
    """
    xi, sections, forces, grid = lax.stop_gradient(c.single((xi, sections, forces, grid)))
    if sections.flexible is not None:  # behind the others: there the curvature jumps, exactly
        order = jnp.argsort(sections.flexible[0] == 0)
        xi, sections, grid = jax.tree.map(lambda x: x[..., order], (xi, sections, grid))
    stages, length = grid.X.shape[0], jnp.sum(grid.h)
    before, here, after, gap, span = _neighbours(stack(xi[:3]))
    h = grid.h[: here.shape[1]]
    lever = h * (1 - _TAPER * jnp.mean(grid.X, axis=0) / length)[: h.size]
    change = (after - before) / span
    if sections.flexible is not None:
        near, middle, far, *_ = _neighbours(sections.flexible[None])
        bends = (near * middle * far)[0]
        lever, change = bends * lever, bends * change
    turned = _square(change)
    first = (span / 2) ** 2 * jnp.sum(lever * turned)
    second = jnp.sum(lever * _square(here - before - gap * change))
    total = jnp.sum(lever)
    phase = 2 * jnp.arctan2(jnp.sqrt(second), jnp.sqrt(first)) / (span / 2)
    error = _quadrature(phase, jnp.sqrt(total) * _ratio(first + second, 2 * jnp.sqrt(second)), grid)
    if forces:
        waves = _quadrature(*_threads(xi, sections, forces, grid), grid)
        error = jnp.maximum(error, jnp.max(waves))
    if loaded:
        force = residual(xi, sections, sections.carry(forces))[3:]
        short = grid.h**2 * jnp.sqrt(c.dot(force, force)) > math.pi**2 * _softest(sections)
        angle = jnp.where(jnp.any(short, axis=0)[: h.size], span * h * jnp.sqrt(turned), 0.0)
        error = jnp.maximum(error, jnp.max(angle, initial=0.0))
    series = jnp.sum(lever * (h**2 * _square(here)) ** (2 * stages - 1) * turned)
    return error + _NEGLECTED[stages] * jnp.sqrt(total * series)


def _threads(
    xi: Vector, sections: CrossSections, forces: Forces, grid: Grid
) -> tuple[Array, Array]:
    """For each thread the phase of its wave per step, and the total angle by which it bends and
    shears the arm."""

    def total(x: Array) -> Array:
        return jnp.sum(x, axis=(-2, -1))

    length, force = jnp.sum(grid.h), together(forces)
    lever = c.times(sections.flexible, grid.weight * (1 - _TAPER * grid.X / length))
    softest = _softest(sections)
    hardest = jnp.max(
        softest
    )  # the square of a thin arm's stiffness underflows in single precision
    pushed = jnp.sum(jnp.maximum(force, 0.0)) / xi[3]
    shear = jnp.minimum(sections.stiffness[4], sections.stiffness[5])
    shear = jnp.maximum(shear - pushed, _MIN_SHEAR * shear)
    path, reach = sections.every_path, sections.every_reach
    square, slope = path.y**2 + path.z**2, path.slope_y**2 + path.slope_z**2
    inside = c.times(reach, lever)
    phase = jnp.sqrt(_ratio(total(inside * slope), total(inside * square)))
    bent = jnp.sqrt(total(lever) * total(inside * square / (softest / hardest) ** 2)) / hardest
    sheared = jnp.sqrt(total(lever) * total(inside * slope / shear**2)) / length
    return phase * length / grid.h.size, jnp.abs(force) * (bent + sheared)


def _softest(sections: CrossSections) -> Array:
    return jnp.minimum(sections.stiffness[1], sections.stiffness[2])


def _neighbours(x: Array) -> tuple[Array, Array, Array, float, float]:
    """Values (n, steps) at three successive nodes for each step, as far as available, of values (n,
    stages, steps), and the distances of the second and third from the first, in steps."""
    stages, nodes = x.shape[1], gauss_legendre(x.shape[1])[0]
    if stages == 1:
        return x[:, 0, :-2], x[:, 0, 1:-1], x[:, 0, 2:], 1.0, 2.0
    gap = float(nodes[1] - nodes[0])
    if stages == 2:
        return x[:, 0, :-1], x[:, 1, :-1], x[:, 0, 1:], gap, 1.0
    return x[:, 0], x[:, 1], x[:, 2], gap, float(nodes[2] - nodes[0])


def _square(x: Array) -> Array:
    """Squared norm of vectors (3, ...)."""
    return jnp.sum(x**2, axis=0)


def _quadrature(phase: Array, bend: Array, grid: Grid) -> Array:
    """Error of the steps for a wave with `phase` per step that bends the arm by the total angle
    `bend`."""
    stages, steps = grid.X.shape
    relative = (
        math.factorial(stages) ** 4
        / ((2 * stages + 1) * math.factorial(2 * stages) ** 3)
        * phase ** (2 * stages)
    )
    in_phase = jnp.clip(1 / (steps * jnp.abs(jnp.sin(phase / 2))), steps**-0.5, 1.0)
    return jnp.minimum(1.0, relative) * in_phase * bend


def _ratio(part: Array, whole: Array) -> Array:
    return jnp.where(whole > 0, part / jnp.where(whole > 0, whole, 1.0), 0.0)
