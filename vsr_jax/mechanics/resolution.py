r"""Whether the steps along an arm are fine enough for its shape, from the strain at their nodes and
the threads' paths alone.

Errors of the tip are estimated, of its place as a share of the arm's length and of its angle;
$|\cdot|$ are root mean squares along the arm with the weight $1 - 0.7 X/L$, since what is bent near
the base moves the tip most, what is bent near the tip turns it; and s is the number of Gauss nodes
of a step.

- Quadrature. A wave of curvature with amplitude a that turns by $\psi$ in a step has there the
  relative error of Gauss-Legendre quadrature, $\epsilon = \psi^{2s} (s!)^4 / ((2s + 1) (2s)!^3)$,
  at most 1. The errors of N steps have phases too: together they are $1 / (N |\sin(\psi / 2)|)$ of
  their sum, from $N^{-1/2}$ to 1. The wave is the greater of two: that through neighbouring nodes,
  whose second and first difference are $a (1 - \cos \varphi)$ and $a \sin \varphi$; and that which
  each thread lays, $\psi = h |d'| / |d|$, $a = |\tau d / EI|$, which no choice of nodes can hide.
  So does the shear $|\tau d'| / (GA - \tau)$ of that wave, which grows without bound where a thread
  that pushes takes the arm's stiffness in shear.
- Boundary layers. A force $|N|$ that loads ask of a section bends it over a length $\sqrt{EI /
  |N|}$: at a clamp, at a tip that carries a moment. Where that is shorter than $h / \pi$ the angle
  $h |\delta k|$ in which the step bends is in doubt.
- Magnus series. Its first neglected term where the curvature changes by $\delta k$ over a step,
  $c_s (h |k|)^{2s-1} |\delta k|$ with $c_s = 1/12, 1/720, 1/30240$ (Bernoulli numbers; the series
  diverges beyond $2 \pi$).
"""

import math

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.scene import CrossSections
from ..numerics import component as c
from ..numerics.component import Vector
from ..numerics.quadrature import Grid, gauss_legendre
from ..typing import Scalar
from .balance import residual

COARSE = 0.1
"""Estimated error of the tip, as a share of the arm's length, from which on a shape counts as
under-resolved."""

_TURNED = 0.7
_STIFF = 1e-3
_NEGLECTED = {1: 1 / 12, 2: 1 / 720, 3: 1 / 30240}


def step_error(
    xi: Vector, sections: CrossSections, forces: Vector, grid: Grid, *, loaded: bool
) -> Scalar:
    """Estimate of the tip's error by the steps, as a share of the arm's length.

    **Arguments:** strain and cross-sections at the nodes of `grid`, component arrays of shape
    (stages, steps); the force of each thread at its start; whether there are external loads.
    """
    xi, sections, forces, grid = lax.stop_gradient(c.single((xi, sections, forces, grid)))
    stages, length = grid.X.shape[0], jnp.sum(grid.h)
    before, here, after, gap, span = _neighbours(xi[:3])
    h = grid.h[: here[0].size]
    weight = h * (1 - _TURNED * jnp.mean(grid.X, axis=0) / length)[: h.size]
    change = tuple((b - a) / span for a, b in zip(before, after, strict=True))
    first = (span / 2) ** 2 * jnp.sum(weight * c.dot(change, change))
    bent = tuple(x - a - gap * d for x, a, d in zip(here, before, change, strict=True))
    second = jnp.sum(weight * c.dot(bent, bent))
    total = jnp.sum(weight)
    phase = 2 * jnp.arctan2(jnp.sqrt(second), jnp.sqrt(first)) / (span / 2)
    error = _quadrature(phase, jnp.sqrt(total) * _ratio(first + second, 2 * jnp.sqrt(second)), grid)
    for wave in _threads(xi, sections, forces, grid):
        error = jnp.maximum(error, _quadrature(*wave, grid))
    if loaded:
        force = residual(xi, sections, sections.carry(forces))[3:]
        short = grid.h**2 * jnp.sqrt(c.dot(force, force)) > math.pi**2 * _softest(sections)
        angle = jnp.where(
            jnp.any(short, axis=0)[: h.size], span * h * jnp.sqrt(c.dot(change, change)), 0.0
        )
        error = jnp.maximum(error, jnp.max(angle, initial=0.0))
    series = jnp.sum(
        weight * (h**2 * c.dot(here, here)) ** (2 * stages - 1) * c.dot(change, change)
    )
    return error + _NEGLECTED[stages] * jnp.sqrt(total * series)


def _threads(
    xi: Vector, sections: CrossSections, forces: Vector, grid: Grid
) -> list[tuple[Scalar, Scalar]]:
    """For each thread by how much its wave turns in a step, and how far it bends and shears the arm
    in all."""
    length, waves = jnp.sum(grid.h), []
    lever = grid.weight * (1 - _TURNED * grid.X / length)
    softest = _softest(sections)
    hardest = jnp.max(softest)  # the square of a thin arm's stiffness is beyond single precision
    pushed = sum((jnp.maximum(force, 0.0) for force in forces), jnp.zeros_like(length)) / xi[3]
    shear = jnp.minimum(sections.stiffness[4], sections.stiffness[5])
    shear = jnp.maximum(shear - pushed, _STIFF * shear)
    for path, reach, force in zip(sections.paths, sections.reach, forces, strict=True):
        square, slope = path.y**2 + path.z**2, path.slope_y**2 + path.slope_z**2
        inside = c.times(reach, lever)
        phase = (
            jnp.sqrt(_ratio(jnp.sum(inside * slope), jnp.sum(inside * square)))
            * length
            / grid.h.size
        )
        bent = (
            jnp.sqrt(jnp.sum(lever) * jnp.sum(inside * square / (softest / hardest) ** 2)) / hardest
        )
        sheared = jnp.sqrt(jnp.sum(lever) * jnp.sum(inside * slope / shear**2)) / length
        waves.append((phase, jnp.abs(force) * (bent + sheared)))
    return waves


def _softest(sections: CrossSections) -> Array:
    return jnp.minimum(sections.stiffness[1], sections.stiffness[2])


def _neighbours(k: Vector) -> tuple[Vector, Vector, Vector, float, float]:
    """Values at three nodes in a row for each step, as far as there are any, and how far, in steps,
    the others are from the first."""
    stages, nodes = k[0].shape[0], gauss_legendre(k[0].shape[0])[0]
    if stages == 1:
        return (
            tuple(x[0, :-2] for x in k),
            tuple(x[0, 1:-1] for x in k),
            tuple(x[0, 2:] for x in k),
            1.0,
            2.0,
        )
    size = k[0].shape[1] - (stages == 2)
    last = tuple(x[0, 1:] if stages == 2 else x[2] for x in k)
    span = 1.0 if stages == 2 else float(nodes[2] - nodes[0])
    return (
        tuple(x[0, :size] for x in k),
        tuple(x[1, :size] for x in k),
        last,
        float(nodes[1] - nodes[0]),
        span,
    )


def _quadrature(phase: Scalar, bend: Scalar, grid: Grid) -> Scalar:
    """Error of the steps for waves that turn by `phase` in each and bend the arm by `bend` in
    all."""
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
