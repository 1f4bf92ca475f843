r"""Objectives of a design: dimensionless functions of one scene solved for several sets of inputs.

Objectives can be added and scaled: `TipError(targets) + 0.1 * Tension(10.0)`. `Measure` makes an
objective of a function of `Arms`.
"""

from abc import abstractmethod
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.arms import Arms
from ..analysis.derivatives import compliance
from ..numerics.se3 import rotation_vector
from ..solution.equilibrium import Equilibrium
from ..typing import ArrayLike, Scalar, ScalarLike
from ..validation import concrete, instance, numbers, on_arm, positive, rigid


class Objective(eqx.Module):
    """A dimensionless number to be minimised."""

    @abstractmethod
    def __call__(self, arms: Arms) -> Scalar:
        """Its value."""

    def check(self, sets: int, longest: Scalar) -> None:
        """Validates the objective for a number of sets of inputs and an arm of at most the length
        `longest` [m].

        **Raises:** `ValueError` for another number of targets, and for points beyond the arm.
        """

    def __add__(self, other: "Objective") -> "Objective":
        return Sum((self, instance("objective", other, Objective, "another objective to add")))

    def __mul__(self, factor: ScalarLike) -> "Objective":
        return Weighted(numbers("objective's factor", factor), self)

    __rmul__ = __mul__


class Sum(Objective):
    """$\\sum_i f_i$."""

    parts: tuple[Objective, ...]

    def __call__(self, arms: Arms) -> Scalar:
        return sum((part(arms) for part in self.parts), start=jnp.zeros((), arms.inputs.dtype))

    def check(self, sets: int, longest: Scalar) -> None:
        for part in self.parts:
            part.check(sets, longest)


class Weighted(Objective):
    """$w f$."""

    factor: Scalar
    part: Objective

    def __call__(self, arms: Arms) -> Scalar:
        return self.factor * self.part(arms)

    def check(self, sets: int, longest: Scalar) -> None:
        self.part.check(sets, longest)


class Measure(Objective):
    """A function of `Arms` as an objective.

        Measure(lambda arms: jnp.mean(arms.each(lambda eq: eq.tip[2, 3])))

    **Arguments:** `function`: of `Arms`, returns a dimensionless number.
    """

    function: Callable = eqx.field(static=True)

    def __call__(self, arms: Arms) -> Scalar:
        return self.function(arms)


class TipError(Objective):
    r"""Error of the tip: the mean of $|r_j(L) - r_j^*|^2 / L^2$ over the sets; for poses plus the
    squared angle [rad^2].

    **Arguments:** `targets`: positions [m], shape (sets, 3), or poses, shape (sets, 4, 4).
    """

    targets: Array

    def __init__(self, targets: ArrayLike):
        self.targets = numbers("TipError.targets", targets, None)
        if self.targets.shape[1:] not in ((3,), (4, 4)):
            raise ValueError(
                f"TipError.targets: got shape {self.targets.shape}, need (sets, 3) or (sets, 4, 4)"
            )
        if self.targets.ndim == 3:
            for i, pose in enumerate(self.targets):
                rigid(f"TipError.targets[{i}]", pose)

    def __call__(self, arms: Arms) -> Scalar:
        return jnp.mean(arms.each(_squared_error, self.targets))

    def check(self, sets: int, longest: Scalar) -> None:
        _check_sets("TipError.targets", self.targets, sets)


def _squared_error(eq: Equilibrium, target: Array) -> Scalar:
    tip, is_pose = eq.tip, target.shape == (4, 4)
    position = target[:3, 3] if is_pose else target
    square = jnp.sum((tip[:3, 3] - position) ** 2) / eq.scene.rod.length**2
    if not is_pose:
        return square
    return square + jnp.sum(rotation_vector(target[:3, :3].T @ tip[:3, :3]) ** 2)


