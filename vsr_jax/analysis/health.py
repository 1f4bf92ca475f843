r"""Health of a solve: distance to failure, resolution, conditioning.

The distance to failure is the largest factor $\lambda$ on all inputs (or all loads) such that the
scene can be solved for every smaller factor. A bracket on a logarithmic scale is sampled at 16
factors in parallel and narrowed to the interval before the first failure, four times.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..arm.scene import Scene
from ..files.output import plain
from ..mechanics.balance import unit_wrench
from ..models.base import Model, Status
from ..numerics.compiling import program
from ..numerics.component import free_components, norm, scale, split, times
from ..numerics.loops import scan
from ..numerics.quadrature import make_grid
from ..solution.equilibrium import Equilibrium
from ..solution.plausible_strain import strain_warnings
from ..solution.solver import solve
from ..typing import ArrayLike, DTypeLike, Scalar
from ..validation import is_traced

LEAST_FACTOR, MOST_FACTOR = 1e-4, 1e4
"""Range of the factors."""
_FACTORS, _PASSES = 16, 4
"""Factors per pass, and passes."""
_RESOLUTION = (MOST_FACTOR / LEAST_FACTOR) ** (1 / _FACTORS**_PASSES) - 1
"""Relative width of the last bracket, 0.03 %: a factor may be too small by as much."""

CLOSE = 1.25
"""Factor below which inputs or loads are called close to failure."""
SOFT = 0.1
"""Margin below which an equilibrium is called nearly unstable: its displacements are ten times
those of an arm without forces."""
COARSE_TIP = 1e-3
"""Fraction of the length by which finer steps may move the tip: accuracy of a plot."""
REDUNDANT = 1e3
"""Independence below which threads count as redundant, as a multiple of machine epsilon: the least
eigenvalue of their matrix is then zero to rounding."""


class Limit(NamedTuple):
    """Largest factor on all inputs, or on all loads, within 0.03 %, and the `Status` beyond it.

    The factor lies between 1e-4 and 1e4; with a status of 0 no factor failed.
    """

    factor: Scalar
    status: Array

    def __str__(self) -> str:
        if int(self.status) == Status.CONVERGED:
            return f"may grow together to at least {MOST_FACTOR:g} times"
        then = Status(int(self.status)).message
        return f"may grow together to {float(self.factor):.4g} times; then {then}"

    def record(self) -> dict[str, Any]:
        """The largest `factor`, and the message of the status beyond it, `then`."""
        return {"factor": float(self.factor), "then": Status(int(self.status)).message}


class Health(NamedTuple):
    """Result of `check`.

    - `equilibrium`: the solve itself, with its status, stability margin and condition number.
    - `independence`: of the threads, the least eigenvalue of $K_{ij} = \\int b_i^T \\Sigma^{-1} b_j
      dX$ (eq. 20) at rest, scaled to ones on its diagonal: 0 if some threads are redundant or have
      no effect, 1 if all are independent; None for fewer than two.
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
        return (*self.equilibrium.scene.warnings, *strain_warnings(self.equilibrium))

    @property
    def advice(self) -> tuple[str, ...]:
        """What to do, the most urgent first; one sentence that says so if there is nothing."""
        eq, length = self.equilibrium, float(self.equilibrium.scene.rod.length)
        if not bool(eq.converged):
            return (_REMEDIES[Status(int(eq.status))].format(eq.model.finer()),)
        advice = [
            f"close to failure: {name} may grow by "
            f"{100 * max(float(limit.factor) - 1, 0.0):.2g} % at most"
            for name, limit in self._limits()
            if 1 - _RESOLUTION <= limit.factor < CLOSE
        ]
        if self._margins()[0] < SOFT:
            advice.append(
                "the equilibrium is nearly unstable: small model errors cause large displacements"
            )
        if not float(self.tip_change) < COARSE_TIP * length:
            advice.append(f"take more steps: {eq.model.finer()!r}")
        if (
            self.independence is not None
            and self.independence < REDUNDANT * jnp.finfo(eq.inputs.dtype).eps
        ):
            advice.append(
                "some threads are redundant: their forces cannot be inferred from the shape (the "
                "solve is not affected)"
            )
        return tuple(advice) or ("no problems found",)

    def record(self) -> dict[str, Any]:
        """The same as numbers and strings, with None for unknown quantities.

        **Returns:** `status` as a message, `converged`, `margin`, `condition`, `independence`;
        `inputs` and `loads`, each with `factor` and the message of the status beyond it, `then`;
        `tip_change` [m]; `warnings` and `advice`, lists of sentences.
        """
        eq, (margin, condition) = self.equilibrium, self._margins()

        return {
            "status": eq.message,
            "converged": bool(eq.converged),
            "margin": plain(margin),
            "condition": plain(condition),
            "independence": plain(self.independence),
            "inputs": None if self.inputs is None else self.inputs.record(),
            "loads": None if self.loads is None else self.loads.record(),
            "tip_change": plain(self.tip_change),
            "warnings": list(self.warnings),
            "advice": list(self.advice),
        }

    def __str__(self) -> str:
        eq = self.equilibrium
        if is_traced(eq.status) or jnp.ndim(eq.status) > 0:
            return f"Health(of {eq!r})"
        text = list(eq.heading)
        if bool(eq.converged):
            margin, condition = self._margins()
            text += [
                f"  margin       {margin:.4g} (1 without forces, 0 where the "
                f"equilibrium loses stability)",
                f"  condition    {self._digits(condition)}",
                f"  resolution   finer steps {self._change()}",
            ]
        text += [f"  {name:12} {limit}" for name, limit in self._limits()]
        if self.independence is not None:
            text.append(
                f"  independence {float(self.independence):.2g} of the threads (0: some are "
                f"redundant, 1: all independent)"
            )
        text += [f"  warning      {sentence}" for sentence in self.warnings]
        return "\n".join(text + [f"  advice       {sentence}" for sentence in self.advice])

    def _limits(self) -> list[tuple[str, Limit]]:
        limits = ("inputs", self.inputs), ("loads", self.loads)
        return [(name, limit) for name, limit in limits if limit is not None]

    def _margins(self) -> tuple[float, float]:
        """Stability margin and condition number."""
        return float(self.equilibrium.stability), float(self.equilibrium.condition)

    def _digits(self, condition: float) -> str:
        if not np.isfinite(condition):
            return "unknown"
        digits = -np.log10(float(np.finfo(self.equilibrium.inputs.dtype).eps) * condition)
        return f"{condition:.3g}: about {max(0, int(digits))} digits of the strains are accurate"

    def _change(self) -> str:
        moved, length = float(self.tip_change), float(self.equilibrium.scene.rod.length)
        if not np.isfinite(moved):
            return "do not converge"
        return f"move the tip by {moved:.2g} m, {moved / length:.1g} of the length"


