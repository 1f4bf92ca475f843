r"""What a design makes small: numbers without unit that look at one scene under several sets of
inputs.

Objectives add up and take factors: `TipError(targets) + 0.1 * Tension(10.0)`. A function of `Arms`
is one too, in `Measure`.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.derivatives import compliance
from ..arm.scene import Scene
from ..models.base import Model, Outcome
from ..numerics.se3 import rotation_vector
from ..solution.equilibrium import Equilibrium
from ..typing import Scalar
from ..validation import concrete, instance, numbers, on_arm, positive, rigid


class Arms(eqx.Module):
    """A scene solved under several sets of inputs.

    **Fields:** `scene`; `inputs`, shape (sets, actuators); `model`; the `outcome` of each set.
    """

    scene: Scene
    inputs: Float[Array, "sets inputs"]
    model: Model
    outcome: Outcome

    def each(self, function: Callable, *of_each: Any) -> Any:
        """`function` of the `Equilibrium` of each set, and of what else there is one of for each,
        with the sets in the first axis."""

        def one(inputs: Array, outcome: Outcome, *more: Any) -> Any:
            return function(Equilibrium(self.scene, inputs, self.model, outcome), *more)

        return jax.vmap(one)(self.inputs, self.outcome, *of_each)


class Objective(eqx.Module):
    """A number without unit to be made small."""

    @abstractmethod
    def __call__(self, arms: Arms) -> Scalar:
        """Its value."""

    def check(self, sets: int, longest: Any) -> None:
        """Refuses what does not fit as many sets of inputs, or an arm that is no longer than
        `longest` [m]."""

    def __add__(self, other: "Objective") -> "Objective":
        return Sum((self, instance("objective", other, Objective, "another objective to add")))

    def __mul__(self, factor: Any) -> "Objective":
        return Weighted(numbers("objective's factor", factor), self)

    __rmul__ = __mul__


class Sum(Objective):
    """$\\sum_i f_i$."""

    parts: tuple[Objective, ...]

    def __call__(self, arms: Arms) -> Scalar:
        return sum((part(arms) for part in self.parts), start=jnp.zeros((), arms.inputs.dtype))

    def check(self, sets: int, longest: Any) -> None:
        for part in self.parts:
            part.check(sets, longest)


class Weighted(Objective):
    """$w f$."""

    factor: Scalar
    part: Objective

    def __call__(self, arms: Arms) -> Scalar:
        return self.factor * self.part(arms)

    def check(self, sets: int, longest: Any) -> None:
        self.part.check(sets, longest)


class Measure(Objective):
    """Any function of `Arms`, as `Measure(lambda arms: jnp.mean(arms.each(lambda eq: eq.tip[2,
    3])))`."""

    function: Callable = eqx.field(static=True)

    def __call__(self, arms: Arms) -> Scalar:
        return self.function(arms)


class TipError(Objective):
    r"""Tips at their targets: the mean of $|r_j(L) - r_j^*|^2 / L^2$ over the sets; of poses with
    the square of the angle [rad] added.

    **Arguments:** `targets`: places [m], shape (sets, 3), or poses, shape (sets, 4, 4).
    """

    targets: Array

    def __init__(self, targets: Any):
        self.targets = numbers("TipError.targets", targets, None)
        if self.targets.shape[1:] not in ((3,), (4, 4)):
            raise ValueError(
                f"TipError.targets: got shape {self.targets.shape}, need (sets, 3) or (sets, 4, 4)"
            )
        if self.targets.ndim == 3:
            for i, pose in enumerate(self.targets):
                rigid(f"TipError.targets[{i}]", pose)

    def __call__(self, arms: Arms) -> Scalar:
        return jnp.mean(arms.each(_missed, self.targets))

    def check(self, sets: int, longest: Any) -> None:
        _one_a_set("TipError.targets", self.targets, sets)


def _missed(eq: Equilibrium, target: Array) -> Scalar:
    tip, posed = eq.tip, target.shape == (4, 4)
    place = target[:3, 3] if posed else target
    square = jnp.sum((tip[:3, 3] - place) ** 2) / eq.scene.rod.length**2
    return (
        square + jnp.sum(rotation_vector(target[:3, :3].T @ tip[:3, :3]) ** 2) if posed else square
    )


class CurveError(Objective):
    r"""Arms along curves: the mean of $|r_j(X_k) - r_{jk}^*|^2 / L^2$ over the sets and points.

    A tip does not tell where along the arm it was led astray. With `local` each point counts by $(L
    / X_k)^4$: a curvature that is wrong moves a point by the square of its distance, so all
    distances speak alike, and the base is found before the tip. Use it to find a routing from far
    off; at an exact fit it has the same minimum.

    **Arguments:**
    - `points`: where the axis is wanted [m], shape (points, 3) for all sets or (sets, points, 3).
    - `X`: abscissas [m] of the points, on the arm; with `local` beyond its base; evenly spaced up
      to the tip by default, base left out.
    - `local`: whether points near the base count more.
    """

    points: Array
    X: Float[Array, " points"] | None
    local: bool = eqx.field(static=True)

    def __init__(self, points: Any, X: Any = None, *, local: bool = False):
        self.local = local
        self.points = numbers("CurveError.points", points, None)
        if self.points.ndim not in (2, 3) or self.points.shape[-1] != 3:
            raise ValueError(
                f"CurveError.points: got shape {self.points.shape}, need (points, 3) or (sets, "
                f"points, 3)"
            )
        self.X = (
            None
            if X is None
            else numbers("CurveError.X", X, self.points.shape[-2:-1], least=0.0, positive=local)
        )

    def __call__(self, arms: Arms) -> Scalar:
        many, length = self.points.shape[-2], arms.scene.rod.length
        X = length * jnp.arange(1, many + 1) / many if self.X is None else self.X
        points = jnp.broadcast_to(self.points, (arms.inputs.shape[0], many, 3))
        missed = (
            arms.each(lambda eq, wanted: jnp.sum((eq.position(X) - wanted) ** 2, axis=-1), points)
            / length**2
        )
        return jnp.mean(missed * (length / X) ** 4 if self.local else missed)

    def check(self, sets: int, longest: Any) -> None:
        if self.points.ndim == 3:
            _one_a_set("CurveError.points", self.points, sets)
        if self.X is not None:
            on_arm("CurveError.X", self.X, longest)


class Workspace(Objective):
    r"""A large workspace: $-\frac1{2n} \sum \log(\lambda_i / L^2 + \delta)$ of the n greatest
    eigenvalues of the covariance of the tips.

    **Arguments:** `dimensions`: n, 3 for a volume, 2 for tips that move in a surface, 1 for a line.
    """

    dimensions: int = eqx.field(static=True)

    def __init__(self, dimensions: int = 3):
        if dimensions not in (1, 2, 3):
            raise ValueError(f"Workspace.dimensions: got {dimensions!r}, need 1, 2 or 3")
        self.dimensions = dimensions

    def __call__(self, arms: Arms) -> Scalar:
        tips = arms.each(lambda eq: eq.tip[:3, 3]) / arms.scene.rod.length
        off = tips - jnp.mean(tips, axis=0)
        spread = jnp.linalg.eigvalsh(off.T @ off / tips.shape[0])[-self.dimensions :]
        return -0.5 * jnp.mean(jnp.log(spread + jnp.finfo(tips.dtype).eps))

    def check(self, sets: int, longest: Any) -> None:
        if sets <= self.dimensions:
            raise ValueError(
                f"Workspace: got {sets} sets of inputs, need more than {self.dimensions} to span "
                f"so many dimensions"
            )


class TipCompliance(Objective):
    r"""A stiff tip: $\log \sqrt{\operatorname{tr}(C_F^T C_F)}$ of the displacements $C_F$ [m] by a
    force of 1 N, the mean over the sets.

    **Arguments:** `direction`: only forces in this direction [-], a vector in space; any by
    default.
    """

    direction: Float[Array, "3"] | None

    def __init__(self, direction: Any = None):
        self.direction = (
            None if direction is None else numbers("TipCompliance.direction", direction, (3,))
        )
        known = None if self.direction is None else concrete(self.direction)
        if known is not None and not np.any(known):
            raise ValueError("TipCompliance.direction: got zero, need a vector that is not")

    def __call__(self, arms: Arms) -> Scalar:
        moved = arms.each(compliance)[:, 3:, 3:]
        if self.direction is not None:
            moved = moved @ (self.direction / jnp.linalg.norm(self.direction))[:, None]
        return jnp.mean(0.5 * jnp.log(jnp.sum(moved**2, axis=(1, 2))))


class Tension(Objective):
    r"""Small forces: the mean of $(\tau_i / \tau_0)^2$ over threads and sets.

    **Arguments:** `scale`: $\tau_0$ [N].
    """

    scale: float = eqx.field(static=True)

    def __init__(self, scale: float):
        self.scale = positive("Tension.scale", scale)

    def __call__(self, arms: Arms) -> Scalar:
        return jnp.mean((arms.each(lambda eq: eq.forces) / self.scale) ** 2)


def _one_a_set(name: str, array: Array, sets: int) -> None:
    if array.shape[0] != sets:
        raise ValueError(
            f"{name}: got {array.shape[0]} of them for {sets} sets of inputs, need one a set"
        )
