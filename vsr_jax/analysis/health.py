r"""Health of a solve: distance to failure, resolution, conditioning.

The distance to failure is the largest factor $\lambda$ on all inputs (or all loads) such that the
scene can be solved for every smaller factor. A bracket on a logarithmic scale is sampled at 16
factors in parallel and narrowed to the interval before the first failure, four times.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array

from ..arm.loads import Frame, Load
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..mechanics.balance import free_components, thread_direction, thread_wrench
from ..models.base import Model, Status
from ..numerics.component import Wrench, norm, scale, split
from ..numerics.quadrature import make_grid
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import Scalar
from .plausible import strain_warnings, warnings_of

LEAST_FACTOR, MOST_FACTOR = 1e-4, 1e4
"""Range of the factors."""
_FACTORS, _PASSES = 16, 4
"""Factors per pass, and passes: 1e8 ** (1 / 16 ** 4) = 1.0003 resolves the factor to 0.03 %."""


class Limit(NamedTuple):
    """Largest factor on all inputs, or on all loads, within 0.03 %, and the `Status` beyond it.

    The factor lies between 1e-4 and 1e4; with a status of 0 no factor failed.
    """

    factor: Scalar
    status: Array


class Health(NamedTuple):
    """Result of `check`.

    - `equilibrium`: the solve itself, with its status, stability margin and condition number.
    - `independence`: of the threads, the least eigenvalue of $K_{ij} = \\int b_i^T \\Sigma^{-1} b_j
      dX$ (eq. 20) at rest, scaled to ones on its diagonal: 0 if some threads are redundant, 1 if
      all are independent; None for fewer than two.
    - `inputs`, `loads`: largest factor on each, a `Limit`; None if the scene has none.
    - `tip_change` [m]: displacement of the tip with twice the steps (`Continuum`: with a hundredth
      of the tolerances).
    - `warnings`: sentences about implausible numbers.
    """

    equilibrium: Equilibrium
    independence: Scalar | None
    inputs: Limit | None
    loads: Limit | None
    tip_change: Scalar

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences about implausible numbers, most often a wrong unit; none under `jax.jit`."""
        return (*warnings_of(self.equilibrium.scene), *strain_warnings(self.equilibrium))


class _ScaledLoad(Load):
    """A load multiplied by a factor."""

    load: Load
    factor: Scalar
    frame: Frame = eqx.field(static=True)
    effect = "scaled load"

    def __init__(self, load: Load, factor: Scalar):
        self.load, self.factor, self.frame = load, factor, load.frame

    def density(self, rod: Rod, X: Scalar) -> Wrench | None:
        whole = self.load.density(rod, X)
        return None if whole is None else scale(self.factor, whole)

    def point(self, rod: Rod) -> tuple[Scalar, Wrench] | None:
        point = self.load.point(rod)
        return None if point is None else (point[0], scale(self.factor, point[1]))

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return self.load.breakpoints(rod)


def check(scene: Scene, inputs: ArrayLike | Sequence, *, model: Model | None = None) -> Health:
    """Health of one solve: stability margin, distance to failure, resolution, conditioning. Takes
    about seventy further solves.

    **Arguments:** as for `solve`.

    **Returns:** a `Health`; quantities that a failed solve does not have are NaN.

    **Raises:** `ValueError` as `solve` does.
    """
    return _check(solve(scene, inputs, model=model))


@eqx.filter_jit
def _check(eq: Equilibrium) -> Health:
    scene, inputs, model = eq.scene, eq.inputs, eq.model
    finer = solve(scene, inputs, model=model.finer())

    def status_at(of_inputs: Scalar, of_loads: Scalar) -> Array:
        loads = tuple(_ScaledLoad(load, of_loads) for load in scene.loads)
        return solve(
            eqx.tree_at(lambda scene: scene.loads, scene, loads), of_inputs * inputs, model=model
        ).status

    # one program for both searches, since compiling takes longer than solving
    grown = jnp.array([True, False])[: 1 + bool(scene.loads)]
    limits = jax.vmap(
        lambda grow: _limit(lambda factor: status_at(*_either(grow, factor)), inputs.dtype)
    )(grown)
    first, last = (jax.tree.map(lambda x, i=i: x[i], limits) for i in (0, -1))
    return Health(
        eq,
        _independence(scene) if len(scene.actuators) > 1 else None,
        first if scene.actuators else None,
        last if scene.loads else None,
        norm(split(finer.tip[:3, 3] - eq.tip[:3, 3])),
    )


def _either(inputs_grow: Array, factor: Scalar) -> tuple[Scalar, Scalar]:
    one = jnp.ones_like(factor)
    return jnp.where(inputs_grow, factor, one), jnp.where(inputs_grow, one, factor)


def _limit(status_at: Callable[[Scalar], Array], dtype: DTypeLike) -> Limit:
    def narrow(bracket: tuple[Scalar, Scalar], _: None) -> tuple[tuple[Scalar, Scalar], Array]:
        low, high = bracket
        steps = jnp.arange(_FACTORS + 1, dtype=dtype) / _FACTORS
        factors = low * (high / low) ** steps
        status = jax.vmap(status_at)(factors[1:])
        failed = status != Status.CONVERGED
        first = jnp.where(jnp.any(failed), jnp.argmax(failed), _FACTORS - 1)
        return (factors[first], factors[first + 1]), status[first]

    bracket = jnp.array(LEAST_FACTOR, dtype), jnp.array(MOST_FACTOR, dtype)
    (low, high), status = lax.scan(narrow, bracket, None, length=_PASSES)
    return Limit(jnp.where(status[-1] == Status.CONVERGED, high, low), status[-1])


def _independence(scene: Scene) -> Scalar:
    """Least eigenvalue of the matrix of eq. (20) at rest, scaled to ones on its diagonal."""
    grid = make_grid(scene.edges(), 32, 3)
    sections = scene.sections(grid.X)
    wrenches = [
        thread_wrench(thread_direction(sections.rest, path)[0], path) for path in sections.paths
    ]
    wrenches = [
        free_components(w if reach is None else scale(reach, w), scene.free)
        for w, reach in zip(wrenches, sections.reach, strict=True)
    ]
    B = jnp.stack([jnp.stack(jnp.broadcast_arrays(*w)) for w in wrenches])
    stiffness = jnp.stack(jnp.broadcast_arrays(*free_components(sections.stiffness, scene.free)))
    K = jnp.einsum("iask,jask,ask,sk->ij", B, B, 1 / stiffness, grid.weight)
    size = jnp.sqrt(jnp.diag(K))
    return jnp.linalg.eigvalsh(K / (size[:, None] * size[None, :]))[0]
