r"""The health of a solve: how far it is from where it fails, how well it is resolved, how well it
is conditioned.

The distance to failure is the greatest factor $\lambda$ by which the inputs (or the loads) may grow
together, all else held, with every smaller one solved. It is bracketed on a logarithmic scale, many
factors at once, and the bracket is narrowed where the first of them fails.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array

from ..arm.loads import Frame, Load
from ..arm.rod import Rod
from ..arm.scene import Scene
from ..mechanics.balance import free_components, thread_direction, thread_wrench
from ..models.base import Model, Status
from ..numerics.component import Vector, norm, scale, split
from ..numerics.quadrature import make_grid
from ..solution.equilibrium import Equilibrium
from ..solution.solver import solve
from ..typing import Scalar
from .plausible import strain_warnings, warnings_of

LEAST_FACTOR, MOST_FACTOR = 1e-4, 1e4
_FACTORS, _PASSES = 16, 4


class Limit(NamedTuple):
    """How far all inputs, or all loads, may grow together: the factor, within 0.03 %, and the
    `Status` beyond it.

    The factor lies between 1e-4 and 1e4; a status of 0 at its end says that nothing failed.
    """

    factor: Scalar
    status: Array


class Health(NamedTuple):
    """What `check` finds.

    - `equilibrium`: the solve itself, with its status, its margin of `stability` and its
      `condition`.
    - `independence`: of the threads, the least eigenvalue of $K_{ij} = \\int b_i^T \\Sigma^{-1} b_j
      dX$ (eq. 20) at rest with ones on its diagonal: 0 where some threads do together what others
      do, 1 where none knows of another; None for fewer than two.
    - `inputs`, `loads`: how far each may grow, a `Limit`; None where there are none.
    - `tip_change` [m]: by which the tip moves with twice the steps (`Continuum`: with a hundredth
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
        """Sentences about numbers that are far outside of what arms have, most often by a slip of
        unit; none under `jax.jit`."""
        return (*warnings_of(self.equilibrium.scene), *strain_warnings(self.equilibrium))


class _Share(Load):
    """A load times a factor."""

    load: Load
    factor: Scalar
    frame: Frame = eqx.field(static=True)
    effect = "share of a load"

    def __init__(self, load: Load, factor: Scalar):
        self.load, self.factor, self.frame = load, factor, load.frame

    def density(self, rod: Rod, X: Scalar) -> Vector | None:
        whole = self.load.density(rod, X)
        return None if whole is None else scale(self.factor, whole)

    def point(self, rod: Rod) -> tuple[Scalar, Vector] | None:
        point = self.load.point(rod)
        return None if point is None else (point[0], scale(self.factor, point[1]))

    def breakpoints(self, rod: Rod) -> tuple[Scalar, ...]:
        return self.load.breakpoints(rod)


def check(scene: Scene, inputs: Any, *, model: Model | None = None) -> Health:
    """The health of one solve, from some seventy others: margin, distance to failure, resolution,
    conditioning.

    **Arguments:** as for `solve`.

    **Returns:** a `Health`; what is not known of a solve that failed is NaN.

    **Raises:** `ValueError` as `solve` does.
    """
    return _check(solve(scene, inputs, model=model))


@eqx.filter_jit
def _check(eq: Equilibrium) -> Health:
    scene, inputs, model = eq.scene, eq.inputs, eq.model
    finer = solve(scene, inputs, model=model.finer())

    def status_at(of_inputs: Scalar, of_loads: Scalar) -> Array:
        loads = tuple(_Share(load, of_loads) for load in scene.loads)
        return solve(
            eqx.tree_at(lambda scene: scene.loads, scene, loads), of_inputs * inputs, model=model
        ).status

    # one program for both searches: compiling takes longer than solving
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


def _limit(status_at: Callable[[Scalar], Array], dtype: Any) -> Limit:
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
    """Least eigenvalue of eq. 20's matrix with ones on the diagonal, in the arm at rest."""
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
