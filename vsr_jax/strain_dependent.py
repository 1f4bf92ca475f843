r"""The model of eq. 19-21: the basis $B_q = \Sigma^{-1} B_\tau(\xi)$ makes $q = \tau$, and the strain is solved at each node alone."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._check import choice, count
from .balance import solve_balance
from .component import Vector
from .kinematics import ORDERS
from .model import Outcome, SteppedModel, classify, rest_where_failed
from .scene import Scene


class StrainDependent(SteppedModel):
    r"""Strain from the balance of each cross-section, $\xi = \Sigma^{-1} B_\tau(\xi) \tau + \xi^*$ (eq. 21).

    Exact in the strain; the only error is that of the pose steps.

    **Arguments:**
    - `steps`: steps along the arm, shared evenly by its smooth pieces.
    - `order`: order of the steps, 2, 4 (Zanna's, eq. 5) or 6, with one, two or three nodes each.
    """

    steps: int = eqx.field(static=True)
    order: int = eqx.field(static=True)

    def __init__(self, steps: int = 32, order: int = 6):
        self.steps = count("StrainDependent.steps", steps)
        self.order = choice("StrainDependent.order", order, ORDERS)

    def solve(self, scene: Scene, inputs: Float[Array, " inputs"]) -> Outcome:
        sections = scene.sections(self.grid(scene).X)
        tau = scene.forces(inputs)
        solution = solve_balance(sections, tau)
        status = classify(solution.xi, sections, tau, solution.balanced, solution.definite)
        return Outcome(rest_where_failed(status, solution.xi, sections), status, solution.steps)

    def node_strain(self, scene: Scene, inputs: Float[Array, " inputs"], state: Vector) -> Vector:
        return state

    def coordinates(self, scene: Scene, inputs: Float[Array, " inputs"], state: Vector) -> Float[Array, " dofs"]:
        return jnp.array(scene.forces(inputs), inputs.dtype)

    def strain(self, scene: Scene, inputs: Float[Array, " inputs"], state: Any, X: Float[Array, " stations"]) -> Vector:
        return solve_balance(scene.sections(X), scene.forces(inputs)).xi