_REMEDIES = {
    Status.NOT_CONVERGED: "increase the inputs gradually with vsr.follow_branch, "
    "or check that loads and inputs are in SI units",
    Status.UNSTABLE: "the arm would snap: follow the branch with vsr.follow_branch, "
    "or lower inputs or loads to the factor above",
    Status.COLLAPSED: "lower the tensions to the factor above, or stiffen the rod: "
    "its axial stiffness limits the tensions",
    Status.NOT_FINITE: "check the scene and the inputs for NaN and infinities",
    Status.INADMISSIBLE: "tensions and pressures must not be negative; "
    "use a Thread where the force may have either sign",
    Status.UNDER_RESOLVED: "take more steps: {!r}, or still more",
}
"""Advice for a solve that failed."""


def check(scene: Scene, inputs: ArrayLike, *, model: Model | None = None) -> Health:
    """Health of one solve: stability margin, distance to failure, resolution, conditioning. Takes
    one further solve, and 64 for each of inputs and loads that the scene has.

    **Arguments:** as for `solve`.

    **Returns:** a `Health`; quantities that a failed solve does not have are NaN.

    **Raises:** `ValueError` as `solve` does.
    """
    return _check(solve(scene, inputs, model=model))


@program("check")
def _check(eq: Equilibrium) -> Health:
    scene, inputs, model = eq.given_scene, eq.inputs, eq.model
    rest = scene.rest_inputs if scene.driven else 0.0
    finer = solve(scene, inputs, model=model.finer())

    def status_at(of_inputs: Scalar, of_loads: Scalar) -> Array:
        values = rest + of_inputs * (inputs - rest)
        there = scene.at(values)
        loads = tuple(load.scaled(of_loads) for load in there.loads)
        there = eqx.tree_at(lambda scene: scene.loads, there, loads)
        status = solve(there, values[: len(scene.actuators)], model=model).status
        return jnp.where(scene.admits(values), status, Status.INADMISSIBLE)

    # one program for both searches, since compiling takes longer than solving
    grown = [True] * bool(scene.inputs) + [False] * bool(scene.loads)
    limits = (
        jax.vmap(
            lambda grow: _limit(lambda factor: status_at(*_either(grow, factor)), inputs.dtype)
        )(jnp.array(grown))
        if grown
        else None
    )
    first, last = (jax.tree.map(lambda x, i=i: x[i], limits) for i in (0, -1))
    return Health(
        eq,
        _independence(eq.scene) if len(scene.actuators) > 1 else None,
        first if scene.inputs else None,
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
    (low, high), status = scan(narrow, bracket, None, length=_PASSES)
    return Limit(jnp.where(status[-1] == Status.CONVERGED, high, low), status[-1])


def _independence(scene: Scene) -> Scalar:
    """Least eigenvalue of the matrix of eq. (20) at rest, scaled to ones on its diagonal."""
    grid = make_grid(scene.edges(), 32, 3)
    sections = scene.sections(grid.X)
    wrenches = [unit_wrench(sections.rest, path) for path in sections.paths]
    wrenches = [
        free_components(w if reach is None else scale(reach, w), scene.free)
        for w, reach in zip(wrenches, sections.reach, strict=True)
    ]
    B = jnp.stack([jnp.stack(jnp.broadcast_arrays(*w)) for w in wrenches])
    stiffness = jnp.stack(jnp.broadcast_arrays(*free_components(sections.stiffness, scene.free)))
    weight = times(sections.flexible, grid.weight)
    K = jnp.einsum("iask,jask,ask,sk->ij", B, B, 1 / stiffness, weight)
    size = jnp.sqrt(jnp.diag(K))
    size = jnp.where(size > 0, size, 1.0)  # a thread without effect: a row of zeros
    return jnp.linalg.eigvalsh(K / (size[:, None] * size[None, :]))[0]