class CurveError(Objective):
    r"""Error of the axis: the mean of $|r_j(X_k) - r_{jk}^*|^2 / L^2$ over the sets and points.

    With `local` each point has the weight $(L / X_k)^4$. An error of curvature moves a point by the
    square of its distance from the base, so this weight makes the errors at all distances
    comparable, and the routing is found from the base towards the tip. Use it for poor initial
    routings; an exact fit is a minimum of both.

    **Arguments:**
    - `points`: target positions of the axis [m], shape (points, 3) for all sets or (sets, points,
      3).
    - `X`: abscissas [m] of the points, on the arm, with `local` greater than 0; by default evenly
      spaced from the base (excluded) to the tip.
    - `local`: whether to weight points near the base more.
    """

    points: Array
    X: Float[Array, " points"] | None
    local: bool = eqx.field(static=True)

    def __init__(
        self,
        points: ArrayLike,
        X: ArrayLike | None = None,
        *,
        local: bool = False,
    ):
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
        many = self.points.shape[-2]
        points = jnp.broadcast_to(self.points, (arms.inputs.shape[0], many, 3))

        def square(eq: Equilibrium, target: Array) -> Array:
            length = eq.scene.rod.length
            X = length * jnp.arange(1, many + 1) / many if self.X is None else self.X
            found = jnp.sum((eq.position(X) - target) ** 2, axis=-1) / length**2
            return found * (length / X) ** 4 if self.local else found

        return jnp.mean(arms.each(square, points))

    def check(self, sets: int, longest: Scalar) -> None:
        if self.points.ndim == 3:
            _check_sets("CurveError.points", self.points, sets)
        if self.X is not None:
            on_arm("CurveError.X", self.X, longest)


class Workspace(Objective):
    r"""A large workspace: $-\frac1{2n} \sum \log(\lambda_i / L^2 + \delta)$ of the n greatest
    eigenvalues of the covariance of the tips.

    **Arguments:** `dimensions`: n, 3 for a volume, 2 for tips on a surface, 1 for tips on a line.
    """

    dimensions: int = eqx.field(static=True)

    def __init__(self, dimensions: int = 3):
        if dimensions not in (1, 2, 3):
            raise ValueError(f"Workspace.dimensions: got {dimensions!r}, need 1, 2 or 3")
        self.dimensions = dimensions

    def __call__(self, arms: Arms) -> Scalar:
        tips = arms.each(lambda eq: eq.tip[:3, 3] / eq.scene.rod.length)
        off = tips - jnp.mean(tips, axis=0)
        spread = jnp.linalg.eigvalsh(off.T @ off / tips.shape[0])[-self.dimensions :]
        return -0.5 * jnp.mean(jnp.log(spread + jnp.finfo(tips.dtype).eps))

    def check(self, sets: int, longest: Scalar) -> None:
        if sets <= self.dimensions:
            raise ValueError(
                f"Workspace: got {sets} sets of inputs, need more than {self.dimensions}, the "
                f"dimensions"
            )


class TipCompliance(Objective):
    r"""Compliance of the tip: the mean of $\log \sqrt{\operatorname{tr}(C_F^T C_F)}$ over the sets,
    where $C_F$ [m] are the displacements for forces of 1 N.

    **Arguments:** `direction`: only forces in this direction [-], shape (3,); all directions by
    default.
    """

    direction: Float[Array, "3"] | None

    def __init__(self, direction: ArrayLike | None = None):
        self.direction = (
            None if direction is None else numbers("TipCompliance.direction", direction, (3,))
        )
        known = None if self.direction is None else concrete(self.direction)
        if known is not None and not np.any(known):
            raise ValueError("TipCompliance.direction: got zero, need a nonzero vector")

    def __call__(self, arms: Arms) -> Scalar:
        moved = arms.each(compliance)[:, 3:, 3:]
        if self.direction is not None:
            moved = moved @ (self.direction / jnp.linalg.norm(self.direction))[:, None]
        return jnp.mean(0.5 * jnp.log(jnp.sum(moved**2, axis=(1, 2))))


class Tension(Objective):
    r"""Thread forces: the mean of $(\tau_i / \tau_0)^2$ over threads and sets.

    **Arguments:** `scale`: $\tau_0$ [N].
    """

    scale: float = eqx.field(static=True)

    def __init__(self, scale: float):
        self.scale = positive("Tension.scale", scale)

    def __call__(self, arms: Arms) -> Scalar:
        return jnp.mean((arms.each(lambda eq: eq.forces) / self.scale) ** 2)


def _check_sets(name: str, array: Array, sets: int) -> None:
    if array.shape[0] != sets:
        raise ValueError(
            f"{name}: got {array.shape[0]} of them for {sets} sets of inputs, need one per set"
        )
