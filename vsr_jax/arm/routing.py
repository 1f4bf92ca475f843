"""Thread paths: the position $d(X) = (0, d_y, d_z)$ of a thread in the section's frame.

A routing is called as `routing(X)` with a scalar X [m] and returns (d_y, d_z) [m]. Its derivatives
are computed by forward differentiation.
"""

import math
from abc import abstractmethod
from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from ..numerics.component import Vector, Vector3
from ..typing import Scalar, ScalarLike, VectorLike, real
from ..validation import choice, numbers
from .description import Part
from .profile import FunctionOfX, rising_coefficients
from .spline import spline_breakpoints, spline_points, spline_value


class Path(NamedTuple):
    """Position (d_y, d_z) [m] and slope (d_y', d_z') [-] of one thread."""

    y: Array
    z: Array
    slope_y: Array
    slope_z: Array


def thread_tangent(xi: Vector, path: Path) -> Vector3:
    """Tangent of a thread's path in the section's frame (eq. 11): $t_c = k \\times d + u + d'$."""
    kx, ky, kz, ux, uy, uz = xi
    return (
        ux + ky * path.z - kz * path.y,
        uy + path.slope_y - kx * path.z,
        uz + path.slope_z + kx * path.y,
    )


class Routing(Part):
    """The path of one thread through the sections."""

    @abstractmethod
    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        """Position $(d_y, d_z)$ [m] at X [m]."""

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        """Abscissas [m] where a derivative of the path jumps."""
        return ()

    def path(self, X: ScalarLike) -> Path:
        """Position and slope at X [m]."""
        X = real(X)
        (y, z), (slope_y, slope_z) = jax.jvp(self, (X,), (jnp.ones_like(X),))
        return Path(y, z, slope_y, slope_z)


class Parallel(Routing):
    """Parallel to the axis: $d = (0, y, z)$, in metres."""

    y: Scalar = eqx.field(metadata={"unit": "m"})
    z: Scalar = eqx.field(metadata={"unit": "m"})

    def __init__(self, y: ScalarLike, z: ScalarLike):
        self.y = numbers("Parallel.y", y)
        self.z = numbers("Parallel.z", z)

    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        return self.y, self.z


class Linear(Routing):
    """Straight and oblique (eq. 22): $d = (0, y + \\bar y X, z + \\bar z X)$, slopes $\\bar y,
    \\bar z$ [-]."""

    y: Scalar = eqx.field(metadata={"unit": "m"})
    z: Scalar = eqx.field(metadata={"unit": "m"})
    slope_y: Scalar = eqx.field(metadata={"unit": "-"})
    slope_z: Scalar = eqx.field(metadata={"unit": "-"})

    def __init__(
        self, y: ScalarLike, z: ScalarLike, slope_y: ScalarLike = 0.0, slope_z: ScalarLike = 0.0
    ):
        self.y = numbers("Linear.y", y)
        self.z = numbers("Linear.z", z)
        self.slope_y = numbers("Linear.slope_y", slope_y)
        self.slope_z = numbers("Linear.slope_z", slope_z)

    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        return self.y + self.slope_y * X, self.z + self.slope_z * X


class Helix(Routing):
    """Helix (eq. 23): $d = (0, r \\cos\\phi, r \\sin\\phi)$, $\\phi = \\phi_0 \\pm 2 \\pi X / p$,
    $p = 2 \\pi r \\tan\\alpha$.

    **Arguments:**
    - `radius`: $r$ [m], positive.
    - `angle` or `pitch`: the angle $\\alpha$ between path and cross-section [rad], at most $\\pi /
      2$, or the pitch $p$ [m]; exactly one of the two. With `angle` the pitch depends on the
      radius.
    - `phase`: $\\phi_0$ [rad].
    - `hand`: `"right"` rotates from y to z along the arm, `"left"` from z to y.
    """

    radius: Scalar = eqx.field(metadata={"unit": "m"})
    angle: Scalar | None = eqx.field(metadata={"unit": "rad"})
    pitch: Scalar | None = eqx.field(metadata={"unit": "m"})
    phase: Scalar = eqx.field(metadata={"unit": "rad"})
    hand: Literal["right", "left"] = eqx.field(static=True)

    def __init__(
        self,
        radius: ScalarLike,
        angle: ScalarLike | None = None,
        *,
        pitch: ScalarLike | None = None,
        phase: ScalarLike = 0.0,
        hand: Literal["right", "left"] = "right",
    ):
        if (angle is None) == (pitch is None):
            raise ValueError(f"Helix: got angle={angle!r} and pitch={pitch!r}, need one of the two")
        self.radius = numbers("Helix.radius", radius, positive=True)
        self.angle = (
            None if angle is None else numbers("Helix.angle", angle, positive=True, most=1.5708)
        )
        self.pitch = None if pitch is None else numbers("Helix.pitch", pitch, positive=True)
        self.phase = numbers("Helix.phase", phase)
        self.hand = choice("Helix.hand", hand, ("right", "left"))

    @property
    def wavenumber(self) -> Scalar:
        """$\\omega = 2 \\pi / p$ [rad/m], rate of rotation of the path about the axis."""
        if self.pitch is not None:
            return 2 * math.pi / self.pitch
        assert self.angle is not None
        return 1 / (self.radius * jnp.tan(self.angle))

    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        phi = self.phase + (1 if self.hand == "right" else -1) * self.wavenumber * X
        return self.radius * jnp.cos(phi), self.radius * jnp.sin(phi)


class Polynomial(Routing):
    """Polynomial path: $d_y = \\sum_i y_i X^i$, $d_z = \\sum_i z_i X^i$, coefficients in
    ascending order [m^(1-i)]."""

    y: Float[Array, " terms_y"] = eqx.field(metadata={"unit": "m", "powers": True})
    z: Float[Array, " terms_z"] = eqx.field(metadata={"unit": "m", "powers": True})

    def __init__(self, y: VectorLike, z: VectorLike):
        self.y = rising_coefficients("Polynomial.y", y)
        self.z = rising_coefficients("Polynomial.z", z)

    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        return jnp.polyval(self.y[::-1], X), jnp.polyval(self.z[::-1], X)


class Spline(Routing):
    """Cubic not-a-knot spline through at least two points (X, y, z) [m]."""

    X: Float[Array, " points"] = eqx.field(metadata={"unit": "m"})
    y: Float[Array, " points"] = eqx.field(metadata={"unit": "m"})
    z: Float[Array, " points"] = eqx.field(metadata={"unit": "m"})

    def __init__(self, X: VectorLike, y: VectorLike, z: VectorLike):
        self.X = spline_points("Spline.X", X)
        self.y = numbers("Spline.y", y, self.X.shape)
        self.z = numbers("Spline.z", z, self.X.shape)

    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        return spline_value(X, self.X, self.y), spline_value(X, self.X, self.z)

    @property
    def breakpoints(self) -> tuple[Scalar, ...]:
        return spline_breakpoints(self.X)


class Function(Routing):
    """A path given by a function: (d_y, d_z) = `function(X, *parameters)`, with `jax.numpy`.

    **Arguments:**
    - `function`: takes the scalar X [m] and the parameters, returns the pair (d_y, d_z) [m].
    - `parameters`: as for `FunctionOfX`.
    """

    function: FunctionOfX

    def __init__(self, function: Callable[..., tuple[ScalarLike, ScalarLike]], *parameters: PyTree):
        self.function = FunctionOfX("Function", function, *parameters)

    def __call__(self, X: ScalarLike) -> tuple[Scalar, Scalar]:
        y, z = self.function(X)
        return y, z
